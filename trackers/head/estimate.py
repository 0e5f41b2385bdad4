"""From particles to an estimate: the mean around their mode, or the best fit near it.

The fit is made twice, for a face at rest (the registered shape, held tightly) and for one that may deform (the learnt
model, each landmark as loose as it has proved to be). Their evidences say how far each is to be believed; a face
that rests keeps the accuracy of a rigid one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters import weights
from jaxfilters.adaptive import AdaptiveState
from jaxfilters.gaussian import Gaussian
from jaxfilters.models.face.alignment import Alignment, align, relocated
from jaxfilters.models.face.patches import Slopes, learn_slopes
from jaxfilters.models.face.pose import rotation, turning_axes
from jaxfilters.models.face.refinement import Refined, displaced, refine
from jaxfilters.models.face.rig import CameraRig, project_shape
from jaxfilters.models.face.rigid import EXPRESSION_STD, motion_covariance
from jaxfilters.models.face.shape_model import FaceModel, rigid, shape
from jaxfilters.trackers.head import recent
from jaxfilters.trackers.head.search import KAPPA
from jaxfilters.trackers.head.state import NUM_MODES, POSE, HeadState, Recent

FEWEST_SEEN = 4
"""Landmarks without which there is no fit."""
RESTING_STD = 0.02
"""Millimetres: of each landmark of a face at rest about its registered place, beyond the registration's own error."""
UNLEARNT_STD = 0.01
"""Millimetres: of the coefficient of a mode that is not learnt, or not used."""
MEMORY = 0.95
"""Of the running variances, a frame."""
LOOSENESS = (0.02**2, 10.0**2)
MISFIT = (0.05, 20.0)
ORDINARY_EXPRESSION = float(np.linalg.norm(EXPRESSION_STD))
"""Millimetres, root of the sum over all landmarks."""
MEASURED_STD = 10.0
"""Millimetres about the model within which a landmark's place is measured."""


class Estimate(NamedTuple):
    """What one frame says."""

    belief: Gaussian
    """Of pose and mode coefficients."""
    shape: Float[Array, "K 3"]
    """Landmarks in the model frame, millimetres."""
    measured: Float[Array, "K 3"]
    """The same as the images alone have it."""
    is_found: Bool[Array, ""]
    num_anchored: Float[Array, ""]
    """Landmarks that look as registered, and are where the model has them."""
    recent: Recent
    slopes: Slopes
    looseness: Float[Array, " K"]
    misfit: Float[Array, ""]


def around_mode(search: AdaptiveState, state: HeadState, model: FaceModel) -> Estimate:
    """The paper's estimate ([P18], [P19]), which the search has made, with the spread of the particles."""
    x = search.estimate
    apart = jnp.where(jnp.isfinite(search.log_weights), search.particles - x[:, None], 0.0)
    w = weights.linear(search.log_weights)
    covariance = jnp.matmul(apart * w, apart.T, precision="highest")
    M = shape(model, x[POSE:])
    found = jnp.ones((), bool)
    all_of_them = jnp.full((), float(len(M)), x.dtype)
    belief = Gaussian(x, covariance)
    return Estimate(belief, M, M, found, all_of_them, state.recent, state.slopes, state.looseness, state.misfit)


def refined(
    search: AdaptiveState,
    state: HeadState,
    model: FaceModel,
    images: Float[Array, "C rows cols"],
    rig: CameraRig,
    moved: Float[Array, " 6"],
) -> Estimate:
    """The best fit near the particles' mode.

    Args:
        search: After this frame's update.
        state: Before this frame.
        model: Rigid, or with the modes that may be used.
        images: Grey levels.
        rig: Cameras.
        moved: What the head was predicted to move since the last estimate, millimetres and radians.
    """
    loose_prior = _prior(search, state, model, moved)
    loose = state.registered.covariance + state.looseness[:, None, None] * jnp.eye(3)
    x = jnp.concatenate([search.estimate[:POSE], loose_prior.mean[POSE:]])
    found, _ = _aligned(align, state, model, images, rig, x)
    x = refine(loose_prior, found, state.slopes, model, loose, rig, x).belief.mean
    found, anchored = _aligned(_align_anywhere, state, model, images, rig, x)
    free = refine(loose_prior, found, state.slopes, model, loose, rig, x)
    x = free.belief.mean

    rest, rest_belief = _at_rest(loose_prior, found, state, model, rig, x)
    resting = jax.nn.sigmoid(rest.log_evidence - free.log_evidence)
    resting = jnp.where(jnp.isfinite(resting), resting, 0.0)
    M = resting * state.registered.shape + (1 - resting) * shape(model, x[POSE:])
    belief = _with_gauge(_mixed(resting, rest_belief, free.belief), M - state.registered.shape, model)
    measured = displaced(x, found, state.slopes, model, MEASURED_STD**2 * jnp.tile(jnp.eye(3), (len(M), 1, 1)), rig)
    sound = jnp.all(jnp.isfinite(belief.mean)) & jnp.all(jnp.isfinite(belief.covariance))
    is_found = sound & (free.num_seen >= FEWEST_SEEN)
    misfit = resting * rest.misfit + (1 - resting) * free.misfit
    seen = recent.as_seen(found, anchored, M, belief.mean[:POSE], images, rig)
    return Estimate(
        belief,
        M,
        measured,
        is_found,
        jnp.sum(jnp.any(~seen.has_changed, axis=0)).astype(x.dtype),
        seen,
        learn_slopes(state.slopes, found.slope_information, found.slope_score),
        jnp.clip(MEMORY * state.looseness + (1 - MEMORY) * free.excess, *LOOSENESS),
        jnp.clip(state.misfit * (MEMORY + (1 - MEMORY) * misfit), *MISFIT),
    )


