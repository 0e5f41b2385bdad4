"""The head tracker from the first images on: waiting for a face, registering it, following it, finding it again."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters._full_precision import dot
from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.trackers.head.common import learning
from jaxfilters.trackers.head.common.config import HeadConfig, compiled
from jaxfilters.trackers.head.common.finders import FINDERS, Finder
from jaxfilters.trackers.head.common.following import UNUSED_POINTS, Beginning, Compared, Following
from jaxfilters.trackers.head.common.image_position import image_position
from jaxfilters.trackers.head.common.search import first_diffusion, searches
from jaxfilters.trackers.head.common.state import DOUBTFUL, INITIALISING, LOST, NUM_MODES, POSE, HeadState, HeadTrack
from jaxfilters.trackers.head.common.table import in_metres
from jaxfilters.trackers.head.stereo import redetection
from jaxfilters.trackers.head.stereo.claims import with_assumptions
from jaxfilters.trackers.head.stereo.known_face import pose_of_known_face
from jaxfilters.trackers.head.stereo.registration import Registration, RegistrationError, register, register_monocular
from jaxfilters.trackers.head.stereo.tracking import advance, begin
from jaxfilters.trackers.head.stereo.variants import VARIANTS
from jaxfilters.trackers.tracker import checked_times

SAME_FACE_MM = 4.0
"""Root mean square distance between two registered shapes up to which they are of one person."""
MOST_ASIDE = 1e-5
"""Of a camera that is the world, in its rotation matrix and in millimetres: what is left of a rig file's rounding."""


class _Found(NamedTuple):
    """A face, and the images in which it was registered."""

    registration: Registration
    images: np.ndarray
    time: float


