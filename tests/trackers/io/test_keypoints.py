"""Files as the detectors write them: OpenPose 1.7 with `--hand --write_json`, MediaPipe's hand landmarks."""

import csv
import json

import numpy as np
import pytest

from jaxfilters.trackers.articulated.recording import looks_normalized, persistence
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.features import open_features
from jaxfilters.trackers.io.keypoints import read

FRAMES, SIZE = 5, (640, 480)
RNG = np.random.default_rng(0)
POINTS = RNG.uniform((100, 80), (500, 400), (FRAMES, 21, 2)).round(3)
CONFIDENCE = RNG.uniform(0.3, 1, (FRAMES, 21)).round(4)


def openpose_hand(points, confidence):
    return np.concatenate([points, confidence[:, None]], axis=1).ravel().tolist()


def openpose_frame(*people):
    """`people` are (left, right) lists of numbers."""
    people = [
        {
            "person_id": [-1],
            "pose_keypoints_2d": [0.0] * 75,
            "face_keypoints_2d": [],
            "hand_left_keypoints_2d": left,
            "hand_right_keypoints_2d": right,
            "pose_keypoints_3d": [],
            "hand_left_keypoints_3d": [],
            "hand_right_keypoints_3d": [],
        }
        for left, right in people
    ]
    return {"version": 1.3, "people": people}


@pytest.fixture
def openpose(tmp_path):
    """A folder with a right hand in every frame but the second, which shows nobody, and no keypoint 7 in the third."""
    folder = tmp_path / "openpose"
    folder.mkdir()
    for i in range(FRAMES):
        points, confidence = POINTS[i].copy(), CONFIDENCE[i].copy()
        if i == 2:
            points[7], confidence[7] = 0, 0
        frame = openpose_frame(([0.0] * 63, openpose_hand(points, confidence))) if i != 1 else openpose_frame()
        (folder / f"clip_{i + 3:012d}_keypoints.json").write_text(json.dumps(frame))
    return folder


def edit(folder, index, frame):
    file = sorted(folder.glob("*.json"))[index]
    file.write_text(frame if isinstance(frame, str) else json.dumps(frame))


def test_openpose_has_a_file_a_frame(openpose):
    found = read(openpose, "right", 25.0)
    observed = np.ones((FRAMES, 21), bool)
    observed[1], observed[2, 7] = False, False
    np.testing.assert_array_equal(found.points, np.where(observed[..., None], POINTS, np.nan))
    np.testing.assert_array_equal(found.confidence, np.where(observed, CONFIDENCE, 0))
    np.testing.assert_allclose(found.times_s, (np.arange(FRAMES) + 3) / 25)
    sequence = open_features(openpose, noise_px=2.0)
    assert not sequence[1].mask.any()
    assert sequence[2].mask.sum() == 40
    np.testing.assert_allclose(sequence.std[0, :2], 2 / CONFIDENCE[0, 0] * persistence(sequence.times_s))


def test_the_hand_that_is_asked_for_is_read(openpose):
    other = POINTS[0] + 7
    edit(openpose, 0, openpose_frame((openpose_hand(other, CONFIDENCE[0]), openpose_hand(POINTS[0], CONFIDENCE[0]))))
    np.testing.assert_array_equal(read(openpose, "left", 30.0).points[0], other)
    np.testing.assert_array_equal(read(openpose, "right", 30.0).points[0], POINTS[0])


def test_other_people_without_that_hand_are_no_trouble(openpose):
    edit(openpose, 0, openpose_frame(([], []), ([0.0] * 63, [0.0] * 63), ([], openpose_hand(POINTS[3], CONFIDENCE[3]))))
    np.testing.assert_array_equal(read(openpose, "right", 30.0).points[0], POINTS[3])


@pytest.mark.parametrize(
    ("names", "times_s"),
    [
        (("b", "a", "c"), [0, 1 / 30, 2 / 30]),
        (("v_2", "v_10", "v_1"), [1 / 30, 2 / 30, 10 / 30]),
        (("v_1700000040000", "v_1700000000000", "v_1700000080000"), 1.7e6 + np.asarray([0, 0.04, 0.08])),
    ],
)
def test_openpose_times_come_from_the_numbers_of_the_frames(tmp_path, names, times_s):
    for name in names:
        frame = openpose_frame(([], openpose_hand(POINTS[0], CONFIDENCE[0])))
        (tmp_path / f"{name}_keypoints.json").write_text(json.dumps(frame))
    np.testing.assert_allclose(read(tmp_path, "right", 30.0).times_s, times_s, rtol=1e-12)


