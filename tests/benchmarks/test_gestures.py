"""The scenario of symbols: what it measures, and what it says of recordings that are not there."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios import _drawn_symbols, _sfinge, gestures, sfinge
from jaxfilters.benchmarks.scenarios._drawn_symbols import METHODS, Scale, scored
from jaxfilters.hmm import Segment
from jaxfilters.models.gesture.symbols import Recognition
from jaxfilters.models.synthetic import strokes
from jaxfilters.models.synthetic.strokes import Tracked


@pytest.fixture
def two_shapes(monkeypatch):
    """Fewer shapes, and a scale at which the whole scenario is done in seconds."""
    monkeypatch.setattr(_drawn_symbols, "drawn", lambda *args: strokes.drawn(*args, shapes=("V", "L")))
    monkeypatch.setattr(gestures, "QUICK", Scale(1, 5, 2, 3))


@pytest.mark.system
def test_without_recordings_only_what_is_drawn_is_measured(two_shapes, monkeypatch, capsys):
    monkeypatch.delenv("JAXFILTERS_DATA", raising=False)
    metrics = gestures.run(quick=True, seed=0, out=None)
    assert set(metrics) == {
        f"{what}_{fingers}{method}"
        for what in ("accuracy", "sd")
        for fingers in ("one_finger", "two_fingers")
        for method in METHODS
    }
    assert metrics["accuracy_one_finger"].value >= 80
    message = capsys.readouterr().out
    assert all(folder in message for folder in (gestures.SFINGE, *(r[0] for r in gestures.RECORDINGS.values())))


def test_a_symbol_is_right_if_shape_and_fingers_are_and_wrong_if_rejected():
    evaluated = Recognition(np.array([0, -1, 1, 0]), np.ones((2, 4)), np.ones((2, 4)), np.ones(4))
    drawings = Tracked([], [], ("V 1", "V 1", "V 2", "V 2"))
    assert scored(("V 1", "V 2"), evaluated, drawings) == [50, 50]


@pytest.mark.system
def test_recorded_people_are_recognised_from_the_others(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    lines = np.linspace(0, 1, 20)[:, None] * np.array([[100.0, 0, 0]])
    kinds = {"flat": lines, "steep": lines[:, [1, 0, 2]], "hook": np.abs(lines - 50) + lines[:, [1, 0, 2]]}
    people, names = ("A", "B", "C"), tuple(kinds)
    folder = tmp_path / "midair_leap_gestures"
    folder.mkdir()
    np.savez(
        folder / "midair_leap.npz",
        xyz_mm=np.concatenate([kinds[name] + rng.normal(0, 0.5, (20, 3)) for _ in people for name in names]),
        length=[20] * 9,
        gesture=list(names) * 3,
        subject=np.repeat(people, 3),
    )
    monkeypatch.setenv("JAXFILTERS_DATA", str(tmp_path))
    metrics = gestures.recorded_metrics("midair_loso", quick=True)
    assert metrics["accuracy_midair_loso"].value == metrics["accuracy_midair_loso_dtw"].value == 100
    np.savez(folder / "midair_leap.npz", xyz=np.zeros(3))
    with pytest.raises(RecordingError, match="points"):
        gestures.recorded_metrics("midair_loso", quick=True)
    with pytest.raises(RecordingError, match="unipen_digits"):
        gestures.recorded_metrics("unipen_unseen_donor", quick=True)


def test_confidences_that_are_true_have_the_calibration_error_of_binomial_counts():
    """Of 600 strokes in 15 bins: the mean of |count - np| / n, normal to a few percent."""
    expected = np.sqrt(2 * 0.8 * 0.2 * 15 / (np.pi * 600))
    assert gestures._error_by_chance(np.full(600, 0.8)) == pytest.approx(expected, rel=0.05)


def test_a_gesture_is_detected_once_by_more_than_half_of_it():
    truth = [Segment(2, 10, 29), Segment(5, 50, 69)]
    assert _sfinge.scored(truth, truth) == (2, 0, 2, [1, 1])
    half, more = Segment(2, 0, 19), Segment(2, 0, 20)
    assert _sfinge.scored([half], truth)[:3] == (0, 1, 2)
    found = _sfinge.scored([more, Segment(2, 21, 33), Segment(5, 80, 90), Segment(3, 50, 69)], truth)
    # Frames 10 to 29 are in detections of the label, which hold 34 frames.
    assert found == (1, 3, 2, [20 / 34, 0, 0, 0, 0])
    # One long detection over two gestures is a detection of one of them.
    twice = [Segment(2, 10, 29), Segment(2, 35, 54)]
    assert _sfinge.scored([Segment(2, 10, 54)], twice)[:3] == (1, 0, 2)
    assert _sfinge.scored([Segment(2, 10, 54), Segment(2, 36, 54)], twice)[:3] == (2, 0, 2)


def test_features_of_a_hand_do_not_depend_on_where_it_is_nor_on_how_its_palm_is_turned():
    rng = np.random.default_rng(0)
    joints = np.concatenate([rng.normal(size=(9, 20, 3)), np.tile([0.0, 0, 0, 1], (9, 20, 1))], axis=2)
    turn = Rotation.from_euler("xyz", (0.3, 1.0, -0.4))
    moved = joints.copy()
    moved[..., :3] = turn.apply(joints[..., :3].reshape(-1, 3)).reshape(9, 20, 3) + 5
    moved[..., 3:] = turn.as_quat()
    before, after = _sfinge.hand_features(joints), _sfinge.hand_features(moved)
    np.testing.assert_allclose(after[:, :15], before[:, :15], atol=1e-4)
    np.testing.assert_allclose(after[:, 18:], before[:, 18:], atol=1e-3)
    # The velocity is that in the world.
    np.testing.assert_allclose(after[:, 15:18], turn.apply(before[:, 15:18]), atol=1e-4)


def test_segments_at_the_rate_of_the_features_are_frames_of_the_stream():
    assert sfinge._at_rate(2 * sfinge.poses.RATE_HZ, [Segment(2, 10, 33)]) == [Segment(2, 20, 66)]
