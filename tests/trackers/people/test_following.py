"""The loop over a recording: what the tracker is given, in which order, and what is kept of it."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.trackers.people import following
from jaxfilters.trackers.people.recorded import Recorder
from jaxfilters.trackers.people.state import TENTATIVE, TRACKED, CameraFrame, PeopleConfig, Report
from jaxfilters.trackers.people.tracker import people_scene


@pytest.fixture(scope="module")
def scene(camera, floor):
    return people_scene([camera], floor, config=PeopleConfig(capacity=2, cell_m=2.0))


def shown(number):
    """Frames that can be told from others."""
    return (CameraFrame(np.full((2, 2), number, np.uint8), np.zeros((2, 2, 3), np.uint8), np.bool_(True)),)


@pytest.fixture
def given(monkeypatch):
    """Steps taken: frames and seconds. Somebody is tentative at first and tracked, as number 4, from the third on."""
    steps = []

    def step(scene, people, frames, dt):
        assert scene.config.capacity == len(people.mode)
        steps.append((int(frames[0].foreground[0, 0]), float(dt)))
        tracked = len(steps) > 2
        people = people._replace(
            mode=people.mode.at[0].set(TRACKED if tracked else TENTATIVE),
            identity=people.identity.at[0].set(4 if tracked else -1),
            log_odds=people.log_odds + 1,
        )
        n = jnp.ones(len(people.mode))
        return people, Report(people.identity, people.mode, people.belief.mean[:, :2], n, n, n, n, n, n, n > 0, n)

    monkeypatch.setattr(following, "step", step)
    return steps


@pytest.mark.system
def test_frames_come_in_turn_with_the_seconds_between_them(scene, given):
    """Frame numbers are counted, steps are differences of times, and tracks go back to before the confirmation."""
    recorder, times = Recorder(), [0.0, 0.1, 0.4, 0.5]
    found = list(following.follow(scene, [(at, shown(i)) for i, at in enumerate(times)], recorder))
    assert [number for number, _ in given] == [0, 1, 2, 3]
    np.testing.assert_allclose([dt for _, dt in given], [0.0, 0.1, 0.3, 0.1], rtol=1e-6)
    assert [(now.frame, now.time_s) for now in found] == list(enumerate(times))
    assert [len(now.added) for now in found] == [0, 0, 3, 1]
    assert [seen.frame for seen in recorder.tracks[4]] == [0, 1, 2, 3]
    assert all(now.seconds > 0 and isinstance(now.people.mode, np.ndarray) for now in found)


def test_the_next_moment_is_asked_for_when_the_last_has_been_dealt_with(scene, given):
    """So that a background can be told where people stand before it sees the next image."""
    events = []

    def moments():
        for at in (0.0, 0.1):
            events.append("asked")
            yield at, shown(0)

    for _ in following.follow(scene, moments(), Recorder()):
        events.append("dealt with")
    assert events == ["asked", "dealt with"] * 2
    assert len(given) == 2
