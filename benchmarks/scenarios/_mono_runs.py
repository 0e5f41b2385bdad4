"""Rendered heads before one camera, followed by several trackers at once."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfilters.benchmarks.scenarios._poses import DISPLAY, in_millimetres, pose_errors
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.gallery import Gallery, remember
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.face.multilinear import MultilinearFace, learn
from jaxfilters.models.face.rig import CameraRig, monocular
from jaxfilters.models.synthetic.face import Identity
from jaxfilters.models.synthetic.face_motion import MONOCULAR_PLACE_MM, motion, speech_schedule
from jaxfilters.models.synthetic.face_sequence import FaceSequence, face_sequence
from jaxfilters.models.synthetic.face_training import generator_shapes
from jaxfilters.models.synthetic.ict_sequence import IctSequence
from jaxfilters.trackers.head.common.table import TRACKED
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.dense import NUM_DENSE, Dense
from jaxfilters.trackers.head.mono.detections import Detections
from jaxfilters.trackers.head.mono.session import MonoSession
from jaxfilters.trackers.head.mono.state import MonoTrack

START_FRAMES, DETECTED_PX = (0, 6, 12, 18, 24), 0.5
"""In which landmarks are detected, and the standard deviation of each coordinate."""
BLOCK = 40
"""Frames in memory at once."""
TRAINING_KEY = 77


class MonoRun(NamedTuple):
    """What one tracker says of a sequence from the first frame on in which it follows the face."""

    track: MonoTrack
    errors: Float[np.ndarray, "t 6"]
    """Of the pose, millimetres and degrees; NaN where there is none."""
    landmark_mm: Float[np.ndarray, " t"]
    """Mean distance of the landmarks from the true ones in head coordinates, both about their centroids."""
    yaw_deg: Float[np.ndarray, " t"]
    """True one."""

    @property
    def is_tracked(self) -> Bool[np.ndarray, " t"]:
        """Whether the tracker follows the face."""
        return np.isin(self.track.status, TRACKED)

    @property
    def person_index(self) -> Int[np.ndarray, " t"]:
        """Whom of those of the gallery the face is taken for; -1 for an unknown person."""
        return np.asarray(self.track.person_index)

    @property
    def means(self) -> Float[np.ndarray, " 6"]:
        """Mean sizes of the errors; infinite if nothing is tracked."""
        return np.mean(np.abs(self.errors[self.is_tracked]), axis=0) if self.is_tracked.any() else np.full(6, np.inf)

    @property
    def coverage(self) -> Float[np.ndarray, " 6"]:
        """Share of the frames in which the true pose is within two of the claimed standard deviations."""
        return np.mean(np.abs(self.errors) <= 2 * np.asarray(self.track.pose_std) * DISPLAY, axis=0)


def as_arrays(runs: Mapping[str, MonoRun]) -> dict[str, np.ndarray]:
    """Runs by name, flat; see `from_arrays`."""
    arrays: dict[str, np.ndarray] = {}
    for name, run in runs.items():
        of_run = run._asdict()
        parts = of_run.pop("track")._asdict() | of_run
        arrays |= {f"{name}.{part}": np.asarray(value) for part, value in parts.items()}
    return arrays


def from_arrays(arrays: Mapping[str, np.ndarray]) -> dict[str, MonoRun]:
    """Runs by name, of what `as_arrays` made of them."""
    parts: dict[str, dict[str, np.ndarray]] = {}
    for key, array in arrays.items():
        name, _, part = key.rpartition(".")
        parts.setdefault(name, {})[part] = array
    track = lambda of: MonoTrack(*(of[part] for part in MonoTrack._fields))
    return {
        name: MonoRun(track(of), *(of[part] for part in MonoRun._fields if part != "track"))
        for name, of in parts.items()
    }


class Contender(NamedTuple):
    """A tracker, and what it knows of faces."""

    face: MultilinearFace
    options: MonoConfig
    gallery: Gallery | None = None
    """Whom it may recognise."""


class Learnt(NamedTuple):
    """From the training faces of some people."""

    face: MultilinearFace
    people: Gallery
    """The same people."""


def camera() -> CameraRig:
    """Focal length 800 px, 640 x 480."""
    return monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))


def talking_head(user: int, num_frames: int) -> FaceSequence:
    """A person of the generator who moves and speaks; the same user number is the same person."""
    poses = motion("mix", num_frames, user, place_mm=MONOCULAR_PLACE_MM)
    return face_sequence(jax.random.key(user), poses, rig=camera(), expressions=speech_schedule(num_frames))


def learnt_from(people: list[Identity], identities: int, seed: int) -> Learnt:
    """The model of the training faces of some people, and these people."""
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *people)
    key = jax.random.fold_in(jax.random.key(TRAINING_KEY), seed)
    shapes = generator_shapes(key, together)
    face = learn(shapes, identities=identities)
    return Learnt(face, remember(face, shapes))


def follow_all(made: FaceSequence | IctSequence, contenders: Mapping[str, Contender], seed: int) -> dict[str, MonoRun]:
    """Runs of all trackers over one sequence, which is rendered once; they start from landmarks with noise."""
    found = _detections(made, seed)
    sessions = {
        name: MonoSession(made.rig, one.face, one.options, detections=found, gallery=one.gallery)
        for name, one in contenders.items()
    }
    tracks: dict[str, list[MonoTrack]] = {name: [] for name in contenders}
    for start, images in made.chunks(BLOCK):
        for name, session in sessions.items():
            tracks[name].append(session.process(images, made.times[start : start + len(images)]))
    joined = {name: jax.tree.map(lambda *rows: np.concatenate(rows), *parts) for name, parts in tracks.items()}
    return {name: evaluated(in_millimetres(track), made) for name, track in joined.items()}


def evaluated(track: MonoTrack, made: FaceSequence | IctSequence) -> MonoRun:
    """A track beside the truth, without the frames up to the start."""
    first = START_FRAMES[-1] + 1
    track = jax.tree.map(lambda leaf: leaf[first:], track)
    errors = pose_errors(track.pose, made.poses[first:])
    centred = lambda shapes: shapes - shapes.mean(axis=1, keepdims=True)
    apart = centred(np.asarray(track.shape, float)) - centred(made.shapes[first:])
    return MonoRun(track, errors, np.linalg.norm(apart, axis=-1).mean(axis=1), np.degrees(made.poses[first:, 4]))


class OverUsers(NamedTuple):
    """Of one quantity of several runs."""

    mean: np.ndarray
    median: np.ndarray
    worst: np.ndarray
    """The largest."""


def over_users(runs: list[MonoRun], of: Callable[[MonoRun], np.ndarray]) -> OverUsers:
    """Of what the function makes of each run."""
    values = np.stack([np.asarray(of(run), float) for run in runs])
    return OverUsers(values.mean(axis=0), np.median(values, axis=0), values.max(axis=0))


def eyes_apart_of(identity: Identity) -> float:
    """Millimetres between the middles of the corners of either eye of a neutral face."""
    corners = np.asarray(identity.neutral[:4], float)
    return float(np.linalg.norm(corners[2:].mean(axis=0) - corners[:2].mean(axis=0)))


def _detections(made: FaceSequence | IctSequence, seed: int) -> Detections:
    frames = [i for i in START_FRAMES if i < len(made)]
    noise = np.random.default_rng(seed).normal(0, DETECTED_PX, (len(frames), *made.uv.shape[2:]))
    images = np.concatenate([made.frames(i, i + 1)[:, 0] for i in frames])
    points = made.uv[frames, 0] + noise
    dense = _dense(made.uv68[frames, 0], points, seed) if isinstance(made, IctSequence) else None
    return Detections(points, images, float(made.times[frames[-1]]), dense=dense)


def _dense(uv: np.ndarray, ten: np.ndarray, seed: int) -> Dense:
    """The 68 landmarks with noise, for whoever has a model of them; the ten among them are the same ones."""
    found = uv + np.random.default_rng([seed, NUM_DENSE]).normal(0, DETECTED_PX, uv.shape)
    found[:, list(FROM_68)] = ten
    covariance = np.broadcast_to(DETECTED_PX**2 * np.eye(2), (*found.shape, 2))
    return Dense(found, covariance, np.ones(found.shape[:2], bool), 0.0)
