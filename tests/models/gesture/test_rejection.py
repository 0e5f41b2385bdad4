"""The threshold model without its matrix of transitions equals the one with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import hmm
from jaxfilters.models.gesture.rejection import LEAVING, threshold_log_likelihood


@pytest.mark.system
def test_it_is_the_threshold_model_of_the_symbols_side_by_side():
    rng = np.random.default_rng(0)
    chain = hmm.from_topology(hmm.left_right(4), initial=hmm.left_right_initial(4))
    ones = []
    for _ in range(3):
        transition = np.where(np.exp(chain.log_transition) > 0, rng.uniform(0.2, 1, (4, 4)), 0)
        transition /= transition.sum(axis=1, keepdims=True)
        emission = hmm.Codes(jnp.asarray(np.log(rng.dirichlet(np.ones(5), 4)), dtype=float))
        ones.append(hmm.from_probabilities(np.arange(4) == 0, transition, emission))
    models = jax.tree.map(lambda *leaves: jnp.stack(leaves), *ones)
    codes = jnp.asarray(rng.integers(5, size=(30, 7)))
    lengths = jnp.array([30, 29, 1, 0, 12, 30, 5])
    whole = hmm.threshold_model(hmm.parallel_composition(ones, exit_probability=LEAVING))
    expected = hmm.log_evidence(whole, jax.vmap(whole.log_likelihoods, -1, -1)(codes), lengths)
    observed = jax.vmap(lambda model: jax.vmap(model.log_likelihoods, -1, -1)(codes))(models)
    np.testing.assert_allclose(threshold_log_likelihood(models, observed, lengths), expected, rtol=1e-5, atol=1e-4)


@pytest.mark.system
def test_what_no_state_can_produce_is_impossible_and_nan_is():
    chain = hmm.from_topology(hmm.left_right(2), initial=hmm.left_right_initial(2))
    models = jax.tree.map(lambda leaf: leaf[None], chain)
    observed = jnp.zeros((1, 3, 2, 3)).at[0, 1, :, 1].set(-jnp.inf).at[0, 2, :, 2].set(jnp.nan)
    found = threshold_log_likelihood(models, observed, jnp.full(3, 3))
    # Nothing is said against the first one: its probability is 1.
    np.testing.assert_allclose(found, [0, -np.inf, -np.inf], atol=1e-6)
