"""One frame after another: search, estimate, verdict, learning."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxfilters._full_precision import dot
from jaxfilters._xla.compiled_quickly import compiled_lightly, compiled_quickly
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math.diffusion import DiffusionFit
from jaxfilters.models.face.patches import SKIN_NORMALS, Slopes, patches, unknown_slopes
from jaxfilters.models.face.pose import rotation
from jaxfilters.models.face.rig import CameraRig, project_shape
from jaxfilters.models.face.shape_model import FaceModel, rigid
from jaxfilters.particle.adaptive import AdaptiveDiffusionState
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.trackers.head.common import learning
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.estimate import Estimate, around_mode
from jaxfilters.trackers.head.common.near_mode import pose_corrections
from jaxfilters.trackers.head.common.recent import nothing_changed
from jaxfilters.trackers.head.common.search import Searches, at, scattered, score_at
from jaxfilters.trackers.head.common.search import start as start_search
from jaxfilters.trackers.head.common.state import (
    DEFORMABLE,
    DOUBTFUL,
    FRAME_S,
    LOST,
    NUM_MODES,
    PATIENCE,
    POSE,
    RIGID,
    UNITS,
    HeadState,
    HeadTrack,
    KeyFrames,
    Registered,
)
from jaxfilters.trackers.head.stereo.key_frames import nearest_patches, no_key_frames, with_key_frame
from jaxfilters.trackers.head.stereo.sharpening import first_slopes, sharpened
from jaxfilters.trackers.head.stereo.variants import VARIANTS, Variant
from jaxfilters.typing import AnyKey

FEWEST_ANCHORED, FEWEST_PLACED, MOST_OUTLIERS = 2, 3, 60
"""Landmarks that must look as registered, and be where the model has them; in a doubtful pose, landmarks that must be
found by their own patches; for how many frames either need not be: eyes may close while a mouth opens wide, but not for
long."""
LEAST_SCORE, REGAINED_SCORE = 0.35, 0.5
"""Mean correlation below which a face is not found; from which on one that was not found is found again."""
DOUBTFUL_SCORE, NOTHING_SCORE, DOUBT = 0.45, 0.2, 6.0
"""Mean correlation below which a pose is doubtful, and below which what is followed is no face; by how much of
themselves standard deviations grow for each unit below the first. In 33 runs on eleven people of the ICT face model,
who are not those of the benchmark, 95 % of the errors in each coordinate were within 2.0 to 2.7 deviations of the fit
at scores of 0.4 to 0.5, 2.3 to 3.3 at 0.3 to 0.4, 2.5 to 2.9 at 0.2 to 0.3, and 2.9 to 9.5 below."""
MOST_ASTRAY = 10.0
"""Millimetres and degrees to which particles spread about the place where a face was lost, by one more every frame."""
SHARPENING = (15, 300)
"""Frames: how often, and how long after registration, the registered shape is triangulated anew."""
FIRST_MODEL_VARIANCE = 0.3**2
"""mm^2."""
MOST_STEPS = 30.0
"""Frame times: a longer gap is treated as one of this length."""


@partial(compiled_quickly, static_argnames="options")
def begin(
    key: AnyKey,
    model: FaceModel,
    pose: Float[Array, " 6"],
    images: Num[Array, "C rows cols"],
    time: Float[Array, ""],
    rig: CameraRig,
    options: HeadConfig,
    diffusion: DiffusionFit | None = None,
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
        diffusion: Of the particles before anything was estimated; that of the options if none.
    """
    images = jnp.asarray(images, pose.dtype)
    slopes = unknown_slopes(len(model.mean))
    registered = _registered(images, model.mean, pose, slopes, rig)
    if VARIANTS[options.variant].sharpens:
        slopes = first_slopes(images, model.mean, pose, rig)
        registered = _sharper(images, model.mean, pose, slopes, rig)
    x = jnp.concatenate([registered.pose, jnp.zeros(NUM_MODES, pose.dtype)])
    face = rigid(registered.shape, model.templates, num_modes=NUM_MODES)
    variances = jnp.concatenate([jnp.diagonal(jnp.eye(POSE)) * 1e-4, jnp.full(NUM_MODES, 1e-4)])
    return HeadState(
        search=start_search(x, options, diffusion),
        belief=Gaussian(x, jnp.diag(variances).astype(x.dtype)),
        model=face,
        registered=registered,
        recent=nothing_changed(images, registered.shape, registered.pose, rig),
        key_frames=no_key_frames(registered.patches),
        slopes=slopes,
        model_variance=jnp.full(len(face.mean), FIRST_MODEL_VARIANCE, x.dtype),
        residual_scale=jnp.ones((), x.dtype),
        learner=learning.empty_learner(face.mean, face.templates),
        last_good=x,
        misses=jnp.zeros((), jnp.int32),
        num_outliers=jnp.zeros((), jnp.int32),
        age=jnp.zeros((), jnp.int32),
        time=jnp.asarray(time, x.dtype),
        key=key,
    )


