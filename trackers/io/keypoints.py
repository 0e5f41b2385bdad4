"""21 keypoints of a hand over time, as detectors write them: OpenPose's folders, MediaPipe's landmarks, tables.

Formats, as their authors document them. OpenPose (`--hand --write_json`): one `*_keypoints.json` a frame with `people`,
each with `hand_left_keypoints_2d` and `hand_right_keypoints_2d`, 63 numbers x, y, confidence; 0, 0, 0 for a keypoint
that was not found, no numbers without a hand, no people without a person. MediaPipe: `x` and `y` as shares of the
image's width and height, `z` a depth that is not used, and `visibility` that its model of hands leaves at 0. Both count
wrist, thumb 1-4, index, middle, ring, little finger, base to tip.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.trackers.articulated.recording import NUM_KEYPOINTS
from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.frame_numbers import frames_of, times_of
from jaxfilters.trackers.io.input_files import LARGEST, check_rate, is_folder, too_large
from jaxfilters.trackers.io.json_files import read_json_value
from jaxfilters.trackers.io.tables import Columns, read_table

_MOST_GAPS = 100
"""Missing frames per frame that is there, at most: beyond it the numbers are no frame numbers."""
_MOST_FRAMES = 1_000_000
"""Nine hours."""
_LONG = ("frame", "landmark", "x", "y", "visibility", "confidence", "time_s")
_WIDE = {f"{letter}{i}" for letter in "xy" for i in range(NUM_KEYPOINTS)}
_WIDE_EXTRA = {*(f"c{i}" for i in range(NUM_KEYPOINTS)), "frame", "time_s"}
_WANTED_TABLE = (
    "expected the columns frame, landmark, x, y (and visibility, time_s), or x0, y0 to x20, y20 (and c0 to c20, frame, "
    "time_s)"
)
_HANDS = ("landmarks", "hand_landmarks", "multi_hand_landmarks", "multiHandLandmarks", "landmark")
"""What the detector's own interfaces call a frame's hands, or a hand's landmarks."""


class Detections(NamedTuple):
    """One hand over time; pixels or shares of the image."""

    times_s: np.ndarray
    """(frames,)."""
    points: np.ndarray
    """(frames, 21, 2), NaN where nothing was found."""
    confidence: np.ndarray
    """(frames, 21), 0 where nothing was found."""
    frames: np.ndarray
    """(frames,) numbers of the frames, which increase; from 0 where the recording does not count them."""


def read(path: Path, hand: str, fps: float) -> Detections:
    """A folder of OpenPose's files, or a `.json` or `.csv` of MediaPipe's landmarks.

    Args:
        path: The folder or file, which exists.
        hand: `right` or `left`, where files hold both.
        fps: Frames per second where there are no times.

    Raises:
        InputError: the file is damaged or of another form, or shows several hands at once.
    """
    check_rate(fps)
    if is_folder(path):
        return _read_openpose(path, hand, fps)
    readers: dict[str, Callable[[Path, float], Detections]] = {".json": _read_mediapipe, ".csv": _read_table}
    if path.suffix not in readers:
        raise InputError(
            f"{path}: expected a folder of OpenPose's *_keypoints.json, or a .json, .csv or .npz file; "
            f"got suffix {path.suffix!r}."
        )
    return readers[path.suffix](path, fps)


class HandDetections(NamedTuple):
    """Any number of hands over time, in any order; pixels or shares of the image."""

    times_s: np.ndarray
    """(frames,)."""
    points: np.ndarray
    """(frames, hands, 21, 2), NaN where nothing was found."""
    confidence: np.ndarray
    """(frames, hands, 21), 0 where nothing was found."""
    frames: np.ndarray
    """(frames,) numbers of the frames, as of `Detections`."""


