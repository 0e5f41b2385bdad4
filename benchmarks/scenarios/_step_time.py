"""Time of one frame of the plain and of the Rao-Blackwellized filter, side by side."""

import itertools
import time
from collections.abc import Callable
from dataclasses import replace
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
from jaxfilters.models.hand.surface import triangle_hand
from jaxfilters.models.synthetic.depth_sensor import depth_from_millimetres
from jaxfilters.models.synthetic.hand import FRAME_INTERVAL, kinect_v2, simulate_sequence
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig

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
    view = View(kinect_v2(), hand_geometry(), setting.segmented, setting.stride)
    pf, rbpf = (build(setting, num_particles) for build in (particle_filter, rao_blackwellized))
    dt = jnp.asarray(FRAME_INTERVAL, dtype=float)
    predicted = init(rbpf, filter_key)
    calls: dict[str, Callable[[], Any]] = {
        "pf": _Follower(pf, filter_key, view, frames),
        "rbpf": _Follower(rbpf, filter_key, view, frames),
        "rbpf_predict": partial(predict, rbpf, filter_key, predicted, dt),
    }
    return StepTimes(**rounds_of(calls, rounds))


def measure_variants(num_particles: int, rounds: int, seed: int) -> dict[str, np.ndarray]:
    """Seconds a frame of the Rao-Blackwellized filter with the mesh at stride 2, and of the tracker with its guide."""
    recording_key, filter_key = jax.random.split(jax.random.key(seed))
    frames = depth_from_millimetres(simulate_sequence(recording_key, "B", num_frames=NUM_FRAMES).depth_mm)
    setting = replace(improved(), surface=triangle_hand, stride=2)
    view = View(kinect_v2(), hand_geometry(), setting.segmented, setting.stride)
    mesh = _Follower(rao_blackwellized(setting, num_particles), filter_key, view, frames)
    guided = _Tracker(num_particles, filter_key, np.asarray(frames))
    seconds = rounds_of({"rbpf_mesh_stride2": mesh, "rbpf_guided": guided}, rounds)
    return seconds | {"rbpf_guided": seconds["rbpf_guided"] / guided.chunk}


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


class _Tracker:
    """The tracker as the application runs it: a few frames with each call, on the host before and after."""

    chunk = 5

    def __init__(self, num_particles: int, key: Array, frames: np.ndarray):
        config = HandDepthConfig(num_particles=num_particles, scale=1.0)
        self._tracker = hand_depth.build(kinect_v2(), config, hand_geometry())
        self._start = self._state = self._tracker.init(key, frames[0])
        times = FRAME_INTERVAL * np.arange(len(frames), dtype=np.float32)
        self._chunks = itertools.cycle(range(0, len(frames), self.chunk))
        self._frames, self._times = frames, times

    def __call__(self) -> Any:
        first = next(self._chunks)
        part = slice(first, first + self.chunk)
        state = self._state if first else self._start
        self._state, track = self._tracker.step(state, self._frames[part], self._times[part])
        return track


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
