"""Bundle adjustment of a multilinear face: the identity of a person, from landmarks in several frames of one video.

The shape in frame i is `M(s, a_i) + d`: identity s and offset d are the person's, expression a_i and pose p_i the
frame's (Sugano 2007, section 4.3). The offset, which the thesis does not have, is what the model lacks of this face: a
person outside of its training set, an asymmetry, a landmark that was marked beside its place. Everything is found by
Levenberg-Marquardt within a box ([4.25]-[4.37]), first the poses alone, then all of it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PyTree, Real

from jaxfilters.models.face import person_prior
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Person, Prior, posed_shape
from jaxfilters.models.face.rig import CameraRig, project_shape
from jaxfilters.optimize.least_squares import BoxLevenbergMarquardt, cauchy, huber

POSE_UNITS = np.array([10.0, 10.0, 20.0, *np.radians([3.0, 3.0, 3.0])])
"""Of the pose, millimetres and radians, in which the solver counts: by so much it may be off."""
OUTLIER = 3.0
"""Standard deviations from which on a landmark's distance counts less (Huber's loss, then Cauchy's)."""
_SMALLEST = 1e-12
"""Of steps and gradients: the number of steps is the limit."""
HIDDEN_PX = 1e4
"""Residual of a point behind the camera, pixels."""
Loss = Callable[[Array, float], Array]


class Views(NamedTuple):
    """Landmarks in n frames of one camera."""

    uv: Float[Array, "n K 2"]
    """Pixels."""
    covariance: Float[Array, "n K 2 2"]
    """Pixels squared."""
    observed: Bool[Array, "n K"]


class Bundle(NamedTuple):
    """All that is adjusted."""

    poses: Float[Array, "n 6"]
    """Millimetres and radians."""
    expressions: Float[Array, "n A"]
    person: Person


class Reach(NamedTuple):
    """How far a bundle may go from where it starts, in one adjustment."""

    pose: Float[ArrayLike, " 6"]
    """Millimetres and radians ([4.31])."""
    expression: Float[ArrayLike, ""]
    identity: Float[ArrayLike, ""]
    """In standard deviations of the training set, about the start ([4.35], [4.37])."""
    deviations: Float[ArrayLike, ""]
    """In the same, about the training set's mean."""


class Adjustment(NamedTuple):
    """How an adjustment ended."""

    energy: Float[Array, ""]
    """Half of the sum of squared residuals, the prior's included."""
    reprojection_px: Float[Array, ""]
    """Root mean square distance of the landmarks that are visible, a coordinate."""
    iterations: Int[Array, ""]
    """Of the second stage."""


def square(distance: Float[Array, "*shape"], scale: float) -> Float[Array, "*shape"]:
    """Distances as they are, for plain least squares."""
    del scale
    return distance


def adjust(
    face: MultilinearFace,
    rig: CameraRig,
    views: Views,
    start: Bundle,
    prior: Prior,
    reach: Reach,
    *,
    steps: tuple[int, int] = (5, 5),
    losses: tuple[Loss, Loss] = (huber, cauchy),
) -> tuple[Bundle, Adjustment]:
    """The bundle of least energy within its box, by at most so many steps for the poses and for everything.

    Args:
        face: Model.
        rig: One camera.
        views: Landmarks in n frames.
        start: Where the search starts, and about what the box lies; moved into the box where it is outside.
        prior: What holds the bundle.
        reach: The box.
        steps: Of both stages, static ([4.29], [4.32]).
        losses: Of the landmarks' distances in both stages. Far from the solution every landmark should pull, however
            wrong it seems; `square` in both is as published.
    """
    units = _units(face, start, prior)
    low, high = box(face, start, prior, reach)
    scaled = lambda value: jax.tree.map(lambda v, s, u: (v - s) / u, value, start, units)
    whole = lambda y: jax.tree.map(lambda v, s, u: s + u * v, y, start, units)
    bounds = jax.tree.map(jnp.minimum, scaled(low), scaled(high)), jax.tree.map(jnp.maximum, scaled(low), scaled(high))
    zero = jax.tree.map(lambda v, a, b: jnp.clip(jnp.zeros_like(v), a, b), start, *bounds)
    residuals = lambda y, _: all_residuals(face, rig, views, whole(y), prior, loss=losses[1])

    def of_poses(poses: Array, _: None) -> Array:
        return all_residuals(face, rig, views, whole(zero._replace(poses=poses)), prior, loss=losses[0])

    posed, _ = _solved(of_poses, zero.poses, bounds[0].poses, bounds[1].poses, steps[0])
    y, taken = _solved(residuals, zero._replace(poses=posed), *bounds, steps[1])
    found = whole(y)
    apart = jnp.where(views.observed[..., None], views.uv - projected(face, rig, found), 0.0)
    mean = jnp.sum(apart**2) / jnp.maximum(2 * jnp.sum(views.observed), 1)
    rest = residuals(y, None)
    return found, Adjustment(0.5 * jnp.sum(rest**2), jnp.sqrt(mean), taken)