@partial(compiled_lightly, static_argnames="options")
def advance(
    rig: CameraRig,
    searches: Searches,
    state: HeadState,
    images: Num[Array, "b C rows cols"],
    times: Float[Array, " b"],
    is_frame: Bool[Array, " b"],
    options: HeadConfig,
) -> tuple[HeadState, HeadTrack]:
    """State and track after `b` frames; those that are none leave the state alone, and their rows mean nothing."""

    def one(state: HeadState, inputs: tuple) -> tuple[HeadState, HeadTrack]:
        images, time, is_frame = inputs
        step = lambda: _step(rig, searches, state, images, time, options)
        _, empty = jax.eval_shape(step)
        nothing = lambda: (state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), empty))
        return jax.lax.cond(is_frame, step, nothing)

    return jax.lax.scan(one, state, (images, times, is_frame))


@partial(jax.jit, static_argnames="options")  # traced once for its shapes and its program
def _step(
    rig: CameraRig, searches: Searches, state: HeadState, images: Array, time: Array, options: HeadConfig
) -> tuple[HeadState, HeadTrack]:
    variant = VARIANTS[options.variant]
    images = images.astype(state.belief.mean.dtype)
    key, search_key, lost_key = jax.random.split(state.key, 3)
    state = at_last_good(lost_key, state)
    steps = jnp.clip((time - state.time) / FRAME_S, 0.0, MOST_STEPS)
    deforms = options.learn & (rig.num_cameras > 1) & (state.age >= options.rigid_frames)
    model = _usable(state, deforms)
    moved = state.search.velocity * steps
    registered, lasting = state.registered, jnp.zeros((POSE, POSE), moved.dtype)
    if variant.keeps_key_frames:
        expected = state.belief.mean[:POSE] + moved
        nearest, lasting = nearest_patches(state.key_frames, registered.patches, registered.pose, expected)
        state = state._replace(registered=registered._replace(patches=nearest))
    templates, looks = variant.templates(state, model, rig, moved)

    def run(filter: Filter, deviation: Array) -> tuple[AdaptiveDiffusionState, ParticleInfo]:
        filter = at(filter, model, looks, deviation)
        predict_key, update_key = jax.random.split(search_key)
        search = filter.predict(filter.params, predict_key, state.search, steps)
        return filter.update(filter.params, update_key, search, images, steps)

    search, info = variant.search(run, searches, model)
    ahead = state.belief.mean.at[:POSE].add(moved)
    search = variant.begun(search, ahead, lambda x: score_at(model, looks, rig, x, images))
    estimate, search = variant.estimate(search, state, model, images, rig, moved, steps, options)
    estimate = estimate._replace(doubt=estimate.doubt + lasting)
    belief = _held(estimate, search, model, state)
    likenesses = jax.vmap(lambda views: score_at(model, views, rig, belief.mean, images))(jnp.stack([templates, looks]))
    score, likeness = likenesses[0], jnp.max(likenesses)
    doubt = jnp.maximum(DOUBTFUL_SCORE - score, 0.0) if variant.may_doubt else jnp.zeros_like(score)
    is_outlier = (estimate.num_anchored < FEWEST_ANCHORED) | (doubt > DOUBTFUL_SCORE - NOTHING_SCORE)
    is_outlier |= (doubt > 0) & (jnp.sum(jnp.any(estimate.is_placed, axis=0)) < FEWEST_PLACED)
    num_outliers = jnp.where(is_outlier, state.num_outliers + 1, jnp.maximum(state.num_outliers - 2, 0))
    missed = ~estimate.is_found | (likeness < LEAST_SCORE) | (num_outliers > MOST_OUTLIERS)
    missed |= (state.misses > 0) & (likeness < REGAINED_SCORE)
    innovations = jnp.where(missed, 0, pose_corrections(search, state.belief, moved, belief))
    state = state._replace(registered=registered)
    if variant.keeps_key_frames:
        state = state._replace(key_frames=_key_frames(state, belief, lasting, estimate, score, missed, rig))
    state = _learned(variant, state, model, search, belief, estimate, score, missed, images, rig, options)
    due = (state.age % SHARPENING[0] == SHARPENING[0] - 1) & (state.age < SHARPENING[1]) & ~missed
    due &= variant.sharpens
    state = jax.lax.cond(due, partial(_sharpened, rig), lambda state: state, state)
    state = state._replace(
        last_good=jnp.where(missed | (doubt > 0), state.last_good, state.belief.mean),
        misses=jnp.where(missed, state.misses + 1, 0),
        num_outliers=num_outliers,
        age=state.age + 1,
        time=jnp.maximum(time, state.time),
        key=key,
    )
    return state, _track(state, belief, estimate, score, doubt, info.effective_sample_size, innovations, deforms, rig)