HAND = openpose_hand(POINTS[0], CONFIDENCE[0])
WRONG_FRAMES = {
    "two people": (openpose_frame(([], HAND), ([], HAND)), "2 people with a right hand; expected at most one"),
    "too few numbers": (
        openpose_frame(([], HAND[:-3])),
        r"hand_right_keypoints_2d must be 63 numbers or none; .*\(60,\)",
    ),
    "words": (openpose_frame(([], ["x"] * 63)), "hand_right_keypoints_2d must be numbers"),
    "negative confidence": (openpose_frame(([], [-1.0] * 63)), "confidence must be 0 or more; frame 2, keypoint 0"),
    "another file": ({"bodies": []}, r'expected {"people": \[...\]} as OpenPose writes it'),
    "a list": ([1, 2], r'expected {"people": \[...\]}'),
    "people that are numbers": ({"people": [1]}, r'expected {"people": \[...\]}'),
    "a truncated file": (json.dumps(openpose_frame(([], HAND)))[:300], "not JSON"),
    "an empty file": ("", "not JSON"),
}


@pytest.mark.parametrize("what", WRONG_FRAMES)
def test_wrong_openpose_files_are_named(openpose, what):
    frame, message = WRONG_FRAMES[what]
    edit(openpose, 2, frame)
    with pytest.raises(InputError, match=message) as error:
        open_features(openpose)
    assert "clip_000000000005_keypoints.json" in str(error.value) or "frame 2" in str(error.value)


def test_openpose_folders_without_the_hand_are_refused(openpose, tmp_path):
    with pytest.raises(InputError, match="no left hand in any of 5 frames; there are right hands: --hand right"):
        open_features(openpose, hand="left")
    (openpose / "b_000000000003_keypoints.json").write_text(json.dumps(openpose_frame()))
    with pytest.raises(InputError, match=r"b_.* and clip_.* have one frame number; a folder must hold one recording"):
        open_features(openpose)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: no \*_keypoints.json in it"):
        open_features(tmp_path / "empty")
    (tmp_path / "empty" / "a_keypoints.json").write_text(json.dumps(openpose_frame()))
    with pytest.raises(InputError, match=r"no right hand in any of 1 frames \(OpenPose needs --hand\)"):
        open_features(tmp_path / "empty")


def mediapipe_hand(points, **more):
    return [{"x": x / SIZE[0], "y": y / SIZE[1], "z": -0.01, **more} for x, y in points.tolist()]


@pytest.fixture
def mediapipe(tmp_path):
    """Writes frames as JSON."""

    def write(frames):
        file = tmp_path / "hands.json"
        file.write_text(frames if isinstance(frames, str) else json.dumps(frames))
        return file

    return write


FORMS = {
    "landmarks": lambda hand: hand or [],
    "no hand is null": lambda hand: hand,
    "hands": lambda hand: [hand] if hand else [],
    "a result of the tasks": lambda hand: {"hand_landmarks": [hand] if hand else [], "handedness": []},
    "a result of the solutions": lambda hand: {"multi_hand_landmarks": [{"landmark": hand}] if hand else None},
    "a result of JavaScript": lambda hand: {"landmarks": [hand] if hand else []},
}


@pytest.mark.parametrize("form", FORMS)
def test_mediapipe_frames_are_scaled_to_pixels(mediapipe, form):
    file = mediapipe([FORMS[form](mediapipe_hand(POINTS[i]) if i != 1 else None) for i in range(FRAMES)])
    sequence = open_features(file, image_size=SIZE, noise_px=2.0, fps=10.0)
    names = sequence.features.names(5)
    np.testing.assert_allclose(sequence.y[0, :2], POINTS[0, 0])
    np.testing.assert_allclose(sequence.y[3, names.index("p_53_y")], POINTS[3, 20, 1])
    np.testing.assert_allclose(sequence.y[3, names.index("p_20_x")], POINTS[3, 5, 0])
    assert not sequence[1].mask.any()
    assert sequence[0].mask.all()
    np.testing.assert_allclose(sequence.times_s, np.arange(FRAMES) / 10)
    np.testing.assert_allclose(sequence.std[0], 2.0 * persistence(sequence.times_s))
    assert sequence.image_shape == (480, 640)


