"""Extended Kalman filters against dynamax, cuthbert and filterpy: time of a sequence, of its gradient, of many.

One sequence of 500 readings, 30 states and 20 sensors; 1000 sequences of 100 readings, 6 states and 3 sensors; and
50,000 readings of 4 states by an unscented filter, beside that of filterpy. All
libraries compute the log evidence of the same readings in float32 (filterpy in float64), compiled by the caller, and
have to agree before anything is timed. They take turns in every round, and a ratio is the median over the rounds.
`first_call_s_*` is what compilation costs; `repeat_call_ratio` compares a call of this library as it is used, without
a `jit` around it, with a compiled one. Without a peer its ratios are missing: pip install 'jaxfilters[peers]'.
"""

import statistics
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _gaussian_peers as peers
from jaxfilters.benchmarks.scenarios import _gaussian_unscented as unscented
from jaxfilters.benchmarks.scenarios._gaussian_models import Problem, build, coupled, ranging
from jaxfilters.filter import log_evidence as log_evidence_of
from jaxfilters.gaussian import arithmetic as arithmetics

NUM_STEPS, NUM_SHORT_STEPS = 500, 100
NUM_LONG_STEPS, QUICK_LONG_STEPS = 50_000, 2_000
BATCHES = (64, 1000)
ROUNDS, QUICK_ROUNDS = 25, 5
SLOW_ROUNDS = 5
ARITHMETICS = {"joseph": arithmetics.joseph, "fast": arithmetics.fast, "square_root": arithmetics.square_root}
Calls = dict[str, Callable[[], Any]]


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Check that all agree, then time them; `out` is not used."""
    del out
    rounds, present = QUICK_ROUNDS if quick else ROUNDS, peers.installed()
    absent = {"dynamax", "cuthbert", "filterpy"} - set(present)
    if absent:
        sys.stdout.write(f"not installed, and missing below: {', '.join(sorted(absent))}\n")
    jax.block_until_ready(jax.jit(jnp.sin)(1.0))
    metrics = _one_sequence(coupled(seed, num_steps=NUM_STEPS), present, rounds)
    for count in BATCHES[:1] if quick else BATCHES:
        metrics |= _many_sequences(ranging(seed, count, NUM_SHORT_STEPS), present, min(rounds, 2 * SLOW_ROUNDS + 1))
    return metrics | _long_sequence(seed, QUICK_LONG_STEPS if quick else NUM_LONG_STEPS, "filterpy" in present)


def _long_sequence(seed: int, num_steps: int, has_filterpy: bool) -> dict[str, Metric]:
    problem = unscented.walk(seed, num_steps)
    calls: Calls = {"ours": unscented.ours(problem)}
    if has_filterpy:
        short = unscented.walk(seed, NUM_STEPS)
        by_filterpy = unscented.filterpy(short, with_evidence=True)()
        check_agreement({"ours": unscented.ours(short)(), "filterpy": by_filterpy}, tolerance=1e-4)
        calls["filterpy"] = unscented.filterpy(problem, with_evidence=False)
    calls["ours"]()
    times = rounds_of(calls, SLOW_ROUNDS)
    metrics = {
        f"unscented_step_us_{name}": Metric(1e6 * _median(times[name]) / num_steps, "us", "lower") for name in calls
    }
    return metrics | ({"ratio_unscented_to_filterpy": ratio(times, "ours", "filterpy")} if has_filterpy else {})


def _one_sequence(problem: Problem, present: list[str], rounds: int) -> dict[str, Metric]:
    values, gradients = {}, {}
    for name, log_evidence in _log_evidences(problem, present).items():
        values[name] = partial(jax.jit(log_evidence), problem.model, problem.readings)
        gradients[name] = partial(jax.jit(jax.value_and_grad(log_evidence)), problem.model, problem.readings)
    filter = build(problem, problem.model, arithmetics.joseph)
    calls: Calls = {**values, "as_used": partial(log_evidence_of, filter, jax.random.key(0), problem.readings)}
    calls |= {f"gradient_{name}": gradients[name] for name in gradients if name in ("joseph", "square_root", "dynamax")}
    first = {name: _seconds(call) for name, call in calls.items()}
    slow = {"filterpy": peers.filterpy(problem)} if "filterpy" in present else {}
    once: Calls = {**values, **slow}
    check_agreement({name: call() for name, call in once.items()})
    times = rounds_of(calls, rounds)
    if slow:
        together = rounds_of({**slow, "joseph": values["joseph"]}, min(rounds, SLOW_ROUNDS))

    steps = len(problem.readings)
    metrics = {f"step_us_{name}": Metric(1e6 * _median(times[name]) / steps, "us", "lower") for name in values}
    pairs = {
        "ratio_to_dynamax": ("joseph", "dynamax"),
        "ratio_to_dynamax_fast": ("fast", "dynamax"),
        "ratio_to_cuthbert_square_root": ("square_root", "cuthbert"),
        "gradient_over_value": ("gradient_joseph", "joseph"),
        "gradient_over_value_square_root": ("gradient_square_root", "square_root"),
        "gradient_ratio_to_dynamax": ("gradient_joseph", "gradient_dynamax"),
        "repeat_call_ratio": ("as_used", "joseph"),
    }
    metrics |= {name: ratio(times, *pair) for name, pair in pairs.items() if set(pair) <= set(times)}
    if slow:
        metrics["ratio_to_filterpy"] = ratio(together, "joseph", "filterpy")
    return metrics | {f"first_call_s_{name}": Metric(value, "s", "lower") for name, value in first.items()}


def _many_sequences(problem: Problem, present: list[str], rounds: int) -> dict[str, Metric]:
    wanted = {"joseph", "fast", "dynamax"}
    calls: Calls = {}
    for name, log_evidence in _log_evidences(problem, present).items():
        if name in wanted:
            mapped = jax.jit(jax.vmap(log_evidence, in_axes=(None, -1)))
            calls[name] = partial(mapped, problem.model, problem.readings)
    count = problem.readings.shape[-1]
    first = {f"first_call_s_batched_{count}_{name}": _seconds(call) for name, call in calls.items()}
    check_agreement({name: call() for name, call in calls.items()})
    times = rounds_of(calls, rounds)
    steps = count * len(problem.readings)
    metrics = {f"step_us_batched_{count}": Metric(1e6 * _median(times["joseph"]) / steps, "us", "lower")}
    if "dynamax" in calls:
        metrics[f"ratio_batched_{count}"] = ratio(times, "joseph", "dynamax")
        metrics[f"ratio_batched_{count}_fast"] = ratio(times, "fast", "dynamax")
    return metrics | {name: Metric(value, "s", "lower") for name, value in first.items()}


def _log_evidences(problem: Problem, present: list[str]) -> dict[str, peers.LogEvidence]:
    """Functions of the model and the readings, this library's first."""
    found: dict[str, peers.LogEvidence] = {}
    for name, arithmetic in ARITHMETICS.items():
        found[name] = partial(_log_evidence, problem, arithmetic)
    if "dynamax" in present:
        found["dynamax"] = peers.dynamax(problem)
    if "cuthbert" in present:
        found["cuthbert"] = peers.cuthbert(problem)
    return found


