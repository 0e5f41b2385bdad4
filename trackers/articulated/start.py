"""Where an articulated hand may be when it is observed for the first time: hypotheses from points in one image."""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import dot
from jaxfilters.gaussian.constraints import LinearConstraints
from jaxfilters.math.lie import quaternion_multiply, so3_exp
from jaxfilters.math.linalg import solve_triangular
from jaxfilters.models.articulated.anatomy import PALM_WIDTH, relaxed_angles, template_shape
from jaxfilters.models.articulated.hand import ArticulatedHand
from jaxfilters.models.articulated.layout import Layout
from jaxfilters.models.articulated.motion import ANGLE_SPREAD, AboutEase, lean_axes
from jaxfilters.models.articulated.projection import Perspective

NUM_STARTS = 6
FEWEST_POINTS = 4
_TILTS = (-50.0, -20.0, 20.0, 50.0)
"""Degrees about the axis across the palm: fingers away from the camera or towards it."""
_ROLLS = (-45.0, 0.0, 45.0, 135.0, 180.0, 225.0)
"""Degrees about the axis along the palm: 0 shows its inner side, 180 its back."""
STEPS = 8
"""Gauss-Newton steps from each orientation."""
ROTATION_STD, ANGLE_STD = math.radians(15.0), ANGLE_SPREAD
"""About the fitted pose; angles also about the relaxed hand while it is fitted, radians."""
SIZE_STD, LENGTH_STD = 0.1, 0.08
"""Of the hand as a whole, and of each length on its own: shares of the average hand's."""
SIZE_STD_OF_WIDTH = 0.05
"""Of the size of the fingers where the width of the palm was measured: lengths and widths of hands each vary by about
5 to 6 % (S. Pheasant, Bodyspace, 1996), and so does their ratio by 5 % where the two correlate by .6."""
WIDTH_STD = 2.0
"""Millimetres, of a palm's width by a ruler."""
POSITION_STD = 5.0
"""Pixels."""
LIMIT_STD = math.radians(3.0)
"""How far a fitted angle may leave its limits."""
RATE_STD = (6.0, 0.03, math.radians(4.0))
"""Per frame: pixels, quaternion, radians."""
_DISTANCE = 0.6
"""Metres from a camera in perspective at which orientations are compared with the image."""
SAME_POSE = math.radians(15.0)
"""Between the palms of two fits that count as one."""
_SET_BACK = 1e6
_OUTLIER = 3.0
"""Standard deviations of a point beyond which its pull on the fit grows no more."""


class HandSize(NamedTuple):
    """What is known of the size of a hand before a camera in perspective."""

    share: Float[Array, ""] | float = 1.0
    """Of the average hand's."""
    std: Float[Array, ""] | float = SIZE_STD
    """Of its logarithm."""
    width_std: Float[Array, ""] | float = LENGTH_STD
    """Of the palm's width, a share of it."""
    width_varies: Float[Array, ""] | float = 1.0
    """1 where the palm's width goes with the size, 0 where it was measured."""


AVERAGE_SIZE = HandSize()


def size_of(palm_width: float | None) -> HandSize:
    """The size of a hand whose palm is as wide, in metres; `None` is any hand."""
    if palm_width is None:
        return AVERAGE_SIZE
    return HandSize(1e3 * palm_width / PALM_WIDTH, SIZE_STD_OF_WIDTH, 1e-3 * WIDTH_STD / palm_width, 0.0)


class Starts(NamedTuple):
    """Gaussians, hypotheses first, the best first."""

    means: Float[Array, "h n"]
    covariances: Float[Array, "h n n"]
    costs: Float[Array, " h"]
    """Half the squared deviations of points, angles and limits."""
    found: Bool[Array, ""]
    """Whether enough was observed: `FEWEST_POINTS` points."""


def starts_from_points(
    hand: ArticulatedHand,
    limits: LinearConstraints | None,
    y: Float[Array, " rows"],
    mask: Bool[Array, " rows"],
    std: Float[Array, " rows"],
    size: HandSize = AVERAGE_SIZE,
) -> Starts:
    """The poses of an average hand that explain one image best, from many orientations.

    Each orientation is laid over the image by a similarity; those that fit best are refined by Gauss-Newton steps on
    pose, size and angles, with the relaxed hand as a prior and the limits on angles as barriers.

    Args:
        hand: Five fingers whose features are points, (x, y) one after the other.
        limits: Rows on the state; `None` for none.
        y: Pixels; what was not measured may hold anything finite.
        mask: Which rows were measured.
        std: Noise of the rows, pixels.
        size: Of the hand; in weak perspective it means nothing.
    """
    layout = hand.layout
    observed = mask.reshape(-1, 2).all(axis=1)
    target = jnp.where(observed[:, None], y.reshape(-1, 2), 0.0)
    found = jnp.sum(observed) >= FEWEST_POINTS
    orientations = _orientations(y.dtype)
    states, misfits = jax.vmap(lambda q: _laid_over(hand, _template(hand, q, size), target, observed))(orientations)
    order = jnp.argsort(misfits)[: 2 * NUM_STARTS]
    fit = partial(_fitted, hand, limits, y, jnp.repeat(observed, 2), std, size)
    # One after the other: LAPACK calls in a batch stand still in jaxlib 0.10 on two cores.
    means, costs = jax.lax.map(fit, states[order])
    costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
    apart = _apart(layout, means, costs)
    best = jnp.argsort(apart)[:NUM_STARTS]
    means = jnp.where(jnp.isfinite(means[best]), means[best], states[order][best])
    found = found & jnp.all(jnp.isfinite(means))
    means = jnp.where(found, means, jax.vmap(lambda q: _template(hand, q, size))(orientations[:NUM_STARTS]))
    covariances = jax.vmap(partial(start_covariance, hand, size))(means)
    return Starts(means, covariances, apart[best], found)


