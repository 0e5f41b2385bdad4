"""The scenario of guided filters: a small run, and its refusal to time what computes something else."""

import jax
import pytest

from jaxfilters.benchmarks.scenarios import guided


@pytest.mark.system
def test_a_small_run_without_peers_measures_errors_and_times(monkeypatch):
    monkeypatch.setattr(guided, "SCALE", 0.1)
    monkeypatch.setattr(guided, "find_spec", lambda name: None)
    monkeypatch.setattr(guided, "KEYS", 50)
    found = guided.run(quick=True, seed=0, out=None)
    assert found["log_evidence_rmse_adapted"].value < found["log_evidence_rmse_bootstrap"].value
    assert {"guided_n1000_processor_ms", "auxiliary_n1000_processor_ms", "adapted_n1000_processor_ms"} <= set(found)


def test_another_log_evidence_is_not_timed():
    with pytest.raises(RuntimeError, match="wrong finds a log evidence of 3"):
        guided.check({"wrong": lambda key: 3.0 + 0.01 * float(jax.random.normal(key))}, 0, guided.simulate(0, 5))
