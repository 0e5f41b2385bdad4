"""Hidden semi-Markov models beside the sum and the best of all segmentations, one frame at a time and at once."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf
from jaxfilters import hmm
from jaxfilters.hmm import Segment

INITIAL = np.array([0.5, 0.3, 0.2])
TRANSITION = np.array([[0.1, 0.6, 0.3], [0.5, 0.0, 0.5], [0.4, 0.6, 0.0]])
DURATIONS = np.array([[0.1, 0.5, 0.4], [0.0, 0.3, 0.7], [0.6, 0.4, 0.0]])
TAIL = np.array([0.3, 0.0, 0.6])
FRAMES = 6


def model():
    return hmm.semi_markov(INITIAL, TRANSITION, DURATIONS, tail=TAIL)


def scores(seed=0):
    return np.random.default_rng(seed).normal(0, 1.5, (FRAMES, 3))


def duration(state, frames):
    """Probability of exactly so many frames, the tail included."""
    if frames < 3:
        return DURATIONS[state, frames - 1]
    return DURATIONS[state, 2] * TAIL[state] ** (frames - 3) * (1 - TAIL[state])


def all_segmentations(log_likelihoods):
    """Probability of every sequence of segments with the frames: `[(states, starts, probability)]`."""
    found = []
    for cuts in itertools.product([False, True], repeat=FRAMES - 1):
        starts = np.array([True, *cuts])
        firsts = np.flatnonzero(starts)
        lengths = np.diff([*firsts, FRAMES])
        for labels in itertools.product(range(3), repeat=len(firsts)):
            chance = INITIAL[labels[0]]
            for i, (label, length) in enumerate(zip(labels, lengths, strict=True)):
                if i:
                    chance *= TRANSITION[labels[i - 1], label]
                # The last segment has lasted so long at least.
                last = i == len(labels) - 1
                chance *= 1 - sum(duration(label, d) for d in range(1, length)) if last else duration(label, length)
            states = np.repeat(labels, lengths)
            found.append((states, starts, chance * np.exp(log_likelihoods[np.arange(FRAMES), states].sum())))
    return found


@pytest.mark.system
def test_evidence_posterior_and_best_path_are_those_of_all_segmentations():
    log_likelihoods = scores()
    paths = all_segmentations(log_likelihoods)
    total = sum(chance for *_, chance in paths)
    with jax.enable_x64(True):
        own, frames = model(), jnp.asarray(log_likelihoods)
        np.testing.assert_allclose(hmm.semi_markov_log_evidence(own, frames), np.log(total), rtol=1e-12)
        posterior = np.zeros((FRAMES, 3))
        for states, _, chance in paths:
            posterior[np.arange(FRAMES), states] += chance / total
        np.testing.assert_allclose(hmm.semi_markov_posterior(own, frames), posterior, atol=1e-12)
        states, starts, chance = max(paths, key=lambda path: path[2])
        best = hmm.semi_markov_viterbi(own, frames)
        np.testing.assert_array_equal(best.states, states)
        np.testing.assert_array_equal(best.starts, starts)
        np.testing.assert_allclose(best.log_probability, np.log(chance), rtol=1e-12)
        # The filter sums to the same evidence and ends in the same distribution.
        _, (_, infos) = jf.run(hmm.semi_markov_online(own), jax.random.key(0), frames)
        np.testing.assert_allclose(infos.log_evidence.sum(), np.log(total), rtol=1e-12)
        np.testing.assert_allclose(infos.states[-1], posterior[-1], atol=1e-12)


def test_a_geometric_duration_is_a_hidden_markov_model():
    stays = np.array([0.9, 0.6, 0.7])
    leaves = np.where(np.eye(3, dtype=bool), 0, TRANSITION) / np.where(np.eye(3, dtype=bool), 0, TRANSITION).sum(
        axis=1, keepdims=True
    )
    chain = hmm.from_probabilities(INITIAL, np.diag(stays) + (1 - stays)[:, None] * leaves)
    geometric = hmm.semi_markov(INITIAL, leaves, np.ones((3, 1)), tail=stays)
    frames = jnp.asarray(scores(1), jnp.float32)
    expected = hmm.log_evidence(chain, frames)
    np.testing.assert_allclose(hmm.semi_markov_log_evidence(geometric, frames), expected, rtol=1e-5)
    np.testing.assert_array_equal(hmm.semi_markov_viterbi(geometric, frames).states, hmm.viterbi(chain, frames).states)


def test_an_impossible_sequence_has_no_states_and_finite_derivatives():
    frames = jnp.asarray(scores(), jnp.float32).at[2].set(-jnp.inf)
    assert hmm.semi_markov_log_evidence(model(), frames) == -jnp.inf
    assert not np.any(hmm.semi_markov_posterior(model(), frames))
    best = hmm.semi_markov_viterbi(model(), frames)
    assert np.all(best.states == -1)
    assert not np.any(best.starts)


@pytest.mark.system
def test_segments_are_reported_while_the_stream_goes_on_as_the_best_path_has_them():
    lengths, labels = [12, 9, 15, 11, 8, 10, 14], [2, 0, 2, 1, 2, 0, 2]
    truth = np.repeat(labels, lengths)
    rng = np.random.default_rng(3)
    frames = jnp.asarray(3.0 * np.eye(3)[truth] + rng.normal(0, 1.0, (len(truth), 3)), jnp.float32)
    # About ten frames, and anything between.
    bell = np.exp(-0.5 * ((np.arange(1, 21) - 10) / 3) ** 2)
    durations = np.stack([bell, bell, np.ones(20)])
    between = np.array([[0, 0, 1.0], [0, 0, 1.0], [0.5, 0.5, 0]])
    own = hmm.semi_markov([0, 0, 1], between, durations / durations.sum(axis=1, keepdims=True), tail=[0, 0, 0.9])
    filter = hmm.semi_markov_spotter(own, 2, patience=4)
    _, (_, infos) = jf.run(filter, jax.random.key(0), frames)
    at = np.flatnonzero(infos.reports)
    rows = [np.asarray(leaf)[at] for leaf in infos.found[:3]]
    found = [Segment(*map(int, row)) for row in zip(*rows, strict=True)]
    firsts = np.cumsum([0, *lengths])
    assert found == [
        Segment(label, int(firsts[i]), int(firsts[i + 1]) - 1) for i, label in enumerate(labels) if label != 2
    ]
    np.testing.assert_array_equal(at, [segment.end + 4 for segment in found])
    gains = [float((frames[s.start : s.end + 1, s.label] - frames[s.start : s.end + 1, 2]).sum()) for s in found]
    np.testing.assert_allclose(infos.found.score[at], gains, rtol=1e-4)
    # A margin between the gains leaves the weaker ones out.
    strict = hmm.semi_markov_spotter(own, 2, patience=4, margin=float(np.median(gains)))
    _, (_, infos) = jf.run(strict, jax.random.key(0), frames)
    assert int(infos.reports.sum()) == sum(gain >= np.float32(np.median(gains)) for gain in gains)


def test_frames_that_nothing_explains_are_ignored_by_the_filters():
    frames = jnp.asarray(scores(), jnp.float32)
    broken = jnp.concatenate([frames[:3], jnp.full((1, 3), jnp.nan), frames[3:]])
    for filter in (hmm.semi_markov_online(model()), hmm.semi_markov_spotter(model(), 2)):
        state, (_, infos) = jf.run(filter, jax.random.key(0), broken)
        np.testing.assert_array_equal(np.isfinite(infos.log_evidence), np.arange(FRAMES + 1) != 3)
        assert not any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves(state))


def test_a_segment_is_reported_though_the_next_one_ends_within_its_patience():
    labels = np.array([0, 0, 0, 1, 1, 2, 2, 0, 0, 0, 0, 0])
    frames = jnp.asarray(np.where(np.eye(3, dtype=bool)[labels], 0.0, -6.0), jnp.float32)
    between = np.array([[0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    own = hmm.semi_markov([1, 0, 0], between, np.array([[0.5, 0.5], [0, 1], [0, 1]]), tail=[0.5, 0, 0])
    _, (_, infos) = jf.run(hmm.semi_markov_spotter(own, 0, patience=3), jax.random.key(0), frames)
    at = np.flatnonzero(infos.reports)
    np.testing.assert_array_equal(at, [4 + 3, 6 + 3])
    np.testing.assert_array_equal(
        np.stack([np.asarray(leaf)[at] for leaf in infos.found[:3]], 1), [[1, 3, 4], [2, 5, 6]]
    )
