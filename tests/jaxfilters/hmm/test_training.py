"""Expectation-maximisation: it never loses, keeps its zeros, ignores padding, and finds what data were drawn from."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import hmm
from jaxfilters._struct import pytree_dataclass

NUM_CODES = 17


def code_model(seed=0, num_states=4, pseudo_count=0.1):
    rng = np.random.default_rng(seed)
    codes = hmm.Codes(jnp.asarray(np.log(rng.dirichlet(np.ones(NUM_CODES), num_states)), dtype=float), pseudo_count)
    counts = hmm.Codes(jnp.asarray(np.log(rng.dirichlet(np.ones(6), num_states)), dtype=float), pseudo_count)
    first = hmm.left_right_initial(num_states)
    return hmm.from_topology(hmm.left_right(num_states), hmm.Independent((codes, counts)), initial=first)


def code_sequences(seed=1, lengths=(20, 5, 13, 0, 30)):
    rng = np.random.default_rng(seed)
    return [(rng.integers(0, NUM_CODES, n), rng.integers(0, 6, n)) for n in lengths]


@pytest.mark.parametrize("pseudo_count", [0.0, 0.3])
def test_the_objective_never_falls_rows_sum_to_one_and_zeros_stay(x64, pseudo_count):
    model = code_model()
    observations, lengths = hmm.pad(code_sequences())
    trained = hmm.baum_welch(
        model, observations, lengths, max_iterations=25, tolerance=0.0, transition_pseudo_count=pseudo_count
    )
    gain = np.diff(trained.objective)
    assert np.all(gain >= -1e-8 * abs(trained.objective[1:]))
    assert trained.objective[-1] > trained.objective[0] + 10
    learned = trained.model
    for rows in (
        learned.log_initial,
        learned.log_transition,
        *(part.log_probability for part in learned.emission.parts),
    ):
        np.testing.assert_allclose(np.exp(rows).sum(-1), 1, rtol=0, atol=1e-12)
    assert np.all(learned.log_transition[~hmm.left_right(4)] == -np.inf)
    assert np.all(learned.log_initial[1:] == -np.inf)


@pytest.mark.parametrize("family", ["diagonal", "full"])
def test_the_objective_never_falls_for_gaussians_with_a_floor(x64, family):
    rng = np.random.default_rng(2)
    sequences = [np.cumsum(rng.normal(size=(n, 2)), axis=0) for n in (30, 12, 25)] + [np.zeros((5, 2))]
    observations, lengths = hmm.pad(sequences)
    emission = {
        "diagonal": hmm.DiagonalGaussian(jnp.zeros((3, 2)), jnp.ones((3, 2)), 0.3),
        "full": hmm.FullGaussian(jnp.zeros((3, 2)), jnp.tile(jnp.eye(2), (3, 1, 1)), 0.3),
    }[family]
    start = hmm.from_topology(hmm.ergodic(3), emission)
    start = hmm.with_responsibilities(start, observations, hmm.uniform_segmentation(lengths, len(observations), 3))
    trained = hmm.baum_welch(start, observations, lengths, max_iterations=40, tolerance=0.0)
    assert np.all(np.diff(trained.objective) >= -1e-8 * abs(trained.objective[1:]))
    assert np.all(np.isfinite(trained.objective))


def test_padding_of_any_content_and_empty_sequences_change_nothing(x64):
    model, sequences = code_model(), code_sequences()
    observations, lengths = hmm.pad(sequences)
    broken = jax.tree.map(lambda y: jnp.where(jnp.arange(len(y))[:, None] < lengths, y, -99), observations)
    fewer, their_lengths = hmm.pad([sequence for sequence in sequences if len(sequence[0])], 40)
    expected = hmm.baum_welch(model, observations, lengths, max_iterations=5)
    for other, counts in ((broken, lengths), (fewer, their_lengths)):
        found = hmm.baum_welch(model, other, counts, max_iterations=5)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), found, expected)


@pytest.mark.system
def test_one_iteration_moves_to_the_expected_counts(x64):
    model = code_model(3, pseudo_count=0.0)
    (codes, counts), _ = hmm.pad(code_sequences(4, (9,)))
    found = hmm.posterior(model, model.log_likelihoods((codes[:, 0], counts[:, 0])))
    learned = hmm.baum_welch(model, (codes, counts), max_iterations=1).model
    totals = found.transitions.sum(1, keepdims=True)
    np.testing.assert_allclose(np.exp(learned.log_transition), found.transitions / totals, atol=1e-12)
    own = np.stack([found.states[codes[:, 0] == c].sum(0) for c in range(NUM_CODES)], axis=1)
    np.testing.assert_allclose(
        np.exp(learned.emission.parts[0].log_probability), own / own.sum(1, keepdims=True), atol=1e-12
    )


def test_many_models_are_trained_at_once_by_vmap(x64):
    models = [code_model(5), code_model(6)]
    data = [hmm.pad(code_sequences(seed), 30) for seed in (7, 8)]
    stack = lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves])
    together = jax.vmap(hmm.baum_welch)(
        jax.tree.map(stack, *models), jax.tree.map(stack, *[y for y, _ in data]), stack(*[n for _, n in data])
    )
    for i, (model, (y, n)) in enumerate(zip(models, data, strict=True)):
        alone = hmm.baum_welch(model, y, n)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-10), together, alone)


@pytest.mark.system
def test_the_model_that_drew_the_data_is_found_again():
    truth = hmm.from_probabilities(
        [1.0, 0.0],
        [[0.9, 0.1], [0.2, 0.8]],
        hmm.DiagonalGaussian(jnp.array([[-1.0], [2.0]]), jnp.array([[0.25], [1.0]])),
    )
    keys = jax.random.split(jax.random.key(9), 60)
    _, y = jax.vmap(lambda key: hmm.sample(key, truth, 100), out_axes=-1)(keys)
    start = hmm.from_topology(
        hmm.ergodic(2), hmm.DiagonalGaussian(jnp.zeros((2, 1)), jnp.ones((2, 1))), initial=np.array([True, True])
    )
    trained = hmm.best_of_restarts(jax.random.key(10), start, y, jnp.full(60, 100), num_restarts=4)
    learned = trained.model
    order = np.argsort(np.asarray(learned.emission.mean[:, 0]))
    # Some 4000 and 2000 frames: 4 standard deviations, roughly.
    np.testing.assert_allclose(learned.emission.mean[order, 0], [-1, 2], atol=0.1)
    np.testing.assert_allclose(learned.emission.variance[order, 0], [0.25, 1], rtol=0.15)
    np.testing.assert_allclose(
        np.exp(learned.log_transition)[np.ix_(order, order)], [[0.9, 0.1], [0.2, 0.8]], atol=0.04
    )
    assert trained.converged
    assert trained.num_iterations < 30
    likelihood = lambda model: hmm.log_evidence(model, jax.vmap(model.log_likelihoods, -1, -1)(y)).sum()
    assert likelihood(learned) >= likelihood(truth) - 1


def test_frames_that_were_not_seen_teach_nothing_but_take_time(x64):
    model, rng = code_model(11), np.random.default_rng(12)
    observations, lengths = hmm.pad(code_sequences(13))
    mask = rng.uniform(size=observations[0].shape) < 0.7
    hidden = jax.tree.map(lambda y: jnp.where(mask, y, -1), observations)
    trained = hmm.baum_welch(model, hidden, lengths, mask, max_iterations=20, tolerance=0.0)
    assert np.all(np.diff(trained.objective) >= -1e-8 * abs(trained.objective[1:]))
    assert trained.num_impossible == 0


def test_impossible_sequences_are_counted_and_left_out():
    model = code_model(14, pseudo_count=0.1)
    sequences = code_sequences(15, (10, 12))
    expected = hmm.baum_welch(model, *hmm.pad(sequences, 12), max_iterations=3)
    impossible = (np.full(8, 99), np.zeros(8, int))
    observations, lengths = hmm.pad([*sequences, impossible], 12)
    with pytest.raises(ValueError, match=r"codes from 0 to 16 where.*got 99 in frame 0"):
        hmm.baum_welch(model, observations, lengths, max_iterations=3)
    # Where values are not known before compilation.
    found = jax.jit(partial(hmm.baum_welch, max_iterations=3))(model, observations, lengths)
    assert (found.num_impossible, expected.num_impossible) == (1, 0)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), found.model, expected.model)


def test_starts_divide_sequences_evenly_or_pick_random_frames():
    shares = hmm.uniform_segmentation(jnp.array([6, 2, 0]), 6, 3)
    np.testing.assert_array_equal(shares[:, :, 0], np.repeat(np.eye(3), 2, axis=0))
    np.testing.assert_array_equal(shares[:, :, 1].sum(1), [1, 1, 0, 0, 0, 0])
    assert not np.any(shares[:, :, 2])
    random = hmm.random_responsibilities(jax.random.key(16), jnp.array([6, 2, 0]), 6, 3)
    np.testing.assert_allclose(random.sum((0, 2)), 2, rtol=1e-5)
    assert not np.any(random[2:, :, 1:])


def test_what_cannot_be_padded_or_restarted_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        hmm.pad([])
    with pytest.raises(ValueError, match="length = 2"):
        hmm.pad([np.zeros(3)], 2)
    with pytest.raises(ValueError, match="num_restarts"):
        hmm.best_of_restarts(jax.random.key(0), code_model(), *hmm.pad(code_sequences()), num_restarts=0)
    with pytest.raises(ValueError, match="no emission"):
        hmm.with_responsibilities(hmm.from_probabilities([1.0], [[1.0]]), jnp.zeros((2, 1)), jnp.ones((2, 1, 1)))


@pytree_dataclass
class WithoutPrior(hmm.Codes):
    """Codes whose pseudo-counts the objective does not hold."""

    def log_prior(self):
        return jnp.zeros(())


@pytest.mark.parametrize("kind", [hmm.Codes, WithoutPrior])
def test_training_goes_on_where_pseudo_counts_make_codes_possible(x64, kind):
    """A code with probability zero, which makes one of two sequences impossible before the first iteration."""
    probability = jnp.array([[0.7, 0.3, 0.0], [0.3, 0.7, 0.0]])
    model = hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.1, 0.9]], kind(jnp.log(probability), 0.1))
    codes = (np.random.default_rng(0).uniform(size=60) < np.where(np.arange(60) // 15 % 2, 0.1, 0.9)).astype(int)
    observations, lengths = hmm.pad([codes, np.array([0, 2, 0])])
    trained = hmm.baum_welch(model, observations, lengths, max_iterations=300, tolerance=1e-9)
    assert trained.converged
    assert trained.num_impossible == 0
    again = hmm.baum_welch(trained.model, observations, lengths, max_iterations=20, tolerance=0.0)
    assert again.objective[-1] - trained.objective[-1] < 1e-5


@pytree_dataclass
class Ordered(hmm.DiagonalGaussian):
    """An emission whose prior is NaN for one order of two states."""

    def log_prior(self):
        return jnp.where(self.mean[0, 0] > self.mean[1, 0], jnp.nan, 0.0)


@pytest.mark.system
def test_the_best_restart_has_a_number_as_its_objective():
    y = np.where(np.arange(20) // 5 % 2, 5.0, 1.0) + 0.1 * np.random.default_rng(0).normal(size=20)
    observations, lengths = hmm.pad([y[:, None]])
    model = hmm.from_topology(hmm.ergodic(2), Ordered(jnp.zeros((2, 1)), jnp.ones((2, 1))))
    trained = hmm.best_of_restarts(jax.random.key(1), model, observations, lengths, num_restarts=8)
    assert np.isfinite(trained.objective[-1])
    assert trained.model.emission.mean[0, 0] < trained.model.emission.mean[1, 0]
