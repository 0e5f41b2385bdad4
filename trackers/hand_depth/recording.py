"""A depth recording: camera, times and frames."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.io.content_hash import content_hash
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.recording import check_times


@dataclass(frozen=True)
class DepthSequence:
    """A depth recording: camera, times, and frames that are read when asked for.

    `sequence[i]` is a float32 image (rows, cols) in metres, depth along z, NaN where the sensor has no reading.
    """

    camera: Pinhole
    times_s: np.ndarray
    """(frames,) float64 seconds, strictly increasing."""
    read: Callable[[int], np.ndarray]
    """`index -> (rows, cols)` float32 metres; raises `InputError` that names the file when it cannot be read."""
    name: str
    """For messages and reports."""
    joints: np.ndarray | None = None
    """True joints (frames, 21, 3) in metres, where they are known."""

    def __post_init__(self) -> None:
        check_times(self.times_s, self.name)
        if self.joints is not None and self.joints.shape != (len(self), 21, 3):
            raise InputError(f"{self.name}: joints must be ({len(self)}, 21, 3); got {self.joints.shape}.")

    def __len__(self) -> int:
        return len(self.times_s)

    def __getitem__(self, index: int) -> np.ndarray:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}.")
        return self.read(index)

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[i] for i in range(len(self)))

    def fingerprint(self) -> str:
        """A hash of camera, times and the first frame: equal for the same recording wherever it lies."""
        return content_hash(self.camera.matrix(), self.times_s, self[0])


def from_array(camera: Pinhole, times_s: np.ndarray, depth: np.ndarray, name: str = "array") -> DepthSequence:
    """A recording in memory; `depth` is (frames, rows, cols) in metres, NaN, 0 or inf where nothing was read."""
    if depth.shape != (len(times_s), *camera.shape):
        raise InputError(f"{name}: depth must be {(len(times_s), *camera.shape)}; got {depth.shape}.")

    read = lambda index: with_nan_for_nothing(depth[index])
    return DepthSequence(camera, np.asarray(times_s, np.float64), read, name)


def with_nan_for_nothing(frame: np.ndarray) -> np.ndarray:
    """A frame (rows, cols) of float32 metres, NaN where it is NaN, 0, negative or infinite: nothing was read there."""
    frame = frame.astype(np.float32)
    return np.where(np.isfinite(frame) & (frame > 0), frame, np.float32(np.nan))
