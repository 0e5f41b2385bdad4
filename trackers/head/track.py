"""One frame after another: search, estimate, verdict, learning."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxfilters import diffusion
from jaxfilters.adaptive import AdaptiveState
from jaxfilters.filter import Filter
from jaxfilters.gaussian import Gaussian
from jaxfilters.models.face.alignment import facing
from jaxfilters.models.face.patches import SKIN_NORMALS, patches, stretch, turned, unknown_slopes
from jaxfilters.models.face.pose import rotation
from jaxfilters.models.face.rig import CameraRig, jacobian, project_shape
from jaxfilters.models.face.rigid import remove_motion
from jaxfilters.models.face.shape_model import FaceModel, rigid, shape
from jaxfilters.particle import ParticleInfo
from jaxfilters.trackers.head import learning
from jaxfilters.trackers.head.estimate import Estimate, around_mode, refined
from jaxfilters.trackers.head.recent import latest_templates, nothing_changed
from jaxfilters.trackers.head.search import (
    Searches,
    at,
    gathered,
    score_at,
)
from jaxfilters.trackers.head.search import (
    start as start_search,
)
from jaxfilters.trackers.head.sharpening import sharpened
from jaxfilters.trackers.head.state import (
    DEFORMABLE,
    FRAME_S,
    LOST,
    NUM_MODES,
    POSE,
    RIGID,
    HeadOptions,
    HeadState,
    HeadTrack,
    Registered,
)
from jaxfilters.typing import AnyKey

PATIENCE = 10
"""Frames in a row in which the face is not found before it counts as lost."""
FEWEST_ANCHORED, MOST_STRANGE = 2, 35
"""Landmarks that must look as registered, and be where the model has them; for how many frames they need not: eyes may
close while a mouth opens wide, but not for long."""
LEAST_SCORE, REGAINED_SCORE = 0.35, 0.5
"""Mean correlation below which a face is not found; from which on one that was not found is found again."""
SHARPENING = (15, 300)
"""Frames: how often, and how long after registration, the registered shape is triangulated anew."""
FIRST_LOOSENESS = 0.3**2
"""mm^2."""
LEARNING = {"paper": (1.0, learning.without_weighted_motion), "modern": (0.0, remove_motion)}
"""How far the mean shape goes along with those that are measured, and how the skull's motion is taken out of them."""
MOST_STEPS = 30.0
"""Frame times: a longer gap is treated as one of this length."""


def begin(
    key: AnyKey,
    model: FaceModel,
    pose: Float[Array, " 6"],
    images: Num[Array, "C rows cols"],
    time: Float[Array, ""],
    rig: CameraRig,
    options: HeadOptions,
) -> HeadState:
    """State at registration.

    Args:
        key: Random key; it lives in the state from here on.
        model: The registered face.
        pose: Of the head, millimetres and radians.
        images: In which it was registered.
        time: Of these, seconds.
        rig: Cameras.
        options: Constants.
    """
    x = jnp.concatenate([pose, jnp.zeros(NUM_MODES, pose.dtype)])
    images = jnp.asarray(images, pose.dtype)
    seen = patches(images, model.mean, pose, rig, jnp.asarray(SKIN_NORMALS, pose.dtype))
    slopes = unknown_slopes(len(model.mean))
    _, covariance = sharpened(images, model.mean, pose, slopes, jnp.ones((), pose.dtype), rig)
    face = rigid(model.mean, model.templates, num_modes=NUM_MODES)
    variances = jnp.concatenate([jnp.diagonal(jnp.eye(POSE)) * 1e-4, jnp.full(NUM_MODES, 1e-4)])
    return HeadState(
        search=start_search(x, options),
        belief=Gaussian(x, jnp.diag(variances).astype(x.dtype)),
        model=face,
        registered=Registered(model.mean, covariance, seen, pose, images),
        recent=nothing_changed(images, model.mean, pose, rig),
        slopes=slopes,
        looseness=jnp.full(len(model.mean), FIRST_LOOSENESS, x.dtype),
        misfit=jnp.ones((), x.dtype),
        learner=learning.nothing_learnt(model.mean, model.templates),
        misses=jnp.zeros((), jnp.int32),
        strange=jnp.zeros((), jnp.int32),
        age=jnp.zeros((), jnp.int32),
        time=jnp.asarray(time, x.dtype),
        key=key,
    )


@partial(jax.jit, static_argnames="options")
def advance(
    rig: CameraRig,
    searches: Searches,
    state: HeadState,
    images: Num[Array, "b C rows cols"],
    times: Float[Array, " b"],
    is_frame: Bool[Array, " b"],
    options: HeadOptions,
) -> tuple[HeadState, HeadTrack]:
    """State and track after `b` frames; those that are none leave the state alone, and their rows mean nothing."""

    def one(state: HeadState, inputs: tuple) -> tuple[HeadState, HeadTrack]:
        images, time, is_frame = inputs
        _, empty = jax.eval_shape(lambda: _step(rig, searches, state, images, time, options))
        nothing = lambda: (state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), empty))
        return jax.lax.cond(is_frame, lambda: _step(rig, searches, state, images, time, options), nothing)

    return jax.lax.scan(one, state, (images, times, is_frame))


