"""Depth recordings of hands with joints: motions of real hands rendered from scanned ones, and one of a depth camera.

The motions are those of D. Tzionas et al., "Capturing hands in action using discriminative salient points and physics
simulation", IJCV 2016: a scanned surface, bent by linear blend skinning as their tracker followed a real hand, is exact
truth for what is rendered of it, and is not the shape of the tracker's model. The camera's recording (hpx) is real
depth, whose joints are a fit of another model.
"""

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.io.depth import open_depth

DEVELOPMENT = ("01_L", "01_R", "03_L", "05_R", "06_L", "07_R", "08_R", "15_R", "hpx")
"""Recordings on which the tracker was developed."""
HELD = ("02_L", "02_R", "03_R", "04_L", "04_R", "05_L", "06_R", "07_L", "10_R", "17_L", "17_R")
"""Motions on which nothing was chosen, except on 17 how much deeper a poor start is looked for again
(`models.hand.start.DEEPER`); the two scanned hands are those of the others."""
NUM_FRAMES = 48
RATE = 30.0
"""Frames a second of the motions."""
NOISE_M, WALL_M = 0.0015, 1.5
"""Standard deviation of a reading, and the distance of what is behind the hand."""
CLOSE_MM = 25.0
"""Mean joint error below which a pose is right: hands of the other side, or turned over, are 60 to 80 off."""
_SPLIT, _SPLIT_NEARER = 6, 8
"""Parts of a triangle's side at whose corners it is sampled: a pixel or less where the motions were recorded, and at
any distance from 0.3 m on."""
PALM = [0, 5, 9, 17]
"""Joints whose middle is that of the palm."""
_DIGITS = (4, 3, 2, 1, 0)
"""Their names of thumb, index, middle, ring and little finger."""


class HandRecording(NamedTuple):
    """Depth frames of one hand, and its joints."""

    camera: Pinhole
    times_s: Float[np.ndarray, " t"]
    depth: Float[np.ndarray, "t rows cols"]
    """Metres, NaN without a reading."""
    joints: Float[np.ndarray, "t 21 3"]
    """Metres, camera frame, in the order of `JOINT_NAMES`; the tips are on the skin."""
    side: float
    """+1 for a right hand, -1 for a left one."""


PalmPath = Callable[[Float[np.ndarray, "t 3"]], Float[np.ndarray, "t 3"]]
"""Where the middle of a palm is to be in each frame, of where it was recorded; metres, camera frame."""


