"""Fair times on a machine that is not idle."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax


class Spent(NamedTuple):
    """What one call took."""

    processor: float
    """Seconds of processors, all threads of the process together: what others do on the machine hardly changes it."""
    wall: float
    """Seconds until the result was there."""


def interleaved(functions: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of one call of each function, results awaited.

    Every function runs once before (compilation), then all of them once in every round, in alternating order: what
    slows the machine for a while slows all of them, and ratios between them hold.
    """
    if rounds < 1:
        raise ValueError(f"rounds must be at least 1; got {rounds}.")
    for function in functions.values():
        jax.block_until_ready(function())
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for i in range(rounds):
        for name in list(functions)[:: 1 if i % 2 == 0 else -1]:
            start = time.perf_counter()
            jax.block_until_ready(functions[name]())
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(times) for name, times in seconds.items()}


def spent(call: Callable[[], Any]) -> Spent:
    """What one call takes, its results awaited."""
    wall, processor = time.perf_counter(), time.process_time()
    jax.block_until_ready(call())
    return Spent(time.process_time() - processor, time.perf_counter() - wall)


def taking_turns(calls: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, list[Spent]]:
    """What each call took in each round, in alternating order; nothing is called before the first round.

    Raises:
        ValueError: If `rounds < 1`.
    """
    if rounds < 1:
        raise ValueError(f"rounds must be at least 1; got {rounds}.")
    found: dict[str, list[Spent]] = {name: [] for name in calls}
    for i in range(rounds):
        for name in list(calls)[:: 1 if i % 2 == 0 else -1]:
            found[name].append(spent(calls[name]))
    return found