def _step(
    rig: CameraRig, searches: Searches, state: HeadState, images: Array, time: Array, options: HeadOptions
) -> tuple[HeadState, HeadTrack]:
    images = images.astype(state.belief.mean.dtype)
    key, search_key = jax.random.split(state.key)
    steps = jnp.clip((time - state.time) / FRAME_S, 0.0, MOST_STEPS)
    deforms = options.learn & (rig.num_cameras > 1) & (state.age >= options.rigid_frames)
    model = _usable(state, deforms)
    moved = state.search.velocity * steps
    templates = _templates(state, model, rig, moved, options)
    looks = _looks(state, model, templates, rig, moved, options)
    search, info = _searched(search_key, searches, state, model, looks, images, steps, options)
    if options.mode == "modern":
        estimate = refined(search, state, model, images, rig, moved)
        search = _followed(search, state, estimate, steps, options)
    else:
        estimate = around_mode(search, state, model)
    belief = _held(estimate, search, model, state)
    score = score_at(model, templates, rig, belief.mean, images)
    likeness = jnp.maximum(score, score_at(model, looks, rig, belief.mean, images))
    is_strange = estimate.num_anchored < FEWEST_ANCHORED
    strange = jnp.where(is_strange, state.strange + 1, jnp.maximum(state.strange - 2, 0))
    missed = ~estimate.is_found | (likeness < LEAST_SCORE) | (strange > MOST_STRANGE)
    missed |= (state.misses > 0) & (likeness < REGAINED_SCORE)
    state = _learnt(state, model, search, belief, estimate, score, missed, images, rig, options)
    due = (state.age % SHARPENING[0] == SHARPENING[0] - 1) & (state.age < SHARPENING[1]) & ~missed
    due &= options.mode == "modern"
    state = jax.lax.cond(due, partial(_sharpened, rig), lambda state: state, state)
    state = state._replace(
        misses=jnp.where(missed, state.misses + 1, 0),
        strange=strange,
        age=state.age + 1,
        time=jnp.maximum(time, state.time),
        key=key,
    )
    return state, _track(state, belief, estimate, score, info.effective_sample_size, deforms, rig)


def _usable(state: HeadState, deforms: Array) -> FaceModel:
    """The model that may be used: in the first frames, the registered face."""
    face = rigid(state.registered.shape, state.model.templates, num_modes=NUM_MODES)
    return jax.tree.map(lambda a, b: jnp.where(deforms, a, b), state.model, face)


def _templates(state: HeadState, model: FaceModel, rig: CameraRig, moved: Array, options: HeadOptions) -> Array:
    """What the landmarks look like: in the modern mode as the head is expected to be turned, flat where turned away."""
    if options.mode == "paper":
        return model.templates
    pose = state.belief.mean[:POSE] + moved
    by_shape, _ = jacobian(rig, shape(model, state.belief.mean[POSE:]), pose)
    is_facing = facing(state.registered.patches, by_shape)[..., None, None]
    affine = jnp.where(is_facing, stretch(state.registered.patches, state.slopes, by_shape), jnp.eye(2))
    return jnp.where(is_facing, turned(state.registered.patches, affine), 0.0)


def _looks(
    state: HeadState, model: FaceModel, templates: Array, rig: CameraRig, moved: Array, options: HeadOptions
) -> Array:
    """The templates; in the modern mode, for landmarks that have changed since registration, as they looked last.

    Where a face was lost the last frame shows something else.
    """
    if options.mode == "paper":
        return templates
    x = state.belief.mean
    latest = latest_templates(state.recent, state.slopes, templates, shape(model, x[POSE:]), x[:POSE] + moved, rig)
    return jnp.where(state.misses < PATIENCE, latest, templates)


def _searched(
    key: AnyKey,
    searches: Searches,
    state: HeadState,
    model: FaceModel,
    templates: Array,
    images: Array,
    steps: Array,
    options: HeadOptions,
) -> tuple[AdaptiveState, ParticleInfo]:
    """Particles after this frame; they deform where the model does, in the paper's mode."""

    def run(filter: Filter, deviation: Array) -> tuple[AdaptiveState, ParticleInfo]:
        filter = at(filter, model, templates, deviation)
        predict_key, update_key = jax.random.split(key)
        search = filter.predict(filter.params, predict_key, state.search, steps)
        return filter.update(filter.params, update_key, search, images)

    still = jnp.zeros_like(model.deviation)
    if options.mode == "modern":
        return run(searches.rigid, still)
    learnt = jnp.any(model.deviation > 0)
    return jax.lax.cond(learnt, lambda: run(searches.layered, model.deviation), lambda: run(searches.rigid, still))