def load(
    name: str,
    num_frames: int = NUM_FRAMES,
    *,
    every: int = 1,
    evenly: bool = False,
    turned_deg: tuple[float, float] = (0.0, 0.0),
    palm_at_m: PalmPath | None = None,
    wall_m: float = WALL_M,
) -> HandRecording:
    """One of `DEVELOPMENT` or `HELD`: the frames in the middle of a motion, the first ones of a camera's recording.

    Args:
        name: Of the recording.
        num_frames: How many frames, or as many as there are.
        every: One of so many frames is taken, as by a camera of a lower rate.
        evenly: The frames of a motion are spread over all of it, so that the times are no longer those of the motion.
        turned_deg: A motion is turned by this about the x and then the y axis of the camera, in each frame about the
            middle of the palm.
        palm_at_m: A motion is moved such that the middle of the palm is there.
        wall_m: Distance of what is behind the hand of a motion.

    Raises:
        RecordingError: the data are not there.
    """
    if name == "hpx":
        return _camera_recording(recording_folder("hpx_hand_rgbd") / "hpx.npz", num_frames, every)
    with np.load(recording_folder("tzionas_hand_motion") / "tzionas_hand_motion.npz") as data:
        sequence, side = name.split("_")
        if f"seq{sequence}_{side}" not in data:
            raise RecordingError(f"tzionas_hand_motion holds no motion seq{sequence}_{side}.")
        motion = data[f"seq{sequence}_{side}"].astype(float)
        hand = {part: data[f"{side}_{part}"] for part in ("bones", "verts", "faces", "weights", "bind")}
        matrix = data["K"]
    first = max(0, (len(motion) - every * num_frames) // 2)
    spread = np.linspace(0, len(motion) - 1, num_frames).round().astype(int)
    motion = motion[spread] if evenly else motion[first : first + every * num_frames : every]
    lengths = _tip_lengths(recording_folder("tzionas_hand_motion") / f"Model_Hand_{side}.SKEL")
    palm = _joints(motion, hand, lengths, side)[:, PALM].mean(axis=1)
    if any(turned_deg):
        motion = _turned(motion, 1000 * palm, turned_deg)
    if palm_at_m is not None:
        motion = motion + np.pad(1000 * (palm_at_m(palm) - palm)[:, None, :, None], ((0, 0), (0, 0), (0, 0), (3, 0)))
    shape, rng = (480, 640), np.random.default_rng(int(sequence))
    parts = _SPLIT if palm_at_m is None else _SPLIT_NEARER
    depth = np.stack([_rendered(vertices, hand["faces"], matrix, shape, parts) for vertices in _skinned(motion, hand)])
    depth = np.round(depth + NOISE_M * rng.normal(size=depth.shape), 3)
    depth = np.where(np.isfinite(depth), depth, wall_m).astype(np.float32)
    camera = Pinhole.from_matrix(matrix, shape)
    times = np.arange(len(motion), dtype=np.float32) * np.float32(every / RATE)
    return HandRecording(camera, times, depth, _joints(motion, hand, lengths, side), 1.0 if side == "R" else -1.0)


def _turned(
    motion: Float[np.ndarray, "t b 3 4"], about_mm: Float[np.ndarray, "t 3"], degrees: tuple[float, float]
) -> Float[np.ndarray, "t b 3 4"]:
    across, upright = (cv2.Rodrigues(np.deg2rad(angle) * np.eye(3)[axis])[0] for axis, angle in enumerate(degrees))
    turn = upright @ across
    offset = np.pad((about_mm - about_mm @ turn.T)[:, None, :, None], ((0, 0), (0, 0), (0, 0), (3, 0)))
    return np.asarray(turn @ motion + offset)


def pip_flexion(joints: Float[np.ndarray, "t 21 3"]) -> Float[np.ndarray, "t 4"]:
    """Angles in radians between the first two phalanges of the four fingers."""
    fingers = joints[:, 5:].reshape(-1, 4, 4, 3)
    bones = np.diff(fingers[:, :, :3], axis=2)
    bones = bones / np.linalg.norm(bones, axis=-1, keepdims=True)
    return np.arccos(np.clip(np.sum(bones[:, :, 0] * bones[:, :, 1], axis=-1), -1.0, 1.0))


def _camera_recording(path: Path, num_frames: int, every: int) -> HandRecording:
    recording = open_depth(path)
    taken = np.arange(len(recording))[::every][:num_frames]
    depth = np.stack([recording[i] for i in taken])
    times = (recording.times_s - recording.times_s[0]).astype(np.float32)[taken]
    return HandRecording(recording.camera, times, depth, np.asarray(recording.joints)[taken], 1.0)


def _skinned(motion: Float[np.ndarray, "t b 3 4"], hand: dict[str, np.ndarray]) -> Iterator[Float[np.ndarray, "v 3"]]:
    """Vertices in each frame, millimetres: linear blend skinning."""
    rest = np.linalg.inv(_square(hand["bind"].astype(float)))
    points = np.c_[hand["verts"], np.ones(len(hand["verts"]))]
    for transforms in motion:
        yield np.einsum("vb,bij,vj->vi", hand["weights"].astype(float), transforms @ rest, points, optimize=True)


def _square(transforms: Float[np.ndarray, "b 3 4"]) -> Float[np.ndarray, "b 4 4"]:
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(transforms), 1, 4))
    return np.concatenate([transforms, last], axis=1)


def _rendered(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    matrix: np.ndarray,
    shape: tuple[int, int],
    parts: int = _SPLIT,
) -> Float[np.ndarray, "rows cols"]:
    """Depth in metres of a dense surface, by points of its triangles; `inf` beside it."""
    corners = [(i, j, parts - i - j) for i, j in product(range(parts + 1), repeat=2) if i + j <= parts]
    points = np.einsum("kc,fcx->fkx", np.array(corners) / parts, vertices[faces]).reshape(-1, 3)
    pixels = points @ matrix.T
    u, v = np.rint(pixels[:, :2] / pixels[:, 2:]).astype(int).T
    inside = (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0])
    depth = np.full(shape[0] * shape[1], np.inf)
    np.minimum.at(depth, v[inside] * shape[1] + u[inside], 1e-3 * points[inside, 2])
    return depth.reshape(shape)


def _joints(
    motion: Float[np.ndarray, "t b 3 4"], hand: dict[str, np.ndarray], lengths: dict[str, float], side: str
) -> Float[np.ndarray, "t 21 3"]:
    """Origins of the bones, and the ends of the last ones, metres."""
    names = [str(name) for name in hand["bones"]]
    joints = [motion[:, names.index(f"Lower Arm {side}"), :, 3]]
    for digit in _DIGITS:
        chain = [f"{side}Fing.{digit}_{part}" for part in (("Hand", 0, 1) if digit == _DIGITS[0] else (0, 1, 2))]
        joints += [motion[:, names.index(name), :, 3] for name in chain]
        before, last = (hand["bind"][names.index(name)].astype(float) for name in chain[1:])
        along = before[:, :3].T @ (last[:, 3] - before[:, 3])  # a bone lies along one axis of its own frame
        axis = int(np.argmax(np.abs(along)))
        direction = np.sign(along[axis]) * motion[:, names.index(chain[2]), :, axis]
        joints.append(joints[-1] + lengths[chain[2]] * direction)
    return 1e-3 * np.stack(joints, axis=1)


def _tip_lengths(path: Path) -> dict[str, float]:
    """Lengths of the bones by name, millimetres, of a skeleton's file: lines of parent, name and length in turn."""
    lines = [line.strip() for line in path.read_text().splitlines() if line.strip()]
    lines = lines[len(lines) % 3 :]
    return {name: float(length) for name, length in zip(lines[1::3], lines[2::3], strict=True)}
