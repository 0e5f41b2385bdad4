"""`fit gestures --stream` and `recognise --stream` from end to end, and what they refuse."""

import csv

import numpy as np
import pytest

from jaxfilters.models.gesture import streams
from jaxfilters.trackers.app.cli import FAILURE, main
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.gesture_streams import read_streams


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


def written(path, count, seed):
    """Streams of one point that rests, but for gestures to the right and upwards."""
    rng = np.random.default_rng(seed)
    points, rows = [], []
    for i in range(count):
        velocity = np.zeros((150, 2))
        for k, first in enumerate(rng.permutation([20, 60, 100])):
            velocity[first : first + 25, k % 2] = 1.0
            rows.append([i, k % 2, first, first + 24])
        points.append(np.cumsum(velocity + rng.normal(0, 0.1, velocity.shape), axis=0))
    path.parent.mkdir(exist_ok=True)
    np.savez(
        path,
        points=np.concatenate(points),
        length=[150] * count,
        annotations=rows,
        names=["right", "up"],
        fps=20.0,
    )
    return path


@pytest.mark.system
def test_gestures_of_a_folder_are_learnt_and_found(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(streams.learn_streams, "__kwdefaults__", {"num_steps": 40})
    folder, model, table = written(tmp_path / "data" / "some.npz", 6, 0).parent, tmp_path / "m.npz", tmp_path / "t.csv"
    assert main(["fit", "gestures", str(folder), "--stream", "--out", str(model)]) == 0
    message = capsys.readouterr().out
    assert "2 gestures, 18 in 6 streams of 0.8 minutes" in message
    assert "1.00 s after its last frame at the earliest" in message
    other = written(tmp_path / "other.npz", 2, 7)
    assert main(["recognise", str(model), str(other), "--stream", "--out", str(table)]) == 0
    assert "100.0 % of 6 gestures found, 0.00 false alarms a minute" in capsys.readouterr().out
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert {row["gesture"] for row in rows} == {"right", "up"}
    assert all(float(row["reported_s"]) > float(row["end_s"]) > float(row["start_s"]) for row in rows)
    assert main(["recognise", str(other), str(other), "--stream"]) == FAILURE
    assert "fit gestures --stream" in capsys.readouterr().err


def test_options_that_do_not_go_together_are_refused(tmp_path, capsys):
    data = written(tmp_path / "s.npz", 2, 0)
    for more, words in (
        (["--held-out", "sequence"], "--stream"),
        (["--stream", "--held-out", "person"], "sequence"),
        (["--stream", "--add", "x.npz"], "--add"),
    ):
        assert main(["fit", "gestures", str(data), "--out", str(tmp_path / "m.npz"), *more]) == FAILURE
        assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"length": [150, 100]}, "length must be frames"),
        ({"annotations": [[0, 5, 0, 10]]}, "gestures from 0 to 1"),
        ({"annotations": [[0, 1, 200, 210]]}, "lie in their streams"),
        ({"annotations": [[0, 1, 2]]}, "annotations must be integers"),
        ({"fps": 0}, "fps"),
        ({"points": np.zeros((300, 4))}, "points must be numbers"),
    ],
)
def test_a_file_of_streams_that_fits_nothing_is_refused(tmp_path, changed, words):
    path = written(tmp_path / "s.npz", 2, 0)
    with np.load(path) as file:
        arrays = dict(file) | changed
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=words):
        read_streams(path)


def test_differences_and_streams_of_single_gestures_are_read(tmp_path):
    points = np.random.default_rng(0).normal(size=(9, 3, 3)).round(5)
    moved = np.concatenate([np.diff(part, axis=0, prepend=0) for part in (points[:4], points[4:])])
    delta = np.rint(1e5 * moved).astype(np.int32).transpose(1, 2, 0)
    np.savez(tmp_path / "a.npz", delta_1e5=delta, length=[4, 5], gesture=[10, 9])
    np.savez(
        tmp_path / "b.npz", delta_1e5=delta, length=[4, 5], seq_id=[7, 3], annotations=[[3, 9, 1, 20], [9, 1, 0, 1]]
    )
    found = read_streams(tmp_path)
    assert found.names == ("9", "10")
    np.testing.assert_allclose(np.concatenate([own.points for own in found.streams[:2]]), points, atol=1e-9)
    assert [own.is_example for own in found.streams] == [True, True, False, False]
    # An annotation that goes on beyond the end stops there; one of a stream that is not here says nothing.
    assert [own.segments for own in found.streams] == [((1, 0, 3),), ((0, 0, 4),), (), ((0, 1, 4),)]
