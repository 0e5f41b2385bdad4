"""Modelled people from their images alone, at several distances too, beside `solvePnP`.

Nothing is known of a person or of where the landmarks are: the detectors find them, as for a user. The same detections
go to the simplest things that could work: the landmarks to OpenCV's `solvePnP` with the mean face of the same model,
and meshes, where the detector gives them, to the rotation that takes the mean mesh nearest to them. All are judged on
the same frames: those in which the detector finds a face and the tracker follows it. The people are none of those whom
the detectors' errors were measured on (`jaxfilters fit face-detector`).
"""

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.metrics import WITHIN_TWO_SIGMA, Metric
from jaxfilters.benchmarks.recordings import recording_folder
from jaxfilters.benchmarks.scenarios._mono_real import NUM_FRAMES, PEOPLE, QUICK_NUM_FRAMES, filmed, modelled_face
from jaxfilters.benchmarks.scenarios._poses import DISPLAY, in_millimetres, pose_errors
from jaxfilters.models.face.multilinear import MultilinearFace, shape
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.synthetic.ict_course import read_biwi, read_livelink
from jaxfilters.models.synthetic.ict_face import read_ict
from jaxfilters.models.synthetic.ict_sequence import IctSequence
from jaxfilters.trackers.head.common.table import TRACKED
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.detectors import DETECTORS, Detector
from jaxfilters.trackers.head.mono.mesh_rotation import measured, on_axes_of
from jaxfilters.trackers.head.mono.session import MonoSession
from jaxfilters.trackers.head.mono.state import MonoTrack
from jaxfilters.trackers.io.face_models import people_face_model

SUFFIXES = {"cascades": "", "mediapipe": "_mediapipe"}
"""Of the metrics, by detector."""
WORN: dict[str, dict[str, Any]] = {"glasses": {"has_glasses": True}, "beard": {"beard": 0.9}}
"""What the same people wear besides, in runs of their own with the model of the package."""
DISTANCES_MM, DISTANCE_FRAMES = (300, 650, 1500), 150
"""Of the same people in runs of their own, with the model of the package; 150 frames are five seconds."""
AXES = {"x": 0, "y": 1, "z": 2, "roll": 3, "yaw": 4, "pitch": 5}
EVERY = 3
"""Frames from one in which landmarks are detected for `solvePnP` to the next."""
PIECE = 30
"""Frames that are handed over at once."""
FACING = np.array([0.0, 0.0, 600.0])
"""Millimetres: where `solvePnP` starts, without a rotation."""


class DetectedRun(NamedTuple):
    """Errors in the frames in which there are a track and a detection; millimetres and degrees."""

    errors: Float[np.ndarray, "n 6"]
    """Of the tracker."""
    std: Float[np.ndarray, "n 6"]
    """That it claims."""
    pnp_errors: Float[np.ndarray, "n 6"]
    distance: Float[np.ndarray, " n"]
    """True depth."""
    lost_share: float
    """Of the frames after the start in which the face is not followed."""
    mesh_errors: Float[np.ndarray, "n 3"] | None = None
    """Of roll, yaw and pitch of the mesh alone, if the detector gives one."""


