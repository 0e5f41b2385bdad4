"""Counts in a Gaussian filter: ten neurons with Poisson rates over six hidden states, against dynamax.

Both libraries use conditional moments of the counts, linearised at the predicted mean, on the same 500 counts; their
filtered means agree, or nothing is timed. `ratio_emissions_to_dynamax` is the median over rounds of processor times of
compiled programs, in turns, and `ratio_emissions_gradient_to_dynamax` that of the derivative of the log evidence.
`rmse_*` are errors of the filtered means: by this filter, by the Laplace approximation at the mode (`_laplace`), and by
a Kalman filter of the square roots of the counts with a noise of 1/4, what one would do first (`_square_root`).
"""

import statistics
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxfilters as jf
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.timing import spent, taking_turns

STATES, NEURONS, STEPS, QUICK_STEPS = 6, 10, 500, 40
ROUNDS, QUICK_ROUNDS = 25, 2
Q_VARIANCE = 0.02
AGREES = 5e-3
"""Of filtered means, in states of order one, in float32."""


class Problem(NamedTuple):
    """A rotating state, and counts whose log rates are linear in it."""

    F: Float[Array, "n n"]
    C: Float[Array, "m n"]
    offset: float
    truth: Float[Array, "t n"]
    counts: Float[Array, "t m"]

    def log_rate(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """Logarithms of the expected counts."""
        return self.C @ x + self.offset


def simulate(seed: int, steps: int) -> Problem:
    """Counts simulated with the model."""
    rng = np.random.default_rng(seed)
    F = 0.98 * np.linalg.qr(rng.normal(size=(STATES, STATES)))[0]
    C = rng.normal(size=(NEURONS, STATES)) / np.sqrt(STATES)
    x, truth, counts = rng.normal(size=STATES), [], []
    for _ in range(steps):
        x = F @ x + np.sqrt(Q_VARIANCE) * rng.normal(size=STATES)
        truth.append(x)
        counts.append(rng.poisson(np.exp(C @ x + 1.0)))
    array = lambda values: jnp.asarray(np.array(values), float)
    return Problem(array(F), array(C), 1.0, array(truth), array(counts))


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Check that both agree, then time them; `out` is not used."""
    del out
    problem, rounds = simulate(seed, QUICK_STEPS if quick else STEPS), QUICK_ROUNDS if quick else ROUNDS
    prior, Q, key = jf.Gaussian(jnp.zeros(STATES), jnp.eye(STATES)), Q_VARIANCE * jnp.eye(STATES), jax.random.key(0)

    def filter_of(scale: Array, **options: Any) -> jf.Filter:
        counted = jf.emissions.poisson(lambda x: scale * problem.log_rate(x))
        return jf.extended_kalman(prior, lambda x: problem.F @ x, Q, counted, **options)

    def means(scale: Array, counts: Array) -> Array:
        return jf.run(filter_of(scale), key, counts)[1][0].mean

    evidence = lambda scale, counts: jf.log_evidence(filter_of(scale), key, counts)
    programs = {"ours": jax.jit(means), "gradient_ours": jax.jit(jax.value_and_grad(evidence))}
    if find_spec("dynamax") is not None:
        programs["dynamax"] = jax.jit(lambda *arguments: _dynamax(problem, Q, *arguments).filtered_means)
        theirs = lambda *arguments: _dynamax(problem, Q, *arguments).marginal_loglik
        programs["gradient_dynamax"] = jax.jit(jax.value_and_grad(theirs))
    else:
        sys.stdout.write("not installed, and missing below: dynamax\n")
    one = jnp.ones(())
    calls = {name: (lambda program=program: program(one, problem.counts)) for name, program in programs.items()}
    if "dynamax" in calls:
        error = float(jnp.max(jnp.abs(calls["ours"]() - calls["dynamax"]())))
        if not error <= AGREES:
            raise RuntimeError(f"the filtered means of dynamax and ours differ by {error:.2g}.")
    return _errors(problem, calls["ours"](), prior, Q) | _times(calls, rounds)


def _dynamax(problem: Problem, Q: Array, scale: Array, counts: Array) -> Any:
    """Conditional moments filter of dynamax, which starts with an update: the prior is moved once before."""
    ssm = import_module("dynamax.generalized_gaussian_ssm")
    tfd = import_module("tensorflow_probability.substrates.jax.distributions")
    rate = lambda x: jnp.exp(scale * problem.log_rate(x))
    params = ssm.ParamsGGSSM(
        initial_mean=jnp.zeros(STATES),
        initial_covariance=problem.F @ problem.F.T + Q,
        dynamics_function=lambda x: problem.F @ x,
        dynamics_covariance=Q,
        emission_mean_function=rate,
        emission_cov_function=lambda x: jnp.diag(rate(x)),
        emission_dist=lambda mean, _: tfd.Poisson(rate=mean),
    )
    return ssm.conditional_moments_gaussian_filter(params, ssm.EKFIntegrals(), counts)


def _errors(problem: Problem, means: Array, prior: jf.Gaussian, Q: Array) -> dict[str, Metric]:
    key, move = jax.random.key(0), lambda x: problem.F @ x
    counted = jf.emissions.poisson(problem.log_rate)
    laplace = jf.extended_kalman(prior, move, Q, counted, iterations=5, iterate_to="mode")
    root = lambda x: jnp.exp(0.5 * problem.log_rate(x))
    first = jf.extended_kalman(prior, move, Q, root, 0.25 * jnp.eye(NEURONS))
    found = {
        "": means,
        "_laplace": jf.run(laplace, key, problem.counts)[1][0].mean,
        "_square_root": jf.run(first, key, jnp.sqrt(problem.counts))[1][0].mean,
    }
    rmse = lambda means: float(jnp.sqrt(jnp.mean(jnp.square(means - problem.truth))))
    return {f"rmse{name}": Metric(rmse(means), "", "lower") for name, means in found.items()}


def _times(calls: dict[str, Any], rounds: int) -> dict[str, Metric]:
    for call in calls.values():
        spent(call)
    times = {name: [one.processor for one in of] for name, of in taking_turns(calls, rounds).items()}
    found = {f"emissions_ms_{name}": Metric(1e3 * statistics.median(of), "ms", "lower") for name, of in times.items()}
    for ours, peer in (("ours", "dynamax"), ("gradient_ours", "gradient_dynamax")):
        if peer in times:
            ratios = [a / b for a, b in zip(times[ours], times[peer], strict=True)]
            name = "ratio_emissions_to_dynamax" if ours == "ours" else "ratio_emissions_gradient_to_dynamax"
            found[name] = Metric(statistics.median(ratios), "", "lower")
    return found
