"""The recursions against sums and maxima over all paths, and what must hold for impossible and padded sequences."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfilters import hmm

NUM_STATES, NUM_FRAMES = 3, 6


def chain(seed, num_states=NUM_STATES, allowed=None):
    rng = np.random.default_rng(seed)
    transition = rng.dirichlet(np.ones(num_states), num_states)
    if allowed is not None:
        transition = transition * allowed / (transition * allowed).sum(1, keepdims=True)
    return hmm.from_probabilities(rng.dirichlet(np.ones(num_states)), transition)


def scores(seed, num_frames=NUM_FRAMES, num_states=NUM_STATES, batch=()):
    return jnp.asarray(3 * np.random.default_rng(seed).normal(size=(num_frames, num_states, *batch)), dtype=float)


def all_paths(model, log_likelihoods):
    """Every path (n, T) and its log probability with the observations."""
    e, first, step = (np.asarray(x, np.float64) for x in (log_likelihoods, model.log_initial, model.log_transition))
    paths = np.array(list(itertools.product(range(e.shape[1]), repeat=len(e))))
    logs = first[paths[:, 0]] + step[paths[:, :-1], paths[:, 1:]].sum(1) + e[np.arange(len(e)), paths].sum(1)
    return paths, logs


def in_float64(model, log_likelihoods):
    """Scaled forward pass of the textbook in numpy (Rabiner 1989, section V.A)."""
    e = np.asarray(log_likelihoods, np.float64)
    A = np.exp(np.asarray(model.log_transition, np.float64))
    alpha, total = np.exp(np.asarray(model.log_initial, np.float64)), 0.0
    for t, frame in enumerate(e):
        alpha = (alpha if t == 0 else alpha @ A) * np.exp(frame - frame.max())
        total += frame.max() + np.log(alpha.sum())
        alpha = alpha / alpha.sum()
    return total


@pytest.mark.parametrize("allowed", [None, hmm.left_right(3, max_jump=1)], ids=["ergodic", "left-right"])
def test_everything_agrees_with_the_sum_over_all_paths(x64, allowed):
    model, e = chain(0, allowed=allowed), scores(1)
    paths, logs = all_paths(model, e)
    total = np.logaddexp.reduce(logs)
    share = np.exp(logs - total)
    np.testing.assert_allclose(hmm.log_evidence(model, e), total, rtol=0, atol=1e-10)

    states = (share[:, None, None] * (paths[..., None] == np.arange(NUM_STATES))).sum(0)
    moves = (paths[:, :-1, None, None] == np.arange(NUM_STATES)[:, None]) & (
        paths[:, 1:, None, None] == np.arange(NUM_STATES)
    )
    found = hmm.posterior(model, e)
    np.testing.assert_allclose(found.states, states, atol=1e-12)
    np.testing.assert_allclose(found.transitions, (share[:, None, None, None] * moves).sum((0, 1)), atol=1e-12)
    np.testing.assert_allclose(found.log_evidence, total, atol=1e-10)

    best = hmm.viterbi(model, e)
    np.testing.assert_array_equal(best.states, paths[logs.argmax()])
    np.testing.assert_allclose(best.log_probability, logs.max(), atol=1e-12)
    assert best.log_probability <= total


def test_forward_and_backward_meet_in_every_frame(x64):
    model, e = chain(2), scores(3)
    filtered, beta = hmm.forward(model, e), hmm.backward(model, e)
    log_alpha = np.log(filtered.probabilities) + np.cumsum(filtered.log_evidence_per_step)[:, None]
    np.testing.assert_allclose(
        np.logaddexp.reduce(log_alpha + beta, axis=1), np.full(NUM_FRAMES, filtered.log_evidence), atol=1e-12
    )
    for t in range(NUM_FRAMES):
        np.testing.assert_allclose(filtered.log_evidence_per_step[: t + 1].sum(), hmm.log_evidence(model, e[: t + 1]))


def test_the_gradient_is_the_expected_statistics_and_agrees_with_differences(x64):
    model, e = chain(4), scores(5)
    by_model, by_scores = jax.grad(hmm.log_evidence, argnums=(0, 1))(model, e)
    found = hmm.posterior(model, e)
    np.testing.assert_allclose(by_scores, found.states, atol=1e-14)
    np.testing.assert_allclose(by_model.log_transition, found.transitions, atol=1e-14)
    np.testing.assert_allclose(by_model.log_initial, found.states[0], atol=1e-14)
    check_grads(hmm.log_evidence, (model, e), order=1, modes=["rev"], atol=1e-6, rtol=1e-6)


@pytest.mark.system
def test_sequences_along_the_last_axis_under_vmap_and_padded_are_those_on_their_own(x64):
    lengths = np.array([7, 0, 1, 9])
    model, e = chain(6), scores(7, 9, batch=(4,))
    padded = jnp.where(np.arange(9)[:, None, None] < lengths, e, jnp.nan)
    filtered, found, best = (f(model, padded, lengths) for f in (hmm.forward, hmm.posterior, hmm.viterbi))
    backward = hmm.backward(model, padded, lengths)
    mapped = jax.vmap(hmm.posterior, (None, -1, 0))(model, padded, lengths)
    np.testing.assert_allclose(jnp.moveaxis(mapped.states, 0, -1), found.states, atol=1e-14)
    np.testing.assert_allclose(mapped.transitions.sum(0), found.transitions, atol=1e-14)
    np.testing.assert_allclose(hmm.log_evidence(model, padded, lengths), found.log_evidence, atol=1e-14)
    for i, length in enumerate(lengths):
        own = e[:length, :, i]
        alone = [f(model, own) for f in (hmm.forward, hmm.posterior, hmm.viterbi)]
        np.testing.assert_allclose(found.log_evidence[i], alone[1].log_evidence, atol=1e-12)
        np.testing.assert_allclose(filtered.probabilities[:length, :, i], alone[0].probabilities, atol=1e-13)
        np.testing.assert_allclose(
            filtered.log_evidence_per_step[:length, i], alone[0].log_evidence_per_step, atol=1e-12
        )
        np.testing.assert_allclose(found.states[:length, :, i], alone[1].states, atol=1e-13)
        np.testing.assert_allclose(best.log_probability[i], alone[2].log_probability, atol=1e-12)
        np.testing.assert_array_equal(best.states[:length, i], alone[2].states)
        np.testing.assert_allclose(backward[:length, :, i], hmm.backward(model, own), atol=1e-12)
        assert not np.any(found.states[length:, :, i])
        assert not np.any(filtered.probabilities[length:, :, i])
        assert np.all(best.states[length:, i] == -1)


def test_a_gradient_ignores_padding_and_sequences_without_frames(x64):
    model, e = chain(8), scores(9, 5, batch=(2,))
    padded = e.at[3:, :, 0].set(jnp.nan).at[:, :, 1].set(jnp.nan)
    total = lambda model, e, lengths: hmm.log_evidence(model, e, lengths).sum()
    by_model, by_scores = jax.grad(total, argnums=(0, 1))(model, padded, jnp.array([3, 0]))
    own_model, own_scores = jax.grad(hmm.log_evidence, argnums=(0, 1))(model, e[:3, :, 0])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-14), by_model, own_model)
    np.testing.assert_allclose(by_scores[:3, :, 0], own_scores, atol=1e-14)
    assert not np.any(by_scores[3:, :, 0])
    assert not np.any(by_scores[:, :, 1])


@pytest.mark.parametrize("broken", [-np.inf, np.nan])
@pytest.mark.parametrize("frame", [0, 3, 5])
def test_an_impossible_observation_is_minus_infinity_and_never_nan(broken, frame):
    model, e = chain(10), scores(11, batch=(2,)).at[frame, :, 0].set(broken)
    filtered, found, best = (f(model, e) for f in (hmm.forward, hmm.posterior, hmm.viterbi))
    for value in (filtered.log_evidence, found.log_evidence, best.log_probability, hmm.log_evidence(model, e)):
        assert value[0] == -np.inf
        assert np.isfinite(value[1])
    assert np.all(filtered.log_evidence_per_step[frame:, 0] == -np.inf)
    assert np.all(best.states[:, 0] == -1)
    assert not np.any(found.states[..., 0])
    np.testing.assert_allclose(found.transitions.sum(), NUM_FRAMES - 1, rtol=1e-5)
    gradients = jax.grad(lambda *args: hmm.log_evidence(*args).sum(), argnums=(0, 1))(model, e)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((gradients, found.states, filtered.probabilities)))
    assert not np.any(np.isnan(hmm.backward(model, e)))


def test_a_path_that_the_topology_forbids_is_impossible():
    model = hmm.from_topology(hmm.left_right(3, max_jump=1), initial=hmm.left_right_initial(3))
    backwards = jnp.where(jnp.eye(3)[::-1] > 0, 0.0, -jnp.inf)
    assert hmm.log_evidence(model, backwards) == -np.inf
    assert hmm.viterbi(model, backwards).log_probability == -np.inf
    np.testing.assert_allclose(hmm.log_evidence(model, backwards[::-1]), 2 * np.log(0.5), rtol=1e-5)


def test_a_chain_may_fall_far_behind_and_win_in_float32():
    """The state ahead explains 12 frames better by 10 nats each, but cannot explain the last one."""
    model = hmm.from_topology(hmm.left_right(2, max_jump=1), initial=hmm.left_right_initial(2))
    e = jnp.zeros((13, 2)).at[1:12, 0].set(-10.0).at[12].set(jnp.array([0.0, -jnp.inf]))
    np.testing.assert_allclose(hmm.log_evidence(model, e), -110 + 12 * np.log(0.5), rtol=1e-5)
    np.testing.assert_allclose(hmm.posterior(model, e).states[:, 0], 1, rtol=1e-6)


def test_ten_thousand_frames_in_float32_agree_with_float64():
    rng = np.random.default_rng(12)
    model, e = chain(12, 5), jnp.asarray(rng.normal(-4, 6, size=(10_000, 5)), jnp.float32)
    expected = in_float64(model, e)
    np.testing.assert_allclose(hmm.log_evidence(model, e), expected, rtol=0, atol=0.004)
    found = hmm.posterior(model, e)
    np.testing.assert_allclose(found.log_evidence, expected, rtol=0, atol=0.004)
    np.testing.assert_allclose(found.states.sum(1), 1, rtol=1e-5)
    np.testing.assert_allclose(found.transitions.sum(), 9999, rtol=1e-5)
    with jax.enable_x64(True):
        exact = hmm.posterior(
            jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), model), jnp.asarray(e, jnp.float64)
        )
    np.testing.assert_allclose(found.states, exact.states, atol=1e-4)
    assert np.mean(hmm.viterbi(model, e).states == hmm.viterbi(jax.tree.map(jnp.asarray, model), e).states) == 1


def test_hundreds_of_nats_between_states_are_no_trouble_in_float32():
    model, e = chain(13), jnp.asarray(np.random.default_rng(13).normal(0, 1000, size=(50, 3)), jnp.float32)
    _, expected = best_by_hand(model, e)
    np.testing.assert_allclose(hmm.log_evidence(model, e), expected, rtol=1e-5)


def test_what_is_seen_may_be_much_likelier_in_a_state_that_cannot_be_in_float32():
    model = hmm.from_topology(hmm.left_right(2, max_jump=1), initial=hmm.left_right_initial(2))
    e = jnp.zeros((20, 2)).at[0].set(jnp.array([-500.0, 0.0])).at[17].set(jnp.array([-jnp.inf, -300.0]))
    np.testing.assert_allclose(hmm.log_evidence(model, e), -800 + np.log1p(-(0.5**17)), rtol=1e-6)


@pytest.mark.parametrize("num_frames", [3, 16, 35])
def test_the_evidence_of_the_filtered_states_has_the_gradient_of_the_log_likelihood(x64, num_frames):
    model, e = chain(18, allowed=hmm.left_right(3, max_jump=1)), scores(19, num_frames, batch=(2,))
    by_frames = jax.grad(lambda model, e: hmm.forward(model, e).log_evidence.sum(), argnums=(0, 1))(model, e)
    at_once = jax.grad(lambda model, e: hmm.log_evidence(model, e).sum(), argnums=(0, 1))(model, e)
    found, expected = (tree[0].log_transition for tree in (by_frames, at_once))
    possible = np.isfinite(model.log_transition)
    np.testing.assert_allclose(found[possible], expected[possible], atol=1e-10)
    np.testing.assert_allclose(by_frames[1], at_once[1], atol=1e-12)


def best_by_hand(model, e):
    e, first, step = (np.asarray(x, np.float64) for x in (e, model.log_initial, model.log_transition))
    score, back = first + e[0], []
    for frame in e[1:]:
        reached = score[:, None] + step
        back.append(reached.argmax(0))
        score = reached.max(0) + frame
    path = [score.argmax()]
    for origin in reversed(back):
        path.append(origin[path[-1]])
    return path[::-1], score.max()


@pytest.mark.parametrize("num_states", [2, 16, 17])
def test_viterbi_agrees_with_numpy_for_few_and_many_states(num_states):
    model, e = chain(14, num_states), scores(15, 40, num_states)
    path, score = best_by_hand(model, e)
    best = hmm.viterbi(model, e)
    np.testing.assert_array_equal(best.states, path)
    np.testing.assert_allclose(best.log_probability, score, rtol=1e-6)


def test_no_frames_at_all_say_nothing():
    model, e = chain(16), jnp.zeros((0, NUM_STATES, 2))
    found, best = hmm.posterior(model, e), hmm.viterbi(model, e)
    np.testing.assert_array_equal(found.log_evidence, 0)
    np.testing.assert_array_equal(found.transitions, 0)
    np.testing.assert_array_equal(best.log_probability, 0)
    assert hmm.forward(model, e).probabilities.shape == hmm.backward(model, e).shape == (0, NUM_STATES, 2)
    assert not np.any(jax.grad(lambda model: hmm.log_evidence(model, e).sum())(model).log_initial)


def test_hmmlearn_agrees():
    library = pytest.importorskip("hmmlearn.hmm", reason="hmmlearn is not installed")
    rng = np.random.default_rng(17)
    emission = hmm.Codes(jnp.log(jnp.asarray(rng.dirichlet(np.ones(5), NUM_STATES), dtype=float)))
    ours = hmm.from_probabilities(rng.dirichlet(np.ones(NUM_STATES)), rng.dirichlet(np.ones(3), 3), emission)
    theirs = library.CategoricalHMM(NUM_STATES)
    theirs.startprob_, theirs.transmat_ = np.exp(ours.log_initial), np.exp(ours.log_transition)
    theirs.emissionprob_ = np.exp(emission.log_probability)
    y = rng.integers(0, 5, (200, 1))
    e = ours.log_likelihoods(jnp.asarray(y[:, 0]))
    np.testing.assert_allclose(hmm.log_evidence(ours, e), theirs.score(y), rtol=1e-5)
    np.testing.assert_allclose(hmm.posterior(ours, e).states, theirs.predict_proba(y), atol=1e-4)
    np.testing.assert_allclose(hmm.viterbi(ours, e).log_probability, theirs.decode(y)[0], rtol=1e-5)
