"""From frames to a track: waiting for a face, registering it, following it, and finding it again after a loss."""

import math
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.rigid import align
from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.trackers.head import learning
from jaxfilters.trackers.head.corners import eye_centers
from jaxfilters.trackers.head.detect import detect
from jaxfilters.trackers.head.finders import FINDERS, Finder
from jaxfilters.trackers.head.registration import Registration, RegistrationError, register, register_monocular
from jaxfilters.trackers.head.search import first_diffusion, searches
from jaxfilters.trackers.head.state import (
    INITIALISING,
    LOST,
    NUM_MODES,
    POSE,
    HeadOptions,
    HeadState,
    HeadTrack,
    compiled,
)
from jaxfilters.trackers.head.track import advance, begin

SAME_FACE_MM = 4.0
"""Root mean square distance between two registered shapes up to which they are of one person."""
LOOK_EVERY_S = 1.0
"""Seconds between looks for faces while one is followed."""
SAME_PLACE, MOST_CONTRADICTIONS = 0.5, 3
"""How far, in distances between the eyes, a face that is seen may be from the one that is followed; how many looks in a
row may contradict the track before it is given up."""


class _Found(NamedTuple):
    """A face, and the images in which it was registered."""

    registration: Registration
    images: np.ndarray
    time: float


class _Wait(NamedTuple):
    """A search for a face that goes on beside the tracking."""

    outcome: Future[Registration | None]
    images: np.ndarray
    time: float


_begun = jax.jit(begin, static_argnames="options")


