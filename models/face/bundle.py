"""Bundle adjustment of a multilinear face: who somebody is, from landmarks in several frames of one video.

The shape in frame i is `M(s, a_i) + d`: identity s and offset d are the person's, expression a_i and pose p_i the
frame's (Sugano 2007, section 4.3). The offset, which the thesis does not have, is what the model lacks of this face: a
person whom it has not seen, an asymmetry, a landmark that was marked beside its place. Everything is found by
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

from jaxfilters.least_squares import BoxLevenbergMarquardt, cauchy, huber
from jaxfilters.linalg import safe_sqrt
from jaxfilters.models.face.landmarks import EYES
from jaxfilters.models.face.multilinear import MultilinearFace, shape
from jaxfilters.models.face.rig import CameraRig, project_shape

POSE_UNITS = np.array([10.0, 10.0, 20.0, *np.radians([3.0, 3.0, 3.0])])
"""Of the pose, millimetres and radians, in which the solver counts: by so much it may be off."""
OUTLIER = 3.0
"""Standard deviations from which on a landmark's distance counts less (Huber's loss, then Cauchy's)."""
_SMALLEST = 1e-12
"""Of steps and gradients: the number of steps is the limit."""
UNTOLD = 1e-6
"""Information, as a share of that about each parameter itself, about what the past frames do not tell."""
HIDDEN_PX = 1e4
"""Residual of a point behind the camera, pixels."""
Loss = Callable[[Array, float], Array]


class Person(NamedTuple):
    """Whose face it is."""

    identity: Float[Array, " S"]
    offset: Float[Array, "K 3"]
    """What the model lacks of this face in every expression, model frame, millimetres."""


class Views(NamedTuple):
    """Landmarks in n frames of one camera."""

    uv: Float[Array, "n K 2"]
    """Pixels."""
    covariance: Float[Array, "n K 2 2"]
    """Pixels squared."""
    seen: Bool[Array, "n K"]


class Bundle(NamedTuple):
    """All that is adjusted."""

    poses: Float[Array, "n 6"]
    """Millimetres and radians."""
    expressions: Float[Array, "n A"]
    person: Person


class Past(NamedTuple):
    """What frames that are no longer adjusted told of the person: a Gaussian, in information form.

    Minus its logarithm is `p . information p / 2 - pull . p` for the parameters p: identity, then offset.
    """

    information: Float[Array, "d d"]
    pull: Float[Array, " d"]


class Prior(NamedTuple):
    """What holds a bundle beside the images; a weight of 0 lets go, 1 is Bayes' rule."""

    weight: Float[ArrayLike, ""]
    """Of identity and expressions about those of the training set, with their covariances."""
    offset_std: Float[ArrayLike, ""]
    """Millimetres: of each coordinate of the offset; 0 for none."""
    eyes_apart: Float[ArrayLike, ""] = 0.0
    """Millimetres between the centres of the eyes, if that is known: the size of everything follows from it."""
    eyes_apart_std: Float[ArrayLike, ""] = 0.0
    """Millimetres; 0 where it is not known."""
    past: Past | None = None
    """Of frames that were adjusted before."""


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
    """Root mean square distance of the landmarks that are seen, a coordinate."""
    iterations: Int[Array, ""]
    """Of the second stage."""


def square(distance: Float[Array, "*shape"], scale: float) -> Float[Array, "*shape"]:
    """Distances as they are, for plain least squares."""
    del scale
    return distance


def posed_shape(face: MultilinearFace, person: Person, expression: Float[Array, " A"]) -> Float[Array, "K 3"]:
    """Landmarks of a person with an expression in the model frame, millimetres ([4.15] and the offset)."""
    return shape(face, person.identity, expression) + person.offset


def parameters(person: Person) -> Float[Array, " d"]:
    """Identity, then offset, as `Past` has them."""
    return jnp.concatenate([person.identity, person.offset.ravel()])


def nothing_past(face: MultilinearFace) -> Past:
    """Of a person who is new."""
    size = face.num_identities + face.mean.size
    return Past(jnp.zeros((size, size), face.mean.dtype), jnp.zeros(size, face.mean.dtype))


def eyes_apart(face: MultilinearFace, person: Person) -> Float[Array, ""]:
    """Millimetres between the middles of the corners of either eye."""
    corners = posed_shape(face, person, face.expression_mean)[jnp.asarray(EYES)]
    right, left = jnp.mean(corners[:2], axis=0), jnp.mean(corners[2:], axis=0)
    return jnp.sqrt(jnp.sum(jnp.square(left - right)))


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
    apart = jnp.where(views.seen[..., None], views.uv - projected(face, rig, found), 0.0)
    mean = jnp.sum(apart**2) / jnp.maximum(2 * jnp.sum(views.seen), 1)
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
    most = widest * jnp.asarray(prior.offset_std) * jnp.ones_like(start.person.offset)
    return (
        Bundle(start.poses - pose, a_low, Person(s_low, -most)),
        Bundle(start.poses + pose, a_high, Person(s_high, most)),
    )


