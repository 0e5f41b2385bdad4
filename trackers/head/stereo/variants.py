"""What the modern tracker and the paper's do in a frame, side by side: `track` runs either, and knows of neither."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfilters.filter import Filter
from jaxfilters.math import diffusion
from jaxfilters.models.face.alignment import facing
from jaxfilters.models.face.patches import stretch, turned
from jaxfilters.models.face.rig import CameraRig, jacobian
from jaxfilters.models.face.rigid import remove_motion
from jaxfilters.models.face.shape_model import FaceModel, shape
from jaxfilters.particle.adaptive import AdaptiveDiffusionState
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.trackers.head.common import learning
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.estimate import Estimate, around_mode, refined
from jaxfilters.trackers.head.common.recent import latest_templates
from jaxfilters.trackers.head.common.search import LEAST_STEPS, Searches, gathered
from jaxfilters.trackers.head.common.state import PATIENCE, POSE, HeadState

FAR_BETTER = 0.2
"""Mean correlation by which the prediction must be better than the particles' mode."""
Templates = tuple[Array, Array]
"""(C, K, T, T) each: of the registered face, and of the face as it looked last."""


class Variant(NamedTuple):
    """One tracker's part of every step."""

    templates: Callable[[HeadState, FaceModel, CameraRig, Array], Templates]
    """`(state, model, rig, predicted motion)`; templates are flat where a landmark is turned away."""
    search: Callable[
        [Callable[[Filter, Array], tuple[AdaptiveDiffusionState, ParticleInfo]], Searches, FaceModel], tuple
    ]
    """`(run, searches, model)`: one of the searches, run with a diffusion of the mode coefficients."""
    begun: Callable[[AdaptiveDiffusionState, Array, Callable[[Array], Array]], AdaptiveDiffusionState]
    """`(search, predicted state, mean correlation of a state)`: the search with what the estimate begins with."""
    estimate: Callable[..., tuple[Estimate, AdaptiveDiffusionState]]
    """`(search, state, model, images, rig, predicted motion, frame times, options)`, and the search after it."""
    measured: Callable[..., Templates]
    """`(state, estimate, images, rig, whether it is measured)`: the shape that is estimated, the windows about it."""
    follow: float
    """How far the mean shape goes along with those that are measured."""
    still: learning.Still
    """How the skull's motion is taken out of them."""
    sharpens: bool
    """Whether the registered shape is triangulated anew."""
    may_doubt: bool
    """Whether a pose at which the face looks little as registered is doubtful, and claimed to be known less well."""
    keeps_key_frames: bool
    """Whether a turned head is compared with what it looked like before when it was turned."""


def _turned_templates(state: HeadState, model: FaceModel, rig: CameraRig, moved: Array) -> Templates:
    """As the head is expected to be turned; landmarks that have changed since registration also as they looked last.

    Where a face was lost the last frame shows something else.
    """
    x, face = state.belief.mean, state.registered.patches
    M, pose = shape(model, x[POSE:]), x[:POSE] + moved
    by_shape, _ = jacobian(rig, M, pose)
    is_facing = facing(face, by_shape)[..., None, None]
    affine = jnp.where(is_facing, stretch(face, state.slopes, by_shape), jnp.eye(2))
    templates = jnp.where(is_facing, turned(face, affine), 0.0)
    latest = latest_templates(state.recent, state.slopes, templates, M, pose, rig)
    return templates, jnp.where(state.misses < PATIENCE, latest, templates)


def _flat_templates(state: HeadState, model: FaceModel, rig: CameraRig, moved: Array) -> Templates:
    """As registered."""
    del state, rig, moved
    return model.templates, model.templates


def _rigid_search(run: Callable, searches: Searches, model: FaceModel) -> tuple[AdaptiveDiffusionState, ParticleInfo]:
    return run(searches.rigid, jnp.zeros_like(model.deviation))


