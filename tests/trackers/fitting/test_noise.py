import json

import numpy as np
import pytest

from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.points import read_points


@pytest.mark.system
def test_noises_of_synthetic_tracks_are_found_and_written(tmp_path, capsys):
    assert main(["fit", "noise", "--out", str(tmp_path / "new" / "noise.json")]) == 0
    found = json.loads((tmp_path / "new" / "noise.json").read_text())
    assert abs(found["sensor"] - 0.5) < 4 * found["sensor_standard_error"]
    assert abs(found["drive"] - 40.0) < 4 * found["drive_standard_error"]
    assert "Synthetic" in capsys.readouterr().out


def test_a_table_of_tracks_is_read_with_its_gaps(tmp_path):
    (tmp_path / "tips.csv").write_text("frame,id,x,y,more\n0,a,1,2,u\n0,b,3,4,u\n2,a,5,6,u\n")
    points, times = read_points(tmp_path / "tips.csv", 10.0)
    np.testing.assert_allclose(times, [0.0, 0.2])
    np.testing.assert_allclose(points, [[[1, 2], [3, 4]], [[5, 6], [np.nan, np.nan]]])


def test_arrays_are_read_with_or_without_times(tmp_path):
    points = np.arange(12.0).reshape(2, 3, 2)
    np.savez(tmp_path / "a.npz", points=points)
    np.savez(tmp_path / "b.npz", points=points, t_s=[0.0, 0.7])
    np.testing.assert_allclose(read_points(tmp_path / "a.npz", 20.0)[1], [0.0, 0.05])
    np.testing.assert_allclose(read_points(tmp_path / "b.npz", 20.0)[1], [0.0, 0.7])


def test_points_at_rest_are_refused(tmp_path, capsys):
    np.savez(tmp_path / "still.npz", points=np.ones((10, 2, 2)))
    assert main(["fit", "noise", str(tmp_path / "still.npz")]) != 0
    assert "still.npz: all points are at rest" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "frame,id,x,y\n0,a,1,there\n", ""])
def test_another_table_is_refused(tmp_path, text):
    (tmp_path / "some.csv").write_text(text)
    with pytest.raises(InputError, match=r"some\.csv"):
        read_points(tmp_path / "some.csv", 30.0)


def test_a_file_that_is_not_there_is_refused(tmp_path, capsys):
    assert main(["fit", "noise", str(tmp_path / "none.npz")]) != 0
    assert "cannot be read" in capsys.readouterr().err


def test_a_damaged_archive_is_refused(tmp_path):
    whole = tmp_path / "whole.npz"
    np.savez(whole, points=np.zeros((4, 1, 2)))
    (tmp_path / "half.npz").write_bytes(whole.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"half\.npz: not a complete \.npz file"):
        read_points(tmp_path / "half.npz", 30.0)