def _log_evidence(problem, arithmetic, model, readings):
    return log_evidence_of(build(problem, model, arithmetic), jax.random.key(0), readings)


def check_agreement(log_evidences: Mapping[str, Array | float], tolerance: float = 1e-5) -> None:
    """Refuse to time libraries that compute something else.

    Raises:
        RuntimeError: If a log evidence is not the same number as the first one's to `tolerance` of its size. Of many
            sequences one in a hundred may differ: where linearisation is chaotic, rounding decides.
    """
    name, expected = next(iter(log_evidences.items()))
    reference = np.asarray(expected, np.float64)
    for other, found in log_evidences.items():
        error = np.quantile(abs(np.asarray(found, np.float64) - reference) / np.maximum(abs(reference), 100.0), 0.99)
        if not error <= tolerance:
            raise RuntimeError(f"the log evidences of {name} and {other} differ by {error:.2g} of their size.")


def rounds_of(calls: Calls, rounds: int) -> dict[str, list[float]]:
    """Seconds of each call in each round, results awaited, in alternating order."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for i in range(rounds):
        for name in list(calls)[:: 1 if i % 2 == 0 else -1]:
            seconds[name].append(_seconds(calls[name]))
    return seconds


def ratio(times: Mapping[str, list[float]], name: str, to: str) -> Metric:
    """Median of the ratios of the rounds: what slows the machine for a while slows both."""
    return Metric(_median([a / b for a, b in zip(times[name], times[to], strict=True)]), "", "lower")


def _seconds(call):
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def _median(values):
    return float(statistics.median(values))
