"""The paper's sequence and its open problem, over many seeds: runs of the three filters, and what is given of them."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.filter import Filter
from jaxfilters.filter import run as run_filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.articulated.filters import (
    FeatureObservation,
    Inequalities,
    belief_of,
    inequalities,
    literal,
    recommended,
    unconstrained,
)
from jaxfilters.models.articulated.hand import ArticulatedHand
from jaxfilters.models.articulated.limits import limit_rows, table_1
from jaxfilters.models.synthetic.articulated import (
    LAYOUT,
    ArticulatedSequence,
    paper_hand,
    simulate_drawn,
    simulate_held,
    simulate_paper,
)

FILTERS = {"unconstrained": unconstrained, "literal": literal, "recommended": recommended}
LAST = 15
"""Frames at the end of the sequence over which angles are judged."""
DIVERGED = 45.0
"""Degrees: an angle off by more in one of the last frames."""
OTHER_MODE = 4.0
"""Degrees: the median error of a run's angles in the last frames above which it ended in another mode of the posterior.
Of the 100 runs of `recommended` from drawn starts, 95 have less than 2.6 degrees and five more than 4.7."""
HELD_FRAME = 10
"""Of the paper's sequence: the pose that is held."""
R13 = LAYOUT.lengths.start + 2


class Runs(NamedTuple):
    """Filtered sequences, seeds first."""

    truth: np.ndarray
    """(s, t, n)."""
    means: np.ndarray
    """(s, t, n)."""
    shape_covariances: np.ndarray
    """(s, t, 9, 9): of lengths and palm."""

    @property
    def length_errors(self) -> np.ndarray:
        """(s, t, 6), pixels."""
        return (self.means - self.truth)[..., LAYOUT.lengths]

    @property
    def length_covariances(self) -> np.ndarray:
        """(s, t, 6, 6)."""
        count = LAYOUT.lengths.stop - LAYOUT.lengths.start
        return self.shape_covariances[..., :count, :count]

    @property
    def shape_errors(self) -> np.ndarray:
        """(s, t, 9), pixels: lengths and palm."""
        return (self.means - self.truth)[..., LAYOUT.static]


def run_paper(mode: str, shape: int, seeds: range) -> Runs:
    """The 55 frames of the paper."""
    return _filtered(FILTERS[mode], jax.vmap(lambda key: simulate_paper(key, shape))(_keys(shape, seeds)))


def run_drawn(mode: str, shape: int, seeds: range) -> Runs:
    """The same frames from starts that are samples of what is believed."""
    return _filtered(FILTERS[mode], jax.vmap(lambda key: simulate_drawn(key, shape))(_keys(20 + shape, seeds)))


def run_held(mode: str, shape: int, seeds: range, num_frames: int) -> Runs:
    """One pose of the sequence, repeated."""
    simulate = partial(simulate_held, shape=shape, num_frames=num_frames, frame=HELD_FRAME)
    return _filtered(FILTERS[mode], jax.vmap(simulate)(_keys(10 + shape, seeds)))


def _keys(first: int, seeds: range) -> Array:
    return jax.vmap(partial(jax.random.fold_in, jax.random.key(first)))(jnp.arange(seeds.start, seeds.stop))


class Model(NamedTuple):
    """The paper's hand with its limits; made outside of compiled functions, where limits are checked."""

    hand: ArticulatedHand
    limits: Inequalities


def paper_model() -> Model:
    """Two fingers, table 1."""
    return Model(paper_hand(), inequalities(limit_rows(LAYOUT, table_1())))


def filter_of(make, model: Model, sequence: ArticulatedSequence) -> Filter:
    """One of the `FILTERS`, begun where the sequence does."""
    return make(model.hand, Gaussian(sequence.initial_mean, sequence.initial_covariance), model.limits)


def looks_of(sequence: ArticulatedSequence) -> tuple[FeatureObservation, Float[Array, " t"]]:
    """Observations and times between frames, 0 before the first one, as `jaxfilters.run` takes them."""
    std = jnp.broadcast_to(sequence.noise_std, sequence.features.shape)
    inputs = jnp.ones(len(sequence.features), sequence.features.dtype).at[0].set(0.0)
    return FeatureObservation(sequence.features, sequence.masks, std), inputs


def _filtered(make, sequences: ArticulatedSequence) -> Runs:
    means, covariances = _filter_each(make, paper_model(), sequences)
    return Runs(*(np.asarray(x, float) for x in (sequences.states, means, covariances)))


@partial(jax.jit, static_argnames="make")
def _filter_each(make, model: Model, sequences: ArticulatedSequence) -> tuple[Array, Array]:
    def one(sequence: ArticulatedSequence) -> tuple[Array, Array]:
        filter = filter_of(make, model, sequence)
        return run_filter(filter, jax.random.key(0), *looks_of(sequence), collect=_keep_shape)[1]

    # One after the other: a batch of factorisations may stand still in jaxlib 0.10 on two cores.
    return jax.lax.map(one, sequences)


def _keep_shape(state, info) -> tuple[Array, Array]:
    del info
    belief = belief_of(state)
    return belief.mean, belief.covariance[LAYOUT.static, LAYOUT.static]


def diverged(runs: Runs) -> np.ndarray:
    """(s,) whether some angle was off by more than 45 degrees, or not finite, in the last frames."""
    return ~(angle_errors(runs).max(axis=(1, 2)) <= DIVERGED)


def in_other_mode(runs: Runs) -> np.ndarray:
    """(s,) whether the run ended in a wrong pose: the median error of its angles in the last frames is not small."""
    return ~(np.median(angle_errors(runs), axis=(1, 2)) <= OTHER_MODE)


def angle_errors(runs: Runs) -> np.ndarray:
    """(s, 15, 8) degrees, in the last frames."""
    return np.rad2deg(np.abs((runs.means - runs.truth)[:, -LAST:, LAYOUT.angles]))


def coverage(errors: np.ndarray, covariances: np.ndarray) -> float:
    """Share of errors (..., d) within two of their standard deviations."""
    return float(np.mean(np.abs(errors) <= 2 * np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))))


def nees(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """(...,) normalised estimation error squared of errors (..., d): chi-squared with d degrees where all is well."""
    return np.einsum("...i,...i->...", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def band(dimension: int, seeds: int) -> tuple[float, float]:
    """The 95 % band of the mean of as many values of `nees`."""
    half = 1.96 * np.sqrt(2 * dimension / seeds)
    return dimension - half, dimension + half
