"""The table of claims: its arithmetic on errors whose distribution is known."""

import numpy as np
import pytest

from jaxfilters.benchmarks import results_page
from jaxfilters.benchmarks.harness import main
from jaxfilters.benchmarks.metrics import report
from jaxfilters.benchmarks.multi_object import floor_tracks
from jaxfilters.benchmarks.scenarios import _claims, _tip_claims, honesty
from jaxfilters.benchmarks.scenarios._claims import Claims, Recording
from jaxfilters.trackers.people.recorded import Sighting

ENVIRONMENT = {"jaxfilters": "0", "jax": "0", "numpy": "0", "python": "0", "cpu": "c", "cores": 1, "device": "d"}


def claims_of(scale, phi=0.0, recordings=8, frames=500):
    """Errors of two coordinates with correlation `phi` in time, true deviations 1 and 2, claims `scale` times them."""
    rng, made = np.random.default_rng(0), []
    for _ in range(recordings):
        e = [rng.normal(size=2)]
        for _ in range(frames - 1):
            e.append(phi * e[-1] + np.sqrt(1 - phi**2) * rng.normal(size=2))
        errors = np.array(e) * (1.0, 2.0)
        made.append(Recording(errors, np.broadcast_to(scale * np.array([1.0, 2.0]), errors.shape)))
    return Claims("system", "data", ("a_mm", "b_deg"), made)


@pytest.mark.system
def test_true_claims_have_the_right_numbers():
    """4000 independent errors: shares within four standard errors (a false alarm has 1e-3 over all 12 numbers)."""
    scores = _claims.judge(claims_of(1.0))
    np.testing.assert_allclose(scores.coverage, np.array([0.683, 0.954, 0.997])[:, None] + np.zeros(2), atol=0.03)
    assert scores.nees_band[0] < scores.nees < scores.nees_band[1]
    assert scores.effective_frames > 3000
    np.testing.assert_allclose(scores.sharpness, 1.0, atol=0.05)
    assert np.all((scores.interval[0] < 0.954) & (scores.interval[1] > 0.954))
    np.testing.assert_allclose(scores.log_score, scores.log_score_of_constant, atol=2e-3)


def test_claims_that_are_too_narrow_show_in_every_number_and_lasting_errors_are_worth_few_frames():
    scores = _claims.judge(claims_of(0.4, phi=0.97))
    assert np.all(scores.coverage[1] < 0.7)
    assert scores.nees > 3 * scores.nees_band[1]
    np.testing.assert_allclose(scores.autocorrelation, 0.97, atol=0.02)
    # 4000 frames are worth 4000 * 0.03 / 1.97 = 61.
    assert 30 < scores.effective_frames < 110
    assert scores.log_score > scores.log_score_of_constant + 0.5


@pytest.mark.system
def test_metrics_hold_all_that_the_table_prints_and_the_page_has_a_row_for_each_coordinate():
    claims = claims_of(1.0, frames=50)
    scores = _claims.judge(claims)
    metrics = _claims.metrics_of(claims, scores)
    assert {"coverage2_system_data", "nees_system_data", "coverage2_system_data_b_deg"} <= set(metrics)
    assert metrics["crps_system_data_a_mm"].unit == "mm"
    value = {name: metric.value for name, metric in metrics.items()}
    for i, coordinate in enumerate(claims.coordinates):
        of = f"system_data_{coordinate}"
        shares = [value[f"coverage{sigma}_{of}"] for sigma in (1, 2, 3)]
        np.testing.assert_allclose(shares, 100 * scores.coverage[:, i])
        ends = [value[f"{end}_coverage2_{of}"] for end in ("lower", "upper")]
        np.testing.assert_allclose(ends, 100 * scores.interval[:, i])
        errors = np.concatenate([recording.errors[:, i] for recording in claims.recordings])
        assert value[f"rmse_{of}"] == pytest.approx(np.sqrt(np.mean(errors**2)))
        assert value[f"autocorrelation_{of}"] == scores.autocorrelation[i]
    band = [value[f"{end}_nees_system_data"] for end in ("lower", "upper")]
    assert band == pytest.approx([end / 2 for end in scores.nees_band])
    assert value["log_score_system_data"] == scores.log_score
    assert "rmse_system_data" not in metrics  # millimetres and degrees

    page = results_page.results_page([report("honesty", metrics, ENVIRONMENT)], {})
    (row,) = [line for line in page.splitlines() if line.startswith("| `system_data_b_deg` |")]
    assert f"| {value['coverage1_system_data_b_deg']:.4g} % | {value['coverage2_system_data_b_deg']:.4g} % |" in row
    assert row.endswith(f"| {value['rmse_system_data_b_deg']:.4g} deg |")
    assert "| `rmse_system" not in page  # no line for each metric
    table = _claims.table([(claims, scores)])
    assert "a_mm" in table
    assert "rmse" in table