def _layered_search(run: Callable, searches: Searches, model: FaceModel) -> tuple[AdaptiveDiffusionState, ParticleInfo]:
    """Particles deform where the model does."""
    learned = jnp.any(model.deviation > 0)
    return jax.lax.cond(
        learned, lambda: run(searches.layered, model.deviation), lambda: _rigid_search(run, searches, model)
    )


def _likelier(
    search: AdaptiveDiffusionState, predicted: Array, score: Callable[[Array], Array]
) -> AdaptiveDiffusionState:
    """At the prediction where that is far better than the particles' mode: after a second these are spread thinly."""
    of_mode, of_predicted = jax.lax.map(score, jnp.stack([search.estimate, predicted]))
    return search._replace(estimate=jnp.where(of_predicted > of_mode + FAR_BETTER, predicted, search.estimate))


def _at_mode(
    search: AdaptiveDiffusionState, predicted: Array, score: Callable[[Array], Array]
) -> AdaptiveDiffusionState:
    del predicted, score
    return search


def _refined(
    search: AdaptiveDiffusionState,
    state: HeadState,
    model: FaceModel,
    images: Array,
    rig: CameraRig,
    moved: Array,
    steps: Array,
    options: HeadConfig,
) -> tuple[Estimate, AdaptiveDiffusionState]:
    """The fit; particles, velocity and diffusion follow it."""
    estimate = refined(search, state, model, images, rig, moved)
    before, x = state.search, estimate.belief.mean
    elapsed = before.elapsed + steps
    has_gone_on = elapsed > LEAST_STEPS
    since = (x - before.estimate)[:POSE] / jnp.where(has_gone_on, elapsed, 1.0)
    velocity = jnp.where(has_gone_on, since, before.velocity)
    fit = before.fit
    if options.diffusion == "online":
        changed = diffusion.update(fit, before.velocity, velocity - before.velocity)
        fit = jax.tree.map(lambda a, b: jnp.where(has_gone_on, a, b), changed, fit)
    after = gathered(search, x)._replace(estimate=x, velocity=velocity, fit=fit)
    return estimate, jax.tree.map(lambda a, b: jnp.where(estimate.is_found, a, b), after, search)


def _around_mode(
    search: AdaptiveDiffusionState,
    state: HeadState,
    model: FaceModel,
    images: Array,
    rig: CameraRig,
    moved: Array,
    steps: Array,
    options: HeadConfig,
) -> tuple[Estimate, AdaptiveDiffusionState]:
    """What the search itself has made."""
    del images, rig, moved, steps, options
    return around_mode(search, state, model), search


def _as_estimated(state: HeadState, estimate: Estimate, images: Array, rig: CameraRig, is_measured: Array) -> Templates:
    del images, rig, is_measured
    return estimate.measured, state.learner.windows


def _recalculated(state: HeadState, estimate: Estimate, images: Array, rig: CameraRig, is_measured: Array) -> Templates:
    again = partial(learning.recalculated, state.learner, estimate.shape, images, state.model.templates)
    nothing = lambda: (estimate.measured, state.learner.windows)
    return jax.lax.cond(is_measured, lambda: again(estimate.belief.mean[:POSE], rig), nothing)


VARIANTS = {
    "recommended": Variant(
        templates=_turned_templates,
        search=_rigid_search,
        begun=_likelier,
        estimate=_refined,
        measured=_as_estimated,
        follow=0.0,
        still=remove_motion,
        sharpens=True,
        may_doubt=True,
        keeps_key_frames=True,
    ),
    "published": Variant(
        templates=_flat_templates,
        search=_layered_search,
        begun=_at_mode,
        estimate=_around_mode,
        measured=_recalculated,
        follow=1.0,
        still=learning.without_weighted_motion,
        sharpens=False,
        may_doubt=False,
        keeps_key_frames=False,
    ),
}
"""By `HeadConfig.variant`."""
