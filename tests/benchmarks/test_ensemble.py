"""The ensemble scenario: its metrics, on a course and a number of samples that are small."""

import pytest

from jaxfilters.benchmarks.scenarios import ensemble


@pytest.mark.system
def test_every_filter_has_its_error_and_times_are_compared(monkeypatch):
    pytest.importorskip("cuthbert")
    monkeypatch.setattr(ensemble, "QUICK_STEPS", 60)
    monkeypatch.setattr(ensemble, "SPIN_UP", 20)
    monkeypatch.setattr(ensemble, "FILTERS", {name: ensemble.FILTERS[name] for name in ("transform", "serial_half")})
    monkeypatch.setattr(ensemble, "MANY", 60)
    metrics = ensemble.run(quick=True, seed=0, out=None)
    rows = {"rmse_transform", "rmse_serial_half", "step_us_40", "step_us_60"}
    assert set(metrics) == rows | {"ratio_to_cuthbert_40", "ratio_to_cuthbert_60"}
    assert metrics["rmse_transform"].value < 0.6
    assert all(metric.value > 0 and metric.better == "lower" for metric in metrics.values())
