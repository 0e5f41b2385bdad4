"""The computations whose cost `bench cost` models: their programs by size, and the terms that the cost is a sum of."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters.benchmarks.scenarios import _filter_models as models
from jaxfilters.benchmarks.scenarios import hmm, render
from jaxfilters.benchmarks.scenarios._accelerator_tasks import Work
from jaxfilters.benchmarks.scenarios._gaussian_models import build, coupled, ranging
from jaxfilters.filter import log_evidence
from jaxfilters.gaussian import arithmetic
from jaxfilters.hmm import HiddenMarkovModel
from jaxfilters.hmm import log_evidence as log_evidence_of_chains
from jaxfilters.models.hand.mesh import hand_mesh
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.priors import from_noise

Size = tuple[int, ...]
Terms = dict[str, tuple[int, ...]]
"""By name: the powers of the numbers of a size whose product is the term."""
PARTICLE_STEPS, TRACK_STEPS, LONG_STEPS = 4, 20, 50
WINDOW = 256
"""Pixels of a side of the image of a hand, of which every second, third or fourth is kept."""


class Family(NamedTuple):
    """One kind of computation."""

    work: Callable[[int, Size], Work]
    """Program of a seed and a size; the cost is that of one of its steps, of which it says the number."""
    terms: Terms
    """The cost of a step is a sum of these, each with a constant of at least 0."""
    fitted: tuple[Size, ...]
    """Sizes whose costs determine the constants."""
    held_out: tuple[Size, ...]
    """Sizes whose costs are predicted: one between the others, one beyond them."""
    quick: tuple[tuple[Size, ...], tuple[Size, ...]]
    """The same, for a moment."""


def _bootstrap(seed: int, size: Size) -> Work:
    """A random walk of `d` coordinates whose first is observed, with `n` particles and resampling in every step."""
    n, d = size
    readings = jnp.asarray(np.random.default_rng(seed).normal(size=PARTICLE_STEPS), float)
    noise = StandardNormal(d)
    filter = bootstrap(from_noise(_same, noise), _walk, _near, num_particles=n, noise=noise, ess_threshold=1.0)
    return Work(partial(log_evidence, filter, jax.random.key(seed)), (readings,), PARTICLE_STEPS)


def _same(noise: Array) -> Array:
    return noise


def _walk(noise: Array, x: Array, inputs: None = None) -> Array:
    del inputs
    return x + 0.1 * noise


def _near(x: Array, y: Array) -> Array:
    return -2.0 * (y - x[0]) ** 2


def _rao_blackwell(seed: int, size: Size, *, shared: bool) -> Work:
    n, linear = size
    problem = models.mixed(seed, 3, linear, PARTICLE_STEPS)
    filter = models.marginalised(problem.model, n, shared=shared)
    return Work(partial(log_evidence, filter, jax.random.key(seed)), (problem.readings,), PARTICLE_STEPS)


def _extended(seed: int, size: Size) -> Work:
    """An extended Kalman filter of `d` states and two thirds as many readings."""
    (d,) = size
    problem = coupled(seed, d, 2 * d // 3, LONG_STEPS)
    filter = build(problem, problem.model, arithmetic.joseph)
    return Work(partial(log_evidence, filter, jax.random.key(seed)), (problem.readings,), LONG_STEPS)


def _tracks(seed: int, size: Size) -> Work:
    """Extended Kalman filters of `b` tracks, six states and three distances."""
    problem, key = ranging(seed, size[0], TRACK_STEPS), jax.random.key(seed)
    filter = build(problem, problem.model, arithmetic.joseph)
    every = jax.vmap(lambda y: log_evidence(filter, key, y), in_axes=-1)
    return Work(every, (problem.readings,), TRACK_STEPS)


def _hidden_markov(seed: int, size: Size) -> Work:
    """Forward recursions of `b` sequences of 8 states."""
    model = hmm.random_model(seed)
    codes = hmm.draw(seed, model, size[0])
    scores = jax.vmap(HiddenMarkovModel.log_likelihoods, (None, -1), -1)(model, jnp.asarray(codes.T))
    return Work(log_evidence_of_chains, (model, scores), codes.shape[1])


def _depth(seed: int, size: Size) -> Work:
    """The cost of a depth image of so many pixels a side under `p` poses of a hand."""
    p, side = size
    camera, cloud = render.window_camera(WINDOW, WINDOW // side), render.cloud(seed, p, hand_mesh(render.GEOMETRY))
    observed = render_capsules(camera, jax.tree.map(lambda leaf: leaf[..., 0], cloud.capsules))
    one = lambda shape, y: render.compare_hand_capsules(camera, shape, y).absolute_sum
    return Work(jax.vmap(one, in_axes=(-1, None)), (cloud.capsules, observed))


# At most eight linear states: beyond, the filters use another program, with LAPACK and constants of its own.
_PARTICLES: Terms = {"step": (0, 0), "n": (1, 0)}
FAMILIES = {
    "bootstrap": Family(
        _bootstrap,
        _PARTICLES | {"n_d": (1, 1)},
        ((20_000, 4), (20_000, 16), (100_000, 4), (100_000, 16), (400_000, 4), (400_000, 16)),
        ((200_000, 8), (1_000_000, 10)),
        (((500, 2), (500, 4), (1000, 3)), ((700, 3),)),
    ),
    "rao_blackwell": Family(
        partial(_rao_blackwell, shared=False),
        _PARTICLES | {"n_l2": (1, 2), "n_l3": (1, 3)},
        ((1000, 3), (1000, 6), (1000, 8), (4000, 3), (4000, 6), (4000, 8)),
        ((2000, 5), (10_000, 7)),
        (((50, 3), (100, 3)), ((70, 3),)),
    ),
    "rao_blackwell_shared": Family(
        partial(_rao_blackwell, shared=True),
        _PARTICLES | {"n_l": (1, 1)},
        ((5000, 3), (5000, 8), (20_000, 3), (20_000, 8)),
        ((10_000, 6), (50_000, 7)),
        (((50, 3), (100, 3)), ((70, 3),)),
    ),
    "extended": Family(
        _extended,
        {"step": (0,), "d2": (2,), "d3": (3,)},
        ((12,), (24,), (48,), (72,)),
        ((36,), (96,)),
        (((9,), (12,)), ((10,),)),
    ),
    "tracks": Family(
        _tracks,
        {"step": (0,), "b": (1,)},
        ((100,), (1000,), (10_000,)),
        ((3000,), (30_000,)),
        (((10,), (20,)), ((15,),)),
    ),
    "hidden_markov": Family(
        _hidden_markov,
        {"step": (0,), "b": (1,)},
        ((100,), (1000,), (4000,)),
        ((2000,), (10_000,)),
        (((10,), (20,)), ((15,),)),
    ),
    "depth": Family(
        _depth,
        {"image": (0, 0), "p": (1, 0), "p_pixel": (1, 2)},
        ((64, 128), (64, 64), (256, 128), (256, 64)),
        ((128, 85), (512, 128)),
        (((2, 64), (4, 64)), ((3, 64),)),
    ),
}