def people_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Errors of both detectors with a model of other people of the same kind, and with that of the package.

    With the latter also of the same people with glasses, and with a beard.

    Raises:
        RecordingError: if a recording is missing.
    """
    film = filming(quick, seed)
    faces = {"modelled": modelled_face(seed)}
    if not quick:
        faces["modelled_rendered"] = people_face_model().model
    detectors = available_detectors()
    runs: dict[str, list[DetectedRun]] = {}

    def follow(made: IctSequence, kind: str, face: MultilinearFace, person: int) -> None:
        for name, detector in detectors.items():
            one = detected_run(made, face, detector, person + seed)
            runs.setdefault(f"{kind}{SUFFIXES[name]}", []).append(one)
            means = {"tracked": one.errors, "solvePnP": one.pnp_errors}
            message = ", ".join(f"{key} {np.round(np.mean(errors, axis=0), 1)}" for key, errors in means.items())
            sys.stderr.write(f"  person {person}, {kind}, {name}: mean errors {message}\n")

    for person, stretch in PEOPLE[: 1 if quick else None]:
        made = film(person, stretch)
        for kind, face in faces.items():
            follow(made, kind, face, person)
        for worn, how in ({} if quick else WORN).items():
            made = film(person, stretch, **how)
            follow(made, f"modelled_{worn}", faces["modelled_rendered"], person)
    metrics: dict[str, Metric] = {}
    for name, of_people in runs.items():
        metrics |= detected_metrics(name, of_people)
    return metrics


def distance_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Errors of both detectors with the model of the package, for people at each of `DISTANCES_MM`.

    In all but the distance they are those of `people_metrics`, for a shorter time.

    Raises:
        RecordingError: if a recording is missing.
    """
    film, face, detectors = filming(quick, seed, DISTANCE_FRAMES), people_face_model().model, available_detectors()
    runs: dict[str, list[DetectedRun]] = {}
    for person, stretch in PEOPLE[: 1 if quick else None]:
        for distance in DISTANCES_MM:
            made = film(person, stretch, distance_mm=float(distance))
            for name, detector in detectors.items():
                one = detected_run(made, face, detector, person + seed)
                runs.setdefault(f"modelled_at_{distance}mm{SUFFIXES[name]}", []).append(one)
                sys.stderr.write(f"  person {person}, {distance} mm, {name}: {len(one.errors)} frames judged\n")
    metrics: dict[str, Metric] = {}
    for name, of_people in runs.items():
        metrics |= detected_metrics(name, of_people)
    return metrics


def filming(quick: bool, seed: int, num_frames: int = NUM_FRAMES) -> Callable[..., IctSequence]:
    """`(person, stretch, **how) -> sequence`: people who turn and speak as recorded, before one camera.

    `how` is the distance, or what they wear; see `filmed`.

    Raises:
        RecordingError: if a recording is missing.
    """
    model = read_ict(recording_folder("ict_face_model"))
    turns = read_biwi(recording_folder("biwi_head_rotation"))
    speech = read_livelink(recording_folder("livelinkface_take"), model.names)
    num_frames = QUICK_NUM_FRAMES if quick else num_frames

    def film(person: int, stretch: int, **how: Any) -> IctSequence:
        return filmed(model, turns[stretch], speech, person + seed, num_frames, **how)

    return film


def available_detectors() -> dict[str, Detector]:
    """Those that can be loaded here; the others are said and left out."""
    found: dict[str, Detector] = {}
    for name in SUFFIXES:
        try:
            found[name] = DETECTORS[name]()
        except ImportError as error:
            sys.stderr.write(f"  left out: detector {name} ({error})\n")
    return found


def detected_run(made: IctSequence, face: MultilinearFace, detector: Detector, seed: int) -> DetectedRun:
    """One person, followed and located frame by frame from the same detector.

    Args:
        made: The person before one camera.
        face: Model of ten landmarks.
        detector: Of the landmarks.
        seed: Of the particles.
    """
    images = made.frames(0, len(made))
    track = followed(made, images, face, detector, seed)
    located, by_mesh = np.full((2, len(images), 6), np.nan)
    known = None if detector.errors is None else detector.errors.vertices
    vertices = None if known is None else on_axes_of(face, known)
    for i in range(0, len(images), EVERY):
        found = detector.detect(images[i, 0], None)
        if isinstance(found, str):
            continue
        located[i] = pnp(face, made.rig, found.points)
        if vertices is not None and found.solid is not None:
            by_mesh[i, 3:] = measured(vertices, found.solid, made.rig)[0]
    return _evaluated(made, track, located, by_mesh)


def followed(
    made: IctSequence, images: UInt8[np.ndarray, "t 1 rows cols"], face: MultilinearFace, detector: Detector, seed: int
) -> MonoTrack:
    """Track of all images of one person, of whom nothing else is known; millimetres."""
    session = MonoSession(made.rig, face, MonoConfig(seed=seed), detector=detector)
    pieces = [slice(start, start + PIECE) for start in range(0, len(images), PIECE)]
    parts = [session.process(images[piece], made.times[piece]) for piece in pieces]
    return in_millimetres(jax.tree.map(lambda *rows: np.concatenate(rows), *parts))