def _apart(layout: Layout, means: Array, costs: Array) -> Array:
    """Costs with those of poses set back that a better one is close to."""
    q = means[:, layout.quaternion]
    alike = jnp.abs(dot(q, q.T)) > math.cos(0.5 * SAME_POSE)
    better = (costs[None] < costs[:, None]) | ((costs[None] == costs[:, None]) & jnp.tri(len(costs), k=-1, dtype=bool))
    return costs + jnp.where(jnp.any(alike & better, axis=1), _SET_BACK, 0.0)


def _orientations(dtype: np.dtype) -> Float[Array, "k 4"]:
    """Camera from palm, the palm's axis up in the image: turned about it, then across it."""
    rolls, tilts = np.meshgrid(np.radians(_ROLLS), np.radians(_TILTS), indexing="ij")
    upright = jnp.array([0.5, -0.5, 0.5, -0.5], dtype)
    x = jnp.eye(3, dtype=dtype)[0]

    def one(roll: Array, tilt: Array) -> Array:
        # Tilted about the image's horizontal: fingers towards the camera whatever side of the hand is visible.
        return quaternion_multiply(so3_exp(tilt * x), quaternion_multiply(upright, so3_exp(roll * x)))

    return jax.vmap(one)(jnp.asarray(rolls.ravel(), dtype), jnp.asarray(tilts.ravel(), dtype))


def _template(hand: ArticulatedHand, q: Array, size: HandSize) -> Float[Array, " n"]:
    """An average hand of this size, relaxed, on the optical axis: lengths in millimetres for pixels, or in metres."""
    layout = hand.layout
    in_space = isinstance(hand.projection, Perspective)
    shape = jnp.asarray(template_shape(), q.dtype) * (1e-3 * size.share if in_space else 1.0)
    x = jnp.zeros(layout.size, q.dtype).at[layout.quaternion].set(q).at[layout.static].set(shape)
    x = x.at[layout.angles].set(jnp.asarray(relaxed_angles(layout), q.dtype).ravel())
    return x.at[2].set(_DISTANCE) if in_space else x


def _laid_over(hand: ArticulatedHand, x: Array, target: Array, observed: Array) -> tuple[Array, Array]:
    """The state turned in the image, moved and scaled to fit the points best, and the mean square of what remains."""
    layout, weight = hand.layout, observed[:, None] / jnp.maximum(jnp.sum(observed), 1)
    image = hand.observe(x).reshape(-1, 2)
    here, there = jnp.sum(weight * image, axis=0), jnp.sum(weight * target, axis=0)
    a, b = image - here, target - there
    cos = jnp.sum(weight * a * b)
    sin = jnp.sum(weight[:, 0] * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    square = jnp.maximum(jnp.sum(weight * a * a), 1e-6)
    angle, scale = jnp.arctan2(sin, cos), jnp.maximum(jnp.sqrt(cos**2 + sin**2) / square, 1e-3)
    turned = jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])
    misfit = jnp.sum(weight * (b - dot(scale * a, turned.T)) ** 2)
    z = jnp.eye(3, dtype=x.dtype)[2]
    q = quaternion_multiply(so3_exp(angle * z), x[layout.quaternion])
    origin = hand.projection.image_points(hand.wrist(x))
    wrist = there + dot(scale * turned, origin - here)
    if isinstance(hand.projection, Perspective):
        camera = hand.projection.camera
        ray = jnp.append((wrist - camera.center) / camera.focal, 1.0)
        towards = jnp.cross(z, ray)
        q = quaternion_multiply(so3_exp(towards), q)
        return x.at[layout.quaternion].set(q).at[layout.position].set(x[2] / scale * ray), misfit
    moved = x.at[layout.quaternion].set(q).at[layout.position].set(wrist)
    return moved.at[layout.static].multiply(scale), misfit


