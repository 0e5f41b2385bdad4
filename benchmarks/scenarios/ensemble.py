"""Ensemble Kalman filters on the Lorenz-96 model: accuracy of the analyses, and time against cuthbert.

40 variables on a circle, forcing 8, observed every 0.05 time units (one Runge-Kutta step) with unit noise, without
process noise: the usual problem of the field (E. N. Lorenz and K. A. Emanuel, 1998). `rmse_*` is the root mean square
error of the analysed mean, over all variables and all steps after the first 200, of ensembles of 40. About 0.2 is
published for square-root filters that observe all variables (P. Sakov and P. R. Oke, Tellus 60A, 2008, figure 4);
without a filter it is 3.6, and the noise of the observations is 1. `_half`: every second variable is observed. `_10`:
10 samples, fewer than the model has growing directions, which only localised filters survive. `step_us_*` and
`ratio_to_cuthbert_*` are for filters with perturbed observations, of 40 and of 1000 samples, on a linear model of the
same size with process noise, whose transition costs little beside the filter; libraries take turns, and a ratio is the
median over rounds of processor times. Without cuthbert its ratios are missing.
"""

import statistics
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import jaxfilters as jf
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.timing import taking_turns
from jaxfilters.filter import Filter
from jaxfilters.gaussian.ensemble import EnsembleInfo, EnsembleState
from jaxfilters.typing import AnyKey

SIZE, FORCING, INTERVAL = 40, 8.0, 0.05
STEPS, QUICK_STEPS, SPIN_UP = 2000, 400, 200
COUNT, FEW, MANY = 40, 10, 1000
RADIUS = 20.0
ROUNDS, QUICK_ROUNDS, TIMED_STEPS = 15, 3, 100


class Problem(NamedTuple):
    """A course of the model, and what is observed of it."""

    truth: Float[Array, "t n"]
    readings: Float[Array, "t m"]
    every: int
    """Distance between variables that are observed."""