def test_unknown_metrics_are_left_out_and_shown_as_a_dash():
    """One recording has no interval of its coverage; coordinates of one unit have a common error."""
    errors = np.array([[3.0, 1.0], [3.0, 1.0]])
    claims = Claims("s", "d", ("x_mm", "y_mm"), [Recording(errors, np.ones((2, 2)))])
    metrics = _claims.metrics_of(claims, _claims.judge(claims))
    assert "lower_coverage2_s_d_x_mm" not in metrics
    assert metrics["rmse_s_d"].value == pytest.approx(np.sqrt(5))
    page = results_page.results_page([report("honesty", metrics | {"other": metrics["rmse_s_d"]}, ENVIRONMENT)], {})
    assert "| `s_d` |" in page
    assert "| `other` | 2.236 | mm | lower |" in page


def test_frames_without_estimate_or_claim_do_not_count():
    errors = np.array([[1.0], [np.nan], [3.0], [0.0]])
    deviations = np.array([[1.0], [1.0], [1.0], [0.0]])
    scores = _claims.judge(Claims("s", "d", ("x_m",), [Recording(errors, deviations)]))
    np.testing.assert_allclose(scores.coverage[:, 0], [0.5, 0.5, 1.0])
    assert _claims.judge(Claims("s", "d", ("x_m",), [Recording(np.full((3, 1), np.nan), np.ones((3, 1)))])) is None


@pytest.mark.parametrize(("covariances", "nees"), [(None, 5.0), (np.full((2, 1, 1), 4.0), 1.25)])
def test_a_system_is_judged_once_in_a_folder(tmp_path, monkeypatch, covariances, nees):
    ones, calls = np.ones((2, 1)), []

    def one_system(quick, seed):
        calls.append(seed)
        return Claims("s", "d", ("x_m",), [Recording(ones, ones, covariances), Recording(3 * ones, ones, covariances)])

    monkeypatch.setattr(honesty, "SYSTEMS", {"a system, some data": one_system})
    first, second = (honesty.run(quick=True, seed=0, out=tmp_path) for _ in range(2))
    assert calls == [0]
    assert first == second
    assert first["coverage2_s_d_x_m"].value == pytest.approx(50.0)
    assert first["nees_s_d"].value == pytest.approx(nees)


def test_errors_of_people_are_turned_into_the_line_of_sight():
    """A camera at the origin: a person at (0, 4), estimated 0.3 too far and 0.2 to the right."""
    truth = floor_tracks([0], [7], [(0.0, 4.0)])
    covariance = np.diag([0.01, 0.09, 1.0, 1.0, 1.0, 1.0])
    sighting = Sighting(0, 0.0, np.array([0.2, 4.3, 0.0, 0.0, 1.7, 0.0]), covariance, 1.0, 0, "tracked")
    (recording,) = honesty.by_person(truth, {3: [sighting]}, np.zeros(3))
    np.testing.assert_allclose(recording.errors, [[0.3, -0.2]], atol=1e-12)
    np.testing.assert_allclose(recording.deviations, [[0.3, 0.1]], atol=1e-12)


@pytest.mark.system
@pytest.mark.data
def test_a_system_runs_on_its_recording(monkeypatch, capsys):
    one = {"articulated hand, motion capture": honesty.articulated_claims}
    monkeypatch.setattr(honesty, "SYSTEMS", one)
    monkeypatch.setattr(honesty, "QUICK_CAPTURE_FRAMES", 200)
    assert main(["honesty", "--quick"]) == 0
    assert "nees_articulated_dfki" in capsys.readouterr().out


def test_fingertips_belong_to_the_nearest_true_one_within_half_a_finger():
    """Two fingers in two frames; the second frame has a tip 30 pixels off, which is false, and misses the other."""
    truth = np.array([[[10.0, 10.0], [50.0, 10.0]], [[10.0, 12.0], [50.0, 12.0]]])
    position = np.array([[[51.0, 12.0], [0.0, 0.0], [10.5, 9.0]], [[80.0, 12.0], [0.0, 0.0], [10.0, 12.5]]])
    is_tip = np.array([[True, False, True], [True, False, True]])
    sd = np.array([[2.0, 0.0, 3.0], [4.0, 0.0, 5.0]])
    first, second = _tip_claims.by_finger(position, is_tip, sd, truth)
    np.testing.assert_allclose(first.errors, [[0.5, -1.0], [0.0, 0.5]])
    np.testing.assert_allclose(first.deviations, [[3.0, 3.0], [5.0, 5.0]])
    np.testing.assert_allclose(second.errors, [[1.0, 2.0], [np.nan, np.nan]])
    np.testing.assert_allclose(second.deviations, [[2.0, 2.0], [np.nan, np.nan]])
