"""Modelled people that turn and speak as recorded, and real video, before one camera."""

import sys
from functools import cache
from typing import Any

import jax
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios._mesh_agreement import agreement
from jaxfilters.benchmarks.scenarios._mono_runs import Contender, MonoRun, camera, follow_all
from jaxfilters.benchmarks.scenarios._poses import in_millimetres
from jaxfilters.benchmarks.scenarios.head_real import VIDEOS, detector_distances, longest, read_video
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.face.mirroring import PAIRS, PAIRS_68, Pairs
from jaxfilters.models.face.multilinear import MultilinearFace, learn
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.face_motion import MONOCULAR_PLACE_MM
from jaxfilters.models.synthetic.face_training import ict_shapes
from jaxfilters.models.synthetic.ict_course import biwi_course, livelink_course, read_biwi, read_livelink
from jaxfilters.models.synthetic.ict_face import IctModel, read_ict
from jaxfilters.models.synthetic.ict_sequence import IctSequence, ict_sequence
from jaxfilters.trackers.head.common.focal_prior import usual_focal
from jaxfilters.trackers.head.common.table import TRACKED
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.dense import NUM_DENSE
from jaxfilters.trackers.head.mono.session import MonoSession
from jaxfilters.trackers.io.face_models import people_face_model

PEOPLE = ((0, 1), (1, 2), (2, 0), (3, 13), (4, 5), (5, 14), (6, 3), (7, 8))
"""Random key of the person, and which stretch of recorded rotations."""
NUM_FRAMES, QUICK_NUM_FRAMES, QUICK_VIDEO_FRAMES = 300, 64, 90
RANGES = {"0_10": (0, 10), "10_20": (10, 20), "20_30": (20, 30), "30_40": (30, 40), "beyond_40": (40, 91)}
"""Degrees of yaw to either side."""
ROTATIONS = {"roll": 3, "yaw": 4, "pitch": 5}
ON_REAL_IMAGES = {
    "WHENet": (5.72, 8.05, 8.00),
    "FSA-Net": (4.55, 6.27, 6.43),
    "Hopenet": (4.21, 5.32, 7.65),
    "6DRepNet": (3.50, 5.21, 6.55),
    "RCRw": (2.89, 3.95, 4.73),
}
"""Mean absolute errors of roll, yaw and pitch in degrees of networks that see one of the real images at a time, on the
calibrated recordings whose rotations are rendered here (github.com/kuhnkeF/headposeplus, "Results on Biwi+")."""
NUM_TRAINING, IDENTITIES, EXPRESSIONS = 200, 15, 8
TRAINING_KEY, FIRST_PERSON = 2000, 100
"""Of training people, and of those who are filmed: never the same."""
PIECE = 48
"""Frames that are handed over at once."""


def modelled_face(seed: int, landmarks: tuple[int, ...] = FROM_68, pairs: Pairs = PAIRS) -> MultilinearFace:
    """What people of the ICT face model differ in.

    Args:
        seed: Of the people.
        landmarks: Which of the 68 of iBUG.
        pairs: (right, left) among them.

    Raises:
        RecordingError: if the model is not there.
    """
    model = read_ict(recording_folder("ict_face_model"))
    key = jax.random.key(TRAINING_KEY + seed)
    shapes = ict_shapes(key, model, NUM_TRAINING, landmarks=landmarks, noise_mm=0.5)
    return learn(shapes, identities=IDENTITIES, expressions=EXPRESSIONS, pairs=pairs)


@cache
def cross_model(seed: int) -> dict[str, Contender]:
    """The tracker with what modelled people differ in, for faces of the generator; nothing without that model."""
    try:
        return {"b_rendered_modelled": Contender(modelled_face(seed), MonoConfig())}
    except RecordingError as error:
        sys.stderr.write(f"  left out: {error}\n")
        return {}


