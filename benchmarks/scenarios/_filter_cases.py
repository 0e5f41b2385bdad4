"""What `bench filters` measures: each task checks that all libraries agree, then lets them take turns.

A task returns its metrics; a ratio is the median over the rounds of this library's time to another's.
"""

import statistics
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _filter_baselines as baselines
from jaxfilters.benchmarks.scenarios import _filter_models as models
from jaxfilters.benchmarks.scenarios import _filter_peers as peers
from jaxfilters.benchmarks.scenarios import _gaussian_peers as gaussian_peers
from jaxfilters.benchmarks.scenarios import _hmm_peers as hmm_peers
from jaxfilters.benchmarks.scenarios import hmm
from jaxfilters.benchmarks.scenarios._gaussian_models import Problem, build, coupled, ranging
from jaxfilters.benchmarks.scenarios.gaussian import check_agreement
from jaxfilters.benchmarks.timing import Spent, spent, taking_turns
from jaxfilters.filter import log_evidence as log_evidence_of
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian import smoothing
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.gaussian.linear import kalman
from jaxfilters.gaussian.linearize import unscented
from jaxfilters.particle.resampling import systematic

Calls = dict[str, Callable[[], Any]]
Metrics = dict[str, Metric]
AGREE = 4.0
"""Standard errors by which the mean log evidences of particle filters may differ."""


class Setting(NamedTuple):
    """How to measure."""

    peers: list[str]
    rounds: int
    seed: int
    scale: float
    clock: str
    """`processor` or `wall`: which of the two the ratios are of."""

    def size(self, full: int, least: int = 2) -> int:
        """A size of the problem."""
        return max(least, round(full * self.scale))


def gaussian(setting: Setting) -> Metrics:
    """One long sequence of 30 states and 20 sensors: KF, EKF, UKF, RTS smoothers, gradient, call without `jit`."""
    problem = coupled(setting.seed, num_steps=setting.size(500))
    found = _extended(setting, problem)
    found |= _pair(setting, "kf", problem, _linear_log_evidence, peers.dynamax_linear)
    unscented_peer = lambda problem: peers.dynamax_unscented(problem, _unscented(problem, problem.model))
    found |= _pair(setting, "kf_rts", problem, _linear_smoothed_means, peers.dynamax_linear_smoother)
    found |= _pair(setting, "ukf", problem, _unscented_log_evidence, unscented_peer)
    return found | _pair(setting, "rts", problem, _smoothed_means, peers.dynamax_smoother)


def batched(setting: Setting) -> Metrics:
    """1000 sequences of 100 readings, 6 states and 3 sensors."""
    problem = ranging(setting.seed, setting.size(1000), setting.size(100))
    calls: Calls = {}
    for name, log_evidence in _extended_log_evidences(setting, problem, ("joseph",)).items():
        if name in ("joseph", "dynamax"):
            mapped = jax.jit(jax.vmap(log_evidence, in_axes=(None, -1)))
            calls[name] = partial(mapped, problem.model, problem.readings)
    check_agreement({name: call() for name, call in calls.items()})
    times = _turns(setting, calls)
    return _ratios(setting, times, {"ratio_ekf_batched_1000_to_dynamax": ("joseph", "dynamax")}) | _milliseconds(
        "ekf_batched_1000", times
    )


def particle(setting: Setting, num_particles: str, num_steps: str) -> Metrics:
    """The bootstrap filter of a state of ten numbers, resampling in every step."""
    count, full = setting.size(int(num_particles), 64), int(num_particles)
    problem = models.drift(setting.seed, setting.size(int(num_steps)))
    run = jax.jit(log_evidence_of)
    ours = partial(run, models.plain(problem.model, count))
    evidences: dict[str, peers.OfKey] = {"ours": lambda key: ours(key, problem.readings)}
    # cuthbert keeps the particles of every step.
    wanted = [name for name in ("smcx", "particles", "cuthbert") if name in setting.peers]
    for name in wanted[:3] if full <= 10_000 else [name for name in wanted if name != "cuthbert"]:
        evidences[name] = getattr(peers, name)(problem, count)
    _check_particles(evidences, 4 if full > 100_000 else 8)
    calls: Calls = {name: partial(of, jax.random.key(setting.seed)) for name, of in evidences.items()}
    times = _turns(setting, calls, most=5 if full > 10_000 else None)
    found = _ratios(setting, times, {f"ratio_pf_n{full}_to_{name}": ("ours", name) for name in wanted})
    step = statistics.median(one.processor for one in times["ours"]) / (count * len(problem.readings))
    found[f"pf_n{full}_ns_per_particle_step"] = Metric(1e9 * step, "ns", "lower")
    return found | _milliseconds(f"pf_n{full}", times)