def _at_rest(
    prior: Gaussian, found: Alignment, state: HeadState, model: FaceModel, rig: CameraRig, x: Array
) -> tuple[Refined, Gaussian]:
    """The fit of the registered face, and its belief with the mode coefficients of that face."""
    face = rigid(state.registered.shape, model.templates, num_modes=NUM_MODES)
    tight = state.registered.covariance + RESTING_STD**2 * jnp.eye(3)
    covariance = jnp.zeros_like(prior.covariance).at[:POSE, :POSE].set(prior.covariance[:POSE, :POSE])
    covariance = covariance.at[POSE:, POSE:].set(UNLEARNT_STD**2 * jnp.eye(NUM_MODES))
    prior = Gaussian(prior.mean.at[POSE:].set(0.0), covariance)
    rest = refine(prior, found, state.slopes, face, tight, rig, x.at[POSE:].set(0.0))
    a = model.basis.T @ (state.registered.shape - model.mean).ravel()
    return rest, Gaussian(rest.belief.mean.at[POSE:].set(a), rest.belief.covariance)


def _align_anywhere(patches, slopes, images, uv, M, pose, rig) -> Alignment:
    found = align(patches, slopes, images, uv, M, pose, rig)
    return relocated(patches, slopes, images, found, uv, M, pose, rig)


def _aligned(
    way, state: HeadState, model: FaceModel, images: Array, rig: CameraRig, x: Array
) -> tuple[Alignment, Array]:
    """Landmarks in the images, and which of them look as registered."""
    M = shape(model, x[POSE:])
    uv, _ = project_shape(rig, M, x[:POSE])
    found = way(state.registered.patches, state.slopes, images, uv, M, x[:POSE], rig)
    anchored = recent.is_anchored(found)
    found, is_followed = recent.followed(state.recent, found, state.slopes, images, uv, M, x[:POSE], rig)
    drift = jnp.where(is_followed[..., None, None], recent.DRIFT_PX**2 * jnp.eye(2), 0.0)
    return found._replace(covariance=state.misfit * found.covariance + drift), anchored


def _prior(search: AdaptiveState, state: HeadState, model: FaceModel, moved: Array) -> Gaussian:
    """Of this frame before its images: the last belief, moved on, and no deformation too large."""
    spread = jnp.square(search.spread[:POSE])
    before = state.belief
    pose_covariance = before.covariance[:POSE, :POSE] + jnp.diag(spread)
    usual = jnp.square(jnp.where(model.deviation > 0, model.deviation, UNLEARNT_STD))
    walked = jnp.maximum(jnp.diagonal(before.covariance)[POSE:], 0.0) + KAPPA**2 * usual
    variance = 1 / (1 / walked + 1 / usual)
    mean = jnp.concatenate([before.mean[:POSE] + moved, variance / walked * before.mean[POSE:]])
    covariance = jnp.zeros_like(before.covariance).at[:POSE, :POSE].set(pose_covariance)
    return Gaussian(mean, covariance.at[POSE:, POSE:].set(jnp.diag(variance)))


def _with_gauge(belief: Gaussian, deformation: Array, model: FaceModel) -> Gaussian:
    """The belief, with what cannot be known of the skull's motion beside a deformation of this size."""
    share = jnp.minimum(1.0, jnp.sum(deformation**2) / ORDINARY_EXPRESSION**2)
    R = rotation(belief.mean[3:POSE])
    to_angles = jnp.linalg.solve(turning_axes(belief.mean[3:POSE]).T, R)
    turn = jnp.zeros((POSE, POSE), R.dtype).at[:3, :3].set(R).at[3:, 3:].set(to_angles)
    extra = share * turn @ motion_covariance(model.mean) @ turn.T
    return Gaussian(belief.mean, belief.covariance.at[:POSE, :POSE].add(extra))


def _mixed(share: Array, first: Gaussian, second: Gaussian) -> Gaussian:
    """One Gaussian with the moments of two."""
    mean = share * first.mean + (1 - share) * second.mean
    spread = lambda one: one.covariance + jnp.outer(one.mean - mean, one.mean - mean)
    return Gaussian(mean, share * spread(first) + (1 - share) * spread(second))
