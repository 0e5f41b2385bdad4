"""One frame after the other: the tracker over whatever delivers images, with what is to be kept of everybody."""

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax
import numpy as np

from jaxfilters.trackers.people.recorded import Recorder, Sighting
from jaxfilters.trackers.people.state import CameraFrame, People, PeopleScene, Report
from jaxfilters.trackers.people.tracker import start, step


class FollowedFrame(NamedTuple):
    """What is known after one frame."""

    frame: int
    time_s: float
    people: People
    """NumPy leaves."""
    report: Report
    """NumPy leaves."""
    added: list[tuple[int, Sighting]]
    """By identity: of this frame and, for the newly confirmed, of the frames before."""
    seconds: float
    """From the foreground to the report."""


def follow(
    scene: PeopleScene, moments: Iterable[tuple[float, tuple[CameraFrame, ...]]], recorder: Recorder
) -> Iterator[FollowedFrame]:
    """What is known after each moment; the next one is asked for when that has been dealt with.

    Args:
        scene: What is known of the place.
        moments: Seconds since the beginning, and what the cameras deliver then, in their order.
        recorder: What collects the tracks.
    """
    people, previous = start(scene), 0.0
    for index, (time_s, frames) in enumerate(moments):
        began = time.perf_counter()
        people, report = jax.block_until_ready(step(scene, people, frames, np.float32(time_s - previous)))
        seconds, previous = time.perf_counter() - began, time_s
        known, said = jax.device_get((people, report))
        yield FollowedFrame(index, time_s, known, said, recorder.add(index, time_s, known, said), seconds)