def read_hands(path: Path, fps: float) -> HandDetections:
    """All hands in a folder of OpenPose's files, or in a `.json` or `.csv` of MediaPipe's landmarks.

    A table holds one hand. Hands of several people are hands of one frame.

    Args:
        path: The folder or file, which exists.
        fps: Frames per second where there are no times.

    Raises:
        InputError: the file is damaged or of another form, or shows no hand.
    """
    check_rate(fps)
    if is_folder(path):
        files, numbers = _openpose_files(path)
        frames = [[hand for side in ("right", "left") for hand in _openpose_hands(file, side)] for file in files]
        values = _stacked(frames)
        found = values[..., 2] > 0
        points, confidence = np.where(found[..., None], values[..., :2], np.nan), np.where(found, values[..., 2], 0.0)
        detections = Detections(times_of(numbers, fps), points, confidence, frames_of(numbers))
    elif path.suffix == ".json":
        named, times_s = _mediapipe_frames(path, fps)
        values = _stacked([[_mediapipe_hand(hand, name) for hand in _hands_of(frame, name)] for frame, name in named])
        detections = _detections(times_s, values[..., :2], _visibility(values[..., 2]), np.arange(len(values)))
    else:
        single = read(path, "right", fps)
        detections = single._replace(points=single.points[:, None], confidence=single.confidence[:, None])
    if not (detections.confidence > 0).any():
        raise InputError(f"{path}: no hand in any of {len(detections.times_s)} frames.")
    return HandDetections(*detections)


def _stacked(frames: list[list[np.ndarray]]) -> np.ndarray:
    """(frames, hands, 21, 3), NaN where a frame has fewer hands than another."""
    values = np.full((len(frames), max(map(len, frames), default=0), NUM_KEYPOINTS, 3), np.nan)
    for i, hands in enumerate(frames):
        values[i, : len(hands)] = np.reshape(hands, (-1, NUM_KEYPOINTS, 3))
    return values


def _openpose_files(folder: Path) -> tuple[list[Path], np.ndarray]:
    """The files of a recording in the order of their frame numbers, and these."""
    files = sorted(folder.glob("*_keypoints.json"))
    if not files:
        raise InputError(f"{folder}: no *_keypoints.json in it, which OpenPose's --write_json writes.")
    found = [re.search(r"(\d+)_keypoints$", file.stem) for file in files]
    numbers = np.arange(len(files), dtype=float)
    if all(found):
        numbers = np.asarray([float(match[1]) for match in found if match])
        order = np.argsort(numbers, kind="stable")
        files, numbers = [files[i] for i in order], numbers[order]
        if (same := np.flatnonzero(np.diff(numbers) == 0)).size:
            one, other = files[same[0]].name, files[same[0] + 1].name
            raise InputError(f"{folder}: {one} and {other} have one frame number; a folder must hold one recording.")
    return files, numbers


def _read_openpose(folder: Path, hand: str, fps: float) -> Detections:
    files, numbers = _openpose_files(folder)
    hands = {side: [_openpose_hand(file, side) for file in files] for side in ("right", "left")}
    has_hand = {side: any(numbers.any() for numbers in frames) for side, frames in hands.items()}
    other = "left" if hand == "right" else "right"
    if not has_hand[hand]:
        hint = f"; there are {other} hands: --hand {other}" if has_hand[other] else " (OpenPose needs --hand)"
        raise InputError(f"{folder}: no {hand} hand in any of {len(files)} frames{hint}.")
    values = np.stack(hands[hand])
    confidence = values[..., 2]
    points = np.where(confidence[..., None] == 0, np.nan, values[..., :2])
    return Detections(times_of(numbers, fps), points, confidence, frames_of(numbers))


def _openpose_hand(file: Path, side: str) -> np.ndarray:
    """(21, 3): x, y, confidence; zeros without a hand."""
    hands = _openpose_hands(file, side)
    if len(hands) > 1:
        raise InputError(
            f"{file}: {len(hands)} people with a {side} hand; expected at most one (OpenPose's --number_people_max 1)."
        )
    return hands[0] if hands else np.zeros((NUM_KEYPOINTS, 3))


def _openpose_hands(file: Path, side: str) -> list[np.ndarray]:
    """Of all people; each as of `_openpose_hand`."""
    frame = _json(file)
    people = frame.get("people") if isinstance(frame, dict) else None
    if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
        raise InputError(f'{file}: expected {{"people": [...]}} as OpenPose writes it.')
    key, hands = f"hand_{side}_keypoints_2d", []
    for person in people:
        numbers = _array(file, key, person.get(key) or [])
        if np.isnan(numbers).any():
            raise InputError(f"{file}: {key} must be finite; keypoints that were not found are 0, 0, 0.")
        if numbers.size and numbers.shape != (3 * NUM_KEYPOINTS,):
            raise InputError(f"{file}: {key} must be {3 * NUM_KEYPOINTS} numbers or none; got shape {numbers.shape}.")
        if numbers.any():
            hands.append(numbers.reshape(NUM_KEYPOINTS, 3))
    return hands


