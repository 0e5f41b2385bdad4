import gc
import json
import os
import warnings
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.npz import ArrayStream


def expected_metres(depth_mm):
    return np.where(depth_mm > 0, depth_mm / np.float32(1000), np.nan)


@pytest.mark.parametrize("fixture", ["png_folder", "npz_file"])
def test_frames_times_and_camera_are_those_that_were_written(fixture, request, depth_mm, times_us, camera):
    sequence = open_depth(request.getfixturevalue(fixture))
    assert len(sequence) == len(depth_mm)
    np.testing.assert_array_equal(np.stack(list(sequence)), expected_metres(depth_mm))
    np.testing.assert_allclose(sequence.times_s, times_us * 1e-6, atol=1e-9)
    np.testing.assert_array_equal(sequence.camera.matrix(), camera.matrix())
    assert sequence.camera.shape == camera.shape
    assert sequence[0].dtype == np.float32


def test_frames_of_an_npz_can_be_read_in_any_order(npz_file, depth_mm):
    sequence = open_depth(npz_file)
    for i in (7, 3, 3, 39, 0):
        np.testing.assert_array_equal(sequence[i], expected_metres(depth_mm[i]))


def test_folder_and_npz_of_one_recording_have_one_fingerprint(png_folder, npz_file, tmp_path, depth_mm, times_us):
    fingerprint = open_depth(png_folder).fingerprint()
    assert fingerprint == open_depth(npz_file).fingerprint()
    K = [[30.5, 0, 15.25], [0, 31.0, 11.5], [0, 0, 1]]
    np.savez(tmp_path / "other.npz", depth_mm=depth_mm, t_us=times_us, K=K)
    assert fingerprint != open_depth(tmp_path / "other.npz").fingerprint()


def test_true_joints_come_along_in_metres(tmp_path, depth_mm, camera):
    joints_mm = np.random.default_rng(0).normal(500, 50, (len(depth_mm), 21, 3)).astype(np.float32)
    np.savez(tmp_path / "a.npz", depth_mm=depth_mm, K=camera.matrix(), joints_mm=joints_mm)
    np.testing.assert_allclose(open_depth(tmp_path / "a.npz").joints, joints_mm / 1000, rtol=1e-6)
    np.savez(tmp_path / "a.npz", depth_mm=depth_mm, K=camera.matrix(), joints_mm=joints_mm[:, :20])
    with pytest.raises(InputError, match=r"joints must be \(40, 21, 3\); got \(40, 20, 3\)"):
        open_depth(tmp_path / "a.npz")


def write_folder(folder, names, settings):
    folder.mkdir()
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((4, 6), 500 + i, np.uint16))
    (folder / "camera.json").write_text(json.dumps(settings))
    return folder


INTRINSICS = {"fx": 5, "fy": 5, "cx": 2, "cy": 2}


@pytest.mark.parametrize(
    ("names", "settings", "times_s"),
    [
        (["a.png", "b.png", "c.png"], {}, [0, 1 / 30, 2 / 30]),
        (["a.png", "b.png", "c.png"], {"fps": 10}, [0, 0.1, 0.2]),
        (["8.png", "9.png", "11.png"], {"fps": 10}, [0.8, 0.9, 1.1]),
        (["33000.png", "66000.png", "100000.png"], {"fps": 10}, [0.033, 0.066, 0.1]),
        (["8.png", "9.png", "11.png"], {"timestamps_us": [5, 1000, 2000]}, [5e-6, 1e-3, 2e-3]),
    ],
)
def test_times_come_from_the_json_the_names_or_the_frame_rate(tmp_path, names, settings, times_s):
    sequence = open_depth(write_folder(tmp_path / "f", names, INTRINSICS | settings))
    np.testing.assert_allclose(sequence.times_s, times_s, atol=1e-12)
    np.testing.assert_allclose([frame[0, 0] for frame in sequence], [0.5, 0.501, 0.502], rtol=1e-6)


