"""`track fingertips --keypoints`: files of MediaPipe and OpenPose as they write them, followed to names and modes."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.fingertips.keypoint_input import KeypointSource, hands_of
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import open_video
from tests.models.fingertip.test_keypoints import skeleton

SIZE = (640, 480)


def mediapipe(hands):
    """A frame of hand landmarks as the JSON of MediaPipe's tasks has it."""
    listed = [[{"x": x / SIZE[0], "y": y / SIZE[1], "z": 0.0, "visibility": 0} for x, y in hand] for hand in hands]
    return {"handedness": [[{"categoryName": "Right", "score": 0.9}]] * len(listed), "landmarks": listed}


def legacy(hands):
    """The same as its older Python interface has it."""
    return {"multi_hand_landmarks": [{"landmark": landmarks} for landmarks in mediapipe(hands)["landmarks"]]}


def openpose(hands):
    """A frame of OpenPose: the left hand of one person and the right one of another."""
    numbers = [np.concatenate([hand, np.full((21, 1), 0.8)], axis=1).ravel().tolist() for hand in hands]
    keys = ("hand_left_keypoints_2d", "hand_right_keypoints_2d")
    return {"version": 1.3, "people": [{keys[i % 2]: one, keys[1 - i % 2]: []} for i, one in enumerate(numbers)]}


def written(folder: Path, frames, form):
    if form is openpose:
        for i, hands in enumerate(frames):
            (folder / f"clip_{i:012d}_keypoints.json").write_text(json.dumps(openpose(hands)))
        return folder
    (folder / "hand.json").write_text(json.dumps([form(hands) for hands in frames]))
    return folder / "hand.json"


def test_an_impossible_name_is_refused_in_a_short_line():
    with pytest.raises(InputError, match=r"^--keypoints n+\.\.\.: no such file or folder\.$") as refused:
        KeypointSource(Path(3000 * "n"), None, None, SIZE)
    assert len(str(refused.value)) < 240


@pytest.mark.parametrize("form", [mediapipe, legacy, openpose])
def test_hands_of_a_frame_are_read_from_every_form(tmp_path, form):
    two = [skeleton(place=(450, 350)), skeleton(place=(200, 350), size=60)]
    path = written(tmp_path, [[], two, two[:1]], form)
    source = KeypointSource(path, None, 25.0, SIZE)
    assert (source.frames, source.fps, source.image_size) == (3, 25.0, SIZE)
    observed = [hands_of(frame, 2) for _, frame in source.images()]
    np.testing.assert_array_equal([hand.is_hand.sum() for hand in observed], [0, 2, 1])
    # From left to right.
    np.testing.assert_allclose(observed[1].tips[0, :, 1], [two[1][8], two[0][8]], rtol=1e-4)
    only = hands_of(source.sample(3)[1], 1)
    np.testing.assert_allclose(only.tips[0, 0, 1], two[0][8], rtol=1e-4)


def video_of(folder, count):
    """A folder of images, each of which is as bright as its number says."""
    folder.mkdir()
    for i in range(count):
        cv2.imwrite(str(folder / f"{i:03d}.png"), np.full((8, 12, 3), i, np.uint8))
    return open_video(str(folder), fps=30.0)


def table(path, numbers, times=None):
    """A table with a hand a row, which moves a little."""
    names = [f"{letter}{i}" for letter in "xy" for i in range(21)]
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["frame", *names, *([] if times is None else ["time_s"])])
        for i, number in enumerate(numbers):
            rows.writerow([number, *(skeleton() + 0.1 * i).T.ravel(), *([] if times is None else [times[i]])])
    return path


def over(source):
    """Time and image of every frame, 40 for none, and whether it has keypoints."""
    return [(round(t, 6), int(one.picture[0, 0, 0]), bool(one.confidence.any())) for t, one in source.images()]