def _read_mediapipe(file: Path, fps: float) -> Detections:
    named, times_s = _mediapipe_frames(file, fps)
    hands = [_mediapipe_hand(_hand_of(frame, name), name) for frame, name in named]
    values = np.stack(hands) if hands else np.zeros((0, NUM_KEYPOINTS, 3))
    return _detections(times_s, values[..., :2], _visibility(values[..., 2]), np.arange(len(values)))


def _mediapipe_frames(file: Path, fps: float) -> tuple[list[tuple[Any, str]], np.ndarray]:
    """Every frame with what messages call it, and the times."""
    frames = _json(file)
    if isinstance(frames, dict) and "people" in frames:
        raise InputError(f"{file}: one frame of OpenPose; give the folder that holds it.")
    if not isinstance(frames, list):
        raise InputError(f"{file}: expected a list with 21 landmarks for each frame; got a {type(frames).__name__}.")
    times = [frame.get("time_s") if isinstance(frame, dict) else None for frame in frames]
    if len(known := [time for time in times if time is not None]) not in (0, len(frames)):
        raise InputError(f"{file}: time_s must be in every frame or in none; {len(known)} of {len(frames)} have it.")
    times_s = _array(file, "time_s", known) if known else np.arange(len(frames)) / fps
    if times_s.shape != (len(frames),):
        raise InputError(f"{file}: time_s must be one number a frame; got shape {times_s.shape}.")
    return [(frame, f"{file}: frame {i}") for i, frame in enumerate(frames)], times_s


def _hand_of(frame: Any, name: str) -> list[Any]:
    """The landmarks of the one hand in a frame, an empty list without a hand."""
    hands = _hands_of(frame, name)
    if len(hands) > 1:
        raise InputError(f"{name}: {len(hands)} hands; expected at most one (MediaPipe's num_hands=1).")
    return hands[0] if hands else []


def _hands_of(frame: Any, name: str) -> list[list[Any]]:
    """The landmarks of each hand in a frame."""
    while isinstance(frame, dict):
        keys = [key for key in _HANDS if key in frame]
        if not keys:
            raise InputError(f"{name}: expected landmarks; got an object with {shown(sorted(frame))}.")
        frame = frame[keys[0]]
    if frame is None or frame == []:
        return []
    if not isinstance(frame, list):
        raise InputError(f"{name}: expected a list of landmarks; got a {type(frame).__name__}.")
    if isinstance(frame[0], dict) and "x" in frame[0]:
        return [frame]
    return [hand for one in frame for hand in _hands_of(one, name)]


def _mediapipe_hand(landmarks: list[Any], name: str) -> np.ndarray:
    """(21, 3): x, y, visibility; NaN for what is not there."""
    if not landmarks:
        return np.full((NUM_KEYPOINTS, 3), np.nan)
    if len(landmarks) != NUM_KEYPOINTS:
        raise InputError(f"{name}: expected {NUM_KEYPOINTS} landmarks; got {len(landmarks)}.")
    rows = []
    for i, landmark in enumerate(landmarks):
        if not isinstance(landmark, dict) or not {"x", "y"} <= set(landmark):
            raise InputError(f'{name}, landmark {i}: expected {{"x", "y"}}; got {shown(landmark)}.')
        visibility = landmark.get("visibility")
        rows.append([landmark["x"], landmark["y"], np.nan if visibility is None else visibility])
    return _array(name, "landmarks", rows)


def _read_table(file: Path, fps: float) -> Detections:
    """One landmark a row (frame, landmark, x, y) or one frame a row (x0, y0 to x20, y20)."""

    def choose(names: list[str]) -> Columns:
        is_long = {"frame", "landmark", "x", "y"} <= set(names)
        if not is_long and not set(names) >= _WIDE:
            raise InputError(f"{file}: {_WANTED_TABLE}; got {shortened(', '.join(names) or 'nothing')}.")
        numbers = tuple(name for name in (_LONG if is_long else _WIDE | _WIDE_EXTRA) if name in names)
        return Columns(numbers, may_lack=frozenset(numbers))

    cells = read_table(file, _WANTED_TABLE, choose).numbers
    numbers, values, times = (_from_long if "landmark" in cells else _from_wide)(file, cells)
    if not len(numbers):
        raise InputError(f"{file}: no rows in it.")
    return _with_gaps(file, numbers, values, times, fps)