def modelled_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Mean absolute errors of the rotation of modelled people, by axis and by yaw, with two models of faces.

    With one of them also from all 68 landmarks of the first frames. What networks reach on the real images is said
    beside, for an idea of the scale: those are other faces, light and cameras, and no track.

    Raises:
        RecordingError: if a recording is missing.
    """
    model = read_ict(recording_folder("ict_face_model"))
    turns = read_biwi(recording_folder("biwi_head_rotation"))
    speech = read_livelink(recording_folder("livelinkface_take"), model.names)
    contenders = {"modelled": Contender(modelled_face(seed), MonoConfig())}
    if not quick:
        dense = modelled_face(seed, tuple(range(NUM_DENSE)), PAIRS_68)
        contenders["modelled_68"] = Contender(dense, MonoConfig())
        contenders["modelled_rendered"] = Contender(people_face_model().model, MonoConfig())
    runs: dict[str, list[MonoRun]] = {name: [] for name in contenders}
    num_frames = QUICK_NUM_FRAMES if quick else NUM_FRAMES
    for person, stretch in PEOPLE[: 1 if quick else None]:
        made = filmed(model, turns[stretch], speech, person + seed, num_frames)
        for name, one in follow_all(made, contenders, person + seed).items():
            runs[name].append(one)
            sys.stderr.write(f"  person {person}, {name}: {np.round(one.means, 1)}\n")
    for name, errors in ON_REAL_IMAGES.items():
        sys.stderr.write(f"  beside: {name} on the real images, roll, yaw and pitch to {errors} degrees\n")
    metrics: dict[str, Metric] = {}
    for name, of_people in runs.items():
        metrics |= _by_yaw(name, of_people)
    return metrics


def video_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """How long the faces of the videos are followed, how near to where they are detected, and how much as by a mesh.

    Raises:
        RecordingError: if the videos are missing.
    """
    folder = recording_folder("talking_face_video")
    metrics: dict[str, Metric] = {}
    for name, file in list(VIDEOS.items())[: 1 if quick else None]:
        images, fps = read_video(folder / file, QUICK_VIDEO_FRAMES if quick else None)
        rows, cols = images.shape[1:]
        focal = usual_focal((cols, rows))
        rig = monocular(Pinhole.from_intrinsics(focal.px, ((cols - 1) / 2, (rows - 1) / 2), (rows, cols)))
        session = MonoSession(rig, people_face_model().model, MonoConfig(seed=seed), focal_log_std=focal.log_std)
        times = np.arange(len(images)) / fps
        parts = [
            session.process(images[i : i + PIECE, None], times[i : i + PIECE]) for i in range(0, len(images), PIECE)
        ]
        track = in_millimetres(jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts))
        is_tracked = np.isin(track.status, TRACKED)
        apart = detector_distances(images, track, round(fps))
        for frame, what in session.events:
            sys.stderr.write(f"  {name}, frame {frame}: {what}\n")
        try:
            metrics |= agreement(name, images, np.asarray(track.pose, float), is_tracked)
        except ImportError as error:
            sys.stderr.write(f"  left out: agreement with another tracker ({error})\n")
        metrics |= {
            f"{name}_longest_stretch_s": Metric(longest(is_tracked) / fps, "s", "higher"),
            f"{name}_share_tracked": Metric(100 * float(is_tracked.mean()), "%", "higher"),
            f"{name}_losses": Metric(float(sum(what.startswith("lost") for _, what in session.events)), "", "lower"),
            f"{name}_detector_distance": Metric(float(np.median(apart)), "eyes' distances", "lower"),
            f"{name}_detector_distance_worst": Metric(float(np.max(apart)), "eyes' distances", "lower"),
        }
    return metrics


def filmed(
    model: IctModel,
    turns: np.ndarray,
    speech: np.ndarray,
    person: int,
    num_frames: int,
    *,
    distance_mm: float = MONOCULAR_PLACE_MM[2],
    **worn: Any,
) -> IctSequence:
    """A person that turns and speaks as recorded, at a distance from one camera; `worn` as in `ict_sequence`."""
    poses = biwi_course(turns, num_frames, place_mm=(*MONOCULAR_PLACE_MM[:2], distance_mm))
    expressions = livelink_course(speech, num_frames)
    key = jax.random.key(FIRST_PERSON + person)
    return ict_sequence(key, model, poses, rig=camera(), expressions=expressions, **worn)


def _by_yaw(name: str, runs: list[MonoRun]) -> dict[str, Metric]:
    """Over all frames in which the face is followed; ranges without one are left out."""
    errors = np.concatenate([run.errors for run in runs])
    yaw = np.abs(np.concatenate([run.yaw_deg for run in runs]))
    is_tracked = np.concatenate([run.is_tracked for run in runs])
    metrics = {f"{name}_lost_share": Metric(100 * float(np.mean(~is_tracked)), "%", "lower")}
    for suffix, (low, high) in {"": (0, 91), **{f"_{key}": value for key, value in RANGES.items()}}.items():
        rows = is_tracked & (yaw >= low) & (yaw < high)
        if rows.any():
            mean = np.mean(np.abs(errors[rows]), axis=0)
            metrics |= {
                f"{name}_mae_{axis}{suffix}": Metric(float(mean[i]), "deg", "lower") for axis, i in ROTATIONS.items()
            }
            metrics[f"{name}_mae_z{suffix}"] = Metric(float(mean[2]), "mm", "lower")
    return metrics