class HeadSession:
    """Tracks one head through frames that are handed over in pieces."""

    def __init__(
        self,
        rig: CameraRig,
        options: HeadConfig | None = None,
        points: Float[np.ndarray, "K 2"] | None = None,
        *,
        focal_log_std: float = 0.0,
    ) -> None:
        """A session before its first frame.

        Args:
            rig: One camera or more; the frame of the first one is the world.
            options: Constants.
            points: The ten landmarks in the first camera's first image, pixels, (u, v); detected where not given.
            focal_log_std: Standard deviation of the logarithm of a single camera's focal length, by which distances
                are uncertain in proportion; 0 for one that is calibrated.

        Raises:
            ValueError: if the first camera is not at the origin without a rotation, `points` are not ten finite
                pixels, or `focal_log_std` is negative, not finite, or given for several cameras.
            ImportError: if the detector of the options is not installed.
        """
        check_at_origin(rig)
        check_points(points)
        check_focal_log_std(focal_log_std)
        if focal_log_std and rig.num_cameras > 1:
            raise ValueError(f"focal_log_std is for one camera; got {rig.num_cameras} cameras.")
        self._following = Following(_HeadTracker(rig, options or HeadConfig(), points, focal_log_std))

    @property
    def events(self) -> list[tuple[int, str]]:
        """(frame index, what happened), in order."""
        return self._following.events

    @property
    def model(self) -> FaceModel | None:
        """The face as estimated so far, in millimetres; `None` before registration."""
        return None if self._following.state is None else self._following.state.model

    @property
    def contribution(self) -> float:
        """Share of the deformation observed so far that the modes explain, 0 to 1; 0 before there was any."""
        state = self._following.state
        return 0.0 if state is None else float(learning.contribution(state.learner))

    def saved(self) -> dict[str, Any] | None:
        """All that the next frame needs, for `restore` in a session of the same cameras and options.

        A tree that `trackers.io.checkpoint` can save; None while a face is searched for.
        """
        return self._following.saved()

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `saved` gave: the next frames give the rows that they would have given then, bit for bit."""
        self._following.restore(saved)

    def process(self, images: UInt8[np.ndarray, "b C rows cols"], times: Float[np.ndarray, " b"]) -> HeadTrack:
        """Track of the next frames, a row each, in metres and radians.

        Args:
            images: Grey, of all cameras at one moment each, without lens distortion.
            times: Seconds, growing.

        Raises:
            ValueError: if images or times do not fit the rig and each other.
        """
        return in_metres(self._following.process(images, times))


def track(
    images: UInt8[np.ndarray, "b C rows cols"],
    times_s: Float[np.ndarray, " b"],
    rig: CameraRig,
    config: HeadConfig | None = None,
    *,
    points: Float[np.ndarray, "K 2"] | None = None,
    focal_log_std: float = 0.0,
) -> HeadTrack:
    """The head in images in memory; `HeadSession` takes them in pieces.

    Args:
        images: Grey, of all cameras at one moment each, without lens distortion.
        times_s: Seconds, strictly increasing.
        rig: One camera or more; the frame of the first one is the world.
        config: Constants.
        points: The ten landmarks in the first camera's first image, pixels, (u, v); detected where not given.
        focal_log_std: As for `HeadSession`.

    Returns:
        The track: metres and radians, NaN where the head is not tracked.

    Raises:
        ValueError: as for `HeadSession` and its `process`, and for `checked_times`.
    """
    session = HeadSession(rig, config, points, focal_log_std=focal_log_std)
    return session.process(images, checked_times(times_s, len(images)))


def check_at_origin(rig: CameraRig) -> None:
    """Whether poses in the frame of the first camera are those in the world.

    Raises:
        ValueError: if the first camera is turned or moved.
    """
    turned, moved = np.abs(np.asarray(rig.rotation[0]) - np.eye(3)), np.abs(np.asarray(rig.translation[0]))
    if turned.max() > MOST_ASIDE or moved.max() > MOST_ASIDE:
        raise ValueError("rig must have its first camera at the origin, without a rotation: its frame is the world.")


def check_focal_log_std(focal_log_std: float) -> None:
    """Whether it is a standard deviation.

    Raises:
        ValueError: if it is negative or not finite.
    """
    if not (math.isfinite(focal_log_std) and focal_log_std >= 0):
        raise ValueError(f"focal_log_std must be finite and at least 0; got {focal_log_std}.")


def check_points(points: Float[np.ndarray, "K 2"] | None, counts: tuple[int, ...] = (NUM_LANDMARKS,)) -> None:
    """Whether landmarks given by a person can be used.

    Args:
        points: None where they are to be detected.
        counts: How many they may be.

    Raises:
        ValueError: if they are not so many finite pixels.
    """
    shapes = [(count, 2) for count in counts]
    if points is not None and (np.shape(points) not in shapes or not np.all(np.isfinite(points))):
        expected = " or ".join(map(str, shapes))
        raise ValueError(f"points must be {expected} finite pixels; got shape {np.shape(points)}.")


class _HeadTracker:
    """What `Following` asks of a tracker."""

    def __init__(
        self, rig: CameraRig, options: HeadConfig, points: Float[np.ndarray, "K 2"] | None, focal_log_std: float
    ) -> None:
        self.rig, self.chunk, self.is_live = rig, options.chunk, options.live
        self._focal_log_std = focal_log_std
        may_compare = VARIANTS[options.variant].may_doubt and rig.num_cameras > 1
        self.compare_every_s = redetection.EVERY_S if may_compare else math.inf
        self._options, self._points = options, points
        self._compiled, self._diffusion = compiled(options), first_diffusion(options)
        self._searches = searches(rig, options)
        self._finder: Finder = FINDERS[options.detector]()

    @property
    def can_wait(self) -> bool:
        return self.is_live and self._points is None

    def search(self, images: np.ndarray, time: float) -> tuple[_Found | None, list[str]]:
        points, self._points = self._points, None
        wrong: list[str] = []
        is_given = points is not None
        if points is None:
            finder = self._finder
            points = finder.find(images[0])
            wrong = list(finder.complaints)
        if points is None:
            return None, wrong
        try:
            return _Found(self._registered(images, points), images, time), wrong
        except RegistrationError as error:
            return None, [*wrong, f"{UNUSED_POINTS}: {error}" if is_given else str(error)]

    def _registered(self, images: np.ndarray, points: np.ndarray) -> Registration:
        if self.rig.num_cameras == 1:
            return register_monocular(images[0], points, self.rig, num_modes=NUM_MODES)
        return register(images, points, self.rig, num_modes=NUM_MODES)

    def forget(self) -> None:
        self._finder.reset()

    def begin(self, found: _Found, old: HeadState | None, frame: int) -> Beginning:
        face = found.registration
        if old is not None and math.isfinite(self.compare_every_s):
            placed = redetection.located(old, face, found.images, self.rig)
            state, row = self._gone_on(placed, found.images) if placed is not None else (old, None)
            if row is not None and redetection.is_found(row):
                state = state._replace(time=jnp.zeros_like(old.time))
                return Beginning(state, found.time, "registered, a face that is known")
        key = jax.random.fold_in(jax.random.key(self._options.seed), frame)
        pose = jnp.asarray(face.pose, float)
        start = jnp.zeros((), pose.dtype)
        state = begin(
            key, face.model, pose, found.images, start, self.rig, options=self._compiled, diffusion=self._diffusion
        )
        if self.is_live and math.isfinite(self.compare_every_s):
            redetection.prepare(state, found.images, self.rig)
        kept = False
        if old is not None:
            state, kept = _with_known_face(state, old)
        return Beginning(state, found.time, "registered" + (", a face that is known" if kept else ""))

    def saved(self) -> None:
        """The state is all."""

    def restore(self, saved: None, state: HeadState) -> None:
        del saved, state
        # Landmarks which a person gave are of the first image.
        self._points = None

    def advance(
        self, state: HeadState, images: np.ndarray, clock: np.ndarray, is_frame: np.ndarray
    ) -> tuple[HeadState, HeadTrack]:
        return advance(self.rig, self._searches, state, images, clock, is_frame, self._compiled)

    def reported(self, track: HeadTrack, times: np.ndarray) -> HeadTrack:
        del times
        return with_assumptions(track, self._focal_log_std) if self.rig.num_cameras == 1 else track

    def compared(self, state: HeadState, row: HeadTrack, images: np.ndarray, time: float) -> Compared:
        del time
        if row.status not in (DOUBTFUL, LOST):
            return Compared(state, None)
        detected = self._at_detected(state, images)
        if detected is not None:
            other = self._gone_on(detected, images)
            if redetection.is_better(other[1], row):
                return Compared(*other)
        pose = pose_of_known_face(state, images, self.rig)
        if pose is not None:
            other = self._gone_on(redetection.placed(state, pose, images, self.rig, redetection.KNOWN_STD), images)
            if redetection.is_found(other[1]) and redetection.is_better(other[1], row):
                return Compared(*other)
        return Compared(state, None)

    def _at_detected(self, state: HeadState, images: np.ndarray) -> HeadState | None:
        """The state at a detected face, if there is one that has the shape."""
        place = image_position(state.belief.mean[:3], self.rig)
        points = None if place is None else self._finder.glance(images[0], *place)
        if points is None:
            return None
        try:
            found = self._registered(images, points)
        except RegistrationError:
            return None
        return redetection.located(state, found, images, self.rig)

    def _gone_on(self, state: HeadState, images: np.ndarray) -> tuple[HeadState, HeadTrack]:
        """State and row of the tracker that goes on from a state in the same images."""
        frames = np.repeat(images[None], self.chunk, axis=0)
        clock = np.full(self.chunk, float(state.time), np.asarray(state.time).dtype)
        state, track = self.advance(state, frames, clock, np.arange(self.chunk) < 1)
        return state, jax.tree.map(lambda leaf: np.asarray(leaf)[0], track)

    def empty(self, count: int) -> HeadTrack:
        nothing = lambda *shape: np.full((count, *shape), np.nan, np.float32)
        return HeadTrack(
            pose=nothing(POSE),
            pose_std=nothing(POSE),
            deformation=nothing(NUM_MODES),
            shape=nothing(NUM_LANDMARKS, 3),
            image_points=nothing(self.rig.num_cameras, NUM_LANDMARKS, 2),
            score=nothing(),
            effective_sample_size=np.zeros(count, np.float32),
            innovations=np.zeros((count, 2), np.int32),
            status=np.full(count, INITIALISING, np.int32),
        )


def _with_known_face(state: HeadState, old: HeadState) -> tuple[HeadState, bool]:
    """The new state with the deformations of before, if the face is that of before."""
    R, _, apart = redetection.aligned(old.registered.shape, state.registered.shape)
    if not float(apart) <= SAME_FACE_MM:
        return state, False
    turn = lambda vectors: dot(vectors.reshape(-1, NUM_LANDMARKS, 3), R.T).reshape(vectors.shape)
    basis = turn(old.model.basis.T).T
    modes = old.learner.subspace._replace(vectors=turn(old.learner.subspace.vectors))
    model = FaceModel(state.model.mean, basis, old.model.deviation, state.model.templates)
    learner = state.learner._replace(subspace=modes)
    return state._replace(model=model, learner=learner, age=old.age), True
