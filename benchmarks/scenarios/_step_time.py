"""Time of one frame of the plain and of the Rao-Blackwellized filter, side by side."""

import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.benchmarks.scenarios._hand_filters import (
    View,
    advance,
    improved,
    particle_filter,
    rao_blackwellized,
)
from jaxfilters.filter import Filter, init, predict
from jaxfilters.models.hand.skeleton import hand_geometry
from jaxfilters.models.synthetic.depth_sensor import depth_from_millimetres
from jaxfilters.models.synthetic.hand import FRAME_INTERVAL, kinect_v2, simulate_sequence

NUM_FRAMES = 30
"""Of data B, filtered again and again from their start: both filters still follow the hand, and render as much."""


class StepTimes(NamedTuple):
    """Seconds of each round at one ensemble size."""

    pf: np.ndarray
    rbpf: np.ndarray
    rbpf_predict: np.ndarray
    """The part of a frame in which the velocity is carried along: resampling, dynamics, sampling."""

    @property
    def ratio(self) -> float:
        """Median of the ratios of the rounds, RBPF to PF: what slows the machine for a while slows both."""
        return float(np.median(self.rbpf / self.pf))


def measure(num_particles: int, rounds: int, seed: int) -> StepTimes:
    """Times of `rounds` frames of data B (`improved` setting), the first pass over them left out."""
    recording_key, filter_key = jax.random.split(jax.random.key(seed))
    frames = depth_from_millimetres(simulate_sequence(recording_key, "B", num_frames=NUM_FRAMES).depth_mm)
    setting = improved()
    view = View(kinect_v2(), hand_geometry(), setting.segmented)
    pf, rbpf = (build(setting, num_particles) for build in (particle_filter, rao_blackwellized))
    dt = jnp.asarray(FRAME_INTERVAL, dtype=float)
    predicted = init(rbpf, filter_key)
    calls: dict[str, Callable[[], Any]] = {
        "pf": _Follower(pf, filter_key, view, frames),
        "rbpf": _Follower(rbpf, filter_key, view, frames),
        "rbpf_predict": partial(predict, rbpf, filter_key, predicted, dt),
    }
    return StepTimes(**rounds_of(calls, rounds))


class _Follower:
    """A filter that takes one frame more with each call, and starts anew after the last one."""

    def __init__(self, filter: Filter, key: Array, view: View, frames: Float[Array, "t rows cols"]):
        self._filter, self._view = filter, view
        self._start = self._state = init(filter, key)
        self._frames = itertools.cycle(enumerate(zip(jax.random.split(key, len(frames)), frames, strict=True)))

    def __call__(self) -> Any:
        i, (key, frame) = next(self._frames)
        state = self._state if i else self._start
        self._state, estimate = advance(self._filter, key, self._view, state, frame)
        return estimate


def rounds_of(functions: dict[str, Callable[[], Any]], rounds: int) -> dict[str, np.ndarray]:
    """Seconds of each of `rounds` calls of each function, results awaited, in alternating order.

    All of them are called `NUM_FRAMES` times before: compilation, and caches as they are in use.
    """
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for i in range(-NUM_FRAMES, rounds):
        for name in list(functions)[:: 1 if i % 2 == 0 else -1]:
            start = time.perf_counter()
            jax.block_until_ready(functions[name]())
            if i >= 0:
                seconds[name].append(time.perf_counter() - start)
    return {name: np.array(times) for name, times in seconds.items()}
