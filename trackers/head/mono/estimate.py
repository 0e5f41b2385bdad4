"""What one image says of pose and expression of a person who is known so far, and where it shows the landmarks."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import einsum
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.alignment import Alignment
from jaxfilters.models.face.bundle import Views
from jaxfilters.models.face.patches import Slopes, learn_slopes
from jaxfilters.models.face.point_recalculation import point_windows, recalculate_points
from jaxfilters.models.face.refinement import LEAST_SCORE, PIXEL_FLOOR, Refined, refine, running_variance
from jaxfilters.models.face.rig import CameraRig, jacobian, project_shape
from jaxfilters.models.face.shape_model import shape
from jaxfilters.particle.adaptive import AdaptiveDiffusionState
from jaxfilters.trackers.head.common import recent
from jaxfilters.trackers.head.common.estimate import FEWEST_OBSERVED, MEMORY, MODEL_VARIANCE, RESIDUAL_SCALE
from jaxfilters.trackers.head.common.near_mode import anywhere, looked_for, predicted, spread
from jaxfilters.trackers.head.common.state import POSE, Recent
from jaxfilters.trackers.head.mono.state import MonoState

RECALCULATED_PX = 1.0
"""Standard deviation of a recalculated landmark."""
UNMODELLED_MM = 0.35
"""Of each coordinate of a landmark from frame to frame, what a model leaves of people outside of its training set.

Measured in three dimensions, once identity, offset and expressions are the likeliest: models of 200 people leave .36 mm
of people of the ICT face model with recorded speech, .07 mm of the generator's, whose expressions are but two. A person
must not be adjusted to what no person of the model does, however precisely it is measured.
"""
FOLLOWED = recent.Drift(first=2.5, each=0.4, most=6.0)
"""Millimetres by which a landmark that is followed is off.

Measured on three of the ICT face model's people with recorded speech and rotations: 2.0 to 3.7 mm a coordinate as soon
as a landmark has changed its looks, 2.5 to 6 once it was followed for some 30 frames.
"""
RETURNED_SCORE = 0.7
"""Normalised correlation from which on a landmark that did not look as registered does so beyond doubt again.

