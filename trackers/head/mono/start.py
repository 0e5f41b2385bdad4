"""The start of a track: landmarks that were detected in a few frames become a person, and where the head was."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Num

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.bundle import Adjustment, Bundle, Reach, Views, adjust, projected
from jaxfilters.models.face.landmarks import BROWS, EYES, MOUTH, NOSTRILS, NUM_LANDMARKS
from jaxfilters.models.face.misplacement import misplacement
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.patches import SIZE, SKIN_NORMALS, WIDE_SIZE, patches_of, unknown_slopes, windows
from jaxfilters.models.face.person_prior import Person, Prior, nothing_past, posed_shape
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.recent import nothing_changed
from jaxfilters.trackers.head.common.search import Searches, searches
from jaxfilters.trackers.head.common.search import start as start_search
from jaxfilters.trackers.head.common.state import POSE
from jaxfilters.trackers.head.mono.adjustment import informed
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.person import model_of
from jaxfilters.trackers.head.mono.state import AVERAGED, MonoState, Registered, Window, prior_of
from jaxfilters.trackers.io.detector_errors import DetectorErrors
from jaxfilters.typing import AnyKey

STEPS = (10, 10)
"""Of both stages of the first adjustment."""
MOST_TURNED = np.radians(60.0)
WIDE = Reach(pose=np.array([300.0, 300.0, 400.0, *[MOST_TURNED] * 3]), expression=4.0, identity=4.0, deviations=2.0)
"""Of the first adjustment."""
DETECTED_PX = 1.0
"""Standard deviation of a detected landmark."""
UNRENDERED_MM = 1.5
"""Of each coordinate of what a detector misplaces, standard deviation of what rendered people do not show of others.

