"""`jaxfilters track fingertips` from end to end: a rendered hand as a video file, its outputs, and wrong input."""

import csv
import json

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.models.synthetic.desk_hand import desk_video
from jaxfilters.models.synthetic.strokes import drawn, tracked
from jaxfilters.trackers.app import cli, stream
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.output_folder import OutputFolder
from jaxfilters.trackers.fingertips.command import recogniser_of
from jaxfilters.trackers.fingertips.events import ROTATE, SYMBOL, Event, Stroke
from jaxfilters.trackers.fingertips.input import DemoHand, DepthVideo, LiveHands, shown
from jaxfilters.trackers.fingertips.pictures import FingertipPictures, in_words
from jaxfilters.trackers.fingertips.state import HandReport
from jaxfilters.trackers.fingertips.table import TIP_TABLE, tip_rows
from jaxfilters.trackers.io.gesture_models import default_symbols

OPEN, REST = 25, 45
SHAPE = (240, 320)


def write_video(path, images):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, SHAPE[::-1])
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A video of an open hand of which then only the forefinger stays out, and its truth."""
    folder = tmp_path_factory.mktemp("desk")
    fingers = np.zeros((OPEN + REST, 5), bool)
    fingers[:OPEN] = True
    fingers[:, 1] = True
    frames = list(desk_video(jax.random.key(0), fingers, shape=SHAPE))
    write_video(folder / "hand.mp4", [frame.image for frame in frames])
    return folder / "hand.mp4", frames


@pytest.fixture(scope="module")
def results(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "run"
    assert main(["track", "fingertips", str(recording[0]), "--out", str(out)]) == 0
    return out


@pytest.mark.system
def test_fingertips_are_where_they_are(recording, results):
    _, frames = recording
    with (results / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    numbers = [int(row["frame"]) for row in rows]
    assert numbers == sorted(numbers)
    by_frame = {i: [row for row in rows if int(row["frame"]) == i] for i in range(len(frames))}
    assert all(len(by_frame[i]) == 5 for i in range(5, OPEN - 3))
    assert all(len(by_frame[i]) == 1 for i in range(OPEN + 16, len(frames)))
    apart = [
        np.linalg.norm(frames[i].tips[frames[i].extended] - [float(row["x_px"]), float(row["y_px"])], axis=1).min()
        for i in (*range(5, OPEN - 3), *range(OPEN + 16, len(frames)))
        for row in by_frame[i]
    ]
    assert np.mean(apart) < 1
    names = {row["id"] for row in rows}
    assert names == {f"0-{i}" for i in range(5)}
    (thumb,) = {row["id"] for row in by_frame[15] if row["is_thumb"] == "1"}
    (place,) = [[float(row["x_px"]), float(row["y_px"])] for row in by_frame[15] if row["id"] == thumb]
    assert np.linalg.norm(frames[15].tips[0] - place) < 3
    assert {row["status"] for row in rows} == {"tracking", "predicted"}


@pytest.mark.system
def test_every_output_can_be_read(results):
    report = json.loads((results / "report.json").read_text())
    assert report["frames"] == OPEN + REST
    assert report["open_hand"] is True
    assert report["trouble"] == []
    assert sum(report["frames_by_count"].values()) == OPEN + REST
    events = [json.loads(line) for line in (results / "events.jsonl").read_text().splitlines()]
    assert all({"frame", "time_s", "hand", "event", "phase"} <= set(event) for event in events)
    video = cv2.VideoCapture(str(results / "overlay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == OPEN + REST


@pytest.mark.system
def test_hands_in_depth_images_lie_above_the_desk(recording, tmp_path):
    """In millimetres, on a desk at 0.6 m, as a depth camera gives it."""
    _, frames = recording
    rng = np.random.default_rng(0)
    height = np.stack([frame.coverage for frame in frames[5:13]]) * 30
    depth = (600 - height + rng.normal(0, 0.7, height.shape)).round().astype(np.uint16)
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    np.savez(tmp_path / "depth.npz", depth_mm=depth, K=K)
    out = tmp_path / "out"
    command = ["track", "fingertips", str(tmp_path / "depth.npz"), "--mask", "depth", "--out", str(out)]
    assert main(command) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["open_hand"] is True
    assert report["frames_by_count"] == {"0": 2, "5": 6}
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 8


@pytest.mark.system
def test_tips_of_another_run_are_not_overwritten(recording, results, capsys):
    before = (results / "track.csv").read_bytes()
    assert main(["track", "fingertips", str(recording[0]), "--out", str(results)]) == 2
    assert "another run" in capsys.readouterr().err
    assert (results / "track.csv").read_bytes() == before


@pytest.mark.system
def test_a_run_that_was_killed_is_resumed_bit_for_bit(recording, results, tmp_path, monkeypatch, capsys):
    out, command = tmp_path / "run", ["track", "fingertips", str(recording[0]), "--out", str(tmp_path / "run")]
    monkeypatch.setattr(stream, "CHECKPOINT_EVERY_S", 0.0)
    drawn = FingertipPictures.drawn

    def killed(self, image, frame, *rest):
        if frame == 31:
            raise RuntimeError("killed")
        return drawn(self, image, frame, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(FingertipPictures, "drawn", killed)
        assert main(command) == 70
    assert main([*command, "--resume", "--hands", "2"]) == 2
    assert "hands was '1' and is '2'" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    for name in ("track.csv", "events.jsonl"):
        assert (out / name).read_bytes() == (results / name).read_bytes()
    one, other = (json.loads((folder / "report.json").read_text()) for folder in (out, results))
    for timed in ("seconds", "frames_per_second"):
        del one[timed], other[timed]
    assert one == other
    assert (out / "overlay_from_31.mp4").exists()
    (out / "events.jsonl").unlink()
    assert main([*command, "--resume"]) == 2
    assert "events.jsonl: cannot be continued" in capsys.readouterr().err


def test_a_desk_without_a_hand_is_followed_to_its_end(tmp_path, capsys):
    write_video(tmp_path / "desk.mp4", [np.full(SHAPE, 70, np.uint8)] * 5)
    out = tmp_path / "out"
    assert main(["track", "fingertips", str(tmp_path / "desk.mp4"), "--out", str(out), "--no-video"]) == 0
    assert "no open hand" in capsys.readouterr().err
    assert len((out / "track.csv").read_text().splitlines()) == 1
    assert json.loads((out / "report.json").read_text())["frames_by_count"] == {"0": 5}


def test_wrong_input_is_named(recording, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    assert main(["track", "fingertips", str(tmp_path / "none.mp4"), *out]) == 2
    assert "none.mp4" in capsys.readouterr().err
    assert main(["track", "fingertips", "--mask", "depth", *out]) == 2
    assert "--mask depth" in capsys.readouterr().err
    assert main(["track", "fingertips", "--fps", "60", *out]) == 2
    assert "--fps: of no use without a recording" in capsys.readouterr().err
    (tmp_path / "model.npz").write_bytes(b"nothing")
    assert main(["track", "fingertips", str(recording[0]), "--gestures", str(tmp_path / "model.npz"), *out]) == 2
    assert "model.npz" in capsys.readouterr().err


def test_a_depth_recording_is_sampled_to_its_end_and_its_rate_can_be_given(tmp_path):
    depth = np.full((119, 2, 2), 500, np.uint16) + np.arange(119, dtype=np.uint16)[:, None, None]
    times_us = np.rint(np.arange(119) * 1e6 / 30).astype(np.int64)
    np.savez(tmp_path / "depth.npz", depth_mm=depth, K=[[9.0, 0, 1], [0, 9, 1], [0, 0, 1]], t_us=times_us)
    source = DepthVideo(str(tmp_path / "depth.npz"), None)
    depths = [round(1000 * float(image[0, 0])) for image in source.sample(60)]
    assert (len(depths), depths[0], depths[-1], max(np.diff(depths))) == (60, 500, 618, 2)
    assert source.fps == pytest.approx(30, rel=1e-4)
    faster = DepthVideo(str(tmp_path / "depth.npz"), 60.0)
    assert faster.fps == pytest.approx(60)
    np.testing.assert_allclose([time for time, _ in faster.images()], np.arange(119) / 60)


class Camera:
    """A live camera that delivers grey images of growing brightness, and nothing in every other turn."""

    name, fps, image_size = "camera 9", 30.0, (4, 3)

    def images(self):
        for i in range(10):
            yield i / 30, None if i % 2 else np.full((3, 4, 3), i, np.uint8)

    def trouble(self):
        return None


def test_the_first_images_of_a_live_camera_do_not_come_again():
    live = LiveHands(Camera())
    assert [int(image[0, 0, 0]) for image in live.sample(2)] == [0, 2]
    assert [int(image[0, 0, 0]) for _, image in live.images() if image is not None] == [4, 6, 8]
    assert (live.name, live.image_size) == ("camera 9", (4, 3))


def two_hands():
    """A report of one frame: three fingertips of two hands."""
    there = np.array([[True, False], [True, True]])
    return HandReport(
        identity=np.array([[4, -1], [0, 1]]),
        is_tip=there,
        is_observed=np.array([[True, False], [False, True]]),
        position=np.full((2, 2, 2), 30.0),
        sd=np.ones((2, 2)),
        innovations=np.full((2, 2, 2), (2, 1)),
        velocity=np.full((2, 2, 2), 1.5),
        is_thumb=np.array([[False, False], [True, False]]),
        thumb_probability=np.array([[0.1, 0], [0.9, 0.2]]),
        palm=np.full((2, 2), 50.0),
        has_palm=np.array([True, True]),
        axis=np.tile([0.0, -1.0], (2, 1)),
        has_axis=np.array([True, False]),
        mode=np.array([1, 2]),
        num_tips=np.array([1, 2]),
    )


def test_names_begin_with_the_hand():
    names = ["frame", "time_s", *TIP_TABLE.columns, "status"]
    rows = [dict(zip(names, row, strict=True)) for row in TIP_TABLE.rows(7, tip_rows(7, 0.25, two_hands()))]
    assert [(row["frame"], row["time_s"], row["hand"], row["id"]) for row in rows] == [
        (7, "0.250000", hand, name) for hand, name in (("0", "0-4"), ("1", "1-0"), ("1", "1-1"))
    ]
    assert [(row["status"], row["is_thumb"]) for row in rows] == [
        ("tracking", "0"),
        ("predicted", "1"),
        ("tracking", "0"),
    ]
    assert {row["vx_px_per_s"] for row in rows} == {"45"}  # 1.5 pixels in 1/30 s


def test_pictures_leave_the_image_as_it_is():
    image = np.full((101, 141, 3), 90, np.uint8)
    event = Event(0, 0.0, 0, SYMBOL, "end", {"label": "circle"})
    picture = FingertipPictures().drawn(image, 0, 0.0, two_hands(), [event])
    assert picture.shape == (100, 140, 3)
    assert picture.std() > 5
    assert (image == 90).all()
    assert in_words(event) == "symbol: circle"
    turned = Event(0, 0.0, 0, ROTATE, "end", {"angle_rad": np.pi / 4, "x_px": 3.25, "ratio": 1.5})
    assert in_words(turned) == "rotate ends: angle 45 degrees, x 3.25 px, ratio 1.5"
    assert shown(np.array([[0.5, np.nan], [0.6, 0.7]], np.float32)).shape == (2, 2, 3)


@pytest.mark.system
def test_strokes_are_named_by_the_model_of_a_file():
    strokes = tracked(drawn(5, 1))
    recognise = recogniser_of(default_symbols())
    found = [
        recognise(Stroke(points, np.full(len(points), 17, np.int32), counts, np.arange(len(points)) / 30, 0))
        for points, counts in strokes.paths[:8]
    ]
    assert np.mean([one.label == label for one, label in zip(found, strokes.labels[:8], strict=True)]) >= 0.8
    assert all(0 < one.confidence <= 1 for one in found)


def test_more_hands_than_a_person_has_are_refused(tmp_path, capsys):
    assert main(["track", "fingertips", "--hands", "3", "--out", str(tmp_path / "out")]) == 2
    assert "hands must be 1 or 2; got 3" in capsys.readouterr().err


def test_two_runs_in_one_folder_end_in_one_line_before_an_image_is_read(tmp_path, monkeypatch, capsys):
    """Both begin at once: the folder was free when the second one looked, and is locked when it would read images."""
    monkeypatch.setenv("XLA_FLAGS", "")  # `main` sets it
    monkeypatch.setattr(cli, "check_free", lambda path: None)
    for name in ("sample", "images"):
        monkeypatch.setattr(DemoHand, name, lambda *_: pytest.fail("an image was read"))
    first = OutputFolder(tmp_path)
    assert main(["track", "fingertips", "--out", str(tmp_path)]) == 2
    first.close()
    line = f"jaxfilters: error: {tmp_path}: another run writes into it; choose another --out."
    assert capsys.readouterr().err.splitlines() == [line]
