"""Networks of models, and symbols found in streams of which it is known where they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters
from jaxfilters import hmm
from jaxfilters.hmm import Segment

WORDS = {0: (0, 1, 2), 1: (2, 1, 0), 2: (3, 4, 3)}
"""Symbols as runs of codes; 5 and 6 occur only between them."""


def symbol(codes, num_codes=7, purity=0.94):
    """A left-right model without skips whose states each prefer one code."""
    preferred = np.full((len(codes), num_codes), (1 - purity) / (num_codes - 1))
    preferred[np.arange(len(codes)), codes] = purity
    stays, first = np.eye(len(codes)), hmm.left_right_initial(len(codes))
    steps = 0.7 * stays + 0.3 * np.roll(stays, 1, axis=1)
    steps[-1] = stays[-1]
    return hmm.from_probabilities(first, steps, hmm.Codes(jnp.asarray(np.log(preferred), dtype=float)))


def network(leaving=0.1):
    return hmm.parallel_composition([symbol(codes) for codes in WORDS.values()], exit_probability=leaving)


def with_filler():
    """The symbols, and as the last model what lies between them: anything."""
    anything = hmm.from_probabilities([1.0], [[1.0]], hmm.Codes(jnp.full((1, 7), -np.log(7.0), dtype=float)))
    return hmm.parallel_composition([*(symbol(codes) for codes in WORDS.values()), anything])


NOT_THE_FILLER = jnp.array([0.0, 0.0, 0.0, -jnp.inf])


def spotter(**more):
    return hmm.spotter(with_filler(), **{"log_prior": NOT_THE_FILLER, **more})


def stream(seed, labels, gap=(6, 12)):
    """Codes, and where the symbols are."""
    rng = np.random.default_rng(seed)
    codes, truth = [], []
    for label in labels:
        codes += list(rng.integers(5, 7, rng.integers(*gap)))
        start = len(codes)
        for code in WORDS[label]:
            codes += [code] * int(rng.integers(3, 6))
        truth.append(Segment(label, start, len(codes) - 1))
    return jnp.asarray([*codes, *rng.integers(5, 7, 12)]), truth


def spotted(filter, codes, **more):
    _, (_, infos) = jaxfilters.run(filter, jax.random.key(0), codes, **more)
    frames = np.flatnonzero(infos.reports)
    found = [jax.tree.map(lambda leaf, t=t: leaf[t], infos.found) for t in frames]
    return [Segment(int(f.label), int(f.start), int(f.end)) for f in found], frames, infos


def test_models_side_by_side_keep_their_states_apart():
    row = network()
    np.testing.assert_array_equal(row.part, np.repeat([0, 1, 2], 3))
    np.testing.assert_array_equal(row.final, [False, False, True] * 3)
    apart = np.asarray(row.part)[:, None] != np.asarray(row.part)
    assert np.all(np.asarray(row.model.log_transition)[apart] == -np.inf)
    own = np.exp(symbol(WORDS[1]).log_transition) * np.array([[1], [1], [0.9]])
    np.testing.assert_allclose(np.exp(row.model.log_transition[3:6, 3:6]), own, rtol=1e-5)
    np.testing.assert_array_equal(row.model.emission.log_probability[6:], symbol(WORDS[2]).emission.log_probability)
    with pytest.raises(ValueError, match="final"):
        hmm.parallel_composition([symbol(WORDS[0])], [np.ones(2, bool)])
    with pytest.raises(ValueError, match="exit_probability"):
        network(leaving=1.0)
    with pytest.raises(ValueError, match="one class"):
        hmm.parallel_composition([symbol(WORDS[0]), hmm.from_topology(hmm.ergodic(2))])


def test_the_threshold_is_between_the_right_symbol_and_the_wrong_ones():
    row = network()
    null = hmm.threshold_model(row)
    np.testing.assert_allclose(np.exp(null.log_transition).sum(1), 1, rtol=1e-5)
    np.testing.assert_allclose(np.exp(np.diagonal(null.log_transition))[:2], 0.7, rtol=1e-5)
    np.testing.assert_allclose(np.exp(null.log_initial), 1 / 9, rtol=1e-5)
    for label, codes in WORDS.items():
        y = jnp.repeat(jnp.array(codes), 4)
        bar = hmm.log_evidence(null, null.log_likelihoods(y))
        for other in WORDS:
            own = symbol(WORDS[other])
            score = hmm.log_evidence(own, own.log_likelihoods(y))
            assert (score > bar) == (other == label)
    one = hmm.threshold_model(hmm.parallel_composition([symbol((0,))]))
    np.testing.assert_array_equal(one.log_transition, 0)


def test_the_viterbi_path_of_a_loop_cuts_a_stream_into_its_symbols():
    row = network(leaving=0.3)
    chain = hmm.loop(row)
    np.testing.assert_allclose(np.exp(chain.log_transition).sum(1), 1, rtol=1e-5)
    np.testing.assert_allclose(np.exp(chain.log_initial).sum(), 1, rtol=1e-5)
    labels = [0, 2, 0, 0, 2, 1]
    codes = np.concatenate([np.repeat(WORDS[label], 4) for label in labels])
    path = hmm.viterbi(chain, chain.log_likelihoods(jnp.asarray(codes)))
    expected = [Segment(label, 12 * i, 12 * i + 11) for i, label in enumerate(labels)]
    assert hmm.segments(np.asarray(path.states), row) == expected
    assert hmm.segments(np.full(4, -1), row) == []
    never_repeats = hmm.loop(row, part_transition=(1 - np.eye(3)) / 2)
    assert np.all(never_repeats.log_transition[2, :2] == -np.inf)
    with pytest.raises(ValueError, match="part_transition"):
        hmm.loop(row, part_transition=np.eye(2))


@pytest.mark.parametrize("seed", range(4))
def test_symbols_are_found_online_with_their_first_and_last_frames(seed):
    labels = np.random.default_rng(seed).integers(0, 3, 8)
    codes, truth = stream(seed, labels)
    found, reported, infos = spotted(spotter(patience=4), codes)
    assert [one.label for one in found] == list(labels)
    for one, true, frame in zip(found, truth, reported, strict=True):
        assert abs(one.start - true.start) <= 1
        assert abs(one.end - true.end) <= 1
        assert true.end < frame <= one.end + 4
    assert np.all(np.isfinite(infos.log_evidence))


def test_symbols_that_follow_each_other_at_once_are_both_found():
    codes = jnp.asarray(np.concatenate([[5, 6, 5], np.repeat(WORDS[2], 4), np.repeat(WORDS[0], 4), [5, 6, 5, 6, 5]]))
    found, *_ = spotted(spotter(patience=20), codes)
    assert found == [Segment(2, 3, 14), Segment(0, 15, 26)]


def test_what_is_no_symbol_is_not_reported():
    codes = jnp.asarray(np.random.default_rng(9).integers(0, 7, 300))
    found, *_ = spotted(spotter(margin=6.0), codes)
    assert found == []
    y, truth = stream(5, [0, 1])
    assert spotted(spotter(margin=100.0), y)[0] == []
    assert spotted(spotter(min_frames=30), y)[0] == []
    only_one = spotter(log_prior=NOT_THE_FILLER.at[0].set(-jnp.inf))
    assert [one.label for one in spotted(only_one, y)[0]] == [1]
    assert len(truth) == 2


def test_a_stream_goes_on_after_impossible_and_missing_frames():
    codes, truth = stream(6, [0, 1, 2])
    broken = codes.at[truth[0].start - 2].set(99)
    mask = jnp.ones(len(codes), bool).at[truth[1].start + 2].set(False)
    found, _, infos = spotted(spotter(), broken, mask=mask)
    assert [one.label for one in found] == [0, 1, 2]
    assert infos.log_evidence[truth[0].start - 2] == -np.inf
    assert not any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves(infos))


def test_a_spotter_refuses_what_makes_no_sense():
    with pytest.raises(ValueError, match="null"):
        hmm.spotter(network(), hmm.from_topology(hmm.ergodic(2)))
    with pytest.raises(ValueError, match="patience"):
        hmm.spotter(network(), patience=0)