def test_visibility_counts_where_it_is_set_and_means_nothing_where_all_of_it_is_0(mediapipe):
    unset = [mediapipe_hand(points, visibility=0.0, presence=0.0) for points in POINTS]
    np.testing.assert_array_equal(read(mediapipe(unset), "right", 30.0).confidence, 1.0)
    unset[2][4]["visibility"] = 0.5
    expected = np.zeros((FRAMES, 21))
    expected[2, 4] = 0.5
    np.testing.assert_array_equal(read(mediapipe(unset), "right", 30.0).confidence, expected)
    unset[3][4]["visibility"] = None
    assert read(mediapipe(unset), "right", 30.0).confidence[3, 4] == 1.0


def test_mediapipe_frames_may_have_times(mediapipe):
    frames = [{"landmarks": [mediapipe_hand(points)], "time_s": 0.1 * i**2} for i, points in enumerate(POINTS)]
    np.testing.assert_allclose(read(mediapipe(frames), "right", 30.0).times_s, 0.1 * np.arange(FRAMES) ** 2)
    del frames[2]["time_s"]
    with pytest.raises(InputError, match="time_s must be in every frame or in none; 4 of 5 have it"):
        read(mediapipe(frames), "right", 30.0)


LANDMARKS = mediapipe_hand(POINTS[0])
WRONG_HANDS = {
    "two hands": ([LANDMARKS, LANDMARKS], r"frame 1: 2 hands; expected at most one \(MediaPipe's num_hands=1\)"),
    "20 landmarks": (LANDMARKS[1:], "frame 1: expected 21 landmarks; got 20"),
    "a landmark without y": ([*LANDMARKS[:-1], {"x": 0.5}], r'frame 1, landmark 20: expected {"x", "y"}; got {\'x\''),
    "words": ([{"x": "a", "y": "b"}] * 21, "frame 1: landmarks must be numbers"),
    "a number": (3, "frame 1: expected a list of landmarks; got a int"),
    "another object": ({"gestures": []}, r"frame 1: expected landmarks; got an object with \['gestures'\]"),
}


@pytest.mark.parametrize("what", WRONG_HANDS)
def test_wrong_mediapipe_frames_are_named(mediapipe, what):
    frame, message = WRONG_HANDS[what]
    with pytest.raises(InputError, match=message):
        open_features(mediapipe([LANDMARKS, frame, LANDMARKS]), image_size=SIZE)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"frames": []}, "expected a list with 21 landmarks for each frame; got a dict"),
        (openpose_frame(), "one frame of OpenPose; give the folder that holds it"),
        (json.dumps([LANDMARKS])[:-20], "not JSON"),
        ("", "not JSON"),
        ([], "expected at least one frame|no keypoint"),
        ([[], None], "no keypoint has a confidence of 0.2 or more in any frame"),
    ],
)
def test_wrong_json_is_named(mediapipe, content, message):
    with pytest.raises(InputError, match=message):
        open_features(mediapipe(content), image_size=SIZE)


def test_shares_of_the_image_need_its_size(mediapipe):
    file = mediapipe([LANDMARKS])
    with pytest.raises(InputError, match=r"shares of the image instead of pixels; .* --image-size WIDTHxHEIGHT"):
        open_features(file)
    assert looks_normalized(np.asarray([[-0.2, 1.3], [np.nan, np.nan]]))
    assert not looks_normalized(np.asarray([[0.2, 31.0]]))
    assert not looks_normalized(np.full((2, 2), np.nan))


def long_rows(*, with_times=False):
    rows = [["frame", "landmark", "x", "y", "z", "visibility", *(["time_s"] if with_times else [])]]
    for i in range(FRAMES):
        if i != 1:
            for k in range(21):
                row = [2 * i + 4, k, *POINTS[i, k], 0.0, CONFIDENCE[i, k], *([0.5 * i] if with_times else [])]
                rows.append([str(entry) for entry in row])
    return rows


def wide_rows(*, with_confidence=True):
    letters = "xyc" if with_confidence else "xy"
    rows = [["frame", *(f"{letter}{k}" for k in range(21) for letter in letters)]]
    values = np.concatenate([POINTS, CONFIDENCE[..., None]], axis=-1)[..., : len(letters)]
    for i in range(FRAMES):
        entries = [str(entry) for entry in values[i].ravel()] if i != 1 else [""] * (21 * len(letters))
        rows.append([str(2 * i + 4), *entries])
    return rows


