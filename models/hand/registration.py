r"""Pull a hand pose onto a depth image by Gauss-Newton: where a sampler should look.

Three kinds of residual, all in metres, all with the closest capsule point held fixed on its capsule while the pose
moves:

* every observed hand pixel: its signed distance to the hand's surface;
* every rendered pixel over background: its offset in the image plane to the nearest observed hand pixel, at the model's
  depth;
* every rendered pixel in front of the observed surface: its distance to it along the surface normal.

Residuals are weighted by Geman and McClure's function, whose width falls over the iterations. Together with a Gaussian
prior on the pose and soft joint limits this is a maximum a posteriori estimate, and the normal matrix of the residuals
is the information that the image holds about the pose. The family of methods: Tagliasacchi et al. 2015, "Robust
articulated-ICP for real-time hand tracking".
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._full_precision import dot, einsum
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.limits import SOFTNESS, limit_excess
from jaxfilters.models.hand.skeleton import TANGENT_SIZE, HandGeometry, forward_kinematics, local, retract
from jaxfilters.models.rendering.depth import capsule_depth
from jaxfilters.models.rendering.geometry import Capsules

LARGEST_STEP = np.repeat(np.asarray([0.05, 0.4, 0.5], np.float32), (3, 3, 15))
"""Metres and radians: the linearisation holds no farther."""


@dataclass(frozen=True)
class RegistrationConfig:
    """How much the image is trusted; Python numbers, read when building."""

    noise_std: float = 0.005
    """Residual of one pixel, metres: sensor noise and the difference between hand and model."""
    independent_pixels: float = 200.0
    """What all pixels together are worth: neighbouring residuals are correlated."""
    outline_weight: float = 1.0
    front_weight: float = 0.5
    widths: tuple[float, ...] = (0.03, 0.015, 0.015)
    """Width of the robust weight in each iteration, metres."""


class PosePrior(NamedTuple):
    """A Gaussian belief about the pose."""

    mean: Float[Array, " 22"]
    root: Float[Array, "21 21"]
    """Lower triangular root of the covariance in the tangent space at the mean."""


class Registration(NamedTuple):
    """Where the image pulls the pose."""

    pose: Float[Array, " 22"]
    information: Float[Array, "21 21"]
    """Of the image alone, in the tangent space at the pose."""


class Target(NamedTuple):
    """What registration needs of one image; the same for every hypothesis."""

    rays: Float[Array, "m 3"]
    depth: Float[Array, " m"]
    """Metres; `inf` is background, NaN no reading."""
    nearest_hand: Int[Array, " m"]
    """Index of the observed hand pixel nearest in the image."""


def target_from_image(camera: Pinhole, observed: Float[Array, "rows cols"]) -> Target:
    """Prepare an image (metres, `inf` background, NaN no reading) of `camera`; keep it under 50 x 50 pixels or so."""
    return Target(camera.rays().reshape(-1, 3), observed.reshape(-1), _nearest(jnp.isfinite(observed)).reshape(-1))


def _nearest(hand: Bool[Array, "rows cols"]) -> Int[Array, "rows cols"]:
    """Flat index of the hand pixel nearest to each pixel: first along the rows, then along the columns."""
    rows, cols = hand.shape
    far = rows**2 + cols**2
    across = (jnp.arange(cols)[:, None] - jnp.arange(cols)) ** 2
    in_row = jnp.where(hand[:, None, :], across, far)
    column, gap = jnp.argmin(in_row, axis=2), jnp.min(in_row, axis=2)
    down = (jnp.arange(rows)[:, None] - jnp.arange(rows)) ** 2
    row = jnp.argmin(down[:, :, None] + gap, axis=1)
    return row * cols + jnp.take_along_axis(column, row, axis=0)


def register(
    camera: Pinhole,
    target: Target,
    geometry: HandGeometry,
    start: Float[Array, " 22"],
    prior: PosePrior,
    config: RegistrationConfig,
) -> Registration:
    """Maximum a posteriori pose from `start`, one Gauss-Newton step for each of `config.widths`.

    `camera` must be the one that `target` was made with.
    """

    def iterate(pose: Array, width: Array) -> tuple[Array, Array]:
        return gauss_newton(camera, target, geometry, pose, prior, width, config)

    pose, information = jax.lax.scan(iterate, start, jnp.asarray(config.widths))
    return Registration(pose, information[-1])


def gauss_newton(
    camera: Pinhole,
    target: Target,
    geometry: HandGeometry,
    pose: Float[Array, " 22"],
    prior: PosePrior,
    width: Float[Array, ""],
    config: RegistrationConfig,
) -> tuple[Float[Array, " 22"], Float[Array, "21 21"]]:
    """The pose after one Gauss-Newton step with robust weights of the given width, and the information before it."""
    root = prior.root
    gradient, information = normal_equations(camera, target, geometry, pose, width, config)
    excess = limit_excess(pose[7:])
    beyond = jnp.concatenate([jnp.zeros(6), excess]) / SOFTNESS**2
    stiffness = jnp.concatenate([jnp.zeros(6), jnp.where(excess != 0, 1.0, 0.0)]) / SOFTNESS**2
    # In coordinates whitened by the prior the units of metres and radians no longer matter to float32.
    whitened = solve_triangular(root, local(prior.mean, pose), lower=True)
    slope = dot(root.T, gradient + beyond) + whitened
    curvature = dot(dot(root.T, information + jnp.diag(stiffness)), root) + jnp.eye(TANGENT_SIZE, dtype=root.dtype)
    step = dot(-root, cho_solve(cho_factor(curvature, lower=True), slope))
    shortening = jnp.minimum(1.0, jnp.min(LARGEST_STEP / jnp.maximum(jnp.abs(step), 1e-9)))
    return retract(pose, shortening * step), information


def normal_equations(
    camera: Pinhole,
    target: Target,
    geometry: HandGeometry,
    pose: Float[Array, " 22"],
    width: Float[Array, ""],
    config: RegistrationConfig,
) -> tuple[Float[Array, " 21"], Float[Array, "21 21"]]:
    """Gradient and Gauss-Newton matrix of the negative log-likelihood of the image at `pose`."""
    capsules = forward_kinematics(pose, geometry).capsules
    motion = _capsule_motion(pose, geometry)
    hand = jnp.isfinite(target.depth)
    observed = target.rays * jnp.where(hand, target.depth, 1.0)[:, None]
    rendered = capsule_depth(camera, capsules).reshape(-1)
    covered = jnp.isfinite(rendered)
    model = target.rays * jnp.where(covered, rendered, 1.0)[:, None]
    visible, shown = _contact(observed, capsules, motion), _contact(model, capsules, motion)
    terms = (
        _surface_terms(visible, hand, width),
        _outline_terms(shown, target, model[:, 2], covered & jnp.isposinf(target.depth), width, config.outline_weight),
        _front_terms(shown, model - observed, covered & hand, width, config.front_weight),
    )
    residual, jacobian, weight = (jnp.concatenate(parts) for parts in zip(*terms, strict=True))
    count = jnp.maximum(hand.sum(), 1)
    weighted = jacobian * (weight * config.independent_pixels / (count * config.noise_std**2))[:, None]
    return dot(weighted.T, residual), dot(weighted.T, jacobian)


class _Motion(NamedTuple):
    start: Float[Array, "k 3 21"]
    end: Float[Array, "k 3 21"]


class _Contact(NamedTuple):
    """Closest point of the hand's bones to each of m points."""

    distance: Float[Array, " m"]
    """To the surface, metres, negative inside."""
    normal: Float[Array, "m 3"]
    jacobian: Float[Array, "m 3 21"]
    """Motion of the bone point with the pose."""


