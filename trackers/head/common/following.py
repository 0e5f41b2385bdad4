"""From frames to a track, whatever tracker it is: waiting for a face, following it, finding it again after a loss."""

import math
import re
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.head.common.corners import eye_centers
from jaxfilters.trackers.head.common.detect import detect
from jaxfilters.trackers.head.common.state import INITIALISING, LOST

LOOK_EVERY_S = 1.0
"""Seconds between looks for faces while one is followed."""
SAME_PLACE, MOST_CONTRADICTIONS = 0.5, 3
"""How far, in distances between the eyes, a detected face may be from the tracked one; how many detections in a row may
contradict the track before it is given up."""
UNUSED_POINTS = "the landmarks that were given cannot be used"
"""Begins an event; they are then detected."""


class Compared(NamedTuple):
    """What a detector says of a track."""

    state: Any
    """Of the tracker, perhaps another one."""
    row: Any
    """Of the track in this frame; None where it stays as it is."""
    is_elsewhere: bool = True
    """Whether the row contradicts the one that the track had, which is an event."""


class Beginning(NamedTuple):
    """A track that begins."""

    state: Any
    """Of the tracker; its `time` is 0."""
    time: float
    """Of the images that it began with, seconds."""
    what: str
    """For the list of events."""


@runtime_checkable
class FaceTracker(Protocol):
    """What one tracker does its own way. States have the fields `time`, and tracks those of `HeadTrack`."""

    rig: CameraRig
    chunk: int
    """Frames in one compiled call."""
    is_live: bool
    """Whether frames cannot wait."""

    compare_every_s: float
    """Seconds between two frames in which a track is compared with what a detector finds; infinite if it never is."""

    @property
    def can_wait(self) -> bool:
        """Whether the next search goes on beside the frames; that for landmarks which a person gave must not."""
        ...

    def search(self, images: np.ndarray, time: float) -> tuple[Any, list[str]]:
        """What is found in one moment's images (C, rows, cols), or `None`; and what is wrong with them."""
        ...

    def forget(self) -> None:
        """Drops what a search that goes on over several frames has gathered."""
        ...

    def begin(self, found: Any, old: Any, frame: int) -> Beginning:
        """The start of a track with what was found, after the `old` state, if there was one."""
        ...

    def saved(self) -> Any:
        """What the next frame needs beside the state while a face is followed: a tree of arrays and plain values."""
        ...

    def restore(self, saved: Any, state: Any) -> None:
        """Go on from what `saved` gave, and the state at that time; no search is under way."""
        ...

    def advance(self, state: Any, images: np.ndarray, clock: np.ndarray, is_frame: np.ndarray) -> tuple[Any, Any]:
        """State and track after a chunk of frames."""
        ...

    def compared(self, state: Any, row: Any, images: np.ndarray, time: float) -> Compared:
        """State and row of the last frame, or better ones if a detector finds the face elsewhere in it."""
        ...

    def reported(self, track: Any, times: np.ndarray) -> Any:
        """Rows with corrections by a detector that do not enter the state; each row is passed once, in order."""
        ...

    def empty(self, count: int) -> Any:
        """Rows of frames without a face."""
        ...


