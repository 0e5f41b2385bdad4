"""The scenario of speed: everybody it counts is followed, and its names are those that others rely on."""

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


@pytest.mark.system
def test_every_metric_is_there_and_everybody_is_followed(monkeypatch):
    monkeypatch.setattr(people_speed, "QUICK_SHAPES", ("160x120",))
    monkeypatch.setattr(people_speed, "QUICK_COUNTS", (1, 8))
    monkeypatch.setattr(people_speed, "QUICK_ROUNDS", 1)
    metrics = people_speed.run(quick=True, seed=0, out=None)
    kinds = ("fps", "tracking_fps", "candidates_per_second", "followed")
    expected = {f"{kind}_{count}_people_160x120" for kind in kinds for count in (1, 8)}
    assert set(metrics) == expected | {"person_ms_160x120"}
    assert metrics["followed_8_people_160x120"].value == 8
    assert metrics["followed_1_people_160x120"].value == 1
    assert all(np.isfinite(metric.value) for metric in metrics.values())
    rate = people_speed.CANDIDATES * 8 * metrics["tracking_fps_8_people_160x120"].value
    assert metrics["candidates_per_second_8_people_160x120"].value == pytest.approx(rate)


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
    np.testing.assert_allclose(people.belief.mean[:3, 4:], sizes, rtol=1e-6)
    assert people.identity.tolist() == [0, 1, 2, -1, -1]