def at_last_good(key: Array, state: Any) -> Any:
    """A lost face is searched for where it was last observed, ever farther around: particles would wander in noise.

    Args:
        key: Random key.
        state: Of any head tracker, with `search`, `belief`, `last_good` and `misses`.
    """
    lost_for = (state.misses - PATIENCE + 1).astype(state.belief.mean.dtype)
    width = jnp.minimum(lost_for, MOST_ASTRAY) * jnp.asarray(UNITS, state.belief.mean.dtype)
    search, belief = scattered(key, state.search, state.last_good, width)
    lost = state._replace(search=search, belief=belief)
    pick = lambda a, b: a if a is b else jnp.where(state.misses >= PATIENCE, a, b)
    return state._replace(
        search=jax.tree.map(pick, lost.search, state.search), belief=jax.tree.map(pick, lost.belief, state.belief)
    )


def _usable(state: HeadState, deforms: Array) -> FaceModel:
    """The model that may be used: in the first frames, the registered face."""
    face = rigid(state.registered.shape, state.model.templates, num_modes=NUM_MODES)
    return jax.tree.map(lambda a, b: jnp.where(deforms, a, b), state.model, face)


def _held(estimate: Estimate, search: AdaptiveDiffusionState, model: FaceModel, state: HeadState) -> Gaussian:
    """What is believed: the estimate, or where nothing was found the particles."""
    particles = around_mode(search, state, model).belief
    return jax.tree.map(lambda a, b: jnp.where(estimate.is_found, a, b), estimate.belief, particles)


def _learned(
    variant: Variant,
    state: HeadState,
    usable: FaceModel,
    search: AdaptiveDiffusionState,
    belief: Gaussian,
    estimate: Estimate,
    score: Array,
    missed: Array,
    images: Array,
    rig: CameraRig,
    options: HeadConfig,
) -> HeadState:
    """The state after a frame, but for what counts frames."""
    found = ~missed
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(found, a, b), new, old)
    learner, model = state.learner, state.model
    if options.learn and rig.num_cameras > 1:
        is_measured = found & learning.measurable(belief.mean[:POSE], score)
        measured, windows = variant.measured(state, estimate, images, rig, is_measured)
        learner, model = learning.learned(learner, model, measured, windows, is_measured, variant.follow, variant.still)
    search, belief = _carried(search, belief, usable, model)
    # A face that is not found is not headed anywhere.
    search = search._replace(velocity=jnp.where(found, search.velocity, 0.5 * search.velocity))
    return state._replace(
        search=search,
        belief=belief,
        model=model,
        recent=keep(estimate.recent, state.recent),
        slopes=keep(estimate.slopes, state.slopes),
        model_variance=keep(estimate.model_variance, state.model_variance),
        residual_scale=keep(estimate.residual_scale, state.residual_scale),
        learner=learner,
    )


