"""The scenario of speed: what it shows, and what its numbers are made of."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import people_speed
from jaxfilters.trackers.people.state import TRACKED


@pytest.mark.parametrize(("setting", "count"), [(people_speed.ROOM, 32), (people_speed.CROWD, 50)])
def test_people_in_the_crowd_keep_apart(setting, count):
    """The nearest two are farther apart than a width; fewer people are some of the same ones."""
    places, sizes = people_speed.crowd(0, setting.capacity, setting)
    assert len(places) == len(sizes) == count
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + 9 * np.eye(len(places))
    assert apart.min() > 0.5
    some, some_sizes = people_speed.crowd(0, 3, setting)
    np.testing.assert_array_equal(some, places[:3])
    np.testing.assert_array_equal(some_sizes, sizes[:3])
    low, high = np.min(people_speed.FLOOR_M, axis=0), np.max(people_speed.FLOOR_M, axis=0)
    assert np.all((places > low + 0.5) & (places < high - 0.5))


def test_a_crowd_of_fifty_is_in_the_image():
    """Feet and heads, so that everybody can be followed."""
    camera = people_speed.floor_camera(
        people_speed._pinhole(people_speed.CROWD_SHAPE), people_speed.looking(*people_speed.CROWD.camera)
    )
    places, sizes = people_speed.crowd(0, 50, people_speed.CROWD)
    for height in (np.zeros(50), sizes[:, 0]):
        uv, depth = camera.project(jnp.asarray(np.column_stack([places, height]), jnp.float32))
        assert np.all((np.asarray(uv) > 0) & (np.asarray(uv) < [639, 479]))
        assert np.all(np.asarray(depth) > 0)


def test_a_crowd_and_the_background_have_rows_of_their_own(monkeypatch):
    """30 people take 20 ms and 50 take 30: 1.5 times; the background takes 4 ms wherever it is measured alone."""
    people = people_speed._followed(people_speed.PeopleConfig(capacity=4), *people_speed.crowd(0, 2))
    made = []

    def recording(seed, count, shape, setting=people_speed.ROOM):
        made.append((count, shape, setting))
        return people_speed.Recording(None, people, None, None)

    def interleaved(calls, rounds):
        return {
            name: {"tracking_fps_30_people": 0.02, "tracking_fps_50_people": 0.03}.get(name, 0.004) for name in calls
        }

    monkeypatch.setattr(people_speed, "recording", recording)
    monkeypatch.setattr(people_speed, "foreground", lambda recording: None)
    monkeypatch.setattr(people_speed, "interleaved", interleaved)
    metrics = people_speed.run(quick=False, seed=0, out=None)
    assert metrics["tracking_fps_50_people_640x480"].value == pytest.approx(1 / 0.03)
    assert metrics["tracking_growth_30_to_50_people"].value == pytest.approx(1.5)
    assert metrics["background_ms_1080p"].value == pytest.approx(4.0)
    assert made[-2:] == [(count, (480, 640), people_speed.CROWD) for count in (30, 50)]
    assert "background_ms_1080p" not in people_speed.run(quick=True, seed=0, out=None)


def test_rates_are_of_the_times_and_of_who_is_followed(monkeypatch):
    """With one person 10 and 8 ms a frame, with eight 24 and 22: two more for each of the seven others."""
    config = people_speed.PeopleConfig(capacity=people_speed.ROOM.capacity)
    recordings = {
        count: people_speed.Recording(None, people_speed._followed(config, *people_speed.crowd(0, count)), None, None)
        for count in (1, 8)
    }
    seconds = {"fps_1_people": 0.01, "tracking_fps_1_people": 0.008}
    seconds |= {"fps_8_people": 0.024, "tracking_fps_8_people": 0.022}
    monkeypatch.setattr(people_speed, "foreground", lambda recording: None)
    monkeypatch.setattr(people_speed, "interleaved", lambda calls, rounds: {name: seconds[name] for name in calls})
    metrics = people_speed.speed_metrics("160x120", recordings, 1)
    assert {name: metric.value for name, metric in metrics.items()} == pytest.approx(
        {
            "fps_1_people_160x120": 100.0,
            "fps_8_people_160x120": 1 / 0.024,
            "tracking_fps_1_people_160x120": 125.0,
            "tracking_fps_8_people_160x120": 1 / 0.022,
            "followed_1_people_160x120": 1,
            "followed_8_people_160x120": 8,
            "candidates_per_second_1_people_160x120": people_speed.CANDIDATES * 125.0,
            "candidates_per_second_8_people_160x120": people_speed.CANDIDATES * 8 / 0.022,
            "person_ms_160x120": 2.0,
        }
    )


@pytest.mark.system
def test_images_of_all_sizes_show_the_same():
    """The same people at the same places of the image, up to what a smaller image shows."""
    places, sizes = people_speed.crowd(0, 2)
    small, large = (people_speed._image(0, places, sizes, shape, True) for shape in ((60, 80), (180, 240)))
    assert small.shape == (60, 80, 3)
    reduced = large.reshape(60, 3, 80, 3, 3).mean(axis=(1, 3))
    assert np.mean(np.abs(reduced - small).max(axis=-1) < 25) > 0.95


@pytest.mark.system
def test_people_start_where_they_are():
    places, sizes = people_speed.crowd(1, 3)
    people = people_speed._followed(people_speed.PeopleConfig(capacity=5), places, sizes)
    assert int(jnp.sum(people.mode == TRACKED)) == 3
    np.testing.assert_allclose(people.belief.mean[:3, :2], places, rtol=1e-6)
    np.testing.assert_allclose(people.belief.mean[:3, 4:6], sizes, rtol=1e-6)
    assert people.identity.tolist() == [0, 1, 2, -1, -1]