@pytest.mark.parametrize(
    ("names", "settings", "frames"),
    [
        (["a.png", "b.png", "c.png"], {"fps": 10}, [0, 1, 2]),
        (["8.png", "9.png", "11.png"], {"fps": 10}, [8, 9, 11]),
        (["33000.png", "66000.png", "100000.png"], {}, [0, 1, 2]),
        (["8.png", "9.png", "11.png"], {"timestamps_us": [5, 1000, 2000]}, [8, 9, 11]),
    ],
)
def test_a_given_frame_rate_goes_before_what_a_recording_says_of_its_times(tmp_path, npz_file, names, settings, frames):
    sequence = open_depth(write_folder(tmp_path / "f", names, INTRINSICS | settings), fps=60.0)
    np.testing.assert_allclose(sequence.times_s, np.asarray(frames) / 60)
    times_s = open_depth(npz_file, fps=60.0).times_s
    np.testing.assert_allclose(times_s, np.arange(len(times_s)) / 60)


def test_matrix_and_depth_scale_of_the_json(tmp_path):
    K = [[5, 0, 2], [0, 6, 1], [0, 0, 1]]
    sequence = open_depth(write_folder(tmp_path / "f", ["0.png"], {"K": K, "depth_scale": 5000}))
    np.testing.assert_array_equal(sequence.camera.matrix(), K)
    assert sequence[0][0, 0] == np.float32(0.1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fx": 5, "fy": 5, "cx": 2}, r"camera.json: intrinsics missing: \['cy'\]"),
        ({"K": [[5, 0, 2], [0, 5, 2]]}, r"K must have shape \(3, 3\); got \(2, 3\)"),
        ({"K": "nonsense"}, "could not convert string"),
        (INTRINSICS | {"fx": -5}, "focal must be positive"),
        (INTRINSICS | {"depth_scal": 5000}, r"unknown entries \['depth_scal'\]"),
        (INTRINSICS | {"depth_scale": 0}, "depth_scale must be positive units per metre; got 0"),
        (INTRINSICS | {"fps": "fast"}, "fps must be positive; got 'fast'"),
        (INTRINSICS | {"timestamps_us": [1, 2]}, r"expected 3 times, one a frame; got shape \(2,\)"),
        (INTRINSICS | {"timestamps_us": [10, 30, 20]}, "times must increase strictly; frame 1 is at .* frame 2 at"),
        (INTRINSICS | {"timestamps_us": [10, None, 20]}, "frame 1 is not"),
        ([1, 2], "expected .*; got a list"),
    ],
)
def test_wrong_settings_are_named(tmp_path, settings, message):
    folder = write_folder(tmp_path / "f", ["a.png", "b.png", "c.png"], settings)
    with pytest.raises(InputError, match=message):
        open_depth(folder)


def test_settings_that_are_missing_or_no_json(png_folder):
    (png_folder / "camera.json").write_text("{fx: 3")
    with pytest.raises(InputError, match=r"camera.json: not JSON"):
        open_depth(png_folder)
    (png_folder / "camera.json").unlink()
    with pytest.raises(InputError, match=r"camera.json: missing; expected"):
        open_depth(png_folder)


