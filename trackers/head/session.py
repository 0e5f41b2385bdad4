"""From frames to a track: waiting for a face, registering it, following it, and finding it again after a loss."""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters import subspace
from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.rigid import align
from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.trackers.head.detect import StableDetector, complete
from jaxfilters.trackers.head.registration import Registration, RegistrationError, register, register_monocular
from jaxfilters.trackers.head.search import searches
from jaxfilters.trackers.head.state import INITIALISING, LOST, NUM_MODES, POSE, HeadOptions, HeadState, HeadTrack
from jaxfilters.trackers.head.track import advance, begin

SAME_FACE_MM = 4.0
"""Root mean square distance between two registered shapes up to which they are of one person."""


class _Wait(NamedTuple):
    """A search for a face that goes on beside the tracking."""

    outcome: Future
    frame: int


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
        """
        if points is not None and (np.shape(points) != (NUM_LANDMARKS, 2) or not np.all(np.isfinite(points))):
            raise ValueError(f"points must be ({NUM_LANDMARKS}, 2) finite pixels; got shape {np.shape(points)}.")
        self.events: list[tuple[int, str]] = []
        self._rig, self._options = rig, options or HeadOptions()
        self._points = points
        self._searches = searches(rig, self._options)
        self._state: HeadState | None = None
        self._detector = StableDetector()
        self._frames, self._is_lost = 0, False
        self._pool = ThreadPoolExecutor(1) if self._options.live else None
        self._wait: _Wait | None = None
        self._said = ""

    @property
    def model(self) -> FaceModel | None:
        """The face as learnt so far; `None` before registration."""
        return None if self._state is None else self._state.model

    @property
    def contribution(self) -> float:
        """Share of the deformation seen so far that the modes explain, 0 to 1; 0 before there was any."""
        return 0.0 if self._state is None else float(subspace.contribution(self._state.learner.subspace))

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
        clock = np.concatenate([times, np.repeat(times[-1:], missing)]).astype(np.float32)
        assert self._state is not None
        self._state, track = advance(self._rig, self._searches, self._state, filled, clock, is_frame, self._options)
        track = jax.tree.map(lambda leaf: np.asarray(leaf)[: len(times)], track)
        lost = np.flatnonzero(track.status == LOST)
        if lost.size:
            self._say(int(lost[0]), "lost")
        self._is_lost = bool(track.status[-1] == LOST)
        if lost.size and not self._is_lost:
            self._say(len(times) - 1, "found again near where it was lost")
        self._frames += len(times)
        return track

    def _look_for_face(self, images: np.ndarray, times: np.ndarray, start: int) -> HeadTrack:
        """Rows up to the frame that registers a face, or all; a lost face may also turn up where it was lost."""
        if self._is_lost:
            stop = min(start + self._options.chunk, len(times))
            track = self._follow(images[start:stop], times[start:stop])
            if not self._is_lost:
                return track
            self._frames -= stop - start
        else:
            stop, track = len(times), None
        for i in range(start, stop):
            registration = self._registered(images[i])
            self._frames += 1
            if registration is None:
                continue
            self._begin(registration, images[i], float(times[i]))
            return self._empty(i + 1 - start, track)
        return self._empty(stop - start, track)

    def _registered(self, images: np.ndarray) -> Registration | None:
        """The face in these images, if one can be registered; in a live session, that of an earlier frame."""
        if self._points is not None:
            points, self._points = self._points, None
            return self._try(images, points)
        if self._pool is None:
            return self._searched(images)
        if self._wait is None:
            self._wait = _Wait(self._pool.submit(self._searched, images.copy()), self._frames)
            return None
        if not self._wait.outcome.done():
            return None
        found, self._wait = self._wait.outcome.result(), None
        return found

    def _searched(self, images: np.ndarray) -> Registration | None:
        found = self._detector.update(images[0])
        if found is None:
            self._complain(self._detector.reason)
            return None
        if found.num_faces > 1:
            self._complain(f"{found.num_faces} faces; the largest is taken")
        points = complete(images[0], found.points)
        if points is None:
            self._complain("nostrils or brows are not seen")
            return None
        return self._try(images, points)

    def _try(self, images: np.ndarray, points: np.ndarray) -> Registration | None:
        try:
            if self._rig.num_cameras == 1:
                return register_monocular(images[0], points, self._rig, num_modes=NUM_MODES)
            return register(images, points, self._rig, num_modes=NUM_MODES)
        except RegistrationError as error:
            self._complain(str(error))
            return None

    def _begin(self, registration: Registration, images: np.ndarray, time: float) -> None:
        key = jax.random.fold_in(jax.random.key(self._options.seed), self._frames)
        old = self._state
        pose = jnp.asarray(registration.pose, float)
        self._state = begin(
            key, registration.model, pose, jnp.asarray(images), jnp.asarray(time, float), self._rig, self._options
        )
        self._is_lost, self._said = False, ""
        self._detector = StableDetector()
        kept = False
        if old is not None:
            self._state, kept = _with_known_face(self._state, old)
        self._say(-1, "registered" + (", a face that is known" if kept else ""))

    def _empty(self, count: int, track: HeadTrack | None) -> HeadTrack:
        """Rows of frames without a face."""
        C, status = self._rig.num_cameras, INITIALISING if self._state is None or track is None else LOST
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
        if reason != self._said and not reason.endswith("px"):
            self._say(0, reason)
        self._said = reason

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
