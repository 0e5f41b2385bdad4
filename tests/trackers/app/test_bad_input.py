"""What a person reads who gives `jaxfilters track hand-depth` something that cannot be used."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.app.cli import main

pytestmark = pytest.mark.usefixtures("fake_hand_depth")
FRAMES, ROWS, COLS = 5, 24, 32
GOOD = {
    "depth_mm": np.full((FRAMES, ROWS, COLS), 600, np.uint16),
    "K": np.asarray([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]),
    "t_us": np.arange(FRAMES) * 33_333,
}


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


@pytest.fixture
def track(tmp_path, capfd):
    """Runs the command; gives its exit code and its last line on standard error."""

    def run(recording, *options):
        arguments = ["track", "hand-depth", recording, "--out", tmp_path / "out", "--no-video", *options]
        code = main([str(argument) for argument in arguments])
        lines = capfd.readouterr().err.splitlines()
        assert not any("Traceback" in line for line in lines)
        return code, lines[-1]

    return run


@pytest.fixture
def npz(tmp_path):
    """Writes a good recording with some arrays replaced, or left out where None."""

    def write(**changes):
        arrays = {name: array for name, array in (GOOD | changes).items() if array is not None}
        np.savez(tmp_path / "a.npz", **arrays)
        return tmp_path / "a.npz"

    return write


WRONG_ARRAYS = {
    "a single image": (
        {"depth_mm": GOOD["depth_mm"][0]},
        "depth_mm must be (T, H, W) uint16; got (24, 32) uint16.",
    ),
    "metres with NaN": (
        {"depth_mm": np.full((FRAMES, ROWS, COLS), np.nan, np.float32)},
        "depth_mm must be (T, H, W) uint16; got (5, 24, 32) float32.",
    ),
    "no frames": (
        {"depth_mm": GOOD["depth_mm"][:0], "t_us": None},
        "expected at least one frame; times have shape (0,).",
    ),
    "no intrinsics": ({"K": None}, "['K'] missing; expected depth_mm (T, H, W) uint16 and K (3, 3)."),
    "NaN in the intrinsics": ({"K": GOOD["K"] * np.nan}, "K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; got [[nan"),
    "focal length 0": ({"K": np.diag([0.0, 30, 1])}, "focal must be positive, in pixels; got [ 0. 30.]."),
    "a projection matrix": ({"K": np.eye(3, 4)}, "K must have shape (3, 3); got (3, 4)."),
    "one time too few": ({"t_us": GOOD["t_us"][1:]}, "t_us: expected 5 times, one a frame; got shape (4,)."),
    "times that stand still": (
        {"t_us": np.asarray([0, 1, 1, 2, 3]) * 10**5},
        "times must increase strictly; frame 1 is at 0.100000 s, frame 2 at 0.100000 s.",
    ),
    "a time that is NaN": ({"t_us": np.asarray([0, 1, np.nan, 3, 4])}, "times must be finite; frame 2 is not."),
    "joints of another hand": ({"joints_mm": np.zeros((5, 16, 3))}, "joints must be (5, 21, 3); got (5, 16, 3)."),
}


@pytest.mark.parametrize("what", WRONG_ARRAYS)
def test_wrong_arrays_are_one_clear_line(what, npz, track, tmp_path):
    changes, message = WRONG_ARRAYS[what]
    code, line = track(npz(**changes))
    assert code == 2
    assert line.startswith(f"jaxfilters: error: {tmp_path / 'a.npz'}: ")
    assert message in line
    assert not (tmp_path / "out").exists()


WRONG_OPTIONS = {
    "--particles 0": "num_particles must be at least 1; got 0.",
    "--particles -5": "num_particles must be at least 1; got -5.",
    "--stride 0": "stride must be at least 1; got 0.",
    "--scale 3": "scale must be between 0.5 and 2 (1 is the average adult); got 3.0.",
    "--scale nan": "scale must be between 0.5 and 2 (1 is the average adult); got nan.",
}


@pytest.mark.parametrize("options", WRONG_OPTIONS)
def test_wrong_options_are_one_clear_line(options, npz, track, tmp_path):
    code, line = track(npz(), *options.split())
    assert (code, line) == (2, f"jaxfilters: error: {WRONG_OPTIONS[options]}")
    assert not (tmp_path / "out").exists()


def test_paths_that_are_no_recording_are_named(track, tmp_path):
    assert track("nowhere.npz") == (2, "jaxfilters: error: nowhere.npz: no such file or folder.")
    assert track(tmp_path) == (2, f"jaxfilters: error: {tmp_path}: no PNG images in it.")
    (tmp_path / "notes.npz").write_text("not an archive")
    code, line = track(tmp_path / "notes.npz")
    assert code == 2
    assert "notes.npz: not a complete .npz file" in line


@pytest.fixture
def folder(tmp_path):
    """Five images without intrinsics."""
    (tmp_path / "images").mkdir()
    for i in range(FRAMES):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), GOOD["depth_mm"][i])
    return tmp_path / "images"


def test_a_folder_needs_its_intrinsics(folder, track):
    code, line = track(folder)
    assert code == 2
    assert "camera.json: missing; expected" in line
    (folder / "camera.json").write_text('{"fx": 30, "fy": 30, "cx": 16}')
    code, line = track(folder)
    assert code == 2
    assert "camera.json: intrinsics missing: ['cy']" in line


@pytest.mark.system
def test_a_truncated_image_in_the_first_frames_loses_nothing_before_it(folder, track, tmp_path):
    (folder / "camera.json").write_text('{"fx": 30, "fy": 30, "cx": 16, "cy": 12}')
    (folder / "3.png").write_bytes((folder / "3.png").read_bytes()[:40])
    code, line = track(folder)
    assert code == 2
    kept = f"the first 3 frames are in {tmp_path / 'out' / 'track.csv'}"
    assert line == f"jaxfilters: error: {folder / '3.png'}: not a complete PNG image (truncated or damaged); {kept}."


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_disk_that_is_full_from_the_start_is_named(npz, track, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "track.csv").symlink_to("/dev/full")
    code, line = track(npz())
    assert code == 2
    assert line.endswith("out/track.csv: no space left on the device; nothing was kept.")


@pytest.mark.system
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("name", ["report.json", "summary.png", "overlay.mp4"])
def test_a_disk_that_fills_at_the_end_keeps_the_run_for_a_second_try(npz, tmp_path, capsys, name):
    out = tmp_path / "Results"
    out.mkdir()
    (out / name).symlink_to("/dev/full")
    arguments = ["track", "hand-depth", str(npz()), "--out", str(out)]
    assert main(arguments) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f"jaxfilters: error: cannot write {out / name}")
    assert line.endswith(f"the first {FRAMES} frames are kept in {out / 'checkpoint'}; continue with --resume.")
    (out / name).unlink(missing_ok=True)
    assert main([*arguments, "--resume"]) == 0
    assert (out / name).stat().st_size > 0


def test_results_cannot_go_where_a_file_is(npz, track, tmp_path):
    (tmp_path / "out").touch()
    code, line = track(npz())
    assert code == 2
    assert line.startswith(f"jaxfilters: error: cannot write into {tmp_path / 'out'}")
