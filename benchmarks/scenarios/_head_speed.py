"""Milliseconds a frame of the head tracker by the number of particles, and where they go."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.timing import interleaved
from jaxfilters.models.synthetic.face_motion import deformation_schedule, motion
from jaxfilters.models.synthetic.face_sequence import FaceSequence, face_sequence
from jaxfilters.trackers.head.common import learning
from jaxfilters.trackers.head.common.config import HeadConfig, compiled
from jaxfilters.trackers.head.common.estimate import refined
from jaxfilters.trackers.head.common.search import Searches, at, first_diffusion, searches
from jaxfilters.trackers.head.common.state import POSE, HeadState
from jaxfilters.trackers.head.stereo.registration import register
from jaxfilters.trackers.head.stereo.tracking import SHARPENING, advance, begin
from jaxfilters.trackers.head.stereo.variants import VARIANTS

BATCH = 8
"""Frames in one call."""
WARM_UP = 5
"""Calls before the one that is timed: modes have been estimated by then."""
USUAL = 1000
"""Particles."""


class Recording(NamedTuple):
    """A head that moves and deforms, in memory."""

    truth: FaceSequence
    images: np.ndarray


class Prepared(NamedTuple):
    """A tracker in full swing, and the frames it sees next."""

    truth: FaceSequence
    options: HeadConfig
    search: Searches
    state: HeadState
    images: np.ndarray
    times: np.ndarray

    def __call__(self) -> tuple:
        """The next frames, always from the same state."""
        is_frame = np.ones(len(self.times), bool)
        return advance(self.truth.rig, self.search, self.state, self.images, self.times, is_frame, self.options)


def speed_metrics(seed: int, counts: tuple[int, ...], rounds: int) -> dict[str, Metric]:
    """Of both modes in batches, of single frames as from live cameras, and of the stages."""
    recorded = recording(seed)
    options = {f"_{count}_particles": HeadConfig(num_particles=count, rigid_frames=0) for count in counts}
    usual = f"_{USUAL}_particles"
    options[f"{usual}_paper"] = HeadConfig(variant="published", num_particles=USUAL, rigid_frames=0)
    trackers = {name: prepared(recorded, chosen) for name, chosen in options.items()}
    modern, paper = trackers[usual], trackers[f"{usual}_paper"]
    trackers[f"{usual}_live"] = modern._replace(images=modern.images[:1], times=modern.times[:1])
    calls: dict[str, Callable] = {name: one.__call__ for name, one in trackers.items()}
    parts = {"": modern_stages(modern), "_paper": paper_stages(paper)}
    for suffix, stages in parts.items():
        calls |= {f"stage {name}{suffix}": call for name, call in stages.items()}
    seconds = interleaved(calls, rounds)
    per_frame = {
        name: 1e3 * value / (len(trackers[name].times) if name in trackers else BATCH)
        for name, value in seconds.items()
    }
    metrics: dict[str, Metric] = {}
    for name in trackers:
        metrics[f"frame_ms{name}"] = Metric(per_frame[name], "ms", "lower")
        metrics[f"fps{name}"] = Metric(1e3 / per_frame[name], "frames/s", "higher")
    for suffix, stages in parts.items():
        whole = per_frame[f"{usual}{suffix}"]
        spent = {name: per_frame[f"stage {name}{suffix}"] for name in stages}
        spent["rest"] = max(whole - sum(spent.values()), 0.0)
        whole = sum(spent.values())
        for name, ms in spent.items():
            metrics[f"stage_ms_{name}{suffix}"] = Metric(ms, "ms", "lower")
            metrics[f"stage_share_{name}{suffix}"] = Metric(ms / whole, "", "lower")
    return metrics


def recording(seed: int) -> Recording:
    """A head that begins to deform at once."""
    num_frames = 1 + (WARM_UP + 1) * BATCH
    expressions = deformation_schedule(num_frames, start=0, stop=10 * num_frames)
    truth = face_sequence(jax.random.key(seed), motion("mix", num_frames, seed), expressions=expressions)
    return Recording(truth, truth.frames(0, num_frames))


def prepared(recorded: Recording, options: HeadConfig) -> Prepared:
    """A tracker after some frames, old enough not to sharpen the registered shape any more."""
    truth, images = recorded
    registration = register(images[0], np.asarray(truth.uv[0, 0], float), truth.rig)
    pose, times = jnp.asarray(registration.pose, float), truth.times.astype(np.float32)
    first, time = jnp.asarray(images[0]), jnp.asarray(times[0], float)
    program = compiled(options)
    registered = jax.random.key(0), registration.model, pose, first, time, truth.rig
    state = begin(*registered, options=program, diffusion=first_diffusion(options))
    state = state._replace(age=jnp.full_like(state.age, SHARPENING[1]))
    search, is_frame = searches(truth.rig, options), np.ones(BATCH, bool)
    for start in range(1, 1 + WARM_UP * BATCH, BATCH):
        batch = slice(start, start + BATCH)
        state, _ = advance(truth.rig, search, state, images[batch], times[batch], is_frame, program)
    return Prepared(truth, program, search, jax.block_until_ready(state), images[-BATCH:], times[-BATCH:])


def modern_stages(one: Prepared) -> dict[str, Callable]:
    """The parts of the modern tracker's work on the same frames."""
    particles = jax.jit(partial(_each, partial(_searched, one.search, layered=False)))
    found = particles(one.state, _floats(one), _keys())
    refinement = jax.jit(partial(_each, partial(_refined, one.truth.rig)))
    estimates = refinement(one.state, _floats(one), found)
    learn = jax.jit(partial(_each, _learned))
    return {
        "particles": lambda: particles(one.state, _floats(one), _keys()),
        "refinement": lambda: refinement(one.state, _floats(one), found),
        "learning": lambda: learn(one.state, _floats(one), estimates.measured),
    }


