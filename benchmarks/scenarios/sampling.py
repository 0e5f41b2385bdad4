"""Samplers of parameters against particles, smcx and blackjax: particle Gibbs, SMC^2, tempered SMC.

`gibbs`: sweeps of conditional SMC with backward sampling, 100 frames of a stochastic volatility model, 100 particles.
`smc2`: 50 frames, 100 parameters, 100 particles each, two moves at a time. `tempered`: a regression of three
coefficients, 1000 particles, ten moves a stage, stages by the effective sample size. The libraries do the same at
equal settings, so that a ratio per call is one per effective sample; they have to agree before anything is timed. They
take turns in every round, and a ratio is the median over the rounds of processor times. This library and blackjax are
compiled before; particles works in NumPy; smcx compiles in every call. Without a peer its ratios are missing: pip
install 'jaxfilters[peers,mcmc]'.
"""

import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxfilters as jf
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _sampling_peers as peers
from jaxfilters.benchmarks.scenarios._sampling_problems import (
    PRIOR_MEAN,
    PRIOR_SD,
    RHO,
    Sizes,
    filter_of,
    log_prior,
    regression,
    simulated,
)
from jaxfilters.benchmarks.timing import taking_turns
from jaxfilters.typing import AnyKey

SIZES = Sizes()
ROUNDS, QUICK_ROUNDS = 7, 3
OfSeed = Callable[[int], np.ndarray | float]


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Check that all agree, then time them; `out` is not used."""
    del out
    present = peers.installed()
    if absent := set(peers.PEERS) - set(present):
        sys.stdout.write(f"not installed, and missing below: {', '.join(sorted(absent))}\n")
    returns = simulated(seed, SIZES.num_frames)
    found: dict[str, Metric] = {}
    for task, calls in tasks(returns, SIZES, present).items():
        check(task, calls)
        found |= compared(task, calls, QUICK_ROUNDS if quick else ROUNDS)
    return found


def tasks(returns: Float[Array, " t"], sizes: Sizes, present: list[str]) -> dict[str, dict[str, OfSeed]]:
    """The calls of all libraries, by task."""
    found: dict[str, dict[str, OfSeed]] = {
        "gibbs": {"ours": gibbs(returns, sizes)},
        "smc2": {"ours": smc2(returns, sizes)},
        "tempered": {"ours": tempered(sizes)},
    }
    if "particles" in present:
        found["gibbs"]["particles"] = peers.gibbs_of_particles(returns, sizes)
        found["smc2"]["particles"] = peers.smc2_of_particles(returns, sizes)
    if "smcx" in present:
        found["smc2"]["smcx"] = peers.smc2_of_smcx(returns, sizes)
    if "blackjax" in present:
        found["tempered"]["blackjax"] = peers.tempered_of_blackjax(sizes)
    return found


def gibbs(returns: Float[Array, " t"], sizes: Sizes) -> OfSeed:
    """Sweeps of this library; the states of all frames, (sweeps, t)."""
    filter = filter_of(jnp.asarray(PRIOR_MEAN), sizes.num_states)
    scale = np.exp(PRIOR_MEAN)
    kernel = jf.mcmc.conditional_smc(
        filter,
        jf.mcmc.backward_sampling(lambda after, x: jax.scipy.stats.norm.logpdf(after[0], RHO * x[0], scale)),
    )
    path, _ = jf.mcmc.initial_path(jax.random.key(0), kernel, returns)

    @jax.jit
    def sweeps(key: AnyKey, path: Float[Array, "t_plus_1 1"]) -> Float[Array, "sweeps t"]:
        def sweep(path: Array, sweep_key: AnyKey) -> tuple[Array, Array]:
            path, _ = jf.mcmc.update_path(sweep_key, kernel, path, returns)
            return path, path[1:, 0]

        return jax.lax.scan(sweep, path, jax.random.split(key, sizes.num_sweeps))[1]

    return lambda seed: np.asarray(sweeps(jax.random.key(seed), path))


def smc2(returns: Float[Array, " t"], sizes: Sizes) -> OfSeed:
    """SMC^2 of this library; its log evidence."""
    frames = returns[: sizes.num_frames_nested]
    of = partial(filter_of, num_particles=sizes.num_states_nested)

    @jax.jit
    def log_evidence(key: AnyKey) -> Array:
        return jf.mcmc.smc2(
            key, of, lambda key: PRIOR_MEAN + PRIOR_SD * jax.random.normal(key), log_prior, frames,
            num_particles=sizes.num_parameters, num_moves=sizes.num_moves,
        ).log_evidence  # fmt: skip

    return lambda seed: float(log_evidence(jax.random.key(seed)))


def tempered(sizes: Sizes) -> OfSeed:
    """Tempered SMC of this library; its log evidence."""
    prior, log_likelihood, _ = regression()

    @jax.jit
    def log_evidence(key: AnyKey) -> Array:
        return jf.mcmc.tempered_smc(
            key, lambda key: jax.random.normal(key, (3,)), prior, log_likelihood,
            num_particles=sizes.num_tempered, num_moves=sizes.num_tempered_moves,
        ).log_evidence  # fmt: skip

    return lambda seed: float(log_evidence(jax.random.key(seed)))


def check(task: str, calls: Mapping[str, OfSeed]) -> None:
    """Refuse to time libraries that compute something else.

    Raises:
        RuntimeError: If a mean of three runs is further from that of eight runs of this library than five standard
            errors.
    """
    ours = np.array([np.mean(calls["ours"](seed)) for seed in range(8)])
    for name, call in calls.items():
        theirs = np.array([np.mean(call(seed)) for seed in range(3)])
        error = ours.std(ddof=1) * np.sqrt(1 / len(ours) + 1 / len(theirs))
        if not abs(theirs.mean() - ours.mean()) < 5 * error + 1e-6:
            raise RuntimeError(
                f"{task}: {name} finds {theirs.mean():.3f} where ours is {ours.mean():.3f}, +-{error:.3f}."
            )


def compared(task: str, calls: Mapping[str, OfSeed], rounds: int) -> dict[str, Metric]:
    """Milliseconds of one call of each library, and the ratios of processor times to those of the others."""
    spent = taking_turns({name: partial(call, 100) for name, call in calls.items()}, rounds)
    found = {
        f"{task}_ms_{name}": Metric(1e3 * float(np.median([s.processor for s in each])), "ms", "lower")
        for name, each in spent.items()
    }
    for name in set(calls) - {"ours"}:
        ratios = [a.processor / b.processor for a, b in zip(spent["ours"], spent[name], strict=True)]
        found[f"ratio_{task}_to_{name}"] = Metric(float(np.median(ratios)), "", "lower")
    return found
