"""One frame after another: search, estimate, verdict, adjustment."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxfilters._xla.compiled_quickly import compiled_lightly
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.alignment import facing
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.patches import stretch, turned
from jaxfilters.models.face.rig import CameraRig, jacobian, project_shape
from jaxfilters.models.face.shape_model import shape
from jaxfilters.particle.adaptive import AdaptiveDiffusionState
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.trackers.head.common.near_mode import pose_corrections, spread
from jaxfilters.trackers.head.common.recent import latest_templates
from jaxfilters.trackers.head.common.search import KAPPA, LEAST_STEPS, Searches, at, gathered, score_at
from jaxfilters.trackers.head.common.state import DEFORMABLE, DOUBTFUL, FRAME_S, LOST, PATIENCE, POSE
from jaxfilters.trackers.head.mono import adjustment
from jaxfilters.trackers.head.mono.claims import pose_variance
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.estimate import FEWEST_SURE, Estimate, aligned, projected, recalculated
from jaxfilters.trackers.head.mono.state import MonoState, MonoTrack
from jaxfilters.trackers.head.mono.verdict import is_outlier
from jaxfilters.trackers.head.stereo.tracking import (
    LEAST_SCORE,
    MOST_OUTLIERS,
    MOST_STEPS,
    REGAINED_SCORE,
    at_last_good,
)
from jaxfilters.typing import AnyKey

ESTIMATES = {"aligned": aligned, "recalculated": recalculated, "projected": projected}

PUBLISHED_KAPPA = 0.2
"""Diffusion of the expression in its standard deviations (Sugano 2007, section 4.4.2)."""


class System(NamedTuple):
    """What does not change while a head is followed."""

    unknown: MultilinearFace
    """The model."""
    face: MultilinearFace
    """Whom the state is about: the same, or an enrolled person."""
    rig: CameraRig
    searches: Searches
    focal_log_std: Float[Array, ""]
    """Standard deviation of the logarithm of the focal length."""


@partial(compiled_lightly, static_argnames="options")
def advance(
    system: System,
    state: MonoState,
    images: Num[Array, "b 1 rows cols"],
    times: Float[Array, " b"],
    is_frame: Bool[Array, " b"],
    options: MonoConfig,
) -> tuple[MonoState, MonoTrack]:
    """State and track after `b` frames; those that are none leave the state alone, and their rows mean nothing."""

    def one(state: MonoState, inputs: tuple) -> tuple[MonoState, MonoTrack]:
        images, time, is_frame = inputs
        step = lambda: _step(system, state, images, time, options)
        _, empty = jax.eval_shape(step)
        nothing = lambda: (state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), empty))
        return jax.lax.cond(is_frame, step, nothing)

    return jax.lax.scan(one, state, (images, times, is_frame))


@partial(jax.jit, static_argnames="options")  # traced once for its shapes and its program
def _step(
    system: System, state: MonoState, images: Array, time: Array, options: MonoConfig
) -> tuple[MonoState, MonoTrack]:
    rig = system.rig
    images = images.astype(state.belief.mean.dtype)
    key, search_key, lost_key = jax.random.split(state.key, 3)
    state = at_last_good(lost_key, state)
    steps = jnp.clip((time - state.time) / FRAME_S, 0.0, MOST_STEPS)
    moved = state.search.velocity * steps
    templates, looks = _templates(state, rig, moved, options)
    search, info = _searched(search_key, system.searches, state, looks, images, steps, options)
    estimate = ESTIMATES[options.landmarks](search, state, images, rig, moved)
    if not options.is_published:
        search = _followed(search, state, estimate, steps)
    belief = jax.tree.map(lambda a, b: jnp.where(estimate.is_found, a, b), estimate.belief, spread(search))
    score = score_at(state.model, templates, rig, belief.mean, images)
    likeness = jnp.maximum(score, score_at(state.model, looks, rig, belief.mean, images))
    fewer = jnp.maximum(state.num_outliers - 2, 0)
    outlier = is_outlier(estimate.num_anchored, score, belief.mean[:POSE], state.window.poses[0])
    num_outliers = jnp.where(outlier & (not options.is_published), state.num_outliers + 1, fewer)
    missed = ~estimate.is_found | (likeness < LEAST_SCORE) | (num_outliers > MOST_OUTLIERS)
    missed |= (state.misses > 0) & (likeness < REGAINED_SCORE)
    if not options.is_published:
        # Far from the face few landmarks are turned to the camera, and two or three may correlate by chance.
        missed |= (state.misses >= PATIENCE) & (estimate.num_anchored < FEWEST_SURE)
    innovations = jnp.where(missed, 0, pose_corrections(search, state.belief, moved, belief))
    state = _after(state, search, belief, estimate, missed)
    state, is_adjusted = _adjusted(system, state, estimate, score, missed, options)
    state = state._replace(
        misses=jnp.where(missed, state.misses + 1, 0),
        num_outliers=num_outliers,
        time=jnp.maximum(time, state.time),
        key=key,
        last_good=jnp.where(missed, state.last_good, state.belief.mean),
        is_fresh=~missed,
        window=state.window._replace(ages=state.window.ages + 1),
    )
    num_sure = jnp.where(missed, 0.0, jnp.sum(~estimate.is_unsure).astype(score.dtype))
    track = _track(system, state, score, info.effective_sample_size, is_adjusted, num_sure, innovations)
    return state, track


def _templates(state: MonoState, rig: CameraRig, moved: Array, options: MonoConfig) -> tuple[Array, Array]:
    """What landmarks look like as the head is expected to be turned: as at registration; and, if changed, of late."""
    if options.is_published:
        return state.registered.templates, state.registered.templates
    x, observed = state.belief.mean, state.registered.patches
    pose, M = x[:POSE] + moved, shape(state.model, x[POSE:])
    by_shape, _ = jacobian(rig, M, pose)
    is_facing = facing(observed, by_shape)[..., None, None]
    affine = jnp.where(is_facing, stretch(observed, state.slopes, by_shape), jnp.eye(2))
    templates = jnp.where(is_facing, turned(observed, affine), 0.0)
    latest = latest_templates(state.recent, state.slopes, templates, M, pose, rig)
    return templates, jnp.where(state.misses < PATIENCE, latest, templates)


def _searched(
    key: AnyKey,
    searches: Searches,
    state: MonoState,
    templates: Array,
    images: Array,
    steps: Array,
    options: MonoConfig,
) -> tuple[AdaptiveDiffusionState, ParticleInfo]:
    """Particles after this frame; where they make the estimate, half of them move in the expression."""

    def run(filter: Filter, deviation: Array) -> tuple[AdaptiveDiffusionState, ParticleInfo]:
        filter = at(filter, state.model, templates, deviation)
        predict_key, update_key = jax.random.split(key)
        search = filter.predict(filter.params, predict_key, state.search, steps)
        return filter.update(filter.params, update_key, search, images, steps)

    if not options.is_published:
        return run(searches.rigid, jnp.zeros_like(state.model.deviation))
    return run(searches.layered, PUBLISHED_KAPPA / KAPPA * state.model.deviation)


def _followed(
    search: AdaptiveDiffusionState, state: MonoState, estimate: Estimate, steps: Array
) -> AdaptiveDiffusionState:
    """The search after the fit has said where the head is: particles and velocity follow the fit."""
    before, x = state.search, estimate.belief.mean
    elapsed = before.elapsed + steps
    has_gone_on = elapsed > LEAST_STEPS
    moved = (x - before.estimate)[:POSE] / jnp.where(has_gone_on, elapsed, 1.0)
    velocity = jnp.where(has_gone_on, moved, before.velocity)
    # Few landmarks tell the depth of a head by their distances alone: what it seems to move by is their error.
    velocity = jnp.where(estimate.num_anchored < FEWEST_SURE, velocity.at[2].set(0.0), velocity)
    followed = gathered(search, x)._replace(estimate=x, velocity=velocity, fit=before.fit)
    return jax.tree.map(lambda a, b: jnp.where(estimate.is_found, a, b), followed, search)


def _after(
    state: MonoState, search: AdaptiveDiffusionState, belief: Gaussian, estimate: Estimate, missed: Array
) -> MonoState:
    """The state after a frame but for the person, and for what counts frames."""
    found = ~missed
    pick = lambda use, new, old: jax.tree.map(lambda a, b: jnp.where(use, a, b), new, old)
    # Where most landmarks are hidden or changed, residuals say nothing of what skin and model are like otherwise.
    is_usual = found & (estimate.num_anchored >= FEWEST_SURE)
    # A face that is not found is not headed anywhere.
    search = search._replace(velocity=jnp.where(found, search.velocity, 0.5 * search.velocity))
    return state._replace(
        search=search,
        belief=belief,
        recent=pick(found, estimate.recent, state.recent),
        is_unsure=pick(found, estimate.is_unsure, state.is_unsure),
        windows=pick(found, estimate.windows, state.windows),
        slopes=pick(is_usual, estimate.slopes, state.slopes),
        model_variance=pick(is_usual, estimate.model_variance, state.model_variance),
        residual_scale=pick(is_usual, estimate.residual_scale, state.residual_scale),
    )


def _adjusted(
    system: System, state: MonoState, estimate: Estimate, score: Array, missed: Array, options: MonoConfig
) -> tuple[MonoState, Array]:
    """The state after the face was adjusted, if this frame allows and deserves it; and whether it was."""
    unknown, face, rig = system[:3]
    frame = adjustment.frame_of(face, rig, estimate.view, state.person, state.belief.mean, state.modes, state.prior)
    _, response, _, by_focal = frame.about_person
    is_informed = ~missed & jnp.all(jnp.isfinite(response)) & jnp.all(jnp.isfinite(by_focal))
    state = state._replace(
        response=jnp.where(is_informed, response, state.response),
        by_focal=jnp.where(is_informed, by_focal, state.by_focal),
    )
    if not options.adjust:
        return state, jnp.zeros((), bool)
    further = 1.0 if options.is_published else adjustment.FURTHER
    allowed = ~missed & (score >= adjustment.LEAST_SCORE)
    allowed &= jnp.abs(frame.pose[4]) <= further * adjustment.MOST_YAW
    allowed &= jnp.abs(frame.pose[5]) <= further * adjustment.MOST_PITCH
    place, deserves = adjustment.choose(face, state.window, state.prior, state.person, frame, options)
    tried = allowed & deserves
    anew = lambda: adjustment.adjusted(unknown, face, rig, state, frame, place, options)
    after = jax.lax.cond(tried, anew, lambda: state)
    parts = ("person", "prior", "belief", "model", "modes", "window", "registered")
    believed = lambda state: [getattr(state, part) for part in parts]
    sound = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(believed(after))]))
    return jax.lax.cond(sound, lambda: after, lambda: state), tried & sound


def _track(
    system: System,
    state: MonoState,
    score: Array,
    ess: Array,
    is_adjusted: Array,
    num_sure: Array,
    innovations: Array,
) -> MonoTrack:
    unknown, face, rig = system[:3]
    lost = state.misses >= PATIENCE
    known = lambda a: jnp.where(lost, jnp.nan, a)
    x = state.belief.mean
    M = shape(state.model, x[POSE:])
    uv, _ = project_shape(rig, M, x[:POSE])
    of_person = adjustment.uncertainty(face, state.window, state.prior, state.person, state.response)
    is_sure = num_sure >= FEWEST_SURE
    variance = pose_variance(
        jnp.diagonal(state.belief.covariance)[:POSE],
        jnp.diagonal(of_person)[:POSE],
        jnp.square(system.focal_log_std * state.by_focal[:POSE]),
        num_sure,
    )
    expression = state.modes.expression(face, x[POSE:])
    return MonoTrack(
        pose=known(x[:POSE]),
        pose_std=known(jnp.sqrt(variance)),
        deformation=known((expression - unknown.expression_mean) / unknown.expression_std),
        shape=known(M),
        image_points=known(uv),
        score=score,
        effective_sample_size=ess,
        innovations=innovations,
        identity=known((state.person.identity - unknown.identity_mean) / unknown.identity_std),
        offset=known(state.person.offset + face.mean - unknown.mean),
        person_index=jnp.where(lost, -1, state.face_index - 1).astype(jnp.int32),
        is_adjusted=is_adjusted,
        status=jnp.where(lost, LOST, jnp.where(is_sure, DEFORMABLE, DOUBTFUL)).astype(jnp.int32),
    )