def box(face: MultilinearFace, start: Bundle, prior: Prior, reach: Reach) -> tuple[Bundle, Bundle]:
    """Lower and upper bounds, in the form that is never empty wherever the start lies (errata of [4.35], [4.37])."""
    a_mean, a_std = face.expression_mean, face.expression_std
    s_mean, s_std = face.identity_mean, face.identity_std
    widest = jnp.asarray(reach.deviations)

    def sides(value: Array, mean: Array, std: Array, most: Real[ArrayLike, ""]) -> tuple[Array, Array]:
        within = lambda x: jnp.clip(x, mean - widest * std, mean + widest * std)
        return within(value - most * std), within(value + most * std)

    pose = jnp.asarray(reach.pose, start.poses.dtype)
    a_low, a_high = sides(start.expressions, a_mean, a_std, reach.expression)
    s_low, s_high = sides(start.person.identity, s_mean, s_std, reach.identity)
    middle = prior.offset_mean * jnp.ones_like(start.person.offset)
    most = widest * prior.offset_deviations * jnp.ones_like(start.person.offset)
    return (
        Bundle(start.poses - pose, a_low, Person(s_low, middle - most)),
        Bundle(start.poses + pose, a_high, Person(s_high, middle + most)),
    )


def projected(face: MultilinearFace, rig: CameraRig, bundle: Bundle) -> Float[Array, "n K 2"]:
    """Pixels of the landmarks in every frame, NaN behind the camera ([4.17])."""

    def one(pose: Array, expression: Array) -> Array:
        return project_shape(rig, posed_shape(face, bundle.person, expression), pose)[0][0]

    return jax.vmap(one)(bundle.poses, bundle.expressions)


def all_residuals(
    face: MultilinearFace, rig: CameraRig, views: Views, bundle: Bundle, prior: Prior, *, loss: Loss = cauchy
) -> Float[Array, " rows"]:
    """Residuals in standard deviations: of the frames (`frame_residuals`), and of the person (`person_prior`)."""
    of_frames = frame_residuals(face, rig, views, bundle, prior.weight, loss=loss)
    return jnp.concatenate([of_frames, person_prior.residuals(face, bundle.person, bundle.expressions, prior)])


def frame_residuals(
    face: MultilinearFace,
    rig: CameraRig,
    views: Views,
    bundle: Bundle,
    weight: Float[ArrayLike, ""],
    *,
    loss: Loss = cauchy,
) -> Float[Array, " rows"]:
    """Residuals in standard deviations: of the landmarks ([4.18]) and of the expressions.

    Distances of landmarks enter by `loss`, `huber` or `cauchy` of `jaxfilters.least_squares`.

    Args:
        face: Model.
        rig: One camera.
        views: Landmarks in n frames.
        bundle: Where they are.
        weight: Of the expressions; 1 is Bayes' rule.
        loss: Of distances.
    """
    held = weight * person_prior.expression_residuals(face, bundle.person.identity, bundle.expressions)
    return jnp.concatenate([_of_views(face, rig, views, bundle, loss).ravel(), held.ravel()])


def _of_views(face: MultilinearFace, rig: CameraRig, views: Views, bundle: Bundle, loss: Loss) -> Array:
    apart = projected(face, rig, bundle) - views.uv
    apart = jnp.where(jnp.isfinite(apart), apart, HIDDEN_PX)
    # Unit covariance stands where nothing was observed: its root must exist.
    covariance = jnp.where(views.observed[..., None, None], views.covariance, jnp.eye(2))
    (a, b), (_, c) = jnp.moveaxis(covariance, (-2, -1), (0, 1))
    first = apart[..., 0] / jnp.sqrt(a)
    # Rounding must not take what is left of a long thin covariance below zero.
    second = (apart[..., 1] - b / a * apart[..., 0]) / jnp.sqrt(jnp.maximum(c - b * b / a, 1e-6 * c))
    r = jnp.where(views.observed[..., None], jnp.stack([first, second], axis=-1), 0.0)
    length2 = jnp.sum(r * r, axis=-1, keepdims=True)
    apart_at_all = length2 > _SMALLEST
    length = jnp.sqrt(jnp.where(apart_at_all, length2, 1.0))
    return jnp.where(apart_at_all, r / length * loss(length, OUTLIER), r)


def _units(face: MultilinearFace, start: Bundle, prior: Prior) -> Bundle:
    s_std = face.identity_std
    a_std = face.expression_std
    like = lambda unit, value: jnp.broadcast_to(jnp.asarray(unit, value.dtype), value.shape)
    deviations = prior.offset_deviations
    offset = jnp.where(deviations > 0, deviations, 1.0)
    return Bundle(
        like(POSE_UNITS, start.poses),
        like(a_std, start.expressions),
        Person(like(s_std, start.person.identity), like(offset, start.person.offset)),
    )


def _solved(residuals, y: PyTree, low: PyTree, high: PyTree, steps: int) -> tuple[PyTree, Array]:
    if not steps:
        return y, jnp.zeros((), jnp.int32)
    solver = BoxLevenbergMarquardt(rtol=_SMALLEST, atol=_SMALLEST)
    solution: Any = optimistix.least_squares(
        residuals, solver, y, options={"lower": low, "upper": high}, max_steps=steps, throw=False
    )
    return solution.value, solution.stats["num_steps"]
