"""Recorded tracks: who is kept when, and smoothing against the batch solution of the same linear Gaussian model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.trackers.people import recorded
from jaxfilters.trackers.people.recorded import NO_IMAGE, Recorder, Sighting, smoothed, spreads
from jaxfilters.trackers.people.state import DORMANT, FREE, STATE, TENTATIVE, TRACKED, PeopleConfig, Report, nobody
from jaxfilters.trackers.people.table import as_rows, from_rows
from jaxfilters.trackers.people.tracker import motion

CONFIG = PeopleConfig(capacity=2)


def _frame(mode, identity, x=0.0, share=1.0, has_depth=True):
    people = nobody(CONFIG)
    mean = np.zeros((2, STATE), np.float32)
    mean[:, 0] = x
    people = people._replace(
        belief=Gaussian(jnp.asarray(mean), people.belief.covariance),
        mode=jnp.array([mode, FREE]),
        identity=jnp.array([identity, -1]),
        log_odds=jnp.array([1.0, 0.0]),
    )
    n, depth, counts = np.zeros(2), np.array([has_depth, True]), np.array([[4, 3], [4, 4]])
    report = Report(people.identity, people.mode, mean[:, :2], n, n, n, n + share, n, depth, n, counts)
    return jax.tree.map(np.asarray, people), report


def test_frames_before_the_confirmation_follow_with_the_identity():
    recorder = Recorder()
    assert recorder.add(0, 0, 0.0, *_frame(TENTATIVE, -1, 1.0)) == []
    assert recorder.add(1, 1, 0.1, *_frame(TENTATIVE, -1, 2.0)) == []
    added = recorder.add(2, 2, 0.2, *_frame(TRACKED, 5, 3.0))
    assert [(identity, sighting.frame, sighting.mean[0], sighting.mode) for identity, sighting in added] == [
        (5, 0, 1.0, "tentative"),
        (5, 1, 2.0, "tentative"),
        (5, 2, 3.0, "tracked"),
    ]


def test_sightings_are_saved_with_the_image_that_they_belong_to():
    recorder = Recorder()
    for frame, image in enumerate([0, NO_IMAGE, 1]):
        recorder.add(frame, image, 0.1 * frame, *_frame(TRACKED, 5))
    rows = as_rows([(5, sighting) for sighting in recorder.tracks[5]])
    assert rows.image.tolist() == [0, NO_IMAGE, 1]
    assert rows.innovations.tolist() == [[4, 3]] * 3
    assert [(sighting.frame, sighting.image) for _, sighting in from_rows(rows)] == [(0, 0), (1, NO_IMAGE), (2, 1)]


def test_a_person_who_comes_back_stands_once_in_each_frame():
    """Slot 1 follows a person unconfirmed while the old track in slot 0 has not ended yet, and takes its identity."""
    recorder = Recorder()
    for i in range(3):
        people, report = _frame(TRACKED, 5, 1.0)
        people = people._replace(mode=np.array([TRACKED, TENTATIVE]), log_odds=np.array([1.0, i]))
        recorder.add(i, i, 0.1 * i, people, report)
    people, report = _frame(DORMANT, -1, 2.0)
    added = recorder.add(3, 3, 0.3, people._replace(mode=np.array([FREE, TRACKED]), identity=np.array([-1, 5])), report)
    assert [(identity, sighting.frame) for identity, sighting in added] == [(5, 3)]
    assert [sighting.frame for sighting in recorder.tracks[5]] == [0, 1, 2, 3]


def test_memory_is_bounded_by_the_slots_where_tracks_are_not_kept(monkeypatch):
    """A hundred people one after another, and a candidate who is never confirmed; also after a restart."""
    monkeypatch.setattr(recorded, "MOST_UNCONFIRMED", 7)
    recorder, kept = Recorder(keep_tracks=False), Recorder()
    for i in range(200):
        people, report = _frame(TRACKED, i // 2)
        people = people._replace(mode=np.array([TRACKED, TENTATIVE]), log_odds=np.array([1.0, 1.0]))
        added = recorder.add(i, i, 0.1 * i, people, report)
        assert [(who, one.frame) for who, one in added] == [(i // 2, i)]
        assert added[0][1].mean is not kept.add(i, i, 0.1 * i, people, report)[0][1].mean
        if i % 50 == 0:
            again = Recorder(keep_tracks=False)
            again.restore(recorder.state(), ())
            recorder = again
    assert recorder.tracks == {}
    assert recorder.ended == {99: 199}
    assert [one.frame for one in recorder.unconfirmed[1]] == list(range(193, 200))
    assert sum(map(len, kept.tracks.values())) == 200


def test_whoever_is_given_up_leaves_nothing():
    recorder = Recorder()
    recorder.add(0, 0, 0.0, *_frame(TENTATIVE, -1))
    recorder.add(1, 1, 0.1, *_frame(FREE, -1))
    assert [sighting.frame for _, sighting in recorder.add(2, 2, 0.2, *_frame(TRACKED, 0))] == [2]


@pytest.mark.parametrize(
    ("share", "depth", "mode"),
    [(0.05, True, "hidden"), (0.15, True, "tracked"), (0.9, False, "no_depth"), (0.9, True, "tracked")],
)
def test_what_cannot_be_measured_is_said(share, depth, mode):
    ((_, sighting),) = Recorder().add(0, 0, 0.0, *_frame(TRACKED, 0, 0.0, share, depth))
    assert sighting.mode == mode


def test_spreads_are_along_and_across_the_line_of_sight():
    covariance = np.zeros((STATE, STATE))
    covariance[0, 0], covariance[1, 1] = 0.04, 0.01
    sighting = Sighting(0, 0.0, np.array([3.0, 0, 0, 0, 1.7, 0.4]), covariance, 1.0, 0, "tracked")
    assert spreads(np.array([[0.0, 0.0]]), sighting) == pytest.approx((0.2, 0.1))
    # The second camera is nearer, and looks along Y.
    assert spreads(np.array([[0.0, 0.0], [3.0, -1.0]]), sighting) == pytest.approx((0.1, 0.2))


@pytest.mark.system
def test_smoothed_tracks_are_the_batch_solution(x64):
    """Filtered in NumPy, smoothed here, against the least-squares solution of all frames at once."""
    rng = np.random.default_rng(0)
    steps, n = np.array([0.0, 0.1, 0.2, 0.1, 0.1, 0.3]), 6
    H, R = np.eye(STATE)[[0, 1]], 0.02 * np.eye(2)
    readings = rng.standard_normal((n, 2))
    mean, covariance, sightings = np.zeros(STATE), np.eye(STATE), []
    blocks, rhs = np.zeros((n * STATE, n * STATE)), np.zeros(n * STATE)
    blocks[:STATE, :STATE] += np.eye(STATE)
    for t in range(n):
        now = slice(t * STATE, (t + 1) * STATE)
        if t:
            F, Q = (np.asarray(a, float) for a in motion(CONFIG, jnp.asarray(steps[t])))
            information = np.linalg.inv(Q)
            mean, covariance = F @ mean, F @ covariance @ F.T + Q
            before = slice((t - 1) * STATE, t * STATE)
            blocks[before, before] += F.T @ information @ F
            blocks[now, now] += information
            blocks[before, now] -= F.T @ information
            blocks[now, before] -= information @ F
        gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + R)
        mean, covariance = mean + gain @ (readings[t] - H @ mean), covariance - gain @ H @ covariance
        blocks[now, now] += H.T @ np.linalg.inv(R) @ H
        rhs[now] += H.T @ np.linalg.inv(R) @ readings[t]
        sightings.append(Sighting(t, float(steps[: t + 1].sum()), mean, covariance, 0.0, 0, "tracked"))
    found = smoothed(CONFIG, {3: sightings})[3]
    expected = np.linalg.solve(blocks, rhs).reshape(n, STATE)
    # Beliefs are kept in single precision.
    np.testing.assert_allclose([sighting.mean for sighting in found], expected, atol=2e-4)
    spread = np.linalg.inv(blocks)
    for t, sighting in enumerate(found):
        now = slice(t * STATE, (t + 1) * STATE)
        np.testing.assert_allclose(sighting.covariance, spread[now, now], atol=2e-4)


@pytest.mark.system
@pytest.mark.parametrize(("time", "slot", "mode"), [(20.0, 0, "tracked"), (0.1, 1, "tracked"), (0.1, 0, "tentative")])
def test_a_long_gap_another_slot_and_a_new_start_part_a_track(time, slot, mode):
    here = [
        Sighting(f, t, np.full(STATE, float(f)), np.eye(STATE), 0.0, at, kind)
        for f, t, at, kind in ((0, 0.0, 0, "tracked"), (1, time, slot, mode))
    ]
    for sighting, kept in zip(smoothed(CONFIG, {0: here})[0], here, strict=True):
        np.testing.assert_array_equal(sighting.mean, kept.mean)
