import itertools

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


def runs(num_frames):
    """Two seeds with lengths and palm a pixel off, as uncertain as that, and the angles right."""
    truth = np.zeros((2, num_frames, paper.LAYOUT.size))
    means = truth.copy()
    means[..., paper.LAYOUT.static] += 1
    return paper.Runs(truth, means, np.broadcast_to(np.eye(9), (2, num_frames, 9, 9)))


def test_every_filter_is_judged_by_its_last_frames(monkeypatch, tmp_path):
    monkeypatch.delenv("JAXFILTERS_DATA", raising=False)
    monkeypatch.setattr(paper, "run_paper", lambda mode, shape, seeds: runs(55))
    monkeypatch.setattr(paper, "run_drawn", lambda mode, shape, seeds: runs(55))
    monkeypatch.setattr(paper, "run_held", lambda mode, shape, seeds, num_frames: runs(num_frames))
    monkeypatch.setattr(articulated, "interleaved", lambda calls, rounds: dict.fromkeys(calls, 55e-6))
    value = {name: metric.value for name, metric in articulated.run(quick=True, seed=0, out=tmp_path).items()}
    for mode, shape in itertools.product(paper.FILTERS, (1, 2)):
        of = {name: value[f"{name}_{mode}_shape{shape}"] for name in ("r13_error_px", "r13_rms_px", "coverage_2sigma")}
        assert of == {"r13_error_px": 1, "r13_rms_px": 1, "coverage_2sigma": 1}
        assert value[f"diverged_share_{mode}_shape{shape}"] == value[f"angle_error_deg_{mode}_shape{shape}"] == 0
        assert value[f"nees_lengths_{mode}_shape{shape}"] == pytest.approx(6)
        assert value[f"r13_difference_px_{mode}"] == 0
    assert value["drawn_nees_lengths_median_recommended_shape2"] == pytest.approx(6)
    assert value["held_nees_lengths_recommended"] == pytest.approx(6)
    assert value["held_std_kept_literal"] == 1
    # 55 frames at once.
    assert value["step_us"] == value["step_us_literal"] == pytest.approx(1.0)
    assert (tmp_path / "held_pose.png").stat().st_size > 10_000


def test_who_is_off_by_more_than_45_degrees_has_diverged():
    found = runs(55)
    found.means[0, -1, paper.LAYOUT.angles.start] = np.radians(50)
    found.means[1, 0, paper.LAYOUT.angles.start] = np.radians(50)
    assert paper.diverged(found).tolist() == [True, False]


def test_drawn_starts_are_judged_seed_by_seed_with_and_without_those_that_end_in_another_mode(monkeypatch, capsys):
    """NEES of 6, 1.5 and, with all angles 10 degrees off, 600; right is chi-squared with six degrees of freedom."""
    truth = np.zeros((3, 55, paper.LAYOUT.size))
    means = truth.copy()
    means[..., paper.LAYOUT.static] += np.array([1.0, 0.5, 10.0])[:, None, None]
    means[2, :, paper.LAYOUT.angles] += np.radians(10)
    found = paper.Runs(truth, means, np.broadcast_to(np.eye(9), (3, 55, 9, 9)))
    assert paper.in_other_mode(found).tolist() == [False, False, True]
    assert not paper.diverged(found).any()
    monkeypatch.setattr(paper, "run_drawn", lambda mode, shape, seeds: found)
    value = {name: metric.value for name, metric in articulated.drawn_metrics(range(3)).items()}
    of = {name: value[f"drawn_nees_lengths_{name}_recommended_shape1"] for name in ("mean", "median", "quantile95")}
    assert of == pytest.approx({"mean": 607.5 / 3, "median": 6.0, "quantile95": 0.1 * 6 + 0.9 * 600})
    assert value["drawn_other_mode_share_recommended_shape2"] == pytest.approx(1 / 3)
    # The band of one seed is 1.24 to 14.4.
    assert value["drawn_nees_lengths_in_band_share_recommended_shape1"] == pytest.approx(2 / 3)
    in_mode = {name: value[f"drawn_nees_lengths_{name}_in_mode_recommended_shape1"] for name in ("mean", "median")}
    assert in_mode == pytest.approx({"mean": 3.75, "median": 3.75})
    assert value["drawn_nees_lengths_in_band_share_in_mode_recommended_shape1"] == 1
    assert value["drawn_coverage_2sigma_in_mode_recommended_shape1"] == 1
    assert "6  1.5  600*" in capsys.readouterr().out
