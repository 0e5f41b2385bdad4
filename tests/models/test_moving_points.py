import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxfilters import fit
from jaxfilters.gaussian.extended import Observation
from jaxfilters.models.moving_points import PointFilter, PointNoise, learn, positions, tracks_of


def simulated(seed=0, sensor=0.5, drive=40.0, frames=200):
    """Three coordinates, seen at uneven times, with gaps; and where they are."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.02, 0.05, frames))
    places, x, v = [], np.zeros(3), np.zeros(3)
    for dt in np.diff(times, prepend=times[0]):
        root = np.linalg.cholesky([[dt**3 / 3 + 1e-15, dt**2 / 2], [dt**2 / 2, dt + 1e-9]])
        push = drive * root @ rng.normal(size=(2, 3))
        x, v = x + dt * v + push[0], v + push[1]
        places.append(x)
    places = np.array(places)
    observed = places + sensor * rng.normal(size=places.shape)
    observed[rng.random(observed.shape) < 0.1] = np.nan
    return times, places, observed


@pytest.mark.system
def test_noises_are_learnt_from_tracks_with_gaps():
    times, places, observed = simulated()
    tracks, means = tracks_of(observed, times)
    found = learn(tracks)
    for name, true in (("sensor", 0.5), ("drive", 40.0)):
        z = (float(getattr(found.theta, name)) - true) / float(getattr(found.standard_errors, name))
        assert abs(z) < 4
    smoothed = np.asarray(positions(tracks, found.theta).smoothed) + means
    assert np.sqrt(np.mean((smoothed - places) ** 2)) < 0.8 * np.sqrt(np.nanmean((observed - places) ** 2))


@pytest.mark.system
def test_the_likelihood_is_that_of_all_readings_at_once():
    times, _, observed = simulated(frames=5)
    tracks, _ = tracks_of(observed, times)
    y = Observation(jnp.nan_to_num(tracks.y), jnp.isfinite(tracks.y))
    noise = PointNoise(jnp.float32(0.5), jnp.float32(40.0))
    found = fit.over_sequences(jnp.zeros(2, jnp.uint32), PointFilter(tracks.extent), y, tracks.seconds)(noise)
    extent, expected = float(tracks.extent), 0.0
    elapsed = times - times[0]
    for column in np.asarray(tracks.y)[:, 0].T:
        shorter, longer = np.minimum(elapsed[:, None], elapsed), np.maximum(elapsed[:, None], elapsed)
        covariance = 1600 * (shorter**2 * longer / 2 - shorter**3 / 6) + 25 * extent**2 * elapsed[:, None] * elapsed
        covariance += 4 * extent**2 + 0.25 * np.eye(5)
        read = np.isfinite(column)
        expected += multivariate_normal.logpdf(column[read], np.zeros(read.sum()), covariance[np.ix_(read, read)])
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("points", "times", "message"),
    [
        (np.zeros((2, 1)), np.arange(2.0), "3 or more frames"),
        (np.zeros((3, 1)), np.zeros(3), "times must rise"),
        (np.array([[0.0, np.nan]] * 3), np.arange(3.0), r"coordinates \[1\] never"),
    ],
)
def test_tracks_that_say_nothing_are_refused(points, times, message):
    with pytest.raises(ValueError, match=message):
        tracks_of(points, times)
