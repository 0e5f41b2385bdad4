"""`fit gestures --stream` and `recognise --stream` from end to end, and what they refuse."""

import csv

import jax
import numpy as np
import pytest

from jaxfilters.hmm import semi_markov
from jaxfilters.models.gesture import streams
from jaxfilters.models.gesture.frame_classifier import KERNEL, FrameClassifier
from jaxfilters.models.gesture.poses import PoseTemplate
from jaxfilters.models.gesture.streams import StreamModel
from jaxfilters.trackers.app.cli import FAILURE, main
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.gesture_streams import read_stream_model, read_streams, write_stream_model


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
        (["--stream", "--add", "x.npz"], "--add: of no use with --stream"),
        (["--stream", "--states", "5", "--ways", "2"], "--states, --ways: of no use with --stream"),
        (["--add", "default", "--states", "5"], "--states: of no use with --add"),
    ):
        assert main(["fit", "gestures", str(data), "--out", str(tmp_path / "m.npz"), *more]) == FAILURE
        assert words in capsys.readouterr().err
    for more, words in (
        (["m.npz", "--margin", "0", "--seed", "1"], "--margin, --seed: of no use with --stream"),
        (["default"], "default: the package has no model of gestures in streams; make one with `jaxfilters fit"),
    ):
        assert main(["recognise", more[0], str(data), *more[1:], "--stream"]) == FAILURE
        assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"length": [150, 100]}, "length must be frames"),
        ({"annotations": [[0, 5, 0, 10]]}, "gestures from 0 to 1"),
        ({"annotations": [[0, 1, 200, 210]]}, "lie in their streams"),
        ({"annotations": [[0, 1, 2]]}, "annotations must be integers"),
        ({"length": np.array([2**63 - 1, 2**63 - 1])}, "length must be frames"),
        ({"fps": 0}, "fps must be one number"),
        ({"fps": []}, "fps must be one number"),
        ({"fps": "abc"}, "fps must be one number"),
        ({"fps": [20.0, 30.0]}, "fps must be one number"),
        ({"seq_id": [0.5, np.nan]}, "annotations must be integers"),
        ({"points": np.zeros((300, 4))}, "points must be numbers"),
        ({"points": np.full((300, 1, 2), np.inf)}, "points must be numbers of at most 1e"),
    ],
)
def test_a_file_of_streams_that_fits_nothing_is_refused(tmp_path, changed, words):
    path = written(tmp_path / "s.npz", 2, 0)
    with np.load(path) as file:
        arrays = dict(file) | changed
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=words):
        read_streams(path)


def model_of_two_gestures():
    """Of one point in a plane, with features (12,) and layers of a width of 8."""
    rng = np.random.default_rng(0)
    layers = tuple((rng.normal(size=(KERNEL, channels, 8)), np.zeros(8)) for channels in (12, 8, 8))
    classifier = FrameClassifier(np.zeros(12), np.ones(12), layers, (rng.normal(size=(8, 3)), np.zeros(3)))
    template = PoseTemplate(np.zeros((1, 2)), np.ones(1), np.zeros(1, int), 1.0, 2.0, 0.5)
    follows = [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0]]
    return StreamModel(("a", "b"), template, classifier, semi_markov([0.25, 0.25, 0.5], follows, [[0.5, 0.5]] * 3))


def test_a_model_is_read_as_it_was_written(tmp_path):
    model = model_of_two_gestures()
    write_stream_model(tmp_path / "m.npz", model, "s.npz")
    found = read_stream_model(tmp_path / "m.npz")
    assert found.names == model.names
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), found[1:], model[1:])


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("template_size", np.zeros(0), r"template_size must be numbers \(\); got \(0,\)"),
        ("template_speed", np.array(np.nan), "template_speed must be finite; got nan"),
        ("template_bending", np.array(0.0), "template_bending must be above 0; got 0.0"),
        ("template_shape", np.zeros(2), r"template_shape must be numbers \(J, 2 or 3\)"),
        ("template_weights", np.array([0.5]), r"template_weights .* sum to 1; got \[0.5\]"),
        ("template_moving", np.array([1]), r"template_moving must be \(m,\) integers from 0 to 0, .* got \[1\]"),
        ("template_moving", np.array([-1]), r"template_moving .* got \[-1\]"),
        ("template_moving", np.array([0.0]), "template_moving"),
        ("template_moving", np.zeros(2, int), r"classifier_0 must be numbers \(14,\); got \(12,\)"),
        ("classifier_1", np.zeros(12), "classifier_1 must be standard deviations above 0"),
        ("classifier_2", np.zeros((3, 12, 8)), r"classifier_2 must be numbers \(5, 12, 8\)"),
        ("classifier_4", np.zeros((5, 9, 8)), r"classifier_4 must be numbers \(5, 8, 8\); got \(5, 9, 8\)"),
        ("classifier_5", np.full(8, np.inf), "classifier_5 must be finite; got inf"),
        ("classifier_8", np.zeros((8, 4)), r"classifier_8 must be numbers \(8, 3\); got \(8, 4\)"),
        ("log_initial", np.full(3, np.nan), "log_initial must be logarithms of probabilities; got nan"),
        ("log_transition", np.zeros((3, 3)), "log_transition must be .* that sum to 1; got a sum of 3"),
        ("log_end", np.full((3, 2), 0.5), "log_end must be logarithms of probabilities; got 0.5"),
        ("log_end", np.zeros(3), r"log_end must be \(3, D\), of D frames; got \(3,\)"),
        ("log_stay", np.zeros((3, 2)), "log_end, log_stay must be .* that sum to 1"),
    ],
)
def test_a_model_that_fits_nothing_is_refused_by_the_name_of_the_array(tmp_path, name, values, words):
    path = tmp_path / "m.npz"
    write_stream_model(path, model_of_two_gestures(), "s.npz")
    with np.load(path) as file:
        arrays = dict(file) | {name: values}
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=f"m.npz: {words}"):
        read_stream_model(path)


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
