"""The scenario of hidden Markov models: what it refuses, and what it measures without peers."""

import jax.numpy as jnp
import pytest

from jaxfilters.benchmarks.scenarios import _hmm_peers, hmm
from jaxfilters.benchmarks.scenarios._hmm_peers import Calls


@pytest.fixture
def problem(monkeypatch):
    # With so many frames every symbol occurs, which dynamax needs.
    for name, value in (
        ("NUM_SEQUENCES", 32),
        ("NUM_TRAINING_SEQUENCES", 32),
        ("NUM_FRAMES", 9),
        ("NUM_ITERATIONS", 2),
    ):
        monkeypatch.setattr(hmm, name, value)
    model = hmm.random_model(0)
    codes = hmm.draw(0, model, hmm.NUM_SEQUENCES)
    return model, codes, codes[: hmm.NUM_TRAINING_SEQUENCES], hmm.NUM_ITERATIONS


@pytest.mark.system
def test_without_peers_only_this_library_is_timed(problem, monkeypatch, capsys):
    monkeypatch.setattr(_hmm_peers, "installed", list)
    monkeypatch.setattr(hmm, "QUICK_ROUNDS", 1)
    metrics = hmm.run(quick=True, seed=0, out=None)
    assert set(metrics) == {f"hmm_{task}_ms_ours" for task in Calls._fields} | {"hmm_forward_ms_vmap"}
    assert "dynamax, hmmlearn" in capsys.readouterr().out


def test_a_library_that_computes_something_else_is_not_timed(problem):
    model, codes, *_ = problem
    right = hmm.ours(*problem)
    hmm.check(model, codes, {"ours": right, "again": right._replace(viterbi=right.viterbi)})
    for wrong in ({"forward": lambda: right.forward() + 1}, {"forward_codes": lambda: right.forward_codes() * 1.1}):
        with pytest.raises(RuntimeError, match="differ"):
            hmm.check(model, codes, {"ours": right, "other": right._replace(**wrong)})
    untrained = right._replace(train=lambda: jnp.full((hmm.NUM_STATES,) * 2, 1 / hmm.NUM_STATES))
    with pytest.raises(RuntimeError, match="transition"):
        hmm.check(model, codes, {"ours": right, "other": untrained})


@pytest.mark.system
@pytest.mark.filterwarnings("ignore:jax.core:DeprecationWarning")  # dynamax imports names that JAX will remove
@pytest.mark.parametrize("name", ["dynamax", "hmmlearn"])
def test_a_peer_that_is_installed_agrees(problem, name):
    if name not in _hmm_peers.installed():
        pytest.skip(f"{name} is not installed")
    model, codes, *_ = problem
    hmm.check(model, codes, {"ours": hmm.ours(*problem), name: getattr(_hmm_peers, name)(*problem)})
    assert hmm.sum_of_paths(model, codes, jnp.zeros_like(codes)) < 0


def test_training_without_one_of_the_symbols_is_refused_for_dynamax(problem):
    model, codes, training, iterations = problem
    with pytest.raises(ValueError, match=r"every symbol.*\[16\]"):
        _hmm_peers.dynamax(model, codes, jnp.minimum(training, 15), iterations)
