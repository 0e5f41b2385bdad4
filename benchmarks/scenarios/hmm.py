"""Hidden Markov models against dynamax and hmmlearn: forward pass, Viterbi path, posteriors, Baum-Welch.

1000 sequences of 100 symbols out of 17, 8 states; five iterations of Baum-Welch, in processor time and ten rounds. All
libraries work on the same symbols, this one and dynamax in float32 and compiled, hmmlearn in float64 with the scaled
recursions of its C++ core; they have to agree before anything is timed. They take turns in every round, and a ratio is
the median over the rounds. `forward` starts from log-likelihoods of the states, which each library gets in the layout
that suits it: here the sequences are the last axis, in dynamax the first; `ratio_hmm_forward_vmap_to_dynamax` is this
library in the layout of dynamax. `forward_codes` starts from the symbols, as hmmlearn always does:
`ratio_hmm_forward_to_hmmlearn` is the ratio of that. Without a peer its ratios are missing: pip install
'jaxfilters[peers]'.
"""

import statistics
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxfilters import hmm
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _hmm_peers as peers
from jaxfilters.benchmarks.scenarios._hmm_peers import Calls
from jaxfilters.benchmarks.scenarios.gaussian import check_agreement, ratio, rounds_of
from jaxfilters.benchmarks.timing import taking_turns
from jaxfilters.hmm import HiddenMarkovModel

NUM_STATES, NUM_CODES, NUM_FRAMES = 8, 17, 100
NUM_SEQUENCES, NUM_TRAINING_SEQUENCES = 1000, 1000
NUM_ITERATIONS = 5
ROUNDS, QUICK_ROUNDS, TRAINING_ROUNDS = 25, 5, 10


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Check that all agree, then time them; `out` is not used."""
    del out
    rounds, present = QUICK_ROUNDS if quick else ROUNDS, peers.installed()
    absent = {"dynamax", "hmmlearn"} - set(present)
    if absent:
        sys.stdout.write(f"not installed, and missing below: {', '.join(sorted(absent))}\n")
    model = random_model(seed)
    codes = draw(seed, model, NUM_SEQUENCES)
    problem = (model, codes, codes[:NUM_TRAINING_SEQUENCES], NUM_ITERATIONS)
    libraries = {"ours": ours(*problem)} | {name: getattr(peers, name)(*problem) for name in present}
    check(model, codes, libraries)

    metrics: dict[str, Metric] = {}
    for task in Calls._fields:
        calls = {name: getattr(of, task) for name, of in libraries.items() if getattr(of, task) is not None}
        if task == "forward":
            calls["vmap"] = given_first(model, codes)
            calls["vmap"]()
        if task == "train":
            turns = taking_turns(calls, min(rounds, TRAINING_ROUNDS))
            times = {name: [one.processor for one in own] for name, own in turns.items()}
        else:
            times = rounds_of(calls, rounds)
        for name, seconds in times.items():
            metrics[f"hmm_{task}_ms_{name}"] = Metric(1e3 * statistics.median(seconds), "ms", "lower")
        metrics |= {f"ratio_hmm_{task}_to_{name}": ratio(times, "ours", name) for name in present if name in times}
        if task == "forward_codes" and "hmmlearn" in times:
            metrics["ratio_hmm_forward_to_hmmlearn"] = metrics.pop("ratio_hmm_forward_codes_to_hmmlearn")
        if {"vmap", "dynamax"} <= set(times):
            metrics["ratio_hmm_forward_vmap_to_dynamax"] = ratio(times, "vmap", "dynamax")
    return metrics


def random_model(seed: int) -> HiddenMarkovModel:
    """An ergodic model of symbols whose every probability was drawn."""
    rng = np.random.default_rng(seed)
    logs = np.log(rng.dirichlet(np.ones(NUM_CODES), NUM_STATES))
    return hmm.from_probabilities(
        rng.dirichlet(np.ones(NUM_STATES)),
        rng.dirichlet(np.ones(NUM_STATES), NUM_STATES),
        hmm.Codes(jnp.asarray(logs, dtype=float)),
    )


def draw(seed: int, model: HiddenMarkovModel, num_sequences: int) -> Int[Array, "n t"]:
    """Symbols of that many sequences."""
    keys = jax.random.split(jax.random.key(seed), num_sequences)
    return jax.vmap(lambda key: hmm.sample(key, model, NUM_FRAMES)[1])(keys)


def ours(model: HiddenMarkovModel, codes: Int[Array, "n t"], training: Int[Array, "m t"], num_iterations: int) -> Calls:
    """This library, sequences last."""
    columns, training_columns = jnp.array(codes.T), jnp.array(training.T)
    score = jax.jit(jax.vmap(HiddenMarkovModel.log_likelihoods, (None, -1), -1))
    scores = jax.block_until_ready(score(model, columns))

    @jax.jit
    def forward(model: HiddenMarkovModel, columns: Int[Array, "t n"]) -> Array:
        return hmm.log_evidence(model, jax.vmap(model.log_likelihoods, -1, -1)(columns))

    def train() -> Array:
        found = hmm.baum_welch(model, training_columns, max_iterations=num_iterations, tolerance=-1.0)
        return jnp.exp(found.model.log_transition)

    return Calls(
        partial(hmm.log_evidence, model, scores),
        partial(forward, model, columns),
        lambda: hmm.viterbi(model, scores),
        lambda: hmm.posterior(model, scores),
        train,
    )


def given_first(model: HiddenMarkovModel, codes: Int[Array, "n t"]):
    """The forward pass by `vmap` over sequences that lie along the first axis."""
    scores = jax.block_until_ready(jax.jit(jax.vmap(model.log_likelihoods))(codes))
    return partial(jax.jit(jax.vmap(hmm.log_evidence, (None, 0))), model, scores)


def check(model: HiddenMarkovModel, codes: Int[Array, "n t"], libraries: dict[str, Calls]) -> None:
    """Refuse to time libraries that compute something else.

    Raises:
        RuntimeError: If log-likelihoods or best paths differ by more than 1e-5 of their size, or trained transition
            probabilities by more than 1e-3.
    """
    check_agreement({name: np.sum(np.asarray(of.forward_codes(), np.float64)) for name, of in libraries.items()})
    given = {name: of.forward() for name, of in libraries.items() if of.forward}
    check_agreement({**given, "vmap": given_first(model, codes)()})
    found = {name: of.posterior()[0] for name, of in libraries.items() if of.posterior}
    check_agreement(found)
    best = {name: of.viterbi() for name, of in libraries.items()}
    totals = {"ours": best["ours"].log_probability.sum()}
    if "dynamax" in best:
        totals["dynamax"] = sum_of_paths(model, codes, best["dynamax"])
    if "hmmlearn" in best:
        totals["hmmlearn"] = best["hmmlearn"]
    check_agreement(totals)
    trained = {name: np.asarray(of.train()) for name, of in libraries.items()}
    for name, transition in trained.items():
        error = np.abs(transition - trained["ours"]).max()
        if not error <= 1e-3:
            raise RuntimeError(f"trained transition probabilities of {name} differ from ours by {error:.2g}.")


def sum_of_paths(model: HiddenMarkovModel, codes: Int[Array, "n t"], paths: Int[Array, "n t"]) -> Array:
    """Log probability of all paths with their symbols."""
    steps = model.log_transition[paths[:, :-1], paths[:, 1:]].sum()
    symbols = jnp.take_along_axis(jax.vmap(model.log_likelihoods)(codes), paths[..., None], axis=2).sum()
    return model.log_initial[paths[:, 0]].sum() + steps + symbols
