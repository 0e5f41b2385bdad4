"""The interface of a recording, whatever its frames are."""

from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaxfilters.trackers.io.errors import InputError


@runtime_checkable
class Recording(Protocol):
    """Frames with their times, read when asked for."""

    @property
    def times_s(self) -> np.ndarray:
        """(frames,) float64 seconds, strictly increasing."""

    @property
    def name(self) -> str:
        """For messages and reports."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Any:
        """One frame: an array or a pytree of arrays; raises `InputError` that names what cannot be read."""

    def fingerprint(self) -> str:
        """A hash: equal for the same recording wherever it lies."""


def check_times(times_s: np.ndarray, name: str) -> None:
    """Raise `InputError` unless the times are (frames,) with at least one frame, finite and strictly increasing."""
    if times_s.ndim != 1 or len(times_s) == 0:
        raise InputError(f"{name}: expected at least one frame; times have shape {times_s.shape}.")
    if not np.isfinite(times_s).all():
        raise InputError(f"{name}: times must be finite; frame {int(np.argmin(np.isfinite(times_s)))} is not.")
    steps = np.diff(times_s)
    if (steps <= 0).any():
        i = int(np.argmax(steps <= 0))
        raise InputError(
            f"{name}: times must increase strictly; frame {i} is at {times_s[i]:.6f} s, "
            f"frame {i + 1} at {times_s[i + 1]:.6f} s."
        )
