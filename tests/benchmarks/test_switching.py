"""The scenario of switching systems: a small run, and what it refuses."""

import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import _switching_peers, switching


@pytest.mark.system
def test_a_small_run_has_every_number(monkeypatch):
    for name, value in (("NUM_STEPS", 8), ("NUM_LONG_STEPS", 10), ("SIZES", (20,)), ("QUICK_RUNS", 5)):
        monkeypatch.setattr(switching, name, value)
    monkeypatch.setattr(switching, "QUICK_ROUNDS", 1)
    metrics = switching.run(quick=True, seed=0, out=None)
    names = {f"ratio_switching_{what}_to_{of}_20" for what in ("ms", "cost") for of in ("numpy", "bootstrap")}
    names |= {
        f"switching_{what}_{of}_20" for what in ("log_evidence_std", "ms") for of in ("ours", "numpy", "bootstrap")
    }
    names |= {"imm_ms_ours"} | (
        {"imm_ms_filterpy", "ratio_imm_to_filterpy"} if _switching_peers.has_filterpy() else set()
    )
    assert set(metrics) == names
    assert all(np.isfinite(metric.value) and metric.value > 0 for metric in metrics.values())


def test_filters_of_different_models_are_not_compared():
    values = np.random.default_rng(0).normal(-100, 0.1, 50)
    switching.check({"ours": values, "numpy": values[::-1] + 0.01})
    with pytest.raises(RuntimeError, match="ours and numpy"):
        switching.check({"ours": values, "numpy": values + 1})
