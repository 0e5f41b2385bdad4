"""The scenario of fingertips: what its numbers are made of, and all of their names."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import fingertips
from jaxfilters.benchmarks.scenarios.fingertips import Truth
from jaxfilters.trackers.fingertips.state import HandReport


def report(identity, position):
    """Of runs, all slots that have an identity being fingertips."""
    fields = dict.fromkeys(HandReport._fields, np.zeros(0))
    return HandReport(**fields | {"identity": identity, "position": position, "is_tip": identity >= 0})


def test_identities_are_counted_by_run():
    identity = np.array([[[0, -1], [0, 1]], [[3, -1], [3, -1]]])
    assert fingertips.identities(report(identity, np.zeros((2, 2, 2, 2)))) == 1.5


def test_errors_are_from_the_nearest_finger_that_is_out():
    tips = np.zeros((1, 2, 5, 2))
    tips[:, :, 1] = [10.0, 0.0]
    tips[:, :, 2] = [0.0, 20.0]
    fingers = np.array([[False, True, True, False, False]])
    position = np.array([[[[10.0, 3.0], [0.0, 24.0]], [[0.0, 0.0], [5.0, 5.0]]]])
    identity = np.array([[[0, 1], [0, -1]]])
    total, rows = fingertips.squared_errors(report(identity, position), Truth(tips, fingers))
    assert (total, rows) == (9.0 + 16.0 + 100.0, 3)


@pytest.mark.system
def test_observations_are_stacked_and_hands_rendered():
    key = jax.random.key(0)
    parameters = fingertips.open_hand(key)
    frames = fingertips.render(key, 3, 2)
    found = fingertips.stacked([fingertips.detected(frame.image, parameters) for frame in frames])
    assert frames[0].image.shape == fingertips.SHAPE
    np.testing.assert_array_equal(jnp.sum(found.is_tip, axis=1), 3)


def test_without_the_recording_nothing_is_said_of_it(monkeypatch, capsys):
    monkeypatch.delenv("JAXFILTERS_DATA", raising=False)
    assert fingertips.video_metrics(None, 10) == {}
    assert "JAXFILTERS_DATA" in capsys.readouterr().err


@pytest.mark.system
def test_counts_are_better_with_correspondence_than_without():
    """Figure 5 of the paper, by both methods; hands in images are counted in the tests of the tracker."""
    metrics = fingertips.point_metrics(jax.random.key(0), 1, 300)
    for count in range(1, 6):
        for suffix in ("", "_published"):
            tracked, detected = (metrics[f"accuracy_with_{count}{s}"].value for s in (suffix, "_detected"))
            assert tracked > detected
        assert metrics[f"accuracy_with_{count}"].value > 98.5
    assert metrics["rms_px"].value < 2
    assert metrics["identities_per_finger"].value < 1.5
