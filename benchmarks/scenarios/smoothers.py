"""Smoothers against dynamax, cuthbert and particles: in parallel, samples, expectation-maximisation, backward sampling.

A linear Gaussian model of 4 states and 2 sensors: filter and smoother in logarithmic depth (128 frames), 100 joint
samples of all states, and 5 iterations of expectation-maximisation (512 frames each). A particle filter of 1000
particles and 50 frames: 1000 trajectories by backward sampling, from all weights and by rejection. All libraries find
the same numbers (sampled means within 8 standard errors), or nothing is timed. They take turns in every round; a ratio
is the median over the rounds of processor times. Without a peer its ratios are missing: `jaxfilters[peers]`.
"""

import statistics
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxfilters as jf
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _smoother_peers as peers
from jaxfilters.benchmarks.scenarios._smoother_peers import Linear
from jaxfilters.benchmarks.timing import taking_turns

ROUNDS, QUICK_ROUNDS = 15, 3
NUM_SAMPLES, NUM_ITERATIONS = 100, 5
Calls = dict[str, Callable[[], Any]]


class Sizes(NamedTuple):
    """Sizes of the problems."""

    num_frames: int = 512
    num_parallel_frames: int = 128
    """The programs of other libraries take minutes to compile for more."""
    num_particles: int = 1000
    num_particle_frames: int = 50


def run(*, quick: bool, seed: int, out: Path | None, sizes: Sizes | None = None) -> dict[str, Metric]:
    """Check that all agree, then time them; `out` is not used."""
    del out
    sizes = Sizes() if sizes is None else sizes
    present, rounds = peers.installed(), QUICK_ROUNDS if quick else ROUNDS
    absent = set(peers.PEERS) - set(present)
    if absent:
        sys.stdout.write(f"not installed, and missing below: {', '.join(sorted(absent))}\n")
    problem, short = (peers.linear(seed, count) for count in (sizes.num_frames, sizes.num_parallel_frames))
    tasks = {
        "parallel_smoother": (_parallel(short, present), 2e-3),
        "posterior_samples": (_samples(problem, present), None),
        "em": (_em(problem, present), 5e-2),
        "backward_sampling": (_backward(seed, sizes, present), None),
    }
    metrics: dict[str, Metric] = {}
    for name, (calls, tolerance) in tasks.items():
        check_agreement(name, {of: np.asarray(call(), float) for of, call in calls.items()}, tolerance)
        metrics |= _timed(name, calls, rounds)
    return metrics


def _timed(name: str, calls: Calls, rounds: int) -> dict[str, Metric]:
    times = {of: [each.processor for each in spent] for of, spent in taking_turns(calls, rounds).items()}
    found = {f"{name}_ms_{of}": Metric(1e3 * statistics.median(values), "ms", "lower") for of, values in times.items()}
    ours = [of for of in times if of.startswith("ours")]
    for mine in ours:
        for peer in times.keys() - set(ours):
            ratio = statistics.median(a / b for a, b in zip(times[mine], times[peer], strict=True))
            found[f"ratio_{name}{mine.removeprefix('ours')}_to_{peer}"] = Metric(ratio, "", "lower")
    return found


def check_agreement(name: str, results: Mapping[str, np.ndarray], tolerance: float | None) -> None:
    """Refuse to time libraries that compute something else.

    Args:
        name: What they compute.
        results: By library: arrays of one shape; or samples along the last axis, whose means are compared.
        tolerance: Largest difference; `None` for samples, whose means may differ by 8 standard errors of
            independent samples: trajectories share the particles of one filter.

    Raises:
        RuntimeError: If results differ.
    """
    (first, expected), *others = results.items()
    for other, found in others:
        if tolerance is None:
            error = abs(found.mean(-1) - expected.mean(-1))
            limit = 8 * np.sqrt((found.var(-1) + expected.var(-1)) / expected.shape[-1])
        else:
            error, limit = abs(found - expected), np.full(expected.shape, tolerance)
        if not (error <= limit).all():
            raise RuntimeError(f"{name}: {first} and {other} differ by {(error - limit).max():.2g} more than they may.")


def _parallel(problem: Linear, present: list[str]) -> Calls:
    """Smoothed means in logarithmic depth."""
    root = jnp.linalg.cholesky
    model = jf.smoothing.LinearModel(problem.F, root(problem.Q), problem.H, root(problem.R))
    prior = jf.GaussianRoot(problem.prior.mean, root(problem.prior.covariance))

    @jax.jit
    def means(readings: Array) -> Array:
        beliefs, _ = jf.smoothing.parallel_kalman(prior, model, readings)
        return jf.smoothing.parallel_rts(beliefs, model).mean

    calls: Calls = {"ours": lambda: means(problem.readings)}
    if "dynamax" in present:
        calls["dynamax"] = peers.dynamax_parallel(problem)
    if "cuthbert" in present:
        calls["cuthbert"] = peers.cuthbert_parallel(problem)
    return calls


def _samples(problem: Linear, present: list[str]) -> Calls:
    """Samples (t, n, count) from the readings."""
    filter = jf.kalman(problem.prior, problem.F, problem.Q, problem.H, problem.R)

    @jax.jit
    def samples(key: Array, readings: Array) -> Array:
        _, (beliefs, _) = jf.run(filter, key, readings)
        return jf.smoothing.posterior_samples(filter, key, beliefs, num_samples=NUM_SAMPLES)

    calls: Calls = {"ours": lambda: samples(jax.random.key(0), problem.readings)}
    if "dynamax" in present:
        calls["dynamax"] = peers.dynamax_samples(problem, NUM_SAMPLES)
    return calls


def _em(problem: Linear, present: list[str]) -> Calls:
    """Observation noise after some iterations; all matrices are estimated."""
    filter = jf.kalman(problem.prior, 0.8 * problem.F, 2 * problem.Q, problem.H, 2 * problem.R)

    # Not within a `jit`: whether readings are complete is found out before, as users have it.
    def call() -> Array:
        return jf.fit.em(
            filter, jax.random.key(0), problem.readings[..., None], max_iterations=NUM_ITERATIONS, tolerance=-1.0
        ).fitted.params.R

    calls: Calls = {"ours": call}
    if "dynamax" in present:
        calls["dynamax"] = peers.dynamax_em(problem, NUM_ITERATIONS)
    return calls


def _backward(seed: int, sizes: Sizes, present: list[str]) -> Calls:
    """Trajectories (t, count) from the history of a particle filter."""
    walk = peers.walk(seed, sizes.num_particle_frames)
    count = sizes.num_particles
    pf = jf.bootstrap(
        lambda key: jax.random.normal(key),
        lambda noise, x: walk.rate * x + walk.process_std * noise[0],
        lambda x, y: jax.scipy.stats.norm.logpdf(y, x, walk.noise_std),
        num_particles=count,
        noise=jf.StandardNormal(1),
    )
    density = lambda x_next, x: jax.scipy.stats.norm.logpdf(x_next, walk.rate * x, walk.process_std)
    _, history = jf.run(pf, jax.random.key(seed), jnp.asarray(walk.readings), collect=jf.smoothing.keep_history)
    bound = float(jax.scipy.stats.norm.logpdf(0.0, 0.0, walk.process_std))
    key = jax.random.key(seed + 1)
    sample = jf.smoothing.backward_sampling
    calls: Calls = {
        "ours": lambda: sample(key, history, density, num_paths=count),
        "ours_rejection": lambda: sample(key, history, density, num_paths=count, log_bound=bound),
    }
    if "particles" in present:
        calls |= peers.particles_backward(walk, count, seed)
    return calls