class HeadSession:
    """Tracks one head through frames that are handed over in pieces.

    Attributes:
        model: The face as learnt so far; `None` before registration.
        events: (frame index, what happened), in order.
    """

    def __init__(
        self, rig: CameraRig, options: HeadOptions | None = None, points: Float[np.ndarray, "K 2"] | None = None
    ) -> None:
        """A session before its first frame.

        Args:
            rig: One camera or more.
            options: Constants.
            points: The ten landmarks in the first camera's first image, pixels, (u, v); detected where not given.

        Raises:
            ValueError: if `points` are not ten finite pixels.
            ImportError: if the detector of the options is not installed.
        """
        if points is not None and (np.shape(points) != (NUM_LANDMARKS, 2) or not np.all(np.isfinite(points))):
            raise ValueError(f"points must be ({NUM_LANDMARKS}, 2) finite pixels; got shape {np.shape(points)}.")
        self.events: list[tuple[int, str]] = []
        self._rig, self._options = rig, options or HeadOptions()
        self._compiled = compiled(self._options)
        self._diffusion = first_diffusion(self._options)
        self._points = points
        self._searches = searches(rig, self._options)
        self._state: HeadState | None = None
        self._finder: Finder = FINDERS[self._options.detector]()
        self._frames, self._is_lost, self._time = 0, False, 0.0
        self._pool = ThreadPoolExecutor(1) if self._options.live else None
        self._wait: _Wait | None = None
        self._said: set[str] = set()
        self._looked, self._contradictions, self._is_refuted = -math.inf, 0, False

    @property
    def model(self) -> FaceModel | None:
        """The face as learnt so far; `None` before registration."""
        return None if self._state is None else self._state.model

    @property
    def contribution(self) -> float:
        """Share of the deformation seen so far that the modes explain, 0 to 1; 0 before there was any."""
        return 0.0 if self._state is None else float(learning.contribution(self._state.learner))

    def process(self, images: UInt8[np.ndarray, "b C rows cols"], times: Float[np.ndarray, " b"]) -> HeadTrack:
        """Track of the next frames, a row each.

        Args:
            images: Grey, of all cameras at one moment each, without lens distortion.
            times: Seconds, growing.

        Raises:
            ValueError: if images or times do not fit the rig and each other.
        """
        expected = (len(times), self._rig.num_cameras, *self._rig.shape)
        if images.shape != expected or images.dtype != np.uint8:
            raise ValueError(f"images must be {expected} of uint8; got {images.shape} of {images.dtype}.")
        if not np.all(np.isfinite(times)):
            raise ValueError("times must be finite.")
        if not len(times):
            return self._empty(0, None)
        rows, done = [], 0
        while done < len(times):
            if self._state is None or self._is_lost:
                waited = self._look_for_face(images, times, done)
                rows.append(waited)
                done += len(waited.pose)
                continue
            stop = min(done + self._options.chunk, len(times))
            rows.append(self._follow(images[done:stop], times[done:stop]))
            done = stop
        return jax.tree.map(lambda *parts: np.concatenate(parts), *rows)

    def _follow(self, images: np.ndarray, times: np.ndarray) -> HeadTrack:
        """Rows of at most a chunk of frames; the last chunk is filled up, so that one program serves all."""
        missing = self._options.chunk - len(times)
        is_frame = np.arange(self._options.chunk) < len(times)
        filled = np.concatenate([images, np.repeat(images[-1:], missing, axis=0)])
        assert self._state is not None
        # Counted from the last frame, which single precision can do however late it is.
        state = self._state._replace(time=jnp.zeros_like(self._state.time))
        clock = (np.concatenate([times, np.repeat(times[-1:], missing)]) - self._time).astype(state.time.dtype)
        self._state, track = advance(self._rig, self._searches, state, filled, clock, is_frame, self._compiled)
        self._time = max(self._time, float(np.max(times)))
        track = jax.tree.map(lambda leaf: np.asarray(leaf)[: len(times)], track)
        for i, is_lost in enumerate(track.status == LOST):
            if is_lost != self._is_lost:
                self._say(i, "lost" if is_lost else "found again near where it was lost")
            self._is_lost = bool(is_lost)
        self._frames += len(times)
        if not self._is_lost and times[-1] - self._looked >= LOOK_EVERY_S:
            self._looked = float(times[-1])
            self._look_at(images[-1, 0], track.image_points[-1, 0])
        return track

    def _look_at(self, image: np.ndarray, points: np.ndarray) -> None:
        """Give the track up if a face is seen elsewhere time after time; that none is seen says nothing."""
        seen = detect(image, near=points.mean(axis=0))
        if seen is None:
            return
        right, left = eye_centers(seen.points)
        apart = np.median(np.linalg.norm(points[: len(seen.points)] - seen.points, axis=1))
        is_elsewhere = apart > SAME_PLACE * np.linalg.norm(left - right)
        self._contradictions = self._contradictions + 1 if is_elsewhere else 0
        if self._contradictions == MOST_CONTRADICTIONS:
            self._is_lost = self._is_refuted = True
            self._say(-1, "lost: the face is seen elsewhere")

    def _look_for_face(self, images: np.ndarray, times: np.ndarray, start: int) -> HeadTrack:
        """Rows up to the frame that registers a face, or all; a lost face may also turn up where it was lost."""
        status = LOST if self._is_lost else INITIALISING
        if self._is_lost and not self._is_refuted:
            stop = min(start + self._options.chunk, len(times))
            track = self._follow(images[start:stop], times[start:stop])
            if not self._is_lost:
                self._wait = None
                self._finder.reset()
                return track
            self._frames -= stop - start
        else:
            stop, track = len(times), None
        for i in range(start, stop):
            found = self._registered(images[i], float(times[i]))
            self._frames += 1
            if found is not None:
                self._begin(found)
                return self._empty(i + 1 - start, track, status)
        return self._empty(stop - start, track, status)

    def _registered(self, images: np.ndarray, time: float) -> _Found | None:
        """The face in these images, if one can be registered; in a live session, that of an earlier frame."""
        if self._points is not None or self._pool is None:
            points, self._points = self._points, None
            registration = self._searched(images) if points is None else self._try(images, points)
            return None if registration is None else _Found(registration, images, time)
        if self._wait is None:
            images = images.copy()
            self._wait = _Wait(self._pool.submit(self._searched, images), images, time)
            return None
        if not self._wait.outcome.done():
            return None
        wait, self._wait = self._wait, None
        registration = wait.outcome.result()
        return None if registration is None else _Found(registration, wait.images, wait.time)

    def _searched(self, images: np.ndarray) -> Registration | None:
        points = self._finder.find(images[0])
        for complaint in self._finder.complaints:
            self._complain(complaint)
        return None if points is None else self._try(images, points)

    def _try(self, images: np.ndarray, points: np.ndarray) -> Registration | None:
        try:
            if self._rig.num_cameras == 1:
                return register_monocular(images[0], points, self._rig, num_modes=NUM_MODES)
            return register(images, points, self._rig, num_modes=NUM_MODES)
        except RegistrationError as error:
            self._complain(str(error))
            return None

    def _begin(self, found: _Found) -> None:
        key = jax.random.fold_in(jax.random.key(self._options.seed), self._frames)
        old, face = self._state, found.registration
        pose = jnp.asarray(face.pose, float)
        self._time, start = found.time, jnp.zeros((), pose.dtype)
        self._state = _begun(
            key, face.model, pose, found.images, start, self._rig, options=self._compiled, diffusion=self._diffusion
        )
        self._is_lost, self._is_refuted, self._said = False, False, set()
        self._looked, self._contradictions = found.time, 0
        self._finder.reset()
        kept = False
        if old is not None:
            self._state, kept = _with_known_face(self._state, old)
        self._say(-1, "registered" + (", a face that is known" if kept else ""))

    def _empty(self, count: int, track: HeadTrack | None, status: int = INITIALISING) -> HeadTrack:
        """Rows of frames without a face."""
        C = self._rig.num_cameras
        nothing = lambda *shape: np.full((count, *shape), np.nan, np.float32)
        return HeadTrack(
            pose=nothing(POSE),
            pose_std=nothing(POSE),
            deformation=nothing(NUM_MODES),
            shape=nothing(NUM_LANDMARKS, 3),
            image_points=nothing(C, NUM_LANDMARKS, 2),
            score=nothing() if track is None else track.score[:count],
            effective_sample_size=np.zeros(count, np.float32),
            status=np.full(count, status, np.int32),
        )

    def _complain(self, reason: str) -> None:
        """Says once in every search why there is no face."""
        if reason not in self._said:
            self._say(0, reason)
        self._said.add(reason)

    def _say(self, offset: int, what: str) -> None:
        self.events.append((self._frames + offset, what))


def _with_known_face(state: HeadState, old: HeadState) -> tuple[HeadState, bool]:
    """The new state with what was learnt of deformations, if the face is that of before (specification, section 1)."""
    R, t = align(old.registered.shape, state.registered.shape)
    moved = old.registered.shape @ R.T + t
    apart = float(jnp.sqrt(jnp.mean(jnp.sum((moved - state.registered.shape) ** 2, axis=-1))))
    if not apart <= SAME_FACE_MM:
        return state, False
    turn = lambda vectors: (vectors.reshape(-1, NUM_LANDMARKS, 3) @ R.T).reshape(vectors.shape)
    basis = turn(old.model.basis.T).T
    modes = old.learner.subspace._replace(vectors=turn(old.learner.subspace.vectors))
    model = FaceModel(state.model.mean, basis, old.model.deviation, state.model.templates)
    learner = state.learner._replace(subspace=modes)
    return state._replace(model=model, learner=learner, age=old.age), True