def projected(face: MultilinearFace, rig: CameraRig, bundle: Bundle) -> Float[Array, "n K 2"]:
    """Pixels of the landmarks in every frame, NaN behind the camera ([4.17])."""

    def one(pose: Array, expression: Array) -> Array:
        return project_shape(rig, posed_shape(face, bundle.person, expression), pose)[0][0]

    return jax.vmap(one)(bundle.poses, bundle.expressions)


def all_residuals(
    face: MultilinearFace, rig: CameraRig, views: Views, bundle: Bundle, prior: Prior, *, loss: Loss = cauchy
) -> Float[Array, " rows"]:
    """Residuals in standard deviations: of the landmarks ([4.18]), of identity, expressions, offset, and size.

    Distances of landmarks enter by `loss`, `huber` or `cauchy` of `jaxfilters.least_squares`.
    """
    whiten = lambda covariance, x: jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(covariance), x.T, lower=True)
    identity = whiten(face.identity_covariance, (bundle.person.identity - face.identity_mean)[None])
    expressions = whiten(face.expression_covariance, bundle.expressions - face.expression_mean)
    known = jnp.asarray(prior.offset_std) > 0
    offset = jnp.where(known, bundle.person.offset / jnp.where(known, prior.offset_std, 1.0), 0.0)
    held = prior.weight * jnp.concatenate([identity.ravel(), expressions.ravel()])
    measured = jnp.asarray(prior.eyes_apart_std) > 0
    wrong = eyes_apart(face, bundle.person) - prior.eyes_apart
    size = jnp.where(measured, wrong / jnp.where(measured, prior.eyes_apart_std, 1.0), 0.0)
    before = jnp.zeros(0, offset.dtype) if prior.past is None else _of_past(face, prior.past, bundle.person)
    return jnp.concatenate(
        [_of_views(face, rig, views, bundle, loss).ravel(), held, offset.ravel(), size[None], before]
    )


def _of_past(face: MultilinearFace, past: Past, person: Person) -> Array:
    """Residuals of which half the sum of squares is the past's part of the energy, but for a constant.

    In units of each parameter's own information and about the mean person, so that one small constant can stand for
    what the past does not tell, and rounding does not grow with what it does.
    """
    product = lambda a, b: jnp.matmul(a, b, precision="highest")
    scale = safe_sqrt(jnp.diagonal(past.information))
    unit = jnp.where(scale > 0, 1 / jnp.where(scale > 0, scale, 1.0), 1.0)
    mean = parameters(Person(face.identity_mean, jnp.zeros_like(face.mean)))
    pull = unit * (past.pull - product(past.information, mean))
    untold = UNTOLD * jnp.eye(unit.size, dtype=unit.dtype)
    root = jnp.linalg.cholesky(past.information * unit[:, None] * unit + untold)
    towards = jax.scipy.linalg.solve_triangular(root, pull, lower=True)
    return product(root.T, (parameters(person) - mean) / unit) - towards


def _of_views(face: MultilinearFace, rig: CameraRig, views: Views, bundle: Bundle, loss: Loss) -> Array:
    apart = projected(face, rig, bundle) - views.uv
    apart = jnp.where(jnp.isfinite(apart), apart, HIDDEN_PX)
    # Unit covariance stands where nothing was seen: its root must exist.
    covariance = jnp.where(views.seen[..., None, None], views.covariance, jnp.eye(2))
    (a, b), (_, c) = jnp.moveaxis(covariance, (-2, -1), (0, 1))
    first = apart[..., 0] / jnp.sqrt(a)
    # Rounding must not take what is left of a long thin covariance below zero.
    second = (apart[..., 1] - b / a * apart[..., 0]) / jnp.sqrt(jnp.maximum(c - b * b / a, 1e-6 * c))
    r = jnp.where(views.seen[..., None], jnp.stack([first, second], axis=-1), 0.0)
    length2 = jnp.sum(r * r, axis=-1, keepdims=True)
    apart_at_all = length2 > _SMALLEST
    length = jnp.sqrt(jnp.where(apart_at_all, length2, 1.0))
    return jnp.where(apart_at_all, r / length * loss(length, OUTLIER), r)


def _units(face: MultilinearFace, start: Bundle, prior: Prior) -> Bundle:
    s_std = face.identity_std
    a_std = face.expression_std
    like = lambda unit, value: jnp.broadcast_to(jnp.asarray(unit, value.dtype), value.shape)
    offset = jnp.where(jnp.asarray(prior.offset_std) > 0, prior.offset_std, 1.0)
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
