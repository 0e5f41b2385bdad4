"""The floor plan: where the distance from the camera is not measured, it shows how uncertain a place is."""

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.people import drawing
from jaxfilters.trackers.people.recorded import Sighting
from jaxfilters.trackers.people.state import STATE, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene

COVARIANCE = np.array([[0.20, 0.12], [0.12, 0.15]])
"""Square metres: tilted by half a right angle, nearly, so that axes in a wrong direction are noticed."""


def plan(folder, scene, mode):
    """The picture (rows, cols, 3) of a person who stands in a mode for two frames and is tracked a metre away later."""
    mean, covariance = np.zeros(STATE), np.eye(STATE)
    mean[[1, 4, 5]], covariance[:2, :2] = (1.0, 1.7, 0.45), COVARIANCE
    later = mean + np.eye(STATE)[1]
    standing = [Sighting(i, 0.1 * i, mean, covariance, 0.8, 0, mode) for i in (0, 1)]
    returned = [Sighting(i, 0.1 * i, later, covariance, 0.8, 0, "tracked") for i in (900, 901)]
    drawing.write_plan(folder / "plan.png", scene, {2: [*standing, *returned]})
    return cv2.imread(str(folder / "plan.png")).astype(int)


@pytest.mark.system
@pytest.mark.parametrize("mode", ["no_depth", "hidden"])
def test_a_band_of_two_standard_deviations_where_the_distance_is_not_measured(tmp_path, camera, floor, mode):
    """It is an ellipse with the moments of the state: the covariance of points all over two deviations is one of it.

    The scale of the picture follows from the floor in it, which is 8 m wide.
    """
    scene = people_scene([camera], floor, config=PeopleConfig(capacity=2, cell_m=2.0))
    measured, unsure = (plan(tmp_path, scene, one) for one in ("tracked", mode))
    columns = np.flatnonzero((measured == drawing._FLOOR).all(axis=-1).any(axis=0))
    pixels_a_metre = np.ptp(columns) / 8
    row, column = np.nonzero((measured != unsure).any(axis=-1))
    found = np.stack([column, -row]) / pixels_a_metre
    np.testing.assert_allclose(np.cov(found), COVARIANCE, atol=0.006)
    area = len(row) / pixels_a_metre**2
    assert area == pytest.approx(4 * np.pi * np.sqrt(np.linalg.det(COVARIANCE)), rel=0.03)
    # The middle of the floor's width; the tint leaves what lies below it readable.
    assert found[0].mean() * pixels_a_metre == pytest.approx(columns.mean(), abs=2)
    assert np.abs(unsure - measured)[row, column].max(axis=1).mean() < 60