def _fitted(
    hand: ArticulatedHand,
    limits: LinearConstraints | None,
    y: Array,
    observed: Array,
    std: Array,
    size: HandSize,
    start: Array,
) -> tuple[Array, Array]:
    """Gauss-Newton from one state, and the cost at its end."""
    layout = hand.layout
    position, rotation, angles = layout.position.stop, layout.position.stop + 3, layout.position.stop + 4
    in_space = isinstance(hand.projection, Perspective)
    unit = start[2] if in_space else 1.0
    relaxed, spread = jnp.asarray(relaxed_angles(layout), start.dtype).ravel(), _angle_root(hand)

    def state(p: Array) -> Array:
        x = start.at[layout.position].add(unit * p[:position])
        x = x.at[layout.quaternion].set(quaternion_multiply(so3_exp(p[position:rotation]), start[layout.quaternion]))
        return x.at[layout.static].multiply(jnp.exp(p[rotation])).at[layout.angles].add(p[angles:])

    def deviations(p: Array) -> Array:
        x = state(p)
        missed = jnp.where(observed, (hand.observe(x) - y) / std, 0.0)
        pair = jnp.sum(jax.lax.stop_gradient(missed).reshape(-1, 2) ** 2, axis=1)
        missed = missed * jnp.repeat(1 / jnp.sqrt(1 + pair / _OUTLIER**2), 2)
        parts = [missed, solve_triangular(spread, x[layout.angles] - relaxed)]
        parts += [p[rotation:angles] / size.std] if in_space else []
        if isinstance(hand.motion, AboutEase) and hand.motion.lean_std is not None:
            axis, sight = lean_axes(x, layout)
            parts.append(jnp.sum(axis * sight, keepdims=True) / hand.motion.lean_std)
        if limits is not None:
            value = dot(limits.normals, x)
            outside = jnp.maximum(value - limits.upper, 0.0) + jnp.maximum(limits.lower - value, 0.0)
            moves = jnp.any(limits.normals[:, layout.angles] != 0, axis=1)
            parts.append(jnp.where(moves, outside / LIMIT_STD, 0.0))
        return jnp.concatenate(parts)

    def step(carry: tuple, _: None) -> tuple[tuple, None]:
        p, cost, damping = carry
        r, J = deviations(p), jax.jacfwd(deviations)(p)
        A = dot(J.T, J)
        change = jnp.linalg.solve(A + damping * jnp.diag(jnp.diagonal(A) + 1e-3), dot(-J.T, r))
        tried = p + change
        after = 0.5 * jnp.sum(deviations(tried) ** 2)
        better = after < cost
        damping = jnp.where(better, 0.2 * damping, 5.0 * damping)
        return (jnp.where(better, tried, p), jnp.where(better, after, cost), damping), None

    zero = jnp.zeros(angles + 4 * layout.num_fingers, start.dtype)
    first = (zero, 0.5 * jnp.sum(deviations(zero) ** 2), jnp.asarray(0.1, start.dtype))
    (p, cost, _), _ = jax.lax.scan(step, first, None, length=STEPS)
    return state(p), cost


def _angle_root(hand: ArticulatedHand) -> Float[Array, "angles angles"]:
    """Lower triangular root of the covariance of the angles about the relaxed hand, radians."""
    alike = hand.motion.angle_root if isinstance(hand.motion, AboutEase) else None
    return ANGLE_STD * (jnp.eye(4 * hand.layout.num_fingers) if alike is None else alike)


def start_covariance(hand: ArticulatedHand, size: HandSize, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Covariance of a fitted state: pose as fitted, and a hand whose size as a whole is as uncertain as `size` says.

    In perspective a larger hand is at a distance in proportion.
    """
    layout: Layout = hand.layout
    projection = hand.projection
    pixel = x[2] / projection.camera.focal[0] if isinstance(projection, Perspective) else 1.0
    position, quaternion, angle = RATE_STD
    rates = layout.per_moving(1.0, quaternion, angle).at[layout.position].multiply(position * pixel) ** 2
    moving = layout.per_moving(1.0, 0.0, 0.0).at[layout.position].multiply(POSITION_STD * pixel) ** 2
    if not isinstance(projection, Perspective):
        size = AVERAGE_SIZE
    width = layout.palm.start
    shape_std = (LENGTH_STD * x[layout.static]).at[width - layout.static.start].set(size.width_std * x[width])
    errors = jnp.zeros(0) if hand.errors is None else hand.errors.covariance
    variances = jnp.concatenate([moving, rates, shape_std**2, errors]).astype(x.dtype)
    q = x[layout.quaternion]
    across = jnp.eye(4, dtype=x.dtype) - jnp.outer(q, q)
    covariance = jnp.diag(variances).at[layout.quaternion, layout.quaternion].set((0.5 * ROTATION_STD) ** 2 * across)
    root = _angle_root(hand)
    covariance = covariance.at[layout.angles, layout.angles].set(dot(root, root.T))
    grows = jnp.zeros_like(x).at[layout.static].set(x[layout.static])
    if isinstance(projection, Perspective):
        grows = grows.at[layout.position].set(x[layout.position]).at[width].multiply(size.width_varies)
    return covariance + size.std**2 * jnp.outer(grows, grows)
