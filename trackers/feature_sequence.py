"""Features of an articulated hand over time: what was measured in each frame, how well, and what is known of the truth."""

import hashlib
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from jaxfilters.models.articulated.features import BLOCKS, FeatureSet
from jaxfilters.trackers.recording import InputError, check_times


class FeatureFrame(NamedTuple):
    """One frame, float32."""

    y: np.ndarray
    """(rows,) pixels and radians; 0 where nothing was measured."""
    mask: np.ndarray
    """(rows,) bool, False where nothing was measured."""
    std: np.ndarray
    """(rows,) standard deviations of the noise, pixels and radians, positive."""


class Start(NamedTuple):
    """What is believed before the first frame."""

    mean: np.ndarray
    """(n,), in the order of the layout."""
    covariance: np.ndarray
    """(n, n)."""


@dataclass(frozen=True)
class FeatureSequence:
    """A recording of features."""

    num_fingers: int
    features: FeatureSet
    """Which rows there are, and in which order."""
    times_s: np.ndarray
    """(frames,) float64 seconds, strictly increasing."""
    y: np.ndarray
    """(frames, rows) pixels and radians, NaN where nothing was measured."""
    std: np.ndarray
    """(frames, rows) standard deviations of the noise."""
    name: str
    """For messages and reports."""
    image_shape: tuple[int, int] | None = None
    """Rows and columns of the camera's image, where known."""
    start: Start | None = None
    truth: np.ndarray | None = None
    """True states (frames, n), where known."""

    def __post_init__(self) -> None:
        check_times(self.times_s, self.name)
        expected = (len(self.times_s), self.features.size(self.num_fingers))
        for field in ("y", "std"):
            if getattr(self, field).shape != expected:
                raise InputError(f"{self.name}: {field} must be {expected}; got {getattr(self, field).shape}.")
        seen = np.isfinite(self.y)
        if not seen.any():
            raise InputError(f"{self.name}: no feature was measured in any frame.")
        good = np.isfinite(self.std) & (self.std > 0)
        if not good[seen].all():
            frame, row = np.argwhere(seen & ~good)[0]
            raise InputError(
                f"{self.name}: noise must be positive where a feature was measured; frame {frame}, "
                f"{self.features.names(self.num_fingers)[row]}: {self.std[frame, row]}."
            )

    def __len__(self) -> int:
        return len(self.times_s)

    def __getitem__(self, index: int) -> FeatureFrame:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}.")
        mask = np.isfinite(self.y[index])
        y = np.where(mask, self.y[index], 0.0).astype(np.float32)
        return FeatureFrame(y, mask, np.where(mask, self.std[index], 1.0).astype(np.float32))

    def fingerprint(self) -> str:
        """A hash of everything measured: equal for the same recording wherever it lies."""
        digest = hashlib.sha256(repr((self.num_fingers, self.features.blocks)).encode())
        for part in (self.times_s, self.y, self.std):
            digest.update(repr(part.shape).encode() + np.ascontiguousarray(part).tobytes())
        return digest.hexdigest()[:16]


def features_named(names: list[str], recording: str) -> tuple[int, FeatureSet, list[int]]:
    """Number of fingers, feature set, and for each of its rows the place of its name in `names`.

    Raises:
        InputError: the names are not those of whole blocks of features for any number of fingers.
    """
    places = {name: place for place, name in enumerate(names)}
    if len(places) < len(names):
        raise InputError(f"{recording}: names must differ; {max(names, key=names.count)} is there more than once.")
    for num_fingers in range(1, 1 + max(1, len(names))):
        for size in range(1, len(BLOCKS) + 1):
            for blocks in combinations(BLOCKS, size):
                if {"joints", "tips"} <= set(blocks):
                    continue
                features = FeatureSet(blocks)
                expected = features.names(num_fingers)
                if len(expected) == len(names) and set(expected) == set(names):
                    return num_fingers, features, [places[name] for name in expected]
    example = FeatureSet(("wrist", "joints")).names(1)
    raise InputError(
        f"{recording}: names must be those of whole blocks ({', '.join(BLOCKS)}) of features of one hand, "
        f"such as {', '.join(example)}; got {', '.join(names)}."
    )