def test_a_truncated_image_is_named_and_its_neighbours_still_read(png_folder, depth_mm, capfd):
    victim = sorted(png_folder.glob("*.png"))[17]
    victim.write_bytes(victim.read_bytes()[:700])
    sequence = open_depth(png_folder)
    with pytest.raises(InputError, match=rf"{victim.name}: not a complete PNG image"):
        sequence[17]
    np.testing.assert_array_equal(sequence[18], expected_metres(depth_mm[18]))
    capfd.readouterr()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((24, 32), np.uint8), r"expected one 16-bit channel; got shape \(24, 32\), uint8"),
        (np.zeros((24, 32, 3), np.uint16), r"expected one 16-bit channel; got shape \(24, 32, 3\)"),
        (np.zeros((24, 31), np.uint16), r"expected \(24, 32\) pixels like the first image; got \(24, 31\)"),
    ],
)
def test_images_of_another_kind_are_refused(png_folder, image, message):
    cv2.imwrite(str(sorted(png_folder.glob("*.png"))[2]), image)
    with pytest.raises(InputError, match=message):
        open_depth(png_folder)[2]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"K": None}, r"\['K'\] missing; expected depth_mm"),
        ({"depth_mm": None}, r"\['depth_mm'\] missing"),
        ({"depth_mm": np.zeros((40, 24, 32), np.float32)}, r"must be \(T, H, W\) uint16; got \(40, 24, 32\) float32"),
        ({"depth_mm": np.zeros((24, 32), np.uint16)}, r"must be \(T, H, W\) uint16; got \(24, 32\) uint16"),
        ({"depth_mm": np.zeros((0, 24, 32), np.uint16), "t_us": np.zeros(0)}, "expected at least one frame"),
        ({"depth_mm": np.zeros((32, 24, 40), np.uint16).T}, "uint16 in Fortran order"),
        ({"t_us": np.arange(39)}, r"t_us: expected 40 times, one a frame; got shape \(39,\)"),
        ({"t_us": np.arange(40)[::-1]}, "times must increase strictly; frame 0 "),
        ({"K": np.full((3, 3), np.nan)}, "K must be"),
        ({"K": np.eye(4)}, r"K must have shape \(3, 3\); got \(4, 4\)"),
    ],
)
def test_wrong_arrays_are_named(tmp_path, depth_mm, times_us, camera, arrays, message):
    good = {"depth_mm": depth_mm, "t_us": times_us, "K": camera.matrix()}
    np.savez(tmp_path / "a.npz", **{name: array for name, array in (good | arrays).items() if array is not None})
    with pytest.raises(InputError, match=message):
        open_depth(tmp_path / "a.npz")


def test_a_truncated_npz_is_refused(npz_file):
    npz_file.write_bytes(npz_file.read_bytes()[:-500])
    with pytest.raises(InputError, match=r"recording.npz: not a complete .npz file"):
        open_depth(npz_file)


def test_a_damaged_frame_in_an_npz_is_named(npz_file):
    with zipfile.ZipFile(npz_file) as archive:
        info = archive.getinfo("depth_mm.npy")
    content = bytearray(npz_file.read_bytes())
    middle = info.header_offset + info.compress_size // 2
    content[middle : middle + 400] = bytes(400)
    npz_file.write_bytes(content)
    sequence = open_depth(npz_file)
    sequence[0]
    with pytest.raises(InputError, match=r"recording.npz: not a complete .npz file \(frame \d+ of depth_mm: "):
        list(sequence)


def test_paths_that_are_no_recording(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        open_depth(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no PNG images"):
        open_depth(tmp_path)
    (tmp_path / "clip.mp4").touch()
    with pytest.raises(InputError, match=r"expected a folder of PNG images or an .npz file, got suffix '.mp4'"):
        open_depth(tmp_path / "clip.mp4")


@pytest.mark.data
def test_a_real_recording_opens_with_its_truth(data_dir):
    sequence = open_depth(data_dir / "hpx_hand_rgbd" / "hpx.npz")
    assert (len(sequence), sequence.camera.shape) == (18, (480, 640))
    # The wrist-to-index length of the hand in it, from the description of the recording: 94.3 +- 3.8 mm.
    lengths = np.linalg.norm(sequence.joints[:, 5] - sequence.joints[:, 0], axis=-1)
    assert abs(lengths.mean() - 0.0943) < 0.0038
    observed = sequence[0][np.isfinite(sequence[0])]
    assert 0.3 < observed.min() < np.median(observed) < 0.9


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs the list of open files that Linux keeps")
def test_a_recording_that_is_left_in_the_middle_leaves_no_file_open(tmp_path):
    """Even within a cycle of references, as the traceback of an error makes one."""
    np.savez(tmp_path / "a.npz", depth=np.ones((3, 4, 5), np.float32))
    stream = ArrayStream(tmp_path / "a.npz", "depth", "expected depth images")
    stream.read(0)
    descriptors = lambda: [os.readlink(one) for one in Path("/proc/self/fd").iterdir() if one.exists()]
    assert any(name.endswith("a.npz") for name in descriptors())
    cycle = [stream]
    cycle.append(cycle)
    del stream, cycle
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        gc.collect()
    assert not caught
    assert not any(name.endswith("a.npz") for name in descriptors())
