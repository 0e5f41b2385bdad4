"""Runs of one recording whose grey levels differ by one at random: how much of a score is rounding."""

from collections.abc import Callable
from functools import partial

import numpy as np

Disturbance = Callable[[np.ndarray], np.ndarray]
"""From an image (rows, cols, 3) uint8 to another."""


def disturbances(number: int, seed: int) -> list[Disturbance]:
    """One for each of a number of runs: none for the first, and independent ones for the others."""
    changed = partial(_changed_by_a_level, np.random.default_rng(seed))
    return [changed if run else _unchanged for run in range(number)]


def _unchanged(image: np.ndarray) -> np.ndarray:
    return image


def _changed_by_a_level(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Every grey level by -1, 0 or 1 at random."""
    return np.clip(image + rng.integers(-1, 2, image.shape), 0, 255).astype(np.uint8)