def marginal(setting: Setting) -> Metrics:
    """Rao-Blackwellized filters against `vmap` of LAPACK: 1 + 3 states, and 3 + 6."""
    found: Metrics = {}
    for suffix, size, linear_size, num_particles in (("", 1, 3, 1000), ("_wide", 3, 6, 2000)):
        problem = models.mixed(setting.seed, size, linear_size, setting.size(100))
        count = setting.size(num_particles, 64)
        run = jax.jit(log_evidence_of)
        evidences: dict[str, peers.OfKey] = {
            name: partial(_of_key, run, models.marginalised(problem.model, count, shared=shared), problem.readings)
            for name, shared in (("own", False), ("shared", True))
        }
        first = jax.jit(partial(baselines.rao_blackwell, problem.model, num_particles=count))
        evidences["vmap"] = partial(_with_readings, first, problem.readings)
        _check_particles(evidences, 8)
        times = _turns(setting, {name: partial(of, jax.random.key(0)) for name, of in evidences.items()})
        pairs = {f"ratio_rbpf_{name}_to_vmap{suffix}": (name, "vmap") for name in ("own", "shared")}
        found |= _ratios(setting, times, pairs) | _milliseconds(f"rbpf{suffix}", times)
    return found


def resampler(setting: Setting) -> Metrics:
    """Systematic ancestors against a running sum and a search, and against exact arithmetic."""
    found: Metrics = {}
    for name, full in (("n1e3", 1000), ("n1e6", 1_000_000)):
        count = setting.size(full, 1000)
        # So many in one program that the call of it does not count.
        keys = jax.random.split(jax.random.key(setting.seed), max(1, 200_000 // count))
        log_weights = jax.random.normal(jax.random.key(1), (count,))
        schemes = {"ours": systematic, "searchsorted": baselines.searched}
        calls: Calls = {
            of: partial(jax.jit(partial(_in_turn, scheme)), keys, log_weights) for of, scheme in schemes.items()
        }
        wrong = {of: _mismatch(call()[0], keys[0], log_weights) for of, call in calls.items()}
        if not max(wrong.values()) < 0.1:
            raise RuntimeError(f"ancestors are not those of exact arithmetic: {wrong}.")
        times = _turns(setting, calls)
        found |= _ratios(setting, times, {f"ratio_resampler_{name}_to_searchsorted": ("ours", "searchsorted")})
        found |= {f"resampler_{name}_mismatch_{of}": Metric(value, "", "lower") for of, value in wrong.items()}
    return found


def hidden_markov(setting: Setting) -> Metrics:
    """Forward pass and Viterbi path of 1000 sequences of 100 symbols, 8 states."""
    model = hmm.random_model(setting.seed)
    codes = hmm.draw(setting.seed, model, setting.size(1000))
    libraries = {"ours": hmm.ours(model, codes, codes[:2], 1)}
    if "dynamax" in setting.peers:
        libraries["dynamax"] = hmm_peers.dynamax(model, codes, codes[:2], 1)
    forward = {name: of.forward for name, of in libraries.items() if of.forward}
    check_agreement({name: call() for name, call in forward.items()})
    best = {"ours": libraries["ours"].viterbi().log_probability.sum()}
    if "dynamax" in libraries:
        best["dynamax"] = hmm.sum_of_paths(model, codes, libraries["dynamax"].viterbi())
    check_agreement(best)
    found: Metrics = {}
    for name, calls in (("forward", forward), ("viterbi", {name: of.viterbi for name, of in libraries.items()})):
        times = _turns(setting, calls)
        found |= _ratios(setting, times, {f"ratio_hmm_{name}_to_dynamax": ("ours", "dynamax")})
        found |= _milliseconds(f"hmm_{name}", times)
    return found


def first_call(setting: Setting, what: str, library: str) -> Metrics:
    """What the first call costs in a fresh process, compilation included; `what` is `ekf`, `gradient` or `pf`."""
    # The first factorisation makes JAX import SciPy's LAPACK, a tenth of a second that belongs to no filter: some
    # libraries import it with themselves.
    jax.block_until_ready(jax.jit(jnp.linalg.cholesky)(jnp.eye(2)))
    if what == "pf":
        drift = models.drift(setting.seed, setting.size(200))
        filter = models.plain(drift.model, 1000)
        ours: peers.OfKey = lambda key: log_evidence_of(filter, key, drift.readings)
        of_key = ours if library == "ours" else getattr(peers, library)(drift, 1000)
        call: Callable[[], Any] = partial(of_key, jax.random.key(0))
    else:
        problem = coupled(setting.seed, num_steps=setting.size(500))
        name = "joseph" if library == "ours" else library
        log_evidence = _extended_log_evidences(setting, problem, ("joseph",))[name]
        function = log_evidence if what == "ekf" else jax.value_and_grad(log_evidence)
        call = partial(jax.jit(function), problem.model, problem.readings)
    return {f"first_call_s_{what}_{library}": Metric(spent(call).processor, "s", "lower")}


def _extended(setting: Setting, problem: Problem) -> Metrics:
    found = _extended_log_evidences(setting, problem, ("joseph", "fast", "square_root"))
    arguments = (problem.model, problem.readings)
    calls: Calls = {name: partial(jax.jit(of), *arguments) for name, of in found.items()}
    check_agreement({name: call() for name, call in calls.items()})
    # Without a `jit` around it.
    filter = build(problem, problem.model, arithmetics.joseph)
    calls["as_used"] = partial(log_evidence_of, filter, jax.random.key(0), problem.readings)
    for name in ("joseph", "dynamax"):
        if name in found:
            calls[f"gradient_{name}"] = partial(jax.jit(jax.value_and_grad(found[name])), *arguments)
    times = _turns(setting, calls)
    pairs = {
        "ratio_ekf_to_dynamax": ("joseph", "dynamax"),
        "ratio_ekf_fast_to_dynamax": ("fast", "dynamax"),
        "ratio_ekf_square_root_to_cuthbert": ("square_root", "cuthbert"),
        "ratio_gradient_over_value": ("gradient_joseph", "joseph"),
        "ratio_gradient_to_dynamax": ("gradient_joseph", "gradient_dynamax"),
        "repeat_call_ratio": ("as_used", "joseph"),
    }
    return _ratios(setting, times, pairs) | _milliseconds("ekf", times)


def _pair(setting, name, problem, ours, peer) -> Metrics:
    """One computation by this library and by dynamax."""
    arguments = (problem.model, problem.readings)
    calls: Calls = {"ours": partial(jax.jit(partial(ours, problem)), *arguments)}
    if "dynamax" in setting.peers:
        calls["dynamax"] = partial(jax.jit(peer(problem)), *arguments)
    check_agreement({name: call() for name, call in calls.items()})
    times = _turns(setting, calls)
    return _ratios(setting, times, {f"ratio_{name}_to_dynamax": ("ours", "dynamax")}) | _milliseconds(name, times)


def _extended_log_evidences(setting, problem, names):
    found = {name: partial(_extended_log_evidence, problem, getattr(arithmetics, name)) for name in names}
    for name in ("dynamax", "cuthbert"):
        if name in setting.peers:
            found[name] = getattr(gaussian_peers, name)(problem)
    return found


def _extended_log_evidence(problem, arithmetic, model, readings):
    return log_evidence_of(build(problem, model, arithmetic), jax.random.key(0), readings)


def _linear_log_evidence(problem, model, readings):
    Q, R = _noises(problem)
    return log_evidence_of(kalman(problem.start, model.A, Q, model.C, R), jax.random.key(0), readings)


def _linear_smoothed_means(problem, model, readings):
    Q, R = _noises(problem)
    filter = kalman(problem.start, model.A, Q, model.C, R)
    return smoothing.filter_and_smooth(filter, jax.random.key(0), readings)[0].mean


def _unscented_log_evidence(problem, model, readings):
    return log_evidence_of(_unscented(problem, model), jax.random.key(0), readings)


def _unscented(problem, model):
    Q, R = _noises(problem)
    return extended_kalman(problem.start, model.move, Q, model.observe, R, linearize=unscented())


def _smoothed_means(problem, model, readings):
    return smoothing.filter_and_smooth(build(problem, model, arithmetics.joseph), jax.random.key(0), readings)[0].mean


def _noises(problem):
    size, count = problem.start.mean.size, problem.readings.shape[1]
    return problem.process_variance * jnp.eye(size), problem.reading_variance * jnp.eye(count)


def _in_turn(scheme, keys, log_weights):
    return jax.lax.map(lambda key: scheme(key, log_weights), keys)


def _of_key(run, filter, readings, key):
    return run(filter, key, readings)


def _with_readings(run, readings, key):
    return run(key, readings)


def _check_particles(evidences: Mapping[str, peers.OfKey], num_keys: int) -> None:
    """Refuse to time particle filters whose mean log evidences differ by more than chance.

    Raises:
        RuntimeError: If one differs from the first by more than `AGREE` standard errors.
    """
    found = {
        name: np.array([float(of(jax.random.key(100 + i))) for i in range(num_keys)]) for name, of in evidences.items()
    }
    name, reference = next(iter(found.items()))
    for other, values in found.items():
        error = np.sqrt((values.var(ddof=1) + reference.var(ddof=1)) / num_keys)
        apart = abs(values.mean() - reference.mean())
        if not apart <= AGREE * error + 1e-3 * abs(reference.mean()):
            raise RuntimeError(f"the mean log evidences of {name} and {other} differ by {apart:.3g} +- {error:.2g}.")


def _mismatch(ancestors, key, log_weights) -> float:
    """Share of ancestors that differ from those of float64."""
    w = np.exp(np.asarray(log_weights, np.float64))
    running = np.cumsum(w)
    offset = float(jax.random.uniform(key, (), log_weights.dtype))
    grid = (np.arange(w.size) + offset) / w.size * running[-1]
    return float(np.mean(np.asarray(ancestors) != np.searchsorted(running, grid, side="right")))


def _turns(setting: Setting, calls: Calls, most: int | None = None) -> dict[str, list[Spent]]:
    for call in calls.values():
        jax.block_until_ready(call())
    sys.stderr.write(".")
    sys.stderr.flush()
    return taking_turns(calls, min(setting.rounds, most or setting.rounds))


def _ratios(setting: Setting, times: Mapping[str, list[Spent]], pairs: Mapping[str, tuple[str, str]]) -> Metrics:
    """Medians of the ratios of the rounds, where both were there."""
    found = {}
    for metric, (name, to) in pairs.items():
        if name in times and to in times:
            of_rounds = [
                getattr(a, setting.clock) / getattr(b, setting.clock)
                for a, b in zip(times[name], times[to], strict=True)
            ]
            found[metric] = Metric(float(statistics.median(of_rounds)), "", "lower")
    return found


def _milliseconds(what: str, times: Mapping[str, list[Spent]]) -> Metrics:
    """Median milliseconds of one call: of processors, and until it was there."""
    found = {}
    for name, of in times.items():
        for clock, unit in (("processor", "ms of processors"), ("wall", "ms")):
            median = statistics.median(getattr(one, clock) for one in of)
            found[f"{what}_{clock}_ms_{name}"] = Metric(1e3 * median, unit, "lower")
    return found
