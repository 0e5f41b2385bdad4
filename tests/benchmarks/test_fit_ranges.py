import os
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios import fit_ranges


@pytest.mark.data
@pytest.mark.system
@pytest.mark.skipif("JAXFILTERS_DATA" not in os.environ, reason="needs plaza_range_slam in JAXFILTERS_DATA")
def test_what_is_learnt_of_the_first_ranges_places_the_robot_better():
    recording = fit_ranges.read(recording_folder("plaza_range_slam") / "Plaza1_.mat").part(slice(600))
    found = fit_ranges.learn(recording.part(slice(400)), "scale")
    before, after = (fit_ranges.localisation_errors(recording, robot) for robot in (fit_ranges.NOMINAL, found.theta))
    assert np.sqrt(np.mean(after[400:] ** 2)) < 0.3 * np.sqrt(np.mean(before[400:] ** 2))
    assert abs(float(fit_ranges.mean_excess(recording, found.theta)) - 2.8) < 0.3


def test_ranges_that_were_written_late_are_put_in_order(tmp_path):
    truth = np.array([[0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [2.0, 2.0, 0.0, 0.0]])
    odometry = np.array([[1.0, 1.0, 0.0], [2.0, 1.0, 0.0]])
    ranges = np.array([[1.5, 9, 7, 3.5], [0.5, 9, 3, 4.0]])
    beacons = np.array([[3.0, 0.5, 4.0], [7.0, 5.0, 0.0]])
    scipy.io.savemat(tmp_path / "some.mat", {"GT": truth, "DR": odometry, "TD": ranges, "TL": beacons})
    recording = fit_ranges.read(tmp_path / "some.mat")
    np.testing.assert_allclose(recording.seconds, [0.5, 1.5])
    np.testing.assert_array_equal(recording.ranges.mask, [[True, False], [False, True]])
    np.testing.assert_allclose(recording.steps.shift[:, 0], [0.5, 1.0], atol=1e-6)
    np.testing.assert_allclose(recording.truth, [[0.5, 0.0], [1.5, 0.0]])


def test_another_file_is_refused(tmp_path):
    (tmp_path / "some.mat").write_bytes(b"nothing")
    with pytest.raises(RecordingError, match="Plaza"):
        fit_ranges.read(Path(tmp_path / "some.mat"))
