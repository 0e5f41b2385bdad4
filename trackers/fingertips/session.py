"""Observations of hands in, fingertips and what they do out, in pieces of any length; a stream that never stops."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.models.fingertip.thumb import ThumbAngles
from jaxfilters.models.gesture import codes
from jaxfilters.trackers.fingertips import drawing, manipulation
from jaxfilters.trackers.fingertips.drawing import (
    NOTHING_DRAWN,
    Drawing,
    DrawingConfig,
    drawn,
    finished,
    symbol_event,
)
from jaxfilters.trackers.fingertips.events import Event, HandFrame, Recogniser
from jaxfilters.trackers.fingertips.hands import run_hands, start_hands
from jaxfilters.trackers.fingertips.manipulation import IDLE, Handling, HandlingConfig, handled
from jaxfilters.trackers.fingertips.state import FingertipConfig, HandReport, Method, scaled
from jaxfilters.trackers.fingertips.tracker import MODERN, PUBLISHED, PUBLISHED_CONFIG

STILL_PX = 1.5
"""Pixels a frame of 1/30 s in a 640x480 image, below which a hand rests."""


USUAL = FingertipConfig()
VARIANTS = {"recommended": (USUAL, MODERN), "published": (PUBLISHED_CONFIG, PUBLISHED)}
"""Constants and strategies by name."""


class FingertipSession:
    """One or more hands from the first frame to the last."""

    def __init__(
        self,
        angles: ThumbAngles,
        *,
        handedness: int = 1,
        num_hands: int = 1,
        height: float = 480.0,
        fps: float = 30.0,
        config: FingertipConfig = USUAL,
        recogniser: Recogniser | None = None,
        method: Method = MODERN,
    ):
        """Hands of which nothing was observed yet.

        Args:
            angles: Of the person's open hand.
            handedness: 1 if the thumb of the first hand is counter-clockwise of its arm in the image, else -1; the
                second hand is the other one.
            num_hands: At most.
            height: Of the images, pixels.
            fps: Frames a second.
            config: Constants, for a 640x480 image and 30 frames a second.
            recogniser: What names strokes; without one they have no label.
            method: The strategies of the tracker.
        """
        self.config = scaled(config, height=height, fps=fps)
        self.events: list[Event] = []
        """All so far, in their order."""
        self._angles, self._method, self._recogniser = angles, method, recogniser
        self._sides = jnp.asarray(handedness * np.array([1.0, -1.0] * num_hands, np.float32)[:num_hands], float)
        self._state = start_hands(self.config, angles, num_hands, method=method)
        self._still = STILL_PX * (height / 480.0) * (30.0 / fps)
        self._handling_config = manipulation.scaled(HandlingConfig(), height=height, fps=fps)
        self._drawing_config = drawing.scaled(DrawingConfig(), height=height, fps=fps)
        self._handling: list[Handling] = [IDLE] * num_hands
        self._drawing: list[Drawing] = [NOTHING_DRAWN] * num_hands
        self._last: list[tuple[np.ndarray, np.ndarray]] | None = None
        self._now: list[HandFrame] = []
        self._frames = 0

    def process(self, observed: HandObservation, times_s: Float[np.ndarray, " frames"]) -> HandReport:
        """Reports of the next frames, (frames, hands, ...) on the host; what began and ended is added to `events`.

        Args:
            observed: (frames, hands, ...); the components of a frame in any order.
            times_s: Of the frames.
        """
        self._state, found = run_hands(
            self.config, self._angles, self._state, observed, self._sides, method=self._method
        )
        report: Any = jax.tree.map(np.asarray, found)
        displacement, code = self._symbols(report)
        for i, time_s in enumerate(times_s):
            self._now = [_frame(report, self._frames, float(time_s), i, h, displacement, code) for h in self._hands()]
            self._frames += 1
            for hand, now in enumerate(self._now):
                self._events_of(hand, now)
        return report

    def saved(self) -> dict[str, Any]:
        """All that the next frame needs but for the events, for `restore` in a session of the same user and options.

        A tree that `trackers.io.checkpoint` can save.
        """
        return {
            "state": self._state,
            "handling": self._handling,
            "drawing": self._drawing,
            "last": self._last,
            "now": self._now,
            "frames": self._frames,
        }

    def restore(self, saved: dict[str, Any], events: list[Event]) -> None:
        """Go on from what `saved` gave, with the events up to then."""
        self._state, self._handling, self._drawing = saved["state"], saved["handling"], saved["drawing"]
        self._last, self._now, self._frames = saved["last"], saved["now"], saved["frames"]
        self.events = events

    def finish(self) -> None:
        """End what is under way: nothing more comes."""
        for hand, now in enumerate(self._now):
            gone = now._replace(identity=now.identity[:0], position=now.position[:0], is_thumb=now.is_thumb[:0], mode=0)
            self._events_of(hand, gone)

    def _hands(self) -> range:
        return range(len(self._drawing))

    def _events_of(self, hand: int, now: HandFrame) -> None:
        self._handling[hand], events = handled(self._handling_config, hand, self._handling[hand], now)
        self.events += events
        before = self._drawing[hand]
        if self._handling[hand].is_pinching:
            # Fingers that hold something draw nothing, even if the thumb is hidden.
            self._drawing[hand], stroke = NOTHING_DRAWN, finished(self._drawing_config, before)
        else:
            self._drawing[hand], stroke = drawn(self._drawing_config, before, now)
        if stroke is not None:
            self.events.append(symbol_event(hand, now, stroke, self._recogniser))

    def _symbols(self, report: Any) -> tuple[np.ndarray, np.ndarray]:
        """Displacement (frames, hands, 2) and direction code (frames, hands) of every frame since the one before."""
        tips, there = report.position, report.is_tip
        if self._last is None:
            self._last = [(tips[0], np.zeros_like(there[0]))]
        tips = np.concatenate([self._last[0][0][None], tips])
        there = np.concatenate([self._last[0][1][None], there])
        self._last = [(tips[-1], there[-1])]
        displacement, code = _coded(jnp.asarray(tips), jnp.asarray(there), self._still)
        return np.asarray(displacement)[1:], np.asarray(code)[1:]


@jax.jit
def _coded(tips: Float[Array, "t h f 2"], there: Bool[Array, "t h f"], still: float | Array) -> tuple[Array, Array]:
    displacement = jax.vmap(codes.displacements, in_axes=1, out_axes=1)(tips, there)
    return displacement, codes.direction_code(displacement, still)


def _frame(
    report: Any, frame: int, time_s: float, i: int, hand: int, displacement: np.ndarray, code: np.ndarray
) -> HandFrame:
    there = report.is_tip[i, hand]
    return HandFrame(
        frame,
        time_s,
        report.identity[i, hand][there],
        report.position[i, hand][there].astype(float),
        report.is_thumb[i, hand][there],
        report.palm[i, hand].astype(float),
        report.axis[i, hand].astype(float),
        int(report.mode[i, hand]),
        displacement[i, hand].astype(float),
        int(code[i, hand]),
    )
