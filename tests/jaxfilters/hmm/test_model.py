"""Models: what is refused, what topologies allow, draws, frames that were not seen, and the online filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters
from jaxfilters import hmm

TRANSITION = np.array([[0.8, 0.2, 0.0], [0.0, 0.7, 0.3], [0.5, 0.0, 0.5]])
INITIAL = np.array([0.5, 0.25, 0.25])


def model():
    codes = np.array([[0.9, 0.1, 0.0], [0.2, 0.6, 0.2], [0.1, 0.0, 0.9]])
    with np.errstate(divide="ignore"):
        return hmm.from_probabilities(INITIAL, TRANSITION, hmm.Codes(jnp.asarray(np.log(codes), dtype=float)))


@pytest.mark.parametrize(
    ("initial", "transition", "named"),
    [
        ([0.5, 0.6], np.eye(2), "initial"),
        ([0.5, 0.5], np.ones((2, 2)), "transition"),
        ([1.5, -0.5], np.eye(2), "initial"),
        ([0.5, 0.5], np.eye(3), "transition"),
        ([np.nan, 1.0], np.eye(2), "initial"),
        ([], np.zeros((0, 0)), "Q > 0"),
    ],
)
def test_what_is_no_probability_is_refused(initial, transition, named):
    with pytest.raises(ValueError, match=named):
        hmm.from_probabilities(initial, transition)


def test_topologies():
    np.testing.assert_array_equal(hmm.left_right(3, max_jump=1), [[1, 1, 0], [0, 1, 1], [0, 0, 1]])
    np.testing.assert_array_equal(hmm.left_right(4)[0], [1, 1, 1, 0])
    assert hmm.ergodic(3).all()
    built = hmm.from_topology(hmm.left_right(3), initial=hmm.left_right_initial(3))
    np.testing.assert_allclose(np.exp(built.log_transition), [[1 / 3] * 3, [0, 0.5, 0.5], [0, 0, 1]], rtol=1e-6)
    np.testing.assert_array_equal(np.exp(built.log_initial), [1, 0, 0])
    for wrong in (lambda: hmm.left_right(0), lambda: hmm.left_right(2, max_jump=0), lambda: hmm.ergodic(0)):
        with pytest.raises(ValueError, match="at least 1"):
            wrong()
    with pytest.raises(ValueError, match="every row"):
        hmm.from_topology(np.array([[True, True], [False, False]]))


def test_draws_follow_the_chain_and_the_emission():
    states, y = hmm.sample(jax.random.key(0), model(), 40_000)
    states, y = np.asarray(states), np.asarray(y)
    for i in range(3):
        after, observed = states[1:][states[:-1] == i], y[states == i]
        count = len(after)
        # 4 standard deviations of a relative frequency; what is impossible never happens.
        np.testing.assert_allclose(np.bincount(after, minlength=3) / count, TRANSITION[i], atol=2 / np.sqrt(count))
        np.testing.assert_allclose(
            np.bincount(observed, minlength=3) / len(observed),
            np.exp(model().emission.log_probability[i]),
            atol=2 / count**0.5,
        )
        assert not np.any(np.isin(after, np.flatnonzero(TRANSITION[i] == 0)))
    firsts = jax.vmap(lambda key: hmm.sample(key, model(), 1)[0][0])(jax.random.split(jax.random.key(1), 2000))
    np.testing.assert_allclose(np.bincount(firsts, minlength=3) / 2000, INITIAL, atol=2 / np.sqrt(2000))
    assert hmm.sample(jax.random.key(0), hmm.from_probabilities(INITIAL, TRANSITION), 3)[1] is None


@pytest.mark.system
def test_the_online_filter_is_the_forward_pass(x64):
    ours = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), model())
    y = jnp.array([0, 0, 1, 2, 2, 0, 1])
    filtered = hmm.forward(ours, ours.log_likelihoods(y))
    _, (states, infos) = jaxfilters.run(hmm.online(ours), jax.random.key(0), y)
    np.testing.assert_allclose(np.exp(states.log_probabilities), filtered.probabilities, atol=1e-12)
    np.testing.assert_allclose(infos.log_evidence, filtered.log_evidence_per_step, atol=1e-12)
    np.testing.assert_array_equal(infos.most_probable, filtered.probabilities.argmax(1))
    own = hmm.HiddenMarkovModel(ours.log_initial, ours.log_transition)
    total = jaxfilters.log_evidence(hmm.online(own), jax.random.key(0), ours.log_likelihoods(y))
    np.testing.assert_allclose(total, filtered.log_evidence, atol=1e-12)
    gradient = jax.grad(lambda f: jaxfilters.log_evidence(f, jax.random.key(0), y))(hmm.online(ours)).params
    expected = jax.grad(lambda model: hmm.log_evidence(model, model.log_likelihoods(y)))(ours)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), gradient, expected)


def test_frames_that_were_not_seen_are_predicted_over(x64):
    ours = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), model())
    y, mask = jnp.array([0, 7, 1, -3, 2]), jnp.array([True, False, True, False, True])
    scores = ours.log_likelihoods(y, mask)
    np.testing.assert_array_equal(scores[1], 0)
    total = hmm.log_evidence(ours, scores)
    summed = np.logaddexp.reduce(
        [hmm.log_evidence(ours, ours.log_likelihoods(y.at[1].set(a).at[3].set(b))) for a in range(3) for b in range(3)]
    )
    np.testing.assert_allclose(total, summed, atol=1e-12)
    by_filter = jaxfilters.log_evidence(hmm.online(ours), jax.random.key(0), y, mask=mask)
    np.testing.assert_allclose(by_filter, total, atol=1e-12)


def test_an_impossible_observation_leaves_the_online_filter_where_it_was():
    filter = hmm.online(model())
    state = jaxfilters.predict(filter, jax.random.key(0), jaxfilters.init(filter, jax.random.key(0)))
    after, info = jaxfilters.update(filter, jax.random.key(0), state, jnp.array(9))
    assert info.log_evidence == -np.inf
    np.testing.assert_array_equal(after.log_probabilities, state.log_probabilities)
    gradient = jax.grad(lambda f: jaxfilters.log_evidence(f, jax.random.key(0), jnp.array([0, 9, 2])))(filter)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_a_log_likelihood_that_is_nan_shows_in_the_evidence_of_the_online_filter():
    filter = hmm.online(hmm.from_probabilities(INITIAL, TRANSITION))
    readings = jnp.zeros((3, len(INITIAL))).at[1, 0].set(jnp.nan)
    _, (states, infos) = jaxfilters.run(filter, jax.random.key(0), readings)
    np.testing.assert_array_equal(np.isnan(infos.log_evidence), [False, True, False])
    assert np.all(np.isfinite(states.log_probabilities))


def test_a_model_without_emission_says_so():
    with pytest.raises(ValueError, match="no emission"):
        hmm.from_probabilities(INITIAL, TRANSITION).log_likelihoods(jnp.zeros(3))
