"""The scenario of speed: what it shows, and what its numbers are made of."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import people_speed
from jaxfilters.trackers.people.state import TRACKED


def test_people_in_the_crowd_keep_apart():
    """The nearest two of 32 are farther apart than two widths; fewer people are some of the same ones."""
    places, sizes = people_speed.crowd(0, people_speed.CAPACITY)
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + 9 * np.eye(len(places))
    assert apart.min() > 0.5
    some, some_sizes = people_speed.crowd(0, 3)
    np.testing.assert_array_equal(some, places[:3])
    np.testing.assert_array_equal(some_sizes, sizes[:3])
    low, high = np.min(people_speed.FLOOR_M, axis=0), np.max(people_speed.FLOOR_M, axis=0)
    assert np.all((places > low + 0.5) & (places < high - 0.5))


def test_rates_are_of_the_times_and_of_who_is_followed(monkeypatch):
    """With one person 10 and 8 ms a frame, with eight 24 and 22: two more for each of the seven others."""
    config = people_speed.PeopleConfig(capacity=people_speed.CAPACITY)
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
