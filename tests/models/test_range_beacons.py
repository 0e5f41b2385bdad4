import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import run
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import Observation
from jaxfilters.models.range_beacons import LinearExcess, RangeRobot, Step, drive, localisation, steps_between

BEACONS = jnp.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0], [40.0, 40.0]])
ROBOT = RangeRobot(LinearExcess(1.5, 0.05), *map(jnp.float32, (0.3, 0.02, 8.0, 0.05, 0.01)))


def circle(num_readings, radius=10.0, turn=0.05):
    """Odometry of a robot that drives in a circle, every 0.1 s, and its true poses after each reading."""
    headings = turn * np.arange(1, num_readings + 1)
    poses = np.stack([20 + radius * np.sin(headings), 20 - radius * np.cos(headings), headings], axis=-1)
    chord = 2 * radius * np.sin(turn / 2)
    return 0.1 * np.arange(1, num_readings + 1), np.full(num_readings, chord), np.full(num_readings, turn), poses


def test_steps_lead_along_the_path_over_any_gap():
    times, distances, turns, poses = circle(300)
    moments = times[[3, 4, 90, 250, 299]]
    steps = steps_between(moments, times, distances, turns)
    x, found = jnp.array([20.0, 10.0, 0.0]), []
    for i in range(len(moments)):
        x = drive(x, jax.tree.map(lambda leaf, i=i: leaf[i], steps))
        found.append(x)
    np.testing.assert_allclose(np.stack(found), poses[[3, 4, 90, 250, 299]], atol=2e-4)
    np.testing.assert_allclose(np.sum(steps.way), distances.sum(), rtol=1e-5)
    np.testing.assert_allclose(np.sum(steps.seconds), 30.0, rtol=1e-5)


@pytest.mark.system
def test_a_robot_is_found_where_it_is_among_wild_ranges():
    rng = np.random.default_rng(0)
    times, distances, turns, poses = circle(400)
    steps = steps_between(times, times, distances, turns)
    true = np.linalg.norm(poses[:, None, :2] - np.asarray(BEACONS), axis=-1)
    wild = rng.random(true.shape) < 0.02
    ranges = 1.5 + 1.05 * true + np.where(wild, 8.0, 0.3) * rng.standard_normal(true.shape)
    heard = np.arange(400)[:, None] % 4 == np.arange(4)
    prior = Gaussian(jnp.array([20.0, 10.0, 0.0]), jnp.diag(jnp.array([1.0, 1.0, 0.1]) ** 2))
    observations = Observation(jnp.asarray(np.where(heard, ranges, np.nan), jnp.float32), jnp.asarray(heard))
    _, (beliefs, infos) = run(localisation(ROBOT, BEACONS, prior), jax.random.key(0), observations, steps)
    error = np.asarray(beliefs.mean) - poses
    squared = np.einsum("ti,tij,tj->t", error, np.linalg.inv(np.asarray(beliefs.covariance)), error)
    # Three numbers; the errors of frames that follow one another are alike, so that the mean is not exactly 3.
    assert 0.5 < np.mean(squared[50:]) < 5
    assert np.sqrt(np.mean(np.sum(error[50:, :2] ** 2, axis=-1))) < 0.25
    heard_wild = np.any(heard & wild & (np.abs(ranges - 1.5 - 1.05 * true) > 3), axis=-1)
    assert np.all(np.asarray(infos.inlier_probability)[heard_wild] < 0.5)
    assert heard_wild.sum() >= 3


@pytest.mark.system
def test_a_robot_at_a_beacon_has_finite_numbers():
    prior = Gaussian(jnp.zeros(3), jnp.eye(3))
    step = Step(jnp.zeros((1, 2)), jnp.zeros(1), jnp.zeros(1), jnp.ones(1))
    observation = Observation(jnp.full((1, 4), 2.0), jnp.ones((1, 4), bool))
    final, _ = run(localisation(ROBOT, BEACONS, prior), jax.random.key(0), observation, step)
    assert np.all(np.isfinite(final.covariance))


@pytest.mark.parametrize(
    ("times", "odometry", "message"),
    [([1.0, 0.5], [0.0, 1.0], "times must be in order"), ([0.5], [1.0, 1.0], "odometry_times")],
)
def test_times_that_do_not_rise_are_refused(times, odometry, message):
    with pytest.raises(ValueError, match=message):
        steps_between(np.array(times), np.array(odometry), np.ones(2), np.zeros(2))