def paper_stages(one: Prepared) -> dict[str, Callable]:
    """The parts of the paper's tracker's work on the same frames."""
    particles = jax.jit(partial(_each, partial(_searched, one.search, layered=True)))
    found = particles(one.state, _floats(one), _keys())
    learn = jax.jit(partial(_each, partial(_recalculated, one.truth.rig)))
    return {
        "particles": lambda: particles(one.state, _floats(one), _keys()),
        "learning": lambda: learn(one.state, _floats(one), found.estimate),
    }


def _each(work: Callable, state: HeadState, images: Array, inputs):
    """One frame after the other, as the tracker does it."""
    return jax.lax.map(lambda one: work(state, *one), (images, inputs))


def _floats(one: Prepared) -> Array:
    return jnp.asarray(one.images, one.state.belief.mean.dtype)


def _keys() -> Array:
    return jax.random.split(jax.random.key(1), BATCH)


def _searched(search: Searches, state: HeadState, images: Array, key: Array, *, layered: bool):
    model = state.model
    chosen, deviation = (search.layered, model.deviation) if layered else (search.rigid, 0 * model.deviation)
    filter = at(chosen, model, model.templates, deviation)
    predict_key, update_key = jax.random.split(key)
    steps = jnp.ones_like(state.time)
    moved = filter.predict(filter.params, predict_key, state.search, steps)
    return filter.update(filter.params, update_key, moved, images, steps)[0]


def _refined(rig, state: HeadState, images: Array, search):
    return refined(search, state, state.model, images, rig, search.velocity[:POSE])


def _learned(state: HeadState, images: Array, shape: Array):
    del images
    windows, always = state.learner.windows, jnp.ones((), bool)
    return learning.learned(state.learner, state.model, shape, windows, always, *_way("recommended"))


def _recalculated(rig, state: HeadState, images: Array, x: Array):
    estimated = state.model.mean + (state.model.basis @ x[POSE:]).reshape(state.model.mean.shape)
    shape, windows = learning.recalculated(state.learner, estimated, images, state.model.templates, x[:POSE], rig)
    return learning.learned(state.learner, state.model, shape, windows, jnp.ones((), bool), *_way("published"))


def _way(mode: str):
    way = VARIANTS[mode]
    return way.follow, way.still