What covers a face correlates by chance with a patch that is searched for in its surroundings.
"""
FEWEST_SURE = 7
"""Landmarks that must look as registered, where the model has them, for an estimate beyond doubt: speech hides two."""


class Estimate(NamedTuple):
    """What one frame says."""

    belief: Gaussian
    """Of pose and mode coefficients, if the person is as believed."""
    view: Views
    """The landmarks in this one frame."""
    is_found: Bool[Array, ""]
    num_anchored: Float[Array, ""]
    """Landmarks that look as registered, and are where the model has them."""
    is_unsure: Bool[Array, " K"]
    """Landmarks that do not, or did not before and have not done so beyond doubt since."""
    recent: Recent
    windows: Float[Array, "1 K T T"]
    """Grey levels about the landmarks."""
    slopes: Slopes
    model_variance: Float[Array, " K"]
    residual_scale: Float[Array, ""]


def aligned(
    search: AdaptiveDiffusionState,
    state: MonoState,
    images: Float[Array, "1 rows cols"],
    rig: CameraRig,
    moved: Float[Array, " 6"],
) -> Estimate:
    """The best fit of the person's face to aligned landmarks near the particles' mode.

    Args:
        search: After this frame's update.
        state: Before this frame.
        images: Grey levels.
        rig: One camera.
        moved: What the head was predicted to move since the last estimate, millimetres and radians.
    """
    prior = predicted(search, state.belief, state.model, moved)
    loose = state.model_variance[:, None, None] * jnp.eye(3)
    x = jnp.concatenate([search.estimate[:POSE], prior.mean[POSE:]])
    drift = FOLLOWED.scaled(rig.focal[0, 0] / jnp.maximum(x[2], 1.0))

    def looked(x: Array, is_last: Array) -> tuple[Array, tuple[Alignment, Array, Array, Refined]]:
        """Landmarks near a state, in the last look also from elsewhere, and the fit to them."""
        aligner = partial(anywhere, beyond=is_last)
        found, anchored, is_followed = looked_for(aligner, state, state.model, images, rig, x, drift)
        fit = refine(prior, found, state.slopes, state.model, loose, rig, x, ~is_followed)
        return fit.belief.mean, (found, anchored, is_followed, fit)

    # One program for both looks: it takes half as long to compile.
    _, looks = jax.lax.scan(looked, x, jnp.array([False, True]))
    found, anchored, is_followed, fit = jax.tree.map(lambda leaf: leaf[-1], looks)
    M, pose = shape(state.model, fit.belief.mean[POSE:]), fit.belief.mean[:POSE]
    sound = jnp.all(jnp.isfinite(fit.belief.mean)) & jnp.all(jnp.isfinite(fit.belief.covariance))
    drifted = recent.drifted(state.recent, is_followed, drift)
    observed = recent.as_observed(found, anchored, M, pose, images, rig, drifted)
    by_shape = jnp.where(found.observed[..., None, None], jacobian(rig, M, pose)[0], 0.0)
    by_slope = einsum("ckij,kjl,cknl->ckin", found.by_slope, state.slopes.covariance, found.by_slope)
    variance = state.model_variance + UNMODELLED_MM**2
    spread = einsum("ckix,k,ckjx->ckij", by_shape, variance, by_shape)
    covariance = found.covariance + by_slope + spread + PIXEL_FLOOR**2 * jnp.eye(2)
    # The score of a landmark that is followed is that of the last frame's patch; the registered one has a lower one.
    is_unsure = unsure(state.is_unsure, observed.has_changed, jnp.where(anchored & ~is_followed, found.score, 0.0))
    return Estimate(
        fit.belief,
        # What is followed from the last frame is some other point of the skin, and says nothing of the person.
        Views(found.uv, covariance, found.observed & (found.score > LEAST_SCORE) & ~is_followed),
        sound & (fit.num_observed >= FEWEST_OBSERVED),
        jnp.sum(jnp.any(~observed.has_changed, axis=0)).astype(x.dtype),
        is_unsure,
        observed,
        state.windows,
        learn_slopes(state.slopes, found.slope_information, found.slope_score),
        running_variance(state.model_variance, fit.excess, fit.alignment_variance, 1 - MEMORY, MODEL_VARIANCE),
        jnp.clip(
            state.residual_scale * (1 + (1 - MEMORY) * fit.misfit_share * (fit.residual_scale - 1)), *RESIDUAL_SCALE
        ),
    )


def recalculated(
    search: AdaptiveDiffusionState,
    state: MonoState,
    images: Float[Array, "1 rows cols"],
    rig: CameraRig,
    moved: Float[Array, " 6"],
) -> Estimate:
    """The particles' estimate, with landmarks recalculated from grey levels; arguments are those of `aligned`."""
    rough = projected(search, state, images, rig, moved)
    m, templates = rough.view.uv[0], state.registered.templates[0]
    previous = jnp.where(state.is_fresh, state.windows[0], templates)
    uv, info = recalculate_points(m, m, images[0], previous, templates)
    windows = point_windows(images[0], uv, size=templates.shape[-1])[None]
    # A window beyond the border leaves the point where it was: that is no measurement.
    observed = rough.view.observed & jnp.isfinite(info.residual)
    return rough._replace(view=rough.view._replace(uv=uv[None], observed=observed), windows=windows)


def unsure(before: Bool[Array, " K"], has_changed: Bool[Array, "C K"], score: Float[Array, "C K"]) -> Bool[Array, " K"]:
    """Landmarks that do not look as registered, or did not before and have not done so beyond doubt since.

    Args:
        before: Those of the frame before.
        has_changed: Which do not look as registered, in each camera.
        score: Correlation with what was registered, 0 where another patch is followed.
    """
    return jnp.all(has_changed, axis=0) | (before & ~jnp.any(score > RETURNED_SCORE, axis=0))


def projected(
    search: AdaptiveDiffusionState,
    state: MonoState,
    images: Float[Array, "1 rows cols"],
    rig: CameraRig,
    moved: Float[Array, " 6"],
) -> Estimate:
    """The particles' estimate and its own projections for landmarks; arguments are those of `aligned`."""
    del images, moved
    belief = spread(search)
    x = belief.mean
    uv, in_front = project_shape(rig, shape(state.model, x[POSE:]), x[:POSE])
    covariance = RECALCULATED_PX**2 * jnp.tile(jnp.eye(2, dtype=uv.dtype), (*uv.shape[:2], 1, 1))
    view = Views(jnp.where(in_front[..., None], uv, 0.0), covariance, in_front)
    every = jnp.full((), float(uv.shape[1]), x.dtype)
    return Estimate(
        belief,
        view,
        jnp.all(jnp.isfinite(x)),
        every,
        jnp.zeros(uv.shape[1], bool),
        state.recent,
        state.windows,
        state.slopes,
        state.model_variance,
        state.residual_scale,
    )
