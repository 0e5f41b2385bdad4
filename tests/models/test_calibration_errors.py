import numpy as np
import pytest

from jaxfilters.models.calibration_errors import check_determined, standard_deviations


def test_standard_deviations_are_those_of_a_linear_model():
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(30, 4)) * [1, 1e-4, 1e3, 1]
    errors = rng.normal(0, 0.7, 30)
    wanted = rng.normal(size=(4, 3)) * [[1], [1e-4], [1e3], [1]]
    covariance = np.linalg.inv(slopes.T @ slopes) * (errors @ errors) / (30 - 4)
    expected = np.sqrt(np.diag(wanted.T @ covariance @ wanted))
    np.testing.assert_allclose(standard_deviations(slopes, errors, wanted, least_noise_px=0.1), expected, rtol=1e-9)
    doubled = standard_deviations(slopes, 0 * errors, wanted, least_noise_px=2 * np.linalg.norm(errors) / np.sqrt(26))
    np.testing.assert_allclose(doubled, 2 * expected, rtol=1e-9)


def test_a_direction_that_no_error_shows_is_open():
    slopes = np.random.default_rng(0).normal(size=(20, 3))
    slopes[:, 2] = slopes[:, 0] + slopes[:, 1]
    found = standard_deviations(slopes, np.zeros(20), np.eye(3)[:, :1], least_noise_px=0.5)
    assert found[0] > 1e10


@pytest.mark.parametrize(("focal", "place"), [(0.06, 0.01), (0.01, 0.06), (np.nan, 0.01), (0.01, np.inf)])
def test_open_cameras_are_named(focal, place):
    check_determined(0.05, 0.05, 0.05)
    with pytest.raises(
        ValueError, match=f"standard deviation of {focal:.2g} of itself, the position one of {place:.2g} "
    ):
        check_determined(focal, place, 0.05)