@pytest.fixture
def table(tmp_path):
    """Writes rows as CSV."""

    def write(rows):
        with (tmp_path / "hand.csv").open("w", newline="") as file:
            csv.writer(file).writerows(rows)
        return tmp_path / "hand.csv"

    return write


@pytest.mark.parametrize("rows", [long_rows(), wide_rows()], ids=["a landmark a row", "a frame a row"])
def test_both_tables_say_the_same(table, rows):
    found = read(table(rows), "right", 10.0)
    observed = np.arange(FRAMES) != 1
    np.testing.assert_array_equal(found.points, np.where(observed[:, None, None], POINTS, np.nan))
    np.testing.assert_array_equal(found.confidence, np.where(observed[:, None], CONFIDENCE, 0))
    np.testing.assert_allclose(found.times_s, (2 * np.arange(FRAMES) + 4) / 10)


def test_tables_may_have_times_and_lack_confidence_and_landmarks(table):
    found = read(table(long_rows(with_times=True)), "right", 10.0)
    np.testing.assert_allclose(found.times_s, 0.5 * np.arange(FRAMES))
    rows = [row[:4] for row in long_rows() if row[1] != "7"]
    found = read(table(rows), "right", 10.0)
    observed = (np.arange(FRAMES) != 1)[:, None] & (np.arange(21) != 7)
    np.testing.assert_array_equal(found.confidence, observed)
    found = read(table([row[1:] for row in wide_rows(with_confidence=False)]), "right", 10.0)
    np.testing.assert_allclose(found.times_s, np.arange(FRAMES) / 10)
    np.testing.assert_array_equal(found.confidence, np.repeat(np.arange(FRAMES)[:, None] != 1, 21, axis=1))


def replaced(rows, row, column, entry):
    rows = [list(entries) for entries in rows]
    rows[row][column] = entry
    return rows


WRONG_TABLES = {
    "nothing": ([], "expected the columns frame, landmark, x, y .*; got nothing"),
    "a header": (long_rows()[:1], "no rows in it"),
    "other columns": ([["t", "u", "v"], ["1", "2", "3"]], "expected the columns .*; got t, u, v"),
    "a finger too few": ([row[:-3] for row in wide_rows()], "expected the columns"),
    "a row cut off": ([*long_rows()[:-1], ["12", "20"]], r"line 85 has 2 entries, its header 6 \(truncated\?\)"),
    "a word": (replaced(long_rows(), 3, 2, "left"), "line 4: x must be a number; got 'left'"),
    "half a frame": (replaced(long_rows(), 3, 0, "4.5"), "frame must be whole numbers"),
    "no frame": (replaced(long_rows(), 3, 0, ""), "frame must be whole numbers"),
    "landmark 21": (replaced(long_rows(), 3, 1, "21"), "landmark must be 0 to 20; got 21"),
    "two hands": (long_rows() + long_rows()[1:], "2 hands; expected at most one: landmark 0 of frame 4 is there again"),
    "frames that go back": (replaced(wide_rows(), 3, 0, "4"), "frames must increase; frame 4 follows frame 6"),
    "numbers that are times": (replaced(wide_rows(), 5, 0, "1700000001"), "too many gaps"),
    "no time": (replaced(long_rows(with_times=True), 21, 6, ""), "time_s must be a number in every row; frame 4"),
    "an infinite place": (replaced(wide_rows(), 1, 1, "inf"), "line 2: x0 must be a finite number"),
    "confidence below 0": (replaced(wide_rows(), 1, 3, "-1"), "confidence must be 0 or more; frame 0, keypoint 0"),
}


@pytest.mark.parametrize("what", WRONG_TABLES)
def test_wrong_tables_are_named(table, what):
    rows, message = WRONG_TABLES[what]
    with pytest.raises(InputError, match=rf"hand\.csv: .*{message}"):
        open_features(table(rows))


def test_files_of_another_kind_are_refused(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00frame")
    with pytest.raises(InputError, match=r"a\.csv: not text in UTF-8"):
        open_features(tmp_path / "a.csv")
    (tmp_path / "clip.mp4").touch()
    with pytest.raises(InputError, match=r"expected a folder of OpenPose's \*_keypoints.json, or .*suffix '\.mp4'"):
        open_features(tmp_path / "clip.mp4")
