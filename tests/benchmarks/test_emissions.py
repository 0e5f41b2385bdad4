"""The scenario of counts: it runs with and without dynamax, and filters of other results are not timed."""

import pytest

from jaxfilters.benchmarks.scenarios import emissions

pytestmark = [pytest.mark.system, pytest.mark.filterwarnings("ignore::DeprecationWarning")]


def test_counts_are_followed_best_by_the_mode(monkeypatch):
    monkeypatch.setattr(emissions, "find_spec", lambda name: None)
    found = emissions.run(quick=True, seed=0, out=None)
    assert found["rmse_laplace"].value < min(found["rmse"].value, found["rmse_square_root"].value)
    assert found["emissions_ms_gradient_ours"].value > 0
    assert "ratio_emissions_to_dynamax" not in found


def test_filters_of_other_results_are_not_timed(monkeypatch):
    pytest.importorskip("dynamax")
    monkeypatch.setattr(emissions, "AGREES", 0.0)
    with pytest.raises(RuntimeError, match="differ by"):
        emissions.run(quick=True, seed=0, out=None)