def move(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """The state 0.05 time units later, by one Runge-Kutta step."""
    rate = lambda x: (jnp.roll(x, -1) - jnp.roll(x, 2)) * jnp.roll(x, 1) - x + FORCING
    return jf.motion.rk4()(rate, x, jnp.asarray(INTERVAL, x.dtype))


def simulate(key: AnyKey, steps: int, every: int = 1) -> Problem:
    """A course from a state on the attractor, and readings of every so-manieth variable with unit noise."""
    start_key, noise_key = jax.random.split(key)

    @jax.jit
    def course(key: AnyKey) -> Array:
        start = FORCING + jax.random.normal(key, (SIZE,))
        return jax.lax.scan(lambda x, _: (move(x),) * 2, start, length=steps + 1000)[1][1000:]

    truth = course(start_key)
    noise = jax.random.normal(noise_key, (steps, SIZE // every))
    return Problem(truth, truth[:, ::every] + noise, every)


def build(problem: Problem, num_particles: int = COUNT, radius: float | None = None, **options) -> Filter:
    """An ensemble filter of the problem, which starts from the truth with unit noise; localised within `radius`."""
    points = jnp.arange(float(SIZE))[:, None]
    around = lambda a, b: jnp.minimum(jnp.abs(a - b), SIZE - jnp.abs(a - b))[0]
    if radius is not None:
        options["localization"] = jf.ensemble.localization(points, points[:: problem.every], radius, distance=around)
    R = jnp.eye(problem.readings.shape[1])
    prior = jf.priors.gaussian_prior(jf.Gaussian(problem.truth[0], jnp.eye(SIZE)))
    observe = lambda x: x[:: problem.every]
    # Nothing is random in the model; one number a sample is the least that a source draws.
    noise = jf.StandardNormal(1)
    transition = lambda _noise, x: move(x)
    return jf.ensemble_kalman(prior, transition, observe, R, num_particles=num_particles, noise=noise, **options)


def analysed(state: EnsembleState, info: EnsembleInfo) -> Array:
    """The mean of the samples."""
    del info
    return jnp.mean(state.particles, axis=1)


def rmse(filter: Filter, key: AnyKey, problem: Problem, spin_up: int) -> float:
    """Root mean square error of the analysed mean after the first steps."""
    # The belief before the first step is about the first state of the course, and the first reading of the next one.
    _, means = jf.run(filter, key, problem.readings[1:], collect=analysed)
    errors = (means - problem.truth[1:])[spin_up:]
    return float(jnp.sqrt(jnp.mean(jnp.square(errors))))


FILTERS: dict[str, tuple[int, dict]] = {
    "transform": (1, dict(analysis=jf.ensemble.transform, inflation=1.02)),
    "transform_relaxed": (1, dict(analysis=jf.ensemble.transform, relaxation=0.3)),
    "serial": (1, dict(analysis=jf.ensemble.serial, inflation=1.02, radius=RADIUS)),
    "perturbed": (1, dict(inflation=1.04, radius=RADIUS)),
    "transform_half": (2, dict(analysis=jf.ensemble.transform, inflation=1.02)),
    "serial_half": (2, dict(analysis=jf.ensemble.serial, inflation=1.02, radius=RADIUS)),
    "transform_local_10": (
        1,
        dict(analysis=jf.ensemble.transform, inflation=1.03, radius=RADIUS, num_particles=FEW),
    ),
    "serial_10": (1, dict(analysis=jf.ensemble.serial, inflation=1.03, radius=RADIUS, num_particles=FEW)),
}
"""Distance between observed variables, and the options of `build`."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Filter one course with every filter, then time; `out` is not used."""
    del out
    key, filter_key = jax.random.split(jax.random.key(seed))
    problems = {every: simulate(key, QUICK_STEPS if quick else STEPS, every) for every in (1, 2)}
    found = {}
    for name, (every, options) in FILTERS.items():
        error = rmse(build(problems[every], **options), filter_key, problems[every], SPIN_UP)
        found[f"rmse_{name}"] = Metric(error, "", "lower")
    for count in (COUNT, MANY):
        found |= timed(filter_key, simulate_linear(key, TIMED_STEPS), count, QUICK_ROUNDS if quick else ROUNDS)
    return found


def shift(noise: Float[Array, " n"], x: Float[Array, " n"]) -> Float[Array, " n"]:
    """A linear model: all variables move on by one place, decay and are driven by noise."""
    return 0.9 * jnp.roll(x, 1) + 0.4 * noise


def simulate_linear(key: AnyKey, steps: int) -> Problem:
    """A course of the linear model from zero, and readings of every variable with unit noise."""
    drive_key, noise_key = jax.random.split(key)
    drive = jax.random.normal(drive_key, (steps, SIZE))
    truth = jax.lax.scan(lambda x, noise: (shift(noise, x),) * 2, jnp.zeros(SIZE), drive)[1]
    return Problem(truth, truth + jax.random.normal(noise_key, truth.shape), 1)


def timed(key: AnyKey, problem: Problem, count: int, rounds: int) -> dict[str, Metric]:
    """Processor time of a step of so many samples, and its ratio to that of cuthbert, which keeps the same results.

    Raises:
        RuntimeError: If the two libraries follow the course differently well.
    """
    prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(SIZE), jnp.eye(SIZE)))
    filter = jf.ensemble_kalman(
        prior, shift, lambda x: x, jnp.eye(SIZE), num_particles=count, noise=jf.StandardNormal(SIZE)
    )
    follow = jax.jit(lambda filter, readings: jf.run(filter, key, readings, collect=analysed)[1])
    calls: dict[str, Callable[[], Array]] = {"ours": partial(follow, filter, problem.readings)}
    if find_spec("cuthbert") is not None:
        calls["cuthbert"] = _cuthbert(problem, count, key)
    else:
        sys.stdout.write("not installed, and missing below: cuthbert\n")
    errors = [float(jnp.sqrt(jnp.mean(jnp.square(call() - problem.truth)))) for call in calls.values()]
    if max(errors) > 1.1 * min(errors):
        raise RuntimeError(f"the libraries follow the same course with different errors: {errors}.")
    times = {name: [spent.processor for spent in spents] for name, spents in taking_turns(calls, rounds).items()}
    steps = len(problem.readings)
    found = {f"step_us_{count}": Metric(1e6 * statistics.median(times["ours"]) / steps, "us", "lower")}
    if "cuthbert" in times:
        ratios = [ours / peer for ours, peer in zip(times["ours"], times["cuthbert"], strict=True)]
        found[f"ratio_to_cuthbert_{count}"] = Metric(statistics.median(ratios), "", "lower")
    return found


def _cuthbert(problem: Problem, count: int, key: AnyKey) -> Callable[[], Array]:
    """The means by the ensemble filter of cuthbert with perturbed observations."""
    library = import_module("cuthbert")
    module = import_module("cuthbert.ensemble_kalman.ensemble_kalman_filter")
    root = jnp.eye(SIZE)
    filtering = module.build_filter(
        lambda key: jax.random.normal(key, (SIZE,)),
        lambda _: lambda x, key: shift(jax.random.normal(key, x.shape), x),
        lambda reading: (lambda x: x, root, reading),
        count,
    )

    @jax.jit
    def means(readings: Array) -> Array:
        start, rest = jax.random.split(key)
        states = library.filter(filtering, readings, filtering.init_prepare(key=start), key=rest)
        return jnp.mean(states.ensemble, axis=1)[1:]

    return partial(means, problem.readings)
