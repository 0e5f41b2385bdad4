import numpy as np
import pytest
from scipy import stats

from jaxfilters.benchmarks.scenarios import _articulated_paper as paper
from jaxfilters.benchmarks.scenarios import articulated


def test_consistency_is_measured_as_it_should_be():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    errors = rng.normal(size=(4000, 6)) @ root.T
    covariances = np.broadcast_to(root @ root.T, (4000, 6, 6))
    values = paper.nees(errors, covariances)
    low, high = paper.band(6, 4000)
    assert low < values.mean() < high  # true in 95 of 100 seeds; this seed is fixed
    assert stats.kstest(values, stats.chi2(6).cdf).pvalue > 1e-3
    assert paper.coverage(errors, covariances) == pytest.approx(0.9545, abs=0.01)


@pytest.mark.system
def test_a_tiny_run_has_every_metric_of_the_issue(monkeypatch, tmp_path):
    """As many seeds and frames of the held pose as of the moving hand: the same compiled filters."""
    monkeypatch.delenv("JAXFILTERS_DATA", raising=False)
    monkeypatch.setattr(articulated, "QUICK_NUM_SEEDS", 2)
    monkeypatch.setattr(articulated, "QUICK_NUM_HELD_SEEDS", 2)
    monkeypatch.setattr(paper, "FILTERS", {name: paper.FILTERS[name] for name in ("literal", "recommended")})
    monkeypatch.setattr(articulated, "QUICK_HELD_FRAMES", 55)
    metrics = articulated.run(quick=True, seed=0, out=tmp_path)
    for mode in ("literal", "recommended"):
        for name in ("diverged_share", "r13_error_px", "angle_error_deg", "coverage_2sigma", "nees_lengths"):
            assert {f"{name}_{mode}_shape1", f"{name}_{mode}_shape2"} <= set(metrics)
    assert {"step_us", "held_nees_lengths_recommended", "held_std_kept_literal"} <= set(metrics)
    assert metrics["diverged_share_recommended_shape1"].value == 0
    assert (tmp_path / "held_pose.png").stat().st_size > 10_000
