"""From particles to an estimate: the mean around their mode, or the best fit near it.

The fit is made for a face at rest (the registered shape, held tightly) and for one that may deform (the estimated
model, each landmark as loose as it has proved to be, or as expressions of several strengths make it). Their evidences
say how far each is to be believed; a face that rests keeps the accuracy of a rigid one.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import dot, tensordot
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.alignment import Alignment
from jaxfilters.models.face.patches import Slopes, learn_slopes
from jaxfilters.models.face.pose import rotation, turning_axes
from jaxfilters.models.face.refinement import Refined, displaced, refine
from jaxfilters.models.face.rig import CameraRig, jacobian
from jaxfilters.models.face.rigid import EXPRESSION_STD, motion_covariance
from jaxfilters.models.face.shape_model import FaceModel, shape
from jaxfilters.particle.adaptive import AdaptiveDiffusionState
from jaxfilters.trackers.head.common import recent
from jaxfilters.trackers.head.common.near_mode import UNKNOWN_STD, anywhere, looked_for, predicted, spread
from jaxfilters.trackers.head.common.state import NUM_MODES, POSE, HeadState, Recent

FEWEST_OBSERVED = 4
"""Landmarks without which there is no fit."""
RESTING_STD = 0.012
"""Millimetres: of each landmark of a face at rest about its registered place, beyond the registration's own error."""
MEMORY = 0.95
"""Of the running variances, a frame."""
MODEL_VARIANCE = (0.02**2, 10.0**2)
RESIDUAL_SCALE = (0.05, 20.0)
STRENGTHS = (0.0, 1.0, 3.0)
"""Of expressions that no mode describes, in those of `EXPRESSION_STD`."""
FIRST_LOOK = STRENGTHS.index(1.0)
"""The face that is assumed where landmarks are looked for the first time."""
ALIKE, ALIKE_ANEW = 4.0, 2.0
"""The landmarks of a face move together in an expression: ten of them say no more than some three would; and as much
again that the next frame, with another expression, does not profit."""
ORDINARY_EXPRESSION = float(np.linalg.norm(EXPRESSION_STD))
"""Millimetres, root of the sum over all landmarks."""
MATCHING_STD = 0.05
"""Pixels by which all landmarks together may be displaced in an image at registration, for as long as the face is
followed. The log scores of x and z of people 0 to 2 of `bench head-real` are best, and alike to 0.01, with 0.05 and
0.07, of 0, 0.03, 0.05, 0.07, 0.1 and 0.15."""
_DAMPING = 1e-4
MEASURED_STD = 10.0
"""Millimetres about the model within which a landmark's place is measured."""


class _Assumed(NamedTuple):
    """What a fit takes the face to be."""

    prior: Gaussian
    mean: Float[Array, "K 3"]
    """Of its model, as the next."""
    basis: Float[Array, "3*K B"]
    landmark_covariance: Float[Array, "K 3 3"]
    """Covariance of each landmark about the model, mm^2."""
    deforms: Bool[ArrayLike, ""]
    """Whether the fit begins with the mode coefficients that are expected, or without any."""


class Estimate(NamedTuple):
    """What one frame says."""

    belief: Gaussian
    """Of pose and mode coefficients."""
    doubt: Float[Array, "6 6"]
    """Covariance of the pose beside that of the belief, which the next frame does not start from."""
    shape: Float[Array, "K 3"]
    """Landmarks in the model frame, millimetres."""
    measured: Float[Array, "K 3"]
    """The same as the images alone have it."""
    is_found: Bool[Array, ""]
    num_anchored: Float[Array, ""]
    """Landmarks that look as registered, and are where the model has them."""
    is_placed: Bool[Array, "C K"]
    """Those of them that were found by their own patches, clearly, and not by what the last frame showed."""
    recent: Recent
    slopes: Slopes
    model_variance: Float[Array, " K"]
    residual_scale: Float[Array, ""]


def around_mode(search: AdaptiveDiffusionState, state: HeadState, model: FaceModel) -> Estimate:
    """The published estimate, which the search has made, with the spread of the particles.

    Oka and Sato 2006, equations 18 and 19.
    """
    belief = spread(search)
    x = belief.mean
    M = shape(model, x[POSE:])
    found = jnp.ones((), bool)
    all_of_them = jnp.full((), float(len(M)), x.dtype)
    doubt = jnp.zeros((POSE, POSE), x.dtype)
    return Estimate(
        belief,
        doubt,
        M,
        M,
        found,
        all_of_them,
        jnp.ones_like(state.recent.has_changed),
        state.recent,
        state.slopes,
        state.model_variance,
        state.residual_scale,
    )


