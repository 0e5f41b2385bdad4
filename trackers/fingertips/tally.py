"""Counts over the frames of a run, for its report; their size does not grow with the run."""

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from jaxfilters.models.synthetic.desk_hand import DeskFrame
from jaxfilters.trackers.fingertips.state import HandReport
from jaxfilters.trackers.fingertips.table import name_of


class Tally(NamedTuple):
    """What was counted so far."""

    frames: int = 0
    first_s: float = 0.0
    """Time of the first frame, seconds."""
    last_s: float = 0.0
    frames_by_fingertip: dict[str, int] = {}  # noqa: RUF012 - never changed in place
    frames_by_count: dict[str, int] = {}  # noqa: RUF012
    num_errors: int = 0
    """Fingertips in frames with a true one."""
    sum_of_errors: float = 0.0
    """Pixels, of these from the nearest true one."""
    right_counts: int = 0
    """Frames with as many fingertips as there are."""

    def add(self, time_s: float, report: HandReport, truth: DeskFrame | None) -> "Tally":
        """The counts with one more frame, and its truth where it is known."""
        names = Counter(self.frames_by_fingertip)
        names.update(name_of(int(hand), int(report.identity[hand, slot])) for hand, slot in np.argwhere(report.is_tip))
        count = int(report.num_tips.sum())
        errors = _errors(report, truth)
        return Tally(
            self.frames + 1,
            self.first_s if self.frames else time_s,
            time_s,
            dict(names),
            dict(Counter(self.frames_by_count) + Counter({str(count): 1})),
            self.num_errors + len(errors),
            self.sum_of_errors + float(errors.sum()),
            self.right_counts + int(truth is not None and int(truth.extended.sum()) == count),
        )

    @property
    def mean_error_px(self) -> float:
        """NaN without a truth."""
        return self.sum_of_errors / self.num_errors if self.num_errors else math.nan


def _errors(report: HandReport, truth: DeskFrame | None) -> np.ndarray:
    """Pixels of every fingertip from the nearest true one."""
    if truth is None or not truth.extended.any():
        return np.zeros(0)
    places = report.position[report.is_tip]
    return np.linalg.norm(places[:, None] - truth.tips[truth.extended], axis=-1).min(axis=1)