def _from_long(file: Path, cells: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    frames, landmarks = (_whole(file, name, cells[name]) for name in ("frame", "landmark"))
    if (wrong := (landmarks < 0) | (landmarks >= NUM_KEYPOINTS)).any():
        raise InputError(f"{file}: landmark must be 0 to {NUM_KEYPOINTS - 1}; got {landmarks[wrong][0]}.")
    numbers, places = np.unique(frames, return_inverse=True)
    pairs, counts = np.unique(np.stack([frames, landmarks]), axis=1, return_counts=True)
    if (counts > 1).any():
        frame, landmark = pairs[:, np.argmax(counts > 1)]
        raise InputError(
            f"{file}: {counts.max()} hands; expected at most one: landmark {landmark} of frame {frame} is there again."
        )
    values = np.full((len(numbers), NUM_KEYPOINTS, 3), np.nan)
    missing = np.full(len(frames), np.nan)
    confidence = cells.get("confidence", _visibility(cells.get("visibility", missing)))
    values[places, landmarks] = np.stack([cells["x"], cells["y"], confidence], axis=1)
    if "time_s" not in cells:
        return numbers, values, None
    times = np.full(len(numbers), np.nan)
    times[places] = cells["time_s"]
    return numbers, values, times


def _from_wide(file: Path, cells: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    rows = len(cells["x0"])
    missing = np.full(rows, np.nan)
    columns = [[cells.get(f"{letter}{i}", missing) for letter in "xyc"] for i in range(NUM_KEYPOINTS)]
    values = np.moveaxis(np.asarray(columns), -1, 0)
    numbers = _whole(file, "frame", cells["frame"]) if "frame" in cells else np.arange(rows)
    return numbers, values, cells.get("time_s")


def _with_gaps(file: Path, numbers: np.ndarray, values: np.ndarray, times: np.ndarray | None, fps: float) -> Detections:
    """Frames that the table leaves out, because nothing was found in them, as frames in which nothing was found."""
    steps = np.diff(numbers)
    if (steps <= 0).any():
        i = int(np.argmax(steps <= 0))
        raise InputError(f"{file}: frames must increase; frame {numbers[i + 1]} follows frame {numbers[i]}.")
    if times is not None and not np.isfinite(times).all():
        frame = numbers[~np.isfinite(times)][0]
        raise InputError(f"{file}: time_s must be a number in every row; frame {frame} lacks it.")
    step = int(np.gcd.reduce(steps)) if len(steps) else 1
    places = (numbers - numbers[0]) // step
    if places[-1] + 1 > min(_MOST_GAPS * len(numbers), _MOST_FRAMES):
        raise InputError(
            f"{file}: {len(numbers)} frames numbered from {numbers[0]} to {numbers[-1]}: too many gaps, or too many."
        )
    whole = np.full((places[-1] + 1, NUM_KEYPOINTS, 3), np.nan)
    whole[places] = values
    every = numbers[0] + step * np.arange(len(whole))
    times_s = times_of(every, fps) if times is None else np.interp(every, numbers, times)
    return _detections(times_s, whole[..., :2], whole[..., 2], frames_of(every))


def _detections(times_s: np.ndarray, points: np.ndarray, confidence: np.ndarray, frames: np.ndarray) -> Detections:
    """Confidence 1 where a keypoint has none, 0 where it was not found."""
    found = ~np.isnan(points).any(axis=-1)
    return Detections(times_s, points, np.where(found, np.where(np.isnan(confidence), 1.0, confidence), 0.0), frames)


def _visibility(values: np.ndarray) -> np.ndarray:
    """As it is, or NaN where the detector left all of them at 0: they mean nothing then."""
    return values if np.nan_to_num(values).any() else np.full_like(values, np.nan)


def _json(file: Path) -> Any:
    return read_json_value(file, "expected landmarks of a hand")


def _array(name: Any, what: str, numbers: Any) -> np.ndarray:
    try:
        found = np.asarray(numbers, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {what} must be numbers.") from None
    if too_large(found).any():
        raise InputError(f"{name}: {what} must be numbers of at most {LARGEST:g}.")
    return found


def _whole(file: Path, name: str, values: np.ndarray) -> np.ndarray:
    if not (np.isfinite(values) & (values == np.floor(values))).all():
        raise InputError(f"{file}: {name} must be whole numbers.")
    return values.astype(np.int64)
