"""Hidden Markov models of other libraries on the same problem; each is imported only where it is asked for."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfilters.hmm import HiddenMarkovModel


class Calls(NamedTuple):
    """What a library can do; none of it awaited."""

    forward: Callable[[], Any] | None
    """Log-likelihoods of the sequences (n,), from those of the states."""
    forward_codes: Callable[[], Any]
    """The same from the symbols; or their sum."""
    viterbi: Callable[[], Any]
    """Log probabilities of the best paths, (n,) or their sum; or the paths (n, T)."""
    posterior: Callable[[], Any] | None
    """Log-likelihoods, posteriors of the states, expected transitions."""
    train: Callable[[], Any]
    """Transition matrix (Q, Q) after some iterations of Baum-Welch."""


def installed() -> list[str]:
    """Those of dynamax and hmmlearn that can be imported."""
    return [name for name in ("dynamax", "hmmlearn") if find_spec(name) is not None]


def dynamax(
    model: HiddenMarkovModel, codes: Int[Array, "n t"], training: Int[Array, "m t"], num_iterations: int
) -> Calls:
    """Recursions of dynamax under `vmap` and `jit`; its expectation-maximisation in one loop, without priors.

    Its M-step takes the mode of a Dirichlet distribution, which is NaN where a concentration is exactly 1: without a
    prior, that of a symbol which no training sequence holds.

    Raises:
        ValueError: If a symbol is in no training sequence.
    """
    initial, transition, emission = _probabilities(model)
    if missing := sorted(set(range(emission.shape[1])) - set(np.unique(training).tolist())):
        raise ValueError(f"training must hold every symbol, without which dynamax gives NaN; got none of {missing}.")
    inference = import_module("dynamax.hidden_markov_model.inference")
    log_emission = jnp.log(emission)
    scores = log_emission.T[codes]

    def forward(scores: Float[Array, "t q"]) -> Array:
        return inference.hmm_filter(initial, transition, scores).marginal_loglik

    def posterior(scores: Float[Array, "t q"]) -> tuple[Array, Array, Array]:
        found = inference.hmm_smoother(initial, transition, scores)
        return found.marginal_loglik, found.smoothed_probs, found.trans_probs

    of_codes = jax.jit(jax.vmap(lambda row: forward(log_emission.T[row])))
    given = jax.jit(jax.vmap(forward))
    path = jax.jit(jax.vmap(lambda scores: inference.hmm_posterior_mode(initial, transition, scores)))
    smooth = jax.jit(jax.vmap(posterior))
    train = _dynamax_training(initial, transition, emission, training[..., None], num_iterations)
    return Calls(lambda: given(scores), lambda: of_codes(codes), lambda: path(scores), lambda: smooth(scores), train)


def _dynamax_training(initial, transition, emission, observations, num_iterations):
    library = import_module("dynamax.hidden_markov_model")
    num_states, num_codes = emission.shape
    chain = library.CategoricalHMM(num_states, 1, num_codes, 1.0, 1.0, emission_prior_concentration=1.0)
    params, properties = chain.initialize(
        jax.random.key(0), initial_probs=initial, transition_matrix=transition, emission_probs=emission[:, None]
    )
    start = (params, chain.initialize_m_step_state(params, properties))

    @jax.jit
    def train(start, observations):
        def iterate(_, state):
            params, m_step_state = state
            statistics, _ = jax.vmap(lambda y: chain.e_step(params, y))(observations)
            return chain.m_step(params, properties, statistics, m_step_state)

        return jax.lax.fori_loop(0, num_iterations, iterate, start)[0].transitions.transition_matrix

    return lambda: train(start, observations)


def hmmlearn(
    model: HiddenMarkovModel, codes: Int[Array, "n t"], training: Int[Array, "m t"], num_iterations: int
) -> Calls:
    """Scaled recursions of hmmlearn, which takes the sequences one after the other."""
    library = import_module("hmmlearn.hmm")
    rows, lengths = _in_one_row(codes)
    training_rows, training_lengths = _in_one_row(training)

    def fresh() -> Any:
        chain = library.CategoricalHMM(
            model.log_initial.shape[0], n_iter=num_iterations, tol=-np.inf, init_params="", implementation="scaling"
        )
        chain.startprob_, chain.transmat_, chain.emissionprob_ = (
            np.asarray(table, np.float64) / np.asarray(table, np.float64).sum(-1, keepdims=True)
            for table in _probabilities(model)
        )
        chain.n_features = chain.emissionprob_.shape[1]
        return chain

    chain = fresh()
    return Calls(
        None,
        lambda: chain.score(rows, lengths),
        lambda: chain.decode(rows, lengths)[0],
        None,
        lambda: fresh().fit(training_rows, training_lengths).transmat_,
    )


def _in_one_row(codes):
    table = np.asarray(codes)
    return table.reshape(-1, 1), np.full(len(table), table.shape[1])


def _probabilities(model):
    return jnp.exp(model.log_initial), jnp.exp(model.log_transition), jnp.exp(model.emission.log_probability)