def _key_frames(
    state: HeadState,
    belief: Gaussian,
    lasting: Array,
    estimate: Estimate,
    score: Array,
    missed: Array,
    rig: CameraRig,
) -> KeyFrames:
    """With this frame, if it is one; it is off by what the key frames are off by from which it was placed, too."""
    is_placed = estimate.is_placed & ~missed
    pose = Gaussian(belief.mean[:POSE], belief.covariance[:POSE, :POSE] + lasting)
    return with_key_frame(state.key_frames, state.registered.pose, pose, estimate.recent, is_placed, score, rig)


def _carried(
    search: AdaptiveDiffusionState, belief: Gaussian, before: FaceModel, after: FaceModel
) -> tuple[AdaptiveDiffusionState, Gaussian]:
    """Particles and belief in the modes of a model that has changed."""
    carry = lambda a: learning.carried(a, before, after)
    turning = learning.turning(before, after)
    block = dot(dot(turning, belief.covariance[POSE:, POSE:]), turning.T)
    cross = dot(belief.covariance[:POSE, POSE:], turning.T)
    covariance = belief.covariance.at[POSE:, POSE:].set(block)
    covariance = covariance.at[:POSE, POSE:].set(cross).at[POSE:, :POSE].set(cross.T)
    search = search._replace(
        particles=search.particles.at[POSE:].set(carry(search.particles[POSE:])),
        estimate=search.estimate.at[POSE:].set(carry(search.estimate[POSE:, None])[:, 0]),
    )
    return search, Gaussian(belief.mean.at[POSE:].set(carry(belief.mean[POSE:, None])[:, 0]), covariance)


def _registered(images: Array, shape: Array, pose: Array, slopes: Slopes, rig: CameraRig) -> Registered:
    """The face as it was matched."""
    observed = patches(images, shape, pose, rig, jnp.asarray(SKIN_NORMALS, shape.dtype))
    _, covariance, alike = sharpened(images, shape, pose, slopes, rig)
    return Registered(shape, covariance, alike, observed, pose, images)


def _sharper(images: Array, shape: Array, pose: Array, slopes: Slopes, rig: CameraRig) -> Registered:
    """The face as it looks with the skin inclined like this, about its own centroid."""
    shape, covariance, alike = sharpened(images, shape, pose, slopes, rig)
    center = jnp.mean(shape, axis=0)
    # The landmarks stay where they are in the first image: what moves the centroid moves the pose back.
    place = pose.at[:3].add(dot(rotation(pose[3:]), center))
    shape = shape - center
    observed = patches(images, shape, place, rig, jnp.asarray(SKIN_NORMALS, shape.dtype))
    return Registered(shape, covariance, alike, observed, place, images)


def _sharpened(rig: CameraRig, state: HeadState) -> HeadState:
    """The registered shape as it looks now that the skin's slopes are better known."""
    old = state.registered
    new = _sharper(old.images, old.shape, old.pose, state.slopes, rig)
    sound = jnp.all(jnp.isfinite(new.shape)) & jnp.all(jnp.isfinite(new.covariance))
    new = jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, old)
    return state._replace(registered=new, model=replace(state.model, mean=new.shape))


def _track(
    state: HeadState,
    belief: Gaussian,
    estimate: Estimate,
    score: Array,
    doubt: Array,
    ess: Array,
    innovations: Array,
    deforms: Array,
    rig: CameraRig,
) -> HeadTrack:
    lost = state.misses >= PATIENCE
    known = lambda a: jnp.where(lost, jnp.nan, a)
    uv, _ = project_shape(rig, estimate.shape, belief.mean[:POSE])
    deformable = deforms & jnp.any(state.model.deviation > 0)
    status = jnp.where(doubt > 0, DOUBTFUL, jnp.where(deformable, DEFORMABLE, RIGID))
    std = jnp.sqrt(jnp.diagonal(belief.covariance)[:POSE] + jnp.diagonal(estimate.doubt))
    return HeadTrack(
        pose=known(belief.mean[:POSE]),
        pose_std=known((1 + DOUBT * doubt) * std),
        deformation=known(belief.mean[POSE:]),
        shape=known(estimate.shape),
        image_points=known(uv),
        score=score,
        effective_sample_size=ess,
        innovations=innovations,
        status=jnp.where(lost, LOST, status).astype(jnp.int32),
    )