def _capsule_motion(pose: Array, geometry: HandGeometry) -> _Motion:
    def ends(delta: Array) -> _Motion:
        capsules = forward_kinematics(retract(pose, delta), geometry).capsules
        return _Motion(capsules.start, capsules.end)

    return jax.jacfwd(ends)(jnp.zeros(TANGENT_SIZE, pose.dtype))


def _contact(points: Float[Array, "m 3"], capsules: Capsules, motion: _Motion) -> _Contact:
    bone = capsules.end - capsules.start
    length_squared = jnp.maximum(jnp.sum(bone**2, axis=-1), 1e-12)
    offset = points[:, None] - capsules.start
    share = jnp.clip(jnp.sum(offset * bone, axis=-1) / length_squared, 0.0, 1.0)
    away = offset - share[..., None] * bone
    length = jnp.sqrt(jnp.sum(away**2, axis=-1) + 1e-12)
    winner = jnp.argmin(length - capsules.radius, axis=1)
    row = jnp.arange(points.shape[0])
    share, length, away = share[row, winner], length[row, winner], away[row, winner]
    along = share[:, None, None]
    jacobian = (1 - along) * motion.start[winner] + along * motion.end[winner]
    return _Contact(length - capsules.radius[winner], away / length[:, None], jacobian)


def _surface_terms(visible: _Contact, hand: Bool[Array, " m"], width: Array) -> tuple[Array, Array, Array]:
    jacobian = -einsum("mi,mij->mj", visible.normal, visible.jacobian)
    return visible.distance, jacobian, jnp.where(hand, _robust(visible.distance, width), 0.0)


def _outline_terms(
    shown: _Contact, target: Target, depth: Array, astray: Bool[Array, " m"], width: Array, weight: float
) -> tuple[Array, Array, Array]:
    slope = target.rays[:, :2]
    residual = (slope - slope[target.nearest_hand]) * depth[:, None]
    jacobian = shown.jacobian[:, :2] - slope[:, :, None] * shown.jacobian[:, 2:]
    size = jnp.sqrt(jnp.sum(residual**2, axis=-1))
    scale = jnp.where(astray, weight * _robust(size, width), 0.0)
    return residual.reshape(-1), jacobian.reshape(-1, TANGENT_SIZE), jnp.repeat(scale, 2)


def _front_terms(
    shown: _Contact, gap: Float[Array, "m 3"], both: Bool[Array, " m"], width: Array, weight: float
) -> tuple[Array, Array, Array]:
    residual = jnp.sum(shown.normal * gap, axis=-1)
    jacobian = einsum("mi,mij->mj", shown.normal, shown.jacobian)
    in_front = both & (gap[:, 2] < 0)
    return residual, jacobian, jnp.where(in_front, weight * _robust(residual, width), 0.0)


def _robust(residual: Array, width: Array) -> Array:
    return 1 / (1 + (residual / width) ** 2) ** 2
