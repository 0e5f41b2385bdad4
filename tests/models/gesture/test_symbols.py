"""Symbols learnt of some writers and recognised of others, strokes that are none, and symbols that are added."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import hmm
from jaxfilters.models.gesture.stroke import features, stacked
from jaxfilters.models.gesture.symbols import CHUNK, extended, learn, network, recognise, recognise_all

CORNERS = {
    "caret": [(0, 0), (1, 2), (2, 0)],
    "v": [(0, 2), (1, 0), (2, 2)],
    "square": [(0, 0), (2, 0), (2, 2), (0, 2), (0, 0)],
    "z": [(0, 2), (2, 2), (0, 0), (2, 0)],
}


def drawn(rng, name):
    """A stroke with a writer's proportions, slant and tremor."""
    corners = np.array(CORNERS[name], float) + rng.normal(0, 0.08, (len(CORNERS[name]), 2))
    at = np.linspace(0, len(corners) - 1, rng.integers(50, 90))
    path = np.stack([np.interp(at, np.arange(len(corners)), corners[:, k]) for k in range(2)], axis=1)
    slant = rng.normal(0, 0.12)
    turn = np.array([[np.cos(slant), -np.sin(slant)], [np.sin(slant), np.cos(slant)]])
    return (path * rng.uniform(0.8, 1.25, 2)) @ turn.T * rng.uniform(20, 200) + rng.normal(0, 0.3, path.shape)


def collection(seed, count, names=tuple(CORNERS)):
    rng = np.random.default_rng(seed)
    labels = [name for name in names for _ in range(count)]
    return jnp.stack([features([drawn(rng, name)], num_points=30) for name in labels]), labels


def strokes_last(stacked):
    return jnp.moveaxis(stacked, 0, -1)


@pytest.fixture(scope="module")
def symbols():
    return learn(*collection(0, 8), num_states=6)


@pytest.mark.system
def test_symbols_of_other_writers_are_recognised_with_confidence(symbols):
    strokes, labels = collection(1, 12)
    found = recognise(symbols, strokes_last(strokes))
    assert [symbols.names[i] for i in found.label] == labels
    np.testing.assert_allclose(found.confidence.sum(0), 1, rtol=1e-5)
    assert np.median(found.confidence.max(0)) > 0.9


@pytest.mark.system
def test_what_is_no_symbol_is_rejected_and_symbols_are_not(symbols):
    bar = hmm.threshold_model(network(symbols))
    strokes, _ = collection(2, 12)
    assert np.mean(recognise(symbols, strokes_last(strokes), bar).label >= 0) >= 0.95
    rng = np.random.default_rng(3)
    scribbles = jnp.stack([features([rng.normal(size=(14, 2))], num_points=30) for _ in range(20)])
    found = recognise(symbols, strokes_last(scribbles), bar)
    assert np.mean(found.label < 0) >= 0.9
    assert np.all(recognise(symbols, strokes_last(strokes), bar, margin=100.0).label == -1)


def test_any_number_of_strokes_is_judged_as_each_alone(symbols):
    strokes, _ = collection(2, 12)
    expected = recognise(symbols, strokes_last(strokes), hmm.threshold_model(network(symbols)), margin=0.1)
    num_strokes = len(strokes)
    many = np.tile(strokes_last(strokes), 3)
    assert many.shape[-1] > CHUNK
    lengths = np.where(np.arange(many.shape[-1]) == 3, 0, many.shape[0])
    found = recognise_all(symbols, many, lengths, margin=0.1)
    assert found.label[3] == -1
    assert found.label.shape == lengths.shape
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one[..., -num_strokes:], other, rtol=1e-4, atol=1e-5)


def test_a_symbol_that_hardly_beats_another_is_rejected(symbols):
    strokes, _ = collection(2, 12)
    found = recognise(symbols, strokes_last(strokes))
    best = np.sort(found.log_likelihood, axis=0)
    apart = best[-1] - best[-2]
    # Between two strokes, so that rounding does not decide.
    bar = float(np.mean(np.sort(apart)[[9, 10]]))
    rejected = recognise(symbols, strokes_last(strokes), distance=bar).label < 0
    np.testing.assert_array_equal(rejected, apart < bar)


@pytest.mark.system
def test_features_that_are_not_finite_are_rejected_without_nan(symbols):
    strokes, _ = collection(4, 1)
    found = recognise(symbols, strokes_last(strokes).at[3, 0, 0].set(jnp.nan))
    assert found.label[0] == -1
    assert np.all(found.label[1:] >= 0)
    assert not any(np.any(np.isnan(leaf)) for leaf in found)


@pytest.mark.system
def test_a_symbol_is_added_of_five_strokes():
    few = learn(*collection(5, 8, ("caret", "square", "v")), num_states=6)
    more = extended(few, learn(*collection(6, 5, ("z",)), num_states=6))
    assert more.names == ("caret", "square", "v", "z")
    strokes, labels = collection(7, 10)
    assert [more.names[i] for i in recognise(more, strokes_last(strokes)).label] == labels
    with pytest.raises(ValueError, match="again"):
        extended(few, few)
    with pytest.raises(ValueError, match="same shape"):
        extended(few, learn(*collection(6, 5, ("z",)), num_states=5))


@pytest.mark.system
def test_a_symbol_that_is_drawn_in_two_ways_has_two_models():
    rng = np.random.default_rng(8)
    both_ways = [drawn(rng, "square")[:: 1 if i % 2 else -1] for i in range(12)]
    strokes = jnp.concatenate(
        [jnp.stack([features([stroke], num_points=30) for stroke in both_ways]), collection(9, 1, ("z",))[0]]
    )
    found = learn(strokes, ["square"] * 12 + ["z"], num_states=6, num_variants=2)
    np.testing.assert_array_equal(found.owner, [0, 0, 1])
    assert np.all(recognise(found, strokes_last(strokes[:12])).label == 0)


def test_what_cannot_be_learnt_is_refused():
    strokes, labels = collection(10, 1)
    with pytest.raises(ValueError, match="labels"):
        learn(strokes, labels[:-1])
    with pytest.raises(ValueError, match="finite"):
        learn(strokes.at[0, 0, 0].set(jnp.nan), labels)


@pytest.mark.data
@pytest.mark.system
def test_mid_air_symbols_of_people_it_has_never_seen(data_dir: Path):
    with np.load(data_dir / "midair_leap_gestures" / "midair_leap.npz") as archive:
        recorded = dict(archive)
    ends = np.cumsum(recorded["length"])
    strokes = stacked([([stroke], 1.0) for stroke in np.split(recorded["xyz_mm"], ends[:-1])])
    right = 0
    for person in np.unique(recorded["subject"]):
        own = recorded["subject"] == person
        symbols = learn(strokes[~own], list(recorded["gesture"][~own]))
        found = recognise(symbols, strokes_last(strokes[own])).label
        right += sum(symbols.names[i] == name for i, name in zip(found, recorded["gesture"][own], strict=True))
    assert right / len(ends) >= 0.94