def refined(
    search: AdaptiveDiffusionState,
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
    prior = predicted(search, state.belief, model, moved)
    faces = _assumed(prior, state, model)

    def looked(x: Array, is_last: Array) -> tuple[Array, tuple[Array, Alignment, Array, Array, Refined]]:
        """Landmarks near a state, and the fit to them; in the last look also from elsewhere, and every fit."""
        found, anchored, is_followed = looked_for(partial(anywhere, beyond=is_last), state, model, images, rig, x)
        wanted = is_last | (jnp.arange(len(STRENGTHS) + 1) == FIRST_LOOK)
        fits = _fits(faces, wanted, found, state, model, rig, x, ~is_followed)
        return fits.belief.mean[FIRST_LOOK], (x, found, anchored, is_followed, fits)

    # One program for both looks and all fits: it compiles in half the time.
    start = jnp.concatenate([search.estimate[:POSE], prior.mean[POSE:]])
    _, looks = jax.lax.scan(looked, start, jnp.array([False, True]))
    x, found, anchored, is_followed, every = jax.tree.map(lambda leaf: leaf[-1], looks)
    fits, rest = (jax.tree.map(lambda leaf, part=part: leaf[part], every) for part in (slice(-1), -1))
    a = dot(model.basis.T, (state.registered.shape - model.mean).ravel())
    rest_belief = Gaussian(rest.belief.mean.at[POSE:].set(a), rest.belief.covariance)
    resting, among = _shares(rest, fits)
    average = lambda values: tensordot(among, values, 1)
    is_unknown = jnp.asarray(STRENGTHS) > 0
    doubt = ALIKE_ANEW * (1 - resting) * tensordot(among * is_unknown, fits.belief.covariance, 1)[:POSE, :POSE]
    doubt = doubt.at[:3, :3].add(matching_covariance(rig, rest.belief.mean[:POSE]))
    alike = jnp.where(is_unknown, ALIKE, 1.0)[:, None, None]
    free = _mixed(among, Gaussian(fits.belief.mean, alike * fits.belief.covariance))
    M = resting * state.registered.shape + (1 - resting) * shape(model, free.mean[POSE:])
    beliefs = jax.tree.map(lambda a, b: jnp.stack([a, b]), rest_belief, free)
    belief = _mixed(jnp.stack([resting, 1 - resting]), beliefs)
    belief = _with_gauge(belief, M - state.registered.shape, state, model)
    wide = MEASURED_STD**2 * jnp.tile(jnp.eye(3), (len(M), 1, 1))
    measured = displaced(free.mean, found, state.slopes, model, wide, rig)
    sound = jnp.all(jnp.isfinite(belief.mean)) & jnp.all(jnp.isfinite(belief.covariance))
    is_found = sound & (rest.num_observed >= FEWEST_OBSERVED)
    lacking = lambda fit: fit.misfit_share * (fit.residual_scale - 1)
    residual_scale = resting * lacking(rest) + (1 - resting) * average(lacking(fits))
    drift = recent.drifted(state.recent, is_followed)
    observed = recent.as_observed(found, anchored, M, belief.mean[:POSE], images, rig, drift)
    return Estimate(
        belief,
        doubt,
        M,
        measured,
        is_found,
        jnp.sum(jnp.any(~observed.has_changed, axis=0)).astype(x.dtype),
        ~observed.has_changed & ~is_followed & (found.score > recent.CHANGED_SCORE),
        observed,
        learn_slopes(state.slopes, found.slope_information, found.slope_score),
        jnp.clip(MEMORY * state.model_variance + (1 - MEMORY) * average(fits.excess), *MODEL_VARIANCE),
        jnp.clip(state.residual_scale * (1 + (1 - MEMORY) * residual_scale), *RESIDUAL_SCALE),
    )


def matching_covariance(rig: CameraRig, pose: Float[Array, " 6"]) -> Float[Array, "3 3"]:
    """Covariance of the position of a head whose landmarks are all displaced alike in each image, square millimetres.

    The first images place the registered face, and all others are compared with it: what interpolation, lenses and the
    brightness of the cameras displace all matches by lasts as long as the registration. It is the covariance of the
    least-squares position (of the least change, for one camera) by displacements of `MATCHING_STD` pixels on each axis
    of each image.

    Args:
        rig: Cameras.
        pose: Of the head, millimetres and radians.
    """
    by_pose = jacobian(rig, jnp.zeros((1, 3), pose.dtype), pose)[1]
    by_place = by_pose[..., :3].reshape(-1, 3)
    information = dot(by_place.T, by_place)
    # A slight damping leaves out what one camera does not measure: the distance.
    inverse = jnp.linalg.inv(information + _DAMPING * jnp.trace(information) * jnp.eye(3, dtype=pose.dtype))
    return MATCHING_STD**2 * dot(dot(inverse, information), inverse)


def _shares(rest: Refined, fits: Refined) -> tuple[Array, Array]:
    """How far the face is believed to be at rest; and otherwise, to be as each of the other fits has it."""
    known = lambda evidence: jnp.where(jnp.isfinite(evidence), evidence, -jnp.inf)
    among = jax.nn.softmax(known(fits.log_evidence))
    among = jnp.where(jnp.all(jnp.isfinite(among)), among, jnp.zeros_like(among).at[0].set(1.0))
    resting = jax.nn.sigmoid(rest.log_evidence - jax.nn.logsumexp(known(fits.log_evidence)))
    return jnp.where(jnp.isfinite(resting), resting, 0.0), among


def _landmark_covariance(state: HeadState, strength: Array | float) -> Array:
    """Covariance of each landmark about the model of a face whose expression is so strong, mm^2."""
    expression = jnp.asarray(EXPRESSION_STD**2, state.model_variance.dtype)
    learned = jnp.minimum(state.model_variance[:, None], STRENGTHS[-1] ** 2 * expression + 0.25)
    return state.registered.covariance + jax.vmap(jnp.diag)(jnp.maximum(learned, strength**2 * expression))


def _assumed(prior: Gaussian, state: HeadState, model: FaceModel) -> _Assumed:
    """Faces whose expressions are as strong as those of `STRENGTHS`, and behind them the registered one at rest."""
    free = [
        _Assumed(prior, model.mean, model.basis, _landmark_covariance(state, strength), True) for strength in STRENGTHS
    ]
    tight = state.registered.covariance + RESTING_STD**2 * jnp.eye(3)
    covariance = jnp.zeros_like(prior.covariance).at[:POSE, :POSE].set(prior.covariance[:POSE, :POSE])
    covariance = covariance.at[POSE:, POSE:].set(UNKNOWN_STD**2 * jnp.eye(NUM_MODES))
    at_rest = Gaussian(prior.mean.at[POSE:].set(0.0), covariance)
    rest = _Assumed(at_rest, state.registered.shape, jnp.zeros_like(model.basis), tight, False)
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *free, rest)