def test_frames_lie_over_the_images_with_their_numbers_at_the_times_of_the_file(tmp_path):
    """Every second image from the third on; one has no keypoints, the last one is behind the end of the video."""
    numbers, video = (3, 5, 9, 11), video_of(tmp_path / "video", 11)
    source = KeypointSource(table(tmp_path / "a.csv", numbers), video, None, None)
    at = [round(number / 30, 6) for number in (3, 5, 7, 9, 11)]
    assert over(source) == list(zip(at, (3, 5, 7, 9, 40), (True, True, False, True, True), strict=True))
    assert source.fps == pytest.approx(15)
    assert "11 images beside frames 3 to 11" in source.trouble()
    source = KeypointSource(table(tmp_path / "b.csv", numbers[:3], [7.0, 7.5, 8.5]), video, None, None)
    assert over(source) == [(7.0, 3, True), (7.5, 5, True), (8.0, 7, False), (8.5, 9, True)]
    assert source.trouble() is None
    # The option goes before the times of the file.
    source = KeypointSource(table(tmp_path / "b.csv", numbers[:3], [7.0, 7.5, 8.5]), video, 10.0, None)
    assert (source.fps, [time for time, *_ in over(source)]) == (pytest.approx(5), [0.3, 0.5, 0.7, 0.9])


def test_samples_reach_from_the_first_to_the_last_frame(tmp_path):
    source = KeypointSource(table(tmp_path / "a.csv", range(119)), None, None, SIZE)
    x = [float(frame.points[0, 0, 0] - skeleton()[0, 0]) for frame in source.sample(60)]
    assert len(x) == 60
    np.testing.assert_allclose([x[0], x[-1]], [0, 11.8], atol=1e-6)
    assert max(np.diff(x)) < 0.21


@pytest.mark.system
def test_a_run_over_a_table_that_begins_later_has_its_times(tmp_path):
    path, out = table(tmp_path / "a.csv", range(90, 120)), tmp_path / "out"
    options = ["--image-size", "640x480", "--seconds", "0.5", "--no-video", "--out", str(out)]
    assert main(["track", "fingertips", "--keypoints", str(path), *options]) == 0
    with (out / "track.csv").open() as file:
        times = {(int(row["frame"]), float(row["time_s"])) for row in csv.DictReader(file)}
    assert max(times) == (15, 3.5)
    assert all(abs(time - 3 - frame / 30) < 1e-5 for frame, time in times)


@pytest.mark.system
def test_what_cannot_be_used_is_named(tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    path = str(written(tmp_path, [[skeleton()]] * 2, mediapipe))
    for arguments, word in (
        ((path,), "--image-size"),
        ((path, "--image-size", "640x480", "--mask", "colour"), "--mask colour: of no use with --keypoints"),
        ((path, "none.mp4", "--image-size", "640x480"), "the video says how large its images are"),
        ((str(tmp_path / "none"), "--image-size", "640x480"), "no such file or folder"),
        ((path, "--image-size", "640"), "WIDTHxHEIGHT"),
    ):
        try:
            code = main(["track", "fingertips", "--keypoints", *arguments, *out])
        except SystemExit as ended:
            code = ended.code
        assert code == 2
        assert word in capsys.readouterr().err
    with pytest.raises(InputError, match="no hand in any of 2 frames"):
        KeypointSource(written(tmp_path, [[], []], mediapipe), None, None, SIZE)


@pytest.mark.system
def test_keypoints_are_followed_to_names_thumbs_modes_and_symbols(tmp_path):
    """An open hand, then a forefinger that draws a V and rests."""
    rng = np.random.default_rng(0)
    corners = np.array([(0, 0), (60, 120), (120, 0)], float)
    way = np.stack([np.interp(np.linspace(0, 2, 40), range(3), corners[:, k]) for k in range(2)], axis=1)
    only = (False, True, False, False, False)
    moves = [np.zeros(2)] * 20 + [*way] + [way[-1]] * 25
    frames = [[skeleton((True,) * 5) + 0.3 * rng.normal(size=(21, 2))] for _ in range(20)] + [
        [skeleton(only) + move + 0.3 * rng.normal(size=(21, 2))] for move in moves
    ]
    path, out = written(tmp_path, frames, mediapipe), tmp_path / "out"
    assert main(["track", "fingertips", "--keypoints", str(path), "--image-size", "640x480", "--out", str(out)]) == 0
    report = json.loads((out / "report.json").read_text())
    assert (report["frames"], report["open_hand"], report["fingertips"]) == (len(frames), True, 5)
    with (out / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    thumbs = {row["id"] for row in rows if row["is_thumb"] == "1" and row["frame"] == "15"}
    near = [
        row
        for row in rows
        if row["frame"] == "15"
        and np.hypot(float(row["x_px"]) - frames[15][0][4, 0], float(row["y_px"]) - frames[15][0][4, 1]) < 3
    ]
    assert thumbs == {row["id"] for row in near}
    symbols = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    assert [event["label"] for event in symbols if event["event"] == "symbol"] == ["V 1"]
