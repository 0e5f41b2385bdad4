"""Recorded head rotations and expressions as courses for modelled faces, at 30 frames a second."""

import csv
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from jaxfilters.models.synthetic.face_motion import FPS, STEREO_PLACE_MM

BIWI_FILE, BIWI_FPS = "biwi_1_14.npz", 25.0
"""The rate is not known exactly: 20 to 30 frames a second."""
LIVELINK_FILE, LIVELINK_FPS = "livelink_rows_0_199.csv", 60.0
NECK_MM = (0.0, 75.0, 95.0)
"""What heads turn about, from the centroid of the landmarks."""
BEGIN_S, EASE_S = 1.0, 1.0
"""How long a course stays as it begins, facing ahead without expression, and how long it takes to follow the record."""
_BOTH_SIDES = ("BrowInnerUp", "CheekPuff")


def read_biwi(folder: Path) -> list[Float[np.ndarray, "frames 3"]]:
    """Rotations (roll, yaw, pitch) in radians of every stretch without gaps, sequence after sequence.

    The file's `pyr_deg` turn about z, then y, then x in a frame with y up and z towards the camera, which inverts roll
    and yaw here. (Face boxes agree: they move to the left with our yaw, down with our pitch.)

    Raises:
        ValueError: if the folder lacks the file.
    """
    if not (folder / BIWI_FILE).is_file():
        raise ValueError(f"folder must hold {BIWI_FILE}; {folder} does not.")
    with np.load(folder / BIWI_FILE) as file:
        sequence, frame, degrees = file["seq"], file["frame"].astype(int), file["pyr_deg"]
    angles = np.radians(np.stack([-degrees[:, 2], -degrees[:, 1], degrees[:, 0]], axis=-1))
    return [angles[rows] for rows in _stretches(sequence, frame)]


def read_livelink(folder: Path, names: tuple[str, ...]) -> Float[np.ndarray, "rows expressions"]:
    """Strengths of the named expressions (`jawOpen`, `mouthSmile_L`, ...) in every row of a recording.

    Columns are called `JawOpen`, `MouthSmileLeft`, ...; a column without side moves both. What was not recorded is 0.

    Raises:
        ValueError: if the folder lacks the file, or the file has none of the expressions.
    """
    if not (folder / LIVELINK_FILE).is_file():
        raise ValueError(f"folder must hold {LIVELINK_FILE}; {folder} does not.")
    with (folder / LIVELINK_FILE).open(newline="") as file:
        header, *rows = csv.reader(file)
    columns = {_model_name(name): index for index, name in enumerate(header[2:])}
    sided = [_model_name(name) for name in _BOTH_SIDES if _model_name(name) in columns]
    columns |= {f"{name}{side}": columns[name] for name in sided for side in ("_L", "_R")}
    known = [name for name in names if name in columns]
    if not known:
        raise ValueError(f"{folder / LIVELINK_FILE} must have expressions of the model; it has {header[2:5]}...")
    recorded = np.array([[float(cell) for cell in row[2:]] for row in rows if len(row) == len(header)])
    strengths = np.zeros((len(recorded), len(names)))
    for index, name in enumerate(names):
        if name in columns:
            strengths[:, index] = recorded[:, columns[name]]
    return strengths


def biwi_course(
    angles: Float[np.ndarray, "recorded 3"],
    num_frames: int,
    *,
    fps: float = BIWI_FPS,
    place_mm: tuple[float, float, float] = STEREO_PLACE_MM,
) -> Float[np.ndarray, "frames 6"]:
    """Poses, millimetres and radians, of a head that faces ahead for a second and then turns as recorded.

    The head turns about its neck. Rotations in between are those of constant angular velocity; a record that is too
    short runs back and forth.

    Args:
        angles: Recorded (roll, yaw, pitch) without gaps.
        num_frames: How many, at 30 a second.
        fps: Of the record.
        place_mm: Of the centroid of the landmarks while the head faces ahead.
    """
    recorded = Slerp(np.arange(len(angles)), Rotation.from_euler("ZYX", angles))(
        _back_and_forth(num_frames, len(angles), fps)
    )
    turned = Rotation.from_rotvec(recorded.as_rotvec() * _share(num_frames)[:, None])
    neck = np.array(NECK_MM)
    return np.concatenate([np.array(place_mm) + neck - turned.apply(neck), turned.as_euler("ZYX")], axis=-1)


def livelink_course(
    strengths: Float[np.ndarray, "rows expressions"], num_frames: int, *, fps: float = LIVELINK_FPS
) -> Float[np.ndarray, "frames expressions"]:
    """Strengths at 30 frames a second of a face that is neutral for a second and then moves as recorded.

    A record that is too short runs back and forth.
    """
    at = _back_and_forth(num_frames, len(strengths), fps)
    rows = np.arange(len(strengths))
    columns = [np.interp(at, rows, column) for column in strengths.T]
    return _share(num_frames)[:, None] * np.stack(columns, axis=-1)


def _back_and_forth(num_frames, num_recorded, fps):
    """Place in the record, in its frames, of every frame."""
    walked = np.maximum(np.arange(num_frames) / FPS - BEGIN_S, 0) * fps
    last = num_recorded - 1
    if last == 0:
        return np.zeros(num_frames)
    return last - np.abs(np.mod(walked, 2 * last) - last)


def _share(num_frames):
    """0 while the course begins, then up to 1."""
    share = np.clip((np.arange(num_frames) / FPS - BEGIN_S) / EASE_S, 0, 1)
    return share * share * (3 - 2 * share)


def _stretches(sequence: Int[np.ndarray, " rows"], frame: Int[np.ndarray, " rows"]) -> list[slice]:
    """Rows of one sequence whose frames follow one another."""
    breaks = np.flatnonzero((np.diff(sequence) != 0) | (np.diff(frame) != 1)) + 1
    bounds = [0, *breaks.tolist(), len(frame)]
    return [slice(start, stop) for start, stop in pairwise(bounds)]


def _model_name(column):
    for side in ("Left", "Right"):
        if column.endswith(side) and not column.startswith(("JawLeft", "JawRight", "MouthLeft", "MouthRight")):
            return f"{column[0].lower()}{column[1 : -len(side)]}_{side[0]}"
    return column[0].lower() + column[1:]