def _followed(
    search: AdaptiveState, state: HeadState, estimate: Estimate, steps: Array, options: HeadOptions
) -> AdaptiveState:
    """The search after the fit has said where the head is: particles, velocity and diffusion follow the fit."""
    before, x = state.search, estimate.belief.mean
    velocity = (x - before.estimate)[:POSE] / jnp.maximum(before.elapsed + steps, 1e-3)
    fit = before.fit
    if options.diffusion == "learnt":
        fit = diffusion.update(fit, before.velocity, velocity - before.velocity)
    followed = gathered(search, x)._replace(estimate=x, velocity=velocity, fit=fit)
    return jax.tree.map(lambda a, b: jnp.where(estimate.is_found, a, b), followed, search)


def _held(estimate: Estimate, search: AdaptiveState, model: FaceModel, state: HeadState) -> Gaussian:
    """What is believed: the estimate, or where nothing was found the particles."""
    particles = around_mode(search, state, model).belief
    return jax.tree.map(lambda a, b: jnp.where(estimate.is_found, a, b), estimate.belief, particles)


def _learnt(
    state: HeadState,
    model: FaceModel,
    search: AdaptiveState,
    belief: Gaussian,
    estimate: Estimate,
    score: Array,
    missed: Array,
    images: Array,
    rig: CameraRig,
    options: HeadOptions,
) -> HeadState:
    """The state after a frame, but for what counts frames."""
    found = ~missed
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(found, a, b), new, old)
    learner, after = state.learner, state.model
    if options.learn and rig.num_cameras > 1:
        is_measured = found & learning.measurable(belief.mean[:POSE], score)
        measured, windows = estimate.measured, learner.windows
        if options.mode == "paper":
            measured, windows = jax.lax.cond(
                is_measured,
                lambda: learning.recalculated(
                    learner, estimate.shape, images, state.model.templates, belief.mean[:POSE], rig
                ),
                lambda: (measured, windows),
            )
        learner, after = learning.learnt(learner, state.model, measured, windows, is_measured, *LEARNING[options.mode])
    search, belief = _carried(search, belief, model, after)
    # A face that is not found is not headed anywhere.
    search = search._replace(velocity=jnp.where(found, search.velocity, 0.5 * search.velocity))
    return state._replace(
        search=search,
        belief=belief,
        model=after,
        recent=keep(estimate.recent, state.recent),
        slopes=keep(estimate.slopes, state.slopes),
        looseness=keep(estimate.looseness, state.looseness),
        misfit=keep(estimate.misfit, state.misfit),
        learner=learner,
    )


def _carried(
    search: AdaptiveState, belief: Gaussian, before: FaceModel, after: FaceModel
) -> tuple[AdaptiveState, Gaussian]:
    """Particles and belief in the modes of a model that has changed."""
    carry = lambda a: learning.carried(a, before, after)
    turning = learning.turning(before, after)
    block = turning @ belief.covariance[POSE:, POSE:] @ turning.T
    cross = belief.covariance[:POSE, POSE:] @ turning.T
    covariance = belief.covariance.at[POSE:, POSE:].set(block)
    covariance = covariance.at[:POSE, POSE:].set(cross).at[POSE:, :POSE].set(cross.T)
    search = search._replace(
        particles=search.particles.at[POSE:].set(carry(search.particles[POSE:])),
        estimate=search.estimate.at[POSE:].set(carry(search.estimate[POSE:, None])[:, 0]),
    )
    return search, Gaussian(belief.mean.at[POSE:].set(carry(belief.mean[POSE:, None])[:, 0]), covariance)


def _sharpened(rig: CameraRig, state: HeadState) -> HeadState:
    """The registered shape as it looks now that the skin's slopes are better known, about its own centroid."""
    old = state.registered
    shape, covariance = sharpened(old.images, old.shape, old.pose, state.slopes, state.misfit, rig)
    center = jnp.mean(shape, axis=0)
    # The landmarks stay where they are in the first image: what moves the centroid moves the pose back.
    place = old.pose.at[:3].add(rotation(old.pose[3:]) @ center)
    shape = shape - center
    seen = patches(old.images, shape, place, rig, jnp.asarray(SKIN_NORMALS, shape.dtype))
    new = old._replace(shape=shape, covariance=covariance, pose=place, patches=seen)
    sound = jnp.all(jnp.isfinite(shape)) & jnp.all(jnp.isfinite(covariance))
    new = jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, old)
    return state._replace(registered=new, model=replace(state.model, mean=new.shape))


def _track(
    state: HeadState, belief: Gaussian, estimate: Estimate, score: Array, ess: Array, deforms: Array, rig: CameraRig
) -> HeadTrack:
    lost = state.misses >= PATIENCE
    known = lambda a: jnp.where(lost, jnp.nan, a)
    uv, _ = project_shape(rig, estimate.shape, belief.mean[:POSE])
    deformable = deforms & jnp.any(state.model.deviation > 0)
    return HeadTrack(
        pose=known(belief.mean[:POSE]),
        pose_std=known(jnp.sqrt(jnp.diagonal(belief.covariance)[:POSE])),
        deformation=known(belief.mean[POSE:]),
        shape=known(estimate.shape),
        image_points=known(uv),
        score=score,
        effective_sample_size=ess,
        status=jnp.where(lost, LOST, jnp.where(deformable, DEFORMABLE, RIGID)).astype(jnp.int32),
    )