class Following:
    """Follows one head through frames that are handed over in pieces.

    Attributes:
        state: Of the tracker; `None` before there was a face.
        events: (frame index, what happened), in order.
    """

    def __init__(self, tracker: FaceTracker) -> None:
        self.state: Any = None
        self.events: list[tuple[int, str]] = []
        self._tracker = tracker
        self._frames, self._is_lost, self._time = 0, False, 0.0
        self._pool = ThreadPoolExecutor(1) if tracker.is_live else None
        self._wait: Future[tuple[Any, list[str]]] | None = None
        """A search for a face that goes on beside the tracking."""
        self._said: set[str] = set()
        self._looked, self._contradictions, self._is_refuted = -math.inf, 0, False
        self._compared = -math.inf
        """When the track was last compared with a detection; `_looked` is when any face was looked for."""
        self._latest = -math.inf
        """Time of the last frame, with a face or without."""

    def process(self, images: UInt8[np.ndarray, "b C rows cols"], times: Float[np.ndarray, " b"]) -> Any:
        """Track of the next frames, a row each.

        Args:
            images: Grey, of all cameras at one moment each, without lens distortion.
            times: Seconds, growing.

        Raises:
            ValueError: if images or times do not fit the rig and each other.
        """
        rig = self._tracker.rig
        expected = (len(times), rig.num_cameras, *rig.shape)
        if images.shape != expected or images.dtype != np.uint8:
            raise ValueError(f"images must be {expected} of uint8; got {images.shape} of {images.dtype}.")
        if not np.all(np.isfinite(times)):
            raise ValueError("times must be finite.")
        if np.any(np.diff(times, prepend=self._latest) <= 0):
            raise ValueError("times must grow, from the last frame of the piece before, too.")
        if not len(times):
            return self._empty(0, None)
        self._latest = float(times[-1])
        rows, done = [], 0
        while done < len(times):
            if self.state is None or self._is_lost:
                waited = self._look_for_face(images, times, done)
                rows.append(waited)
                done += len(waited.pose)
                continue
            stop = self._end_of_chunk(times, done)
            rows.append(self._follow(images[done:stop], times[done:stop]))
            done = stop
        return jax.tree.map(lambda *parts: np.concatenate(parts), *rows)

    def saved(self) -> dict[str, Any] | None:
        """All that the next frame needs, for `trees.taken_apart`; None while a face is searched for.

        A search gathers images of several frames: a run that is resumed begins before it.
        """
        if self.state is None or self._is_lost:
            return None
        return {
            "state": self.state,
            "tracker": self._tracker.saved(),
            "events": self.events,
            "said": sorted(self._said),
            "frames": self._frames,
            "time": self._time,
            "looked": self._looked,
            "contradictions": self._contradictions,
            "compared": self._compared,
            "latest": self._latest,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `saved` gave."""
        self.state, self.events, self._said = saved["state"], list(saved["events"]), set(saved["said"])
        self._frames, self._time = saved["frames"], saved["time"]
        self._looked, self._contradictions = saved["looked"], saved["contradictions"]
        self._compared, self._latest = saved["compared"], saved["latest"]
        self._is_lost = self._is_refuted = False
        self._wait = None
        self._tracker.restore(saved["tracker"], self.state)

    def _end_of_chunk(self, times: np.ndarray, start: int) -> int:
        """One past the last frame of a chunk: it ends with the first frame in which a detector is due."""
        stop = min(start + self._tracker.chunk, len(times))
        chunk = times[start:stop]
        is_due = chunk - self._compared >= self._tracker.compare_every_s
        if not self._is_lost:
            is_due |= chunk - self._looked >= LOOK_EVERY_S
        return start + int(np.argmax(is_due)) + 1 if is_due.any() else stop

    def _follow(self, images: np.ndarray, times: np.ndarray) -> Any:
        """Rows of at most a chunk of frames; the last chunk is filled up, so that one program serves all."""
        chunk = self._tracker.chunk
        missing = chunk - len(times)
        is_frame: Bool[np.ndarray, " chunk"] = np.arange(chunk) < len(times)
        filled = np.concatenate([images, np.repeat(images[-1:], missing, axis=0)])
        # Counted from the last frame, which single precision can do however late it is.
        state = self.state._replace(time=jnp.zeros_like(self.state.time))
        clock = (np.concatenate([times, np.repeat(times[-1:], missing)]) - self._time).astype(state.time.dtype)
        self.state, track = self._tracker.advance(state, filled, clock, is_frame)
        self._time = max(self._time, float(np.max(times)))
        track = jax.tree.map(lambda leaf: np.asarray(leaf)[: len(times)], track)
        for i, is_lost in enumerate(track.status == LOST):
            if is_lost != self._is_lost:
                self._say(i, "lost" if is_lost else "found again near where it was lost")
            self._is_lost = bool(is_lost)
        self._frames += len(times)
        if times[-1] - self._compared >= self._tracker.compare_every_s:
            track = self._compare(images[-1], float(times[-1]), track)
        if not self._is_lost and times[-1] - self._looked >= LOOK_EVERY_S:
            self._looked = float(times[-1])
            self._look_at(images[-1, 0], track.image_points[-1, 0])
        return self._tracker.reported(track, times)

    def _compare(self, images: np.ndarray, time: float, track: Any) -> Any:
        """The track of a chunk, with the last row from where the detector finds the face, if that is better."""
        self._compared = time
        row = jax.tree.map(lambda leaf: leaf[-1], track)
        self.state, better, is_elsewhere = self._tracker.compared(self.state, row, images, time)
        if better is None:
            return track
        if is_elsewhere:
            self._say(-1, "found again where it is detected" if self._is_lost else "put where it is detected")
        self._is_lost = False
        return jax.tree.map(lambda rows, last: np.concatenate([rows[:-1], np.asarray(last)[None]]), track, better)

    def _look_at(self, image: np.ndarray, points: np.ndarray) -> None:
        """Give the track up if a face is detected elsewhere time after time; that none is detected says nothing."""
        observed = detect(image, near=points.mean(axis=0))
        if observed is None:
            return
        right, left = eye_centers(observed.points)
        apart = np.median(np.linalg.norm(points[: len(observed.points)] - observed.points, axis=1))
        is_elsewhere = apart > SAME_PLACE * np.linalg.norm(left - right)
        self._contradictions = self._contradictions + 1 if is_elsewhere else 0
        if self._contradictions == MOST_CONTRADICTIONS:
            self._is_lost = self._is_refuted = True
            self._say(-1, "lost: the face is detected elsewhere")

    def _look_for_face(self, images: np.ndarray, times: np.ndarray, start: int) -> Any:
        """Rows up to the frame in which a track begins, or all; a lost face may also turn up where it was lost."""
        status = LOST if self._is_lost else INITIALISING
        if self._is_lost and not self._is_refuted:
            stop = self._end_of_chunk(times, start)
            track = self._follow(images[start:stop], times[start:stop])
            if not self._is_lost:
                self._wait = None
                self._tracker.forget()
                return track
            self._frames -= stop - start
        else:
            stop, track = len(times), None
        for i in range(start, stop):
            found = self._found(images[i], float(times[i]))
            self._frames += 1
            if found is not None:
                self._begin(found)
                return self._empty(i + 1 - start, track, status)
        return self._empty(stop - start, track, status)

    def _found(self, images: np.ndarray, time: float) -> Any:
        """What a track can begin with; in a live session that of earlier frames."""
        if self._pool is None or not self._tracker.can_wait:
            return self._message(self._tracker.search(images, time))
        if self._wait is None:
            self._wait = self._pool.submit(self._tracker.search, images.copy(), time)
            return None
        if not self._wait.done():
            return None
        wait, self._wait = self._wait, None
        return self._message(wait.result())

    def _message(self, outcome: tuple[Any, list[str]]) -> Any:
        """What was found; each thing that is wrong is said once in every search, whatever the numbers in it."""
        found, wrong = outcome
        for reason in wrong:
            kind = re.sub(r"\d+(\.\d+)?", "0", reason)
            if kind not in self._said:
                self._say(0, reason)
            self._said.add(kind)
        return found

    def _begin(self, found: Any) -> None:
        beginning = self._tracker.begin(found, self.state, self._frames)
        self.state, self._time = beginning.state, beginning.time
        self._is_lost, self._is_refuted, self._said = False, False, set()
        self._looked = self._compared = beginning.time
        self._contradictions = 0
        self._tracker.forget()
        self._say(-1, beginning.what)

    def _empty(self, count: int, track: Any, status: int = INITIALISING) -> Any:
        """Rows of frames without a face; what the search for a lost one scored stays."""
        rows = self._tracker.empty(count)
        score = rows.score if track is None else track.score[:count]
        return rows._replace(score=score, status=np.full(count, status, np.int32))

    def _say(self, offset: int, what: str) -> None:
        self.events.append((self._frames + offset, what))
