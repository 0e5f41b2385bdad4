"""The one-camera head tracker from the first image on: waiting for a face, following it, finding it again."""

import math
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.bundle import Views
from jaxfilters.models.face.gallery import Gallery, joined
from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Person, Prior
from jaxfilters.models.face.rig import CameraRig, monocular
from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.trackers.head.common.following import UNUSED_POINTS, Beginning, Compared, Following
from jaxfilters.trackers.head.common.image_position import image_position
from jaxfilters.trackers.head.common.state import INITIALISING, POSE
from jaxfilters.trackers.head.mono import redetection
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.dense import NUM_DENSE, start_densely, tracked
from jaxfilters.trackers.head.mono.detections import Collector, Detections
from jaxfilters.trackers.head.mono.detectors import CascadeDetector, DetectedFace, Detector, MeshGiver
from jaxfilters.trackers.head.mono.facing import with_facing
from jaxfilters.trackers.head.mono.focal import FocalLength, focal_length
from jaxfilters.trackers.head.mono.irises import with_irises
from jaxfilters.trackers.head.mono.mesh_rotation import MeshRotations
from jaxfilters.trackers.head.mono.recognition import People, as_gallery, check_gallery, one_of, people, recognised
from jaxfilters.trackers.head.mono.start import Start, begin, detected, initialise, prior_beside, search_of
from jaxfilters.trackers.head.mono.state import MonoState, MonoTrack
from jaxfilters.trackers.head.mono.table import mono_in_metres
from jaxfilters.trackers.head.mono.tracking import System, advance
from jaxfilters.trackers.head.stereo.session import check_at_origin, check_focal_log_std, check_points
from jaxfilters.trackers.io.face_models import people_face_model
from jaxfilters.trackers.tracker import checked_times

MOST_REPROJECTION = 0.05
"""Distances between the eyes by which landmarks may be from where the face that fits them best has them."""
DEPTH_MM = (100.0, 5000.0)
"""In which a face may be."""
_STATIC = ("num_particles", "landmarks", "selection", "past", "adjust")
"""Options that a compiled program is for; the others reach it as numbers, or do not concern it."""


class _Found:
    """What a track begins with."""

    def __init__(self, detections: Detections, start: Start, views: Views, prior: Prior) -> None:
        self.detections, self.start, self.views, self.prior = detections, start, views, prior
        turned = np.abs(np.asarray(start.bundle.poses[:, 4:])).sum(axis=1)
        self.frame = int(turned.argmin())
        """The one most turned to the camera."""


