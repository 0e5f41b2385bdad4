"""A wheeled robot that measures distances to beacons whose places are known, one at a time.

Ranges of radio beacons are too long, the more so the further off, and some are wild (J. Djugash, B. Hamner, S. Roth,
"Navigating with ranging radios: five data sets with ground truth", Journal of Field Robotics 26(9), 2009): by how
much, the noise and the share of outliers are parameters, to be learnt with those of the odometry.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.gaussian.robust import robust
from jaxfilters.math import linalg


class Step(NamedTuple):
    """What the odometry says since the last range."""

    shift: Float[Array, "... 2"]
    """Metres forwards and to the left, as the robot stood before."""
    turn: Float[Array, "..."]
    """Radians, to the left."""
    way: Float[Array, "..."]
    """Metres along the path, which need not be straight."""
    seconds: Float[Array, "..."]


@pytree_dataclass
class LinearExcess:
    """Ranges that are too long by a constant, and by a share of the distance."""

    bias: Float[Array, ""]
    """Metres."""
    scale: Float[Array, ""]

    def __call__(self, distance: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Metres by which a range is too long at a distance in metres."""
        return self.bias + self.scale * distance


@pytree_dataclass
class RangeRobot:
    """Parameters of the robot's motion and of its ranges: what can be learnt."""

    excess: Callable[[Array], Array]
    """`distances -> metres by which ranges are too long`; its leaves can be learnt, as those of `LinearExcess`."""
    noise: Float[Array, ""]
    """Standard deviation of a range, metres."""
    outlier_share: Float[Array, ""]
    """Share of ranges that are wild, in (0, 1)."""
    outlier_noise: Float[Array, ""]
    """Their standard deviation, metres."""
    slip: Float[Array, ""]
    """Standard deviation of each coordinate after a metre, in metres; it grows with the square root of the way."""
    turn_noise: Float[Array, ""]
    """Standard deviation of the heading after a second, in radians; it grows with the square root of the time."""

    def process_noise(self, step: Step) -> Float[Array, "3 3"]:
        """Covariance of (x, y, heading) after one step."""
        slip = jnp.square(self.slip) * step.way
        return jnp.diag(jnp.stack([slip, slip, jnp.square(self.turn_noise) * step.seconds]))


@pytree_dataclass
class _Sight:
    """Ranges to all beacons as the robot would read them."""

    robot: RangeRobot
    beacons: Float[Array, "b 2"]

    def __call__(self, x: Float[Array, "3"]) -> Float[Array, " b"]:
        distance = linalg.safe_norm(self.beacons - x[:2])
        return distance + self.robot.excess(distance)


def drive(x: Float[Array, "3"], step: Step) -> Float[Array, "3"]:
    """(x, y) in metres and heading in radians after one step."""
    cosine, sine = jnp.cos(x[2]), jnp.sin(x[2])
    forwards, left = step.shift
    return x + jnp.stack([cosine * forwards - sine * left, sine * forwards + cosine * left, step.turn])


def localisation(robot: RangeRobot, beacons: Float[Array, "b 2"], prior: Gaussian) -> Filter:
    """Extended Kalman filter of (x, y, heading) in metres and radians; inputs are `Step`, observations `Measured`.

    Beacons that were not heard are masked.

    Args:
        robot: Parameters, differentiable.
        beacons: Where they are, in metres.
        prior: Belief in (x, y, heading) before the first step.
    """
    sight = _Sight(robot, beacons)
    noise = jnp.square(robot.noise) * jnp.eye(beacons.shape[0])
    inner = extended_kalman(prior, drive, robot.process_noise, sight.__call__, noise)
    return robust(inner, robot.outlier_share, jnp.square(robot.outlier_noise) * jnp.eye(beacons.shape[0]))


def steps_between(
    times: Float[np.ndarray, " n"],
    odometry_times: Float[np.ndarray, " k"],
    distances: Float[np.ndarray, " k"],
    turns: Float[np.ndarray, " k"],
) -> Step:
    """What the odometry says between moments, the first step from the odometry's beginning to `times[0]`.

    Readings are summed along the path, each taken to turn evenly, and interpolated; none is straightened.

    Args:
        times: Of the ranges, seconds, in order.
        odometry_times: At which each reading ends, seconds, rising.
        distances: Metres since the reading before.
        turns: Radians since the reading before.

    Raises:
        ValueError: If times do not rise, or the odometry is shorter than two readings.
    """
    if len(odometry_times) < 2 or np.any(np.diff(odometry_times) <= 0):
        raise ValueError("odometry_times must be two or more, and rise.")
    if np.any(np.diff(times) < 0):
        raise ValueError("times must be in order.")
    start = 2 * odometry_times[0] - odometry_times[1]
    ends = np.concatenate([[start], odometry_times])
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    halfway = heading[:-1] + 0.5 * turns
    path = np.cumsum(np.stack([distances * np.cos(halfway), distances * np.sin(halfway), np.abs(distances)]), axis=1)
    x, y, way = np.concatenate([np.zeros((3, 1)), path], axis=1)
    moments = np.concatenate([[start], times])
    x, y, way, heading = (np.interp(moments, ends, values) for values in (x, y, way, heading))
    dx, dy, cosine, sine = np.diff(x), np.diff(y), np.cos(heading[:-1]), np.sin(heading[:-1])
    shift = np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx], axis=-1)
    return Step(*(jnp.asarray(values) for values in (shift, np.diff(heading), np.diff(way), np.diff(moments))))