def pnp(face: MultilinearFace, rig: CameraRig, points: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, " 6"]:
    """Pose of the mean face by `solvePnP` from detected landmarks, millimetres and radians."""
    mean = np.asarray(shape(face, face.identity_mean, face.expression_mean), float)
    start = np.zeros((3, 1)), FACING[:, None].copy()
    (fx, fy), (cx, cy) = np.asarray(rig.focal[0], float), np.asarray(rig.center[0], float)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    _, turn, place = cv2.solvePnP(mean, points, K, np.zeros(5), *start, useExtrinsicGuess=True)
    return np.concatenate([place.ravel(), Rotation.from_rotvec(turn.ravel()).as_euler("ZYX")])


def detected_metrics(name: str, runs: list[DetectedRun]) -> dict[str, Metric]:
    """Errors, coverage of two standard deviations, and those of the simplest methods, over all people.

    Errors of depth are sizes of each person's mean error: how large a face is stays unknown, whatever is averaged.

    Args:
        name: Suffix of the metrics.
        runs: Of all people; who was never tracked counts as lost, and for nothing else.
    """
    lost = float(np.mean([run.lost_share for run in runs]))
    metrics = {f"lost_share_{name}": Metric(100 * lost, "%", "lower")}
    runs = [run for run in runs if len(run.errors)]
    if not runs:
        return metrics
    for prefix, errors in (("", [r.errors for r in runs]), ("pnp_", [r.pnp_errors for r in runs])):
        every = np.concatenate(errors)
        metrics |= {
            f"{prefix}{axis}_rms_deg_{name}": Metric(float(np.sqrt(np.mean(every[:, i] ** 2))), "deg", "lower")
            for axis, i in AXES.items()
            if i > 2
        }
        depth = np.array([np.mean(one[:, 2]) for one in errors])
        share = np.array([np.mean(one[:, 2] / run.distance) for one, run in zip(errors, runs, strict=True)])
        metrics |= {
            f"{prefix}z_error_mm_{name}": Metric(float(np.mean(np.abs(depth))), "mm", "lower"),
            f"{prefix}z_bias_share_{name}": Metric(100 * abs(float(np.mean(share))), "%", "lower"),
        }
    meshes = [run.mesh_errors for run in runs if run.mesh_errors is not None]
    if meshes:
        rms = np.sqrt(np.mean(np.square(np.concatenate(meshes)), axis=0))
        metrics |= {
            f"mesh_{axis}_rms_deg_{name}": Metric(float(rms[i - 3]), "deg", "lower")
            for axis, i in AXES.items()
            if i > 2
        }
    within = np.concatenate([np.abs(run.errors) <= 2 * run.std for run in runs])
    metrics |= {
        f"coverage2_{axis}_{name}": Metric(100 * float(np.mean(within[:, i])), "%", 100 * WITHIN_TWO_SIGMA)
        for axis, i in AXES.items()
    }
    return metrics


def _evaluated(
    made: IctSequence, track: MonoTrack, located: Float[np.ndarray, "t 6"], by_mesh: Float[np.ndarray, "t 6"]
) -> DetectedRun:
    is_tracked = np.isin(track.status, TRACKED)
    rows = np.flatnonzero(is_tracked & np.isfinite(located[:, 0]))
    begun = int(np.argmax(is_tracked)) if is_tracked.any() else 0
    errors, beside, of_mesh = (pose_errors(one, made.poses)[rows] for one in (track.pose, located, by_mesh))
    lost = float(np.mean(~is_tracked[begun:]))
    has_meshes = bool(len(rows)) and bool(np.all(np.isfinite(of_mesh[:, 3:])))
    std, distance = np.asarray(track.pose_std)[rows] * DISPLAY, made.poses[rows, 2]
    return DetectedRun(errors, std, beside, distance, lost, of_mesh[:, 3:] if has_meshes else None)