class MonoSession:
    """Tracks one head through frames of one camera that are handed over in pieces."""

    def __init__(
        self,
        rig: CameraRig,
        face: MultilinearFace,
        options: MonoConfig | None = None,
        points: Float[np.ndarray, "K 2"] | None = None,
        *,
        detections: Detections | None = None,
        detector: Detector | None = None,
        gallery: Gallery | None = None,
        focal_log_std: float = 0.0,
    ) -> None:
        """A session before its first frame.

        Args:
            rig: One camera.
            face: Model of ten landmarks, or of the 68 of iBUG: the start is then from all that are known, and ten of
                them are followed.
            options: Constants.
            points: The ten landmarks, or 68, in the first image, pixels, (u, v); detected in several images where not
                given.
            detections: Landmarks that were found otherwise in several images, the last of which is still to come.
            detector: What finds landmarks; OpenCV's cascades if none.
            gallery: People of the same model who may be before the camera, beside unknown people.
            focal_log_std: Standard deviation of the logarithm of the camera's focal length, by which distances are
                uncertain in proportion; 0 for one that is calibrated.

        Raises:
            ValueError: if there is not one camera, or its frame is not the world, the model has other landmarks,
                `points` are not ten or 68 finite pixels, `gallery` is not of the model or for the tracker of the
                thesis, which knows nobody, or `focal_log_std` is negative or not finite.
        """
        if rig.num_cameras != 1:
            raise ValueError(f"rig must have one camera; got {rig.num_cameras}.")
        check_at_origin(rig)
        check_points(points, (NUM_LANDMARKS, NUM_DENSE))
        options = options or MonoConfig()
        check_gallery(gallery, tracked(face), options)
        check_focal_log_std(focal_log_std)
        self._tracker = _MonoTracker(rig, face, options, points, detections, detector, gallery, focal_log_std)
        self._following = Following(self._tracker)

    @property
    def events(self) -> list[tuple[int, str]]:
        """(frame index, what happened), in order."""
        return self._following.events

    @property
    def model(self) -> FaceModel | None:
        """The person's face as adjusted so far, in millimetres; `None` before there was one."""
        return None if self._following.state is None else self._following.state.model

    @property
    def person(self) -> Person | None:
        """Who it is, as adjusted so far, in millimetres; `None` before there was a face."""
        return None if self._following.state is None else self._following.state.person

    @property
    def gallery(self) -> Gallery | None:
        """The person who is followed, for later sessions with the same model; `None` before there was a face."""
        return None if self._following.state is None else self._tracker.gallery(self._following.state)

    def focal_length(self) -> FocalLength | None:
        """What the frames that the face is adjusted to say of the focal length; `None` before there was a face."""
        return None if self._following.state is None else self._tracker.focal_length(self._following.state)

    def saved(self) -> dict[str, Any] | None:
        """What `restore` needs in a session of the same cameras and options, as arrays; `None` without a face."""
        return self._following.saved()

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `saved` gave: the next frames give the rows that they would have given then, bit for bit."""
        self._following.restore(saved)

    def process(self, images: UInt8[np.ndarray, "b 1 rows cols"], times: Float[np.ndarray, " b"]) -> MonoTrack:
        """Track of the next frames, a row each, in metres and radians.

        Args:
            images: Grey, without lens distortion.
            times: Seconds, growing.

        Raises:
            ValueError: if images or times do not fit the rig and each other.
        """
        return mono_in_metres(self._following.process(images, times))


def track(
    images: UInt8[np.ndarray, "b rows cols"],
    times_s: Float[np.ndarray, " b"],
    camera: Pinhole,
    config: MonoConfig | None = None,
    *,
    face: MultilinearFace | None = None,
    **known: Any,
) -> MonoTrack:
    """The head in images in memory; `MonoSession` takes them in pieces.

    Args:
        images: Grey, without lens distortion.
        times_s: Seconds, strictly increasing.
        camera: Which took them.
        config: Constants.
        face: Model of ten landmarks, or of the 68 of iBUG; by default the general one of
            `jaxfilters.trackers.io.face_models.people_face_model`, as for videos by the command.
        known: `points`, `detections`, `detector`, `gallery` and `focal_log_std` of `MonoSession`.

    Returns:
        The track: metres and radians, NaN where the head is not tracked.

    Raises:
        ValueError: as for `MonoSession` and its `process`, and for `checked_times`.
    """
    session = MonoSession(monocular(camera), people_face_model().model if face is None else face, config, **known)
    return session.process(images[:, None], checked_times(times_s, len(images)))


class _MonoTracker:
    """What `Following` asks of a tracker."""

    def __init__(
        self,
        rig: CameraRig,
        face: MultilinearFace,
        options: MonoConfig,
        points: np.ndarray | None,
        detections: Detections | None,
        detector: Detector | None,
        gallery: Gallery | None,
        focal_log_std: float,
    ) -> None:
        self.rig, self.chunk, self.is_live = rig, options.chunk, options.live
        self._whole, face = face, tracked(face)  # with all its landmarks, and with ten
        self._face, self._options, self._points, self._detections = face, options, points, detections
        # What is compiled knows its options, but need not be compiled anew for other numbers.
        self._compiled = replace(MonoConfig(), **{name: getattr(options, name) for name in _STATIC})
        self._gallery = gallery
        self._people = people(face, gallery)
        deviation = jnp.asarray(focal_log_std, face.mean.dtype)
        self._system = System(face, face, rig, search_of(rig, options), deviation)
        self._num_at_recognition = 0
        """Adjustments when it was last asked who it is."""
        self._detector = detector or CascadeDetector()
        self._collector = Collector(self._detector)
        self.compare_every_s = math.inf if options.is_published else redetection.seconds_between(self._detector)
        errors = None if options.is_published else self._detector.errors
        self._meshes = MeshRotations(face, rig, None if errors is None else errors.vertices, focal_log_std)
        self._pool = ThreadPoolExecutor(1) if self.is_live and not options.is_published else None
        self._ready: Future[MonoState] | None = None
        """What a face that comes back needs first, compiled beside the frames."""

    @property
    def can_wait(self) -> bool:
        return self.is_live and self._points is None and self._detections is None

    def search(self, images: np.ndarray, time: float) -> tuple[_Found | None, list[str]]:
        collector = self._collector
        if self._points is not None:
            points, self._points = self._points, None
            found, wrong = self._checked(collector.given(points, images[0], time))
            return found, [f"{UNUSED_POINTS}: {reason}" for reason in wrong]
        if self._detections is not None:
            if time < self._detections.time:
                return None, []
            detections, self._detections = self._detections, None
            return self._checked(detections)
        gathered = collector.update(images[0], time)
        wrong = [collector.reason] if collector.reason else []
        if collector.several:
            wrong.append(f"{collector.several} faces; the largest is taken")
        if gathered is None:
            return None, wrong
        found, more = self._checked(gathered)
        return found, wrong + more

    def forget(self) -> None:
        # Not cleared: a search beside the tracking may be at work with the old one.
        self._collector = Collector(self._detector)

    def begin(self, found: _Found, old: MonoState | None, frame: int) -> Beginning:
        key = jax.random.fold_in(jax.random.key(self._options.seed), frame)
        start, detections = found.start, found.detections
        if old is not None:
            self._remember(old)
        self._meshes.restore([])
        zero = jnp.zeros((), start.uv.dtype)
        state = begin(
            key,
            self._face,
            self.rig,
            start,
            found.views,
            jnp.asarray(found.frame),
            detections.images[[found.frame, -1]],
            zero,
            options=self._compiled,
            prior=found.prior,
        )
        self._num_at_recognition, self._system = 0, self._system._replace(face=self._face)
        state = self._recognised(state)
        if self._pool is not None and self._ready is None:
            self._ready = self._pool.submit(self._asked_who, self._system, state)
        what = "registered, a face that is known" if int(state.face_index) else "registered"
        return Beginning(state, detections.time, what)

    def saved(self) -> dict[str, Any]:
        return {
            "people": self._people,
            "num_at_recognition": self._num_at_recognition,
            "meshes": self._meshes.saved(),
        }

    def restore(self, saved: dict[str, Any], state: MonoState) -> None:
        # Landmarks which a person gave, or which were found otherwise, are of the first images.
        self._points = self._detections = None
        self._people, self._num_at_recognition = saved["people"], saved["num_at_recognition"]
        self._meshes.restore(saved["meshes"])
        self._system = self._system._replace(face=self._followed(state))

    def advance(self, state: MonoState, images: np.ndarray, clock: np.ndarray, is_frame: np.ndarray):
        state, track = advance(self._system, state, images, clock, is_frame, self._compiled)
        return self._recognised(state), track

    def compared(self, state: MonoState, row: MonoTrack, images: np.ndarray, time: float) -> Compared:
        place = image_position(state.belief.mean[:3], self.rig)
        if redetection.is_beyond_doubt(state, row):
            if self._meshes.are_used and isinstance(self._detector, MeshGiver) and place is not None:
                self._meshes.add(self._detector.glance(images[0], *place), row, time)
            return Compared(state, None)
        observed = self._detector.detect(images[0], *(place or (None,)))
        if isinstance(observed, str):
            return Compared(state, None)
        compared = self._beside(state, row, observed, images)
        self._meshes.add(observed.solid, row, time, compared.row)
        return compared

    def reported(self, track: MonoTrack, times: np.ndarray) -> MonoTrack:
        # Who was followed before a loss is known, too, but is nobody of the gallery.
        num_known = 0 if self._gallery is None else len(self._gallery.identity)
        index = np.where(np.asarray(track.person_index) < num_known, track.person_index, -1)
        return self._meshes.reported(track._replace(person_index=index), times)

    def _beside(self, state: MonoState, row: MonoTrack, observed: DetectedFace, images: np.ndarray) -> Compared:
        """A track in doubt, or lost, beside what was detected in the last images."""
        found = redetection.located(state, row, self.rig, self._detector, observed, images[0])
        if found is None:
            return Compared(state, None)
        frames = np.repeat(images[None], self.chunk, axis=0)
        clock = np.full(self.chunk, float(state.time), np.asarray(state.time).dtype)
        other, track = advance(self._system, found.state, frames, clock, np.arange(self.chunk) < 1, self._compiled)
        first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], track)
        is_better = redetection.is_better(first, row, agrees=found.agrees)
        return Compared(other, first, not found.agrees) if is_better else Compared(state, None)

    def gallery(self, state: MonoState) -> Gallery:
        return as_gallery(self._system.unknown, self._system.face, state)

    def focal_length(self, state: MonoState) -> FocalLength:
        return focal_length(self._system.unknown, self._system.face, self.rig, state, self._compiled)

    def _recognised(self, state: MonoState) -> MonoState:
        """Asked again whenever the face has been adjusted twice as often: the estimate improves ever slower."""
        if len(self._people.log_prior) > 1 and int(state.num_adjusted) >= 2 * self._num_at_recognition:
            self._num_at_recognition = int(state.num_adjusted)
            state = recognised(self._people, self.rig, state, self._compiled)
            self._system = self._system._replace(face=self._followed(state))
        return state

    def _followed(self, state: MonoState) -> MultilinearFace:
        """The face of whom the state is about."""
        return one_of(self._people, int(state.face_index)) if int(state.face_index) else self._face

    def _remember(self, old: MonoState) -> None:
        """Who was followed may come back, beside those who were remembered from the first."""
        if not self._options.is_published:
            self._people = self._people_with(self._system, old)

    def _people_with(self, system: System, state: MonoState) -> People:
        last = as_gallery(system.unknown, system.face, state)
        return people(self._face, last if self._gallery is None else joined(self._gallery, last))

    def _asked_who(self, system: System, state: MonoState) -> MonoState:
        """As when a face comes back. Frames of a camera must not wait while this is compiled for one person more."""
        redetection.prepare(state, self.rig)
        self._meshes.prepare()
        return recognised(self._people_with(system, state), self.rig, state, self._compiled)

    def empty(self, count: int) -> MonoTrack:
        nothing = lambda *shape: np.full((count, *shape), np.nan, np.float32)
        return MonoTrack(
            pose=nothing(POSE),
            pose_std=nothing(POSE),
            deformation=nothing(self._face.num_expressions),
            shape=nothing(NUM_LANDMARKS, 3),
            image_points=nothing(1, NUM_LANDMARKS, 2),
            score=nothing(),
            effective_sample_size=np.zeros(count, np.float32),
            innovations=np.zeros((count, 2), np.int32),
            identity=nothing(self._face.num_identities),
            offset=nothing(NUM_LANDMARKS, 3),
            person_index=np.full(count, -1, np.int32),
            is_adjusted=np.zeros(count, bool),
            status=np.full(count, INITIALISING, np.int32),
        )

    def _checked(self, detections: Detections) -> tuple[_Found | None, list[str]]:
        """A start, if the landmarks are those of a face before the camera."""
        points, prior = jnp.asarray(detections.points, float), prior_beside(detections.errors, self._options)
        start = initialise(self._face, self.rig, points, prior, detected_px=detections.std_px)
        eyes = detections.points[:, :4].reshape(-1, 2, 2, 2).mean(axis=2)
        apart = float(np.linalg.norm(eyes[:, 1] - eyes[:, 0], axis=-1).mean())
        error, depth = float(start.adjustment.reprojection_px), np.asarray(start.bundle.poses[:, 2])
        if not math.isfinite(float(start.adjustment.energy)):
            return None, ["the face cannot be fitted: the model's covariances are singular, or the prior's scale is"]
        if not math.isfinite(error) or error > MOST_REPROJECTION * apart:
            return None, [f"the points are no face's: the best one is {error:.1f} px from them"]
        if depth.min() < DEPTH_MM[0] or depth.max() > DEPTH_MM[1]:
            return None, [f"the face would be {depth.mean():.0f} mm away"]
        return self._message(detections, start, prior), []

    def _message(self, detections: Detections, start: Start, prior: Prior) -> _Found:
        """The start with all that the detections tell beside the ten landmarks."""
        points = jnp.asarray(detections.points, float)
        views, past = detected(points, jnp.asarray(detections.std_px, points.dtype)), None
        options = self._options
        if options.is_published or not options.prior_weight:
            return _Found(detections, start, views, prior)
        if detections.dense is not None and self._whole.num_landmarks == NUM_DENSE:
            # It has what is misplaced of its own, and leaves none of it in the ten.
            prior = prior._replace(misplaced=None)
            start, past = start_densely(self._whole, self.rig, start, detections.dense, prior)
            # What they tell of the person is in the past already.
            views = views._replace(observed=jnp.zeros_like(views.observed))
        if detections.iris_px is not None and options.eyes_apart_mm is None:
            start, past = with_irises(self._face, self.rig, start, views, past, detections.iris_px, prior)
        if detections.facing_std is not None and bool(views.observed.any()):
            start, past = with_facing(self._face, self.rig, start, views, past, detections.facing_std, prior)
        return _Found(detections, start, views, prior._replace(past=past))