On faces of a foreign model with photographs for skin the cascades' means differ by 1.0 to 4.1 mm from those of the
people that they were measured on; the median is 1.2 mm.
"""
ANCHORED_PX = 0.1
"""Of a landmark in the frame whose picture defines it."""
MOST_UNEVEN = np.radians(6.0)
"""Standard deviation of the directions of left-right pairs from which on a detection is a mistake (section 1)."""
PUBLISHED_SIGMA = 1.0
"""Of the sum of the scores ([4.41])."""
FIRST_MODEL_VARIANCE = 0.5**2
"""mm^2."""
FIRST_STD = np.array([1.0, 1.0, 3.0, 0.02, 0.05, 0.05])
"""Of the pose at the start, millimetres and radians, if the person is as believed."""
_PAIRS = np.array([(EYES[0], EYES[3]), (EYES[1], EYES[2]), MOUTH, NOSTRILS, BROWS])


class Start(NamedTuple):
    """What several frames of detected landmarks say."""

    bundle: Bundle
    adjustment: Adjustment
    uv: Float[Array, "n K 2"]
    """The landmarks as adjusted, pixels."""


def is_symmetric(points: Float[np.ndarray, "K 2"], most: float = MOST_UNEVEN) -> bool:
    """Whether the segments between left and right landmarks have about one direction."""
    right, left = points[_PAIRS[:, 0]], points[_PAIRS[:, 1]]
    across = left - right
    return bool(np.std(np.arctan2(across[:, 1], across[:, 0])) <= most)


def initialise(
    face: MultilinearFace,
    rig: CameraRig,
    points: Float[Array, "n K 2"],
    prior: Prior,
    *,
    detected_px: Float[ArrayLike, "*K"] = DETECTED_PX,
) -> Start:
    """Person and poses from detected landmarks, from heads that look into the camera on the ray of their middle.

    Args:
        face: Model.
        rig: One camera, which is the world.
        points: Landmarks in n frames, pixels.
        prior: What holds the face.
        detected_px: Standard deviation of each coordinate of the points, perhaps for each landmark.
    """
    return _fitted(face, rig, points, _ahead(face, rig, points, prior), prior, WIDE, detected_px)


def prior_beside(errors: DetectorErrors | None, options: MonoConfig) -> Prior:
    """What holds a face, with what the detector of its landmarks misplaces, if anything."""
    if errors is None or options.is_published or not options.prior_weight:
        return prior_of(options)
    covariance = errors.covariance + UNRENDERED_MM**2 * np.eye(len(errors.covariance))
    return prior_of(options)._replace(misplaced=misplacement(errors.mean, covariance, options.offset_std_mm))


@compiled_quickly
def _ahead(face, rig, points, prior) -> Bundle:
    """The mean person, who looks into the camera in all frames."""
    person = Person(face.identity_mean, prior.offset_mean * jnp.ones_like(face.mean))
    expressions = jnp.tile(face.expression_mean, (len(points), 1))
    mean = posed_shape(face, person, face.expression_mean)
    return Bundle(jax.vmap(lambda uv: facing_pose(rig, mean, uv))(points), expressions, person)


def _fitted(face, rig, points, bundle, prior, reach, detected_px) -> Start:
    numbers = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, points.dtype), tree)
    return _adjusted(face, rig, points, bundle, numbers(prior), numbers(reach), numbers(detected_px))


@compiled_quickly
def _adjusted(face, rig, points, bundle, prior, reach, detected_px) -> Start:
    found, info = adjust(face, rig, detected(points, detected_px), bundle, prior, reach, steps=STEPS)
    return Start(found, info, projected(face, rig, found))


@compiled_quickly
def detected(points: Float[Array, "n K 2"], std_px: Float[ArrayLike, "*K"]) -> Views:
    """Landmarks as detected, with the standard deviation of each coordinate, perhaps for each landmark."""
    variance = jnp.broadcast_to(jnp.square(std_px), points.shape[:2])
    covariance = variance[..., None, None] * jnp.eye(2)
    return Views(points, covariance, jnp.ones(points.shape[:2], bool))


@partial(compiled_quickly, static_argnames="options")
def begin(
    key: AnyKey,
    face: MultilinearFace,
    rig: CameraRig,
    start: Start,
    views: Views,
    frame: Int[ArrayLike, ""],
    images: Num[Array, "2 rows cols"],
    time: Float[Array, ""],
    options: MonoConfig,
    prior: Prior,
) -> MonoState:
    """State in the last frame of the start, with templates from one of its frames.

    Args:
        key: Random key; it lives in the state from here on.
        face: Model.
        rig: One camera.
        start: From `initialise`.
        views: Landmarks in its frames; not visible where what they tell is known otherwise (`past`).
        frame: Which of its frames the templates are taken from: the one most turned to the camera.
        images: That frame, and the last one.
        time: Of the last frame, seconds.
        options: Constants.
        prior: What holds the person, with what is known beside these landmarks.
    """
    bundle, uv, person = start.bundle, start.uv[frame], start.bundle.person
    first, last = jnp.asarray(images, uv.dtype)[:, None]
    registered = _registered(face, rig, bundle, uv, frame, first)
    model, modes = model_of(face, person, registered.templates)
    here, expressed = bundle.poses[-1], bundle.expressions[-1]
    x = jnp.concatenate([here, modes.coefficients(face, expressed)])
    variance = jnp.square(jnp.concatenate([jnp.asarray(FIRST_STD, x.dtype), jnp.maximum(model.deviation, 0.1)]))
    window = informed(face, rig, _first_window(bundle, views, uv, frame, options), person, prior)
    size = window.information.shape[-1]
    return MonoState(
        search=start_search(x, search_options(options)),
        belief=Gaussian(x, jnp.diag(variance).astype(x.dtype)),
        face_index=jnp.zeros((), jnp.int32),
        person=person,
        prior=_held(face, prior, options),
        model=model,
        modes=modes,
        response=jnp.zeros((POSE + face.num_expressions, size), x.dtype),
        by_focal=jnp.zeros(POSE + face.num_expressions, x.dtype),
        registered=registered,
        window=window,
        identities=jnp.tile(person.identity, (AVERAGED, 1)),
        num_adjusted=jnp.ones((), jnp.int32),
        recent=nothing_changed(last, posed_shape(face, person, expressed), here, rig),
        windows=registered.templates,
        is_fresh=jnp.zeros((), bool),
        is_unsure=jnp.zeros(NUM_LANDMARKS, bool),
        slopes=unknown_slopes(face.num_landmarks),
        model_variance=jnp.full(face.num_landmarks, FIRST_MODEL_VARIANCE, x.dtype),
        residual_scale=jnp.ones((), x.dtype),
        last_good=x,
        misses=jnp.zeros((), jnp.int32),
        num_outliers=jnp.zeros((), jnp.int32),
        time=jnp.asarray(time, x.dtype),
        key=key,
    )


def _held(face: MultilinearFace, prior: Prior, options: MonoConfig) -> Prior:
    """As a state has it: arrays, and a past from the first where frames will leave one."""
    if prior.past is None and options.past == "marginalised":
        prior = prior._replace(past=nothing_past(face))
    return jax.tree.map(lambda a: jnp.asarray(a, face.mean.dtype), prior)


def search_options(options: MonoConfig) -> HeadConfig:
    """Of the particle filter, which is that of the tracker with several cameras."""
    return HeadConfig(num_particles=options.num_particles)


def search_of(rig: CameraRig, options: MonoConfig) -> Searches:
    """The particle filters for a camera; for the published tracker with its standard deviation of the scores."""
    usual = searches(rig, search_options(options))
    if not options.is_published:
        return usual

    def sharper(filter: Filter) -> Filter:
        likelihood = replace(filter.params.log_likelihood, sigma=PUBLISHED_SIGMA)
        return replace(filter, params=replace(filter.params, log_likelihood=likelihood))

    return Searches(*map(sharper, usual))


def _registered(face, rig, bundle, uv, frame, image) -> Registered:
    """What the landmarks look like in one frame of the start."""
    wide = windows(image, uv[None])
    border = (WIDE_SIZE - SIZE) // 2
    shape = posed_shape(face, bundle.person, bundle.expressions[frame])
    observed = patches_of(wide, shape, bundle.poses[frame], rig, jnp.asarray(SKIN_NORMALS, uv.dtype))
    return Registered(wide, wide[..., border:-border, border:-border], observed)


def _first_window(bundle: Bundle, views: Views, uv: Array, frame: Int[ArrayLike, ""], options: MonoConfig) -> Window:
    """The frames of the start; that of the templates comes first, where they are exact by definition."""
    n = len(views.uv)
    order = jnp.arange(n).at[0].set(frame).at[frame].set(0)
    points, covariance, observed = (leaf[order] for leaf in views)
    if not options.is_published:
        points = points.at[0].set(uv)
        covariance = covariance.at[0].set(ANCHORED_PX**2 * jnp.eye(2))
        observed = observed.at[0].set(True)
    views = Views(points, covariance, observed)
    size = bundle.person.identity.size + bundle.person.offset.size
    return Window(
        views,
        bundle.poses[order],
        bundle.expressions[order],
        jnp.arange(n)[::-1][order],
        jnp.zeros((n, size, size)),
        jnp.zeros((n, size)),
    )


def facing_pose(rig: CameraRig, shape: Array, uv: Array) -> Array:
    """The pose of a head that looks into the camera where its landmarks are on average, as large as they spread."""
    rays = (uv - rig.center[0]) / rig.focal[0]
    middle = jnp.mean(rays, axis=0)
    spread = lambda points: jnp.sqrt(jnp.sum(jnp.square(points - jnp.mean(points, axis=0))))
    z = spread(shape[:, :2]) / spread(rays)
    in_camera = z * jnp.append(middle, 1.0) - jnp.mean(shape, axis=0)
    return jnp.concatenate([in_camera, jnp.zeros(3, in_camera.dtype)])