def _fits(
    faces: _Assumed,
    wanted: Bool[Array, " fits"],
    found: Alignment,
    state: HeadState,
    model: FaceModel,
    rig: CameraRig,
    x: Array,
    is_own: Array,
) -> Refined:
    """The fit of each face that is wanted, zeros in place of the others."""

    def one(inputs: tuple[_Assumed, Array]) -> Refined:
        face, is_wanted = inputs
        assumed = replace(model, mean=face.mean, basis=face.basis)
        start = jnp.where(face.deforms, x, x.at[POSE:].set(0.0))
        # Traced once for its shapes and its program.
        fit = jax.jit(
            lambda: refine(face.prior, found, state.slopes, assumed, face.landmark_covariance, rig, start, is_own)
        )
        nothing = lambda: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(fit))
        return jax.lax.cond(is_wanted, fit, nothing)

    # One by one: batches of factorisations can stand still on two cores.
    return jax.lax.map(one, (faces, wanted))


def _with_gauge(belief: Gaussian, deformation: Array, state: HeadState, model: FaceModel) -> Gaussian:
    """The belief, with what cannot be known of the skull.

    Registration may have it all too near or too far, and beside a deformation of this size its motion is hidden.
    """
    share = jnp.minimum(1.0, jnp.sum(deformation**2) / ORDINARY_EXPRESSION**2)
    R = rotation(belief.mean[3:POSE])
    to_angles = jnp.linalg.solve(turning_axes(belief.mean[3:POSE]).T, R)
    turn = jnp.zeros((POSE, POSE), R.dtype).at[:3, :3].set(R).at[3:, 3:].set(to_angles)
    extra = dot(dot(share * turn, motion_covariance(model.mean)), turn.T)
    extra = extra.at[:3, :3].add(dot(dot(R, state.registered.alike), R.T))
    return Gaussian(belief.mean, belief.covariance.at[:POSE, :POSE].add(extra))


def _mixed(shares: Array, each: Gaussian) -> Gaussian:
    """One Gaussian with the moments of several."""
    mean = dot(shares, each.mean)
    off = each.mean - mean
    spread = each.covariance + off[:, :, None] * off[:, None]
    return Gaussian(mean, tensordot(shares, spread, 1))
