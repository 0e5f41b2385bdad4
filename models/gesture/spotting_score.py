"""How well gestures were found in streams.

A gesture counts as found if more than half of its annotated frames are in a detection with its label that no other
gesture has; a detection that serves no gesture is a false alarm. The Jaccard index is the mean over gestures and false
alarms of the frames that annotation and detections of a label share, over those of either (F. M. Caputo et al., "SFINGE
3D", Computers & Graphics 2020).
"""

from collections.abc import Sequence
from typing import NamedTuple

from jaxfilters.hmm import Segment


class Score(NamedTuple):
    """How gestures were found."""

    detected: int
    false_positives: int
    total: int
    jaccard: list[float]
    """Of every gesture and every false alarm."""


def scored(found: Sequence[Segment], truth: Sequence[Segment]) -> Score:
    """Detections of one sequence beside what was annotated."""
    served: set[int] = set()
    jaccard = []
    for gesture in truth:
        frames = gesture.end - gesture.start + 1
        own = {i: shared_frames(one, gesture) for i, one in enumerate(found) if one.label == gesture.label}
        served |= set([i for i, shared in own.items() if shared > 0.5 * frames and i not in served][:1])
        near = {i: shared for i, shared in own.items() if shared > 0}
        either = frames + sum(found[i].end - found[i].start + 1 - shared for i, shared in near.items())
        jaccard.append(sum(near.values()) / either)
    false = len(found) - len(served)
    return Score(len(served), false, len(truth), jaccard + [0.0] * false)


def shared_frames(a: Segment, b: Segment) -> int:
    """Frames that are in both segments."""
    return max(0, min(a.end, b.end) - max(a.start, b.start) + 1)


def total(scores: Sequence[Score]) -> Score:
    """Of several sequences together."""
    return Score(
        sum(score.detected for score in scores),
        sum(score.false_positives for score in scores),
        sum(score.total for score in scores),
        [value for score in scores for value in score.jaccard],
    )
