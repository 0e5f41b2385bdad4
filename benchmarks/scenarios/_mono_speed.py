"""Milliseconds a frame of the one-camera head tracker: with an adjustment in every frame, as usual, without any."""

from dataclasses import replace

import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios._mono_runs import camera, talking_head
from jaxfilters.benchmarks.timing import interleaved
from jaxfilters.trackers.head.mono.config import PUBLISHED, MonoConfig
from jaxfilters.trackers.head.mono.session import MonoSession
from jaxfilters.trackers.io.face_models import default_face_model

FRAMES, WARM_UP = 32, 64
"""In one call, and before it."""


def speed_metrics(seed: int, rounds: int) -> dict[str, Metric]:
    """Of 750 particles, the same frames over and over, forth and back."""
    made = talking_head(seed, FRAMES)
    images = made.frames(0, FRAMES)
    face = default_face_model().model
    options = {
        "": replace(MonoConfig(), selection="latest"),
        "_usual": MonoConfig(),
        "_without_adjustment": replace(MonoConfig(), adjust=False),
        "_paper": PUBLISHED,
        "_live": replace(MonoConfig(), chunk=1),
    }
    calls = {}
    for name, one in options.items():
        session = MonoSession(camera(), face, one, np.asarray(made.uv[0, 0], float))
        calls[name] = _Endless(session, images)
        for _ in range(WARM_UP // FRAMES):
            calls[name]()
    seconds = interleaved(calls, rounds)
    metrics = {f"frame_ms{name}": Metric(1e3 * value / FRAMES, "ms", "lower") for name, value in seconds.items()}
    return metrics | {"fps_750_particles": Metric(FRAMES / seconds[""], "frames/s", "higher")}


class _Endless:
    """A session that is shown the same frames again and again, forwards and backwards."""

    def __init__(self, session: MonoSession, images: np.ndarray) -> None:
        self._session, self._images, self._shown = session, images, 0

    def __call__(self) -> np.ndarray:
        times = (self._shown + np.arange(len(self._images))) / 30
        self._shown += len(self._images)
        track = self._session.process(self._images, times)
        self._images = self._images[::-1]
        return np.asarray(track.pose)
