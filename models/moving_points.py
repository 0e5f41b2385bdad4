"""Points that move with constant velocity and are observed with noise: both noises, estimated from tracks.

Every coordinate is a sequence of its own, a Kalman filter with position and velocity; all share the two noises. Tracks
are what a detector says: no truth is needed, since jitter that no motion explains is the sensor's.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters import fit
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter, run
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import Observation, extended_kalman
from jaxfilters.gaussian.smoothing import rts
from jaxfilters.motion.models import constant_velocity


class PointNoise(NamedTuple):
    """Noises of one coordinate; positive. Lengths are in the unit of the tracks."""

    sensor: Float[Array, ""]
    """Standard deviation of one reading."""
    drive: Float[Array, ""]
    """Standard deviation of the velocity after a second, per second; it grows with the square root of the time."""


class Tracks(NamedTuple):
    """Coordinates of points over time, each about its own mean; one sequence a column."""

    y: Float[Array, "t 1 n"]
    """NaN where nothing was observed."""
    seconds: Float[Array, "t n"]
    """Since the frame before, the same in all columns."""
    extent: Float[Array, ""]
    """Standard deviation of all coordinates about their means: how far points go."""


def tracks_of(points: Float[np.ndarray, "t *point"], times: Float[np.ndarray, " t"]) -> tuple[Tracks, np.ndarray]:
    """Tracks of points, NaN where not observed, and the mean of each coordinate, which they lack.

    Raises:
        ValueError: If times do not rise, there are fewer than three frames, or a coordinate was never observed.
    """
    points = np.asarray(points, float).reshape(len(points), -1)
    if len(points) < 3 or len(times) != len(points) or np.any(np.diff(times) <= 0):
        raise ValueError(f"times must rise and be one of each of 3 or more frames; got {len(times)} of {len(points)}.")
    never = np.flatnonzero(~np.isfinite(points).any(axis=0))
    if never.size:
        raise ValueError(f"points must each be observed in some frame; coordinates {never.tolist()} never are.")
    means = np.nanmean(points, axis=0)
    about = points - means
    seconds = np.diff(times, prepend=times[0])
    extent = np.sqrt(np.nanmean(about**2))
    columns = np.broadcast_to(seconds[:, None], about.shape)
    return Tracks(
        jnp.asarray(about[:, None], jnp.float32), jnp.asarray(columns, jnp.float32), jnp.float32(extent)
    ), means


def drift(x: Float[Array, "2"], seconds: Float[Array, ""]) -> Float[Array, "2"]:
    """Position and velocity some seconds later."""
    return jnp.stack([x[0] + seconds * x[1], x[1]])


def position(x: Float[Array, "2"]) -> Float[Array, "1"]:
    """The observed part of position and velocity."""
    return x[:1]


@pytree_dataclass
class _Drive:
    """Covariance of what white acceleration adds to position and velocity."""

    drive: Float[Array, ""]

    def __call__(self, seconds: Float[Array, ""]) -> Float[Array, "2 2"]:
        return constant_velocity(jnp.square(self.drive)).process_noise(seconds)


@pytree_dataclass
class PointFilter:
    """The filter of one coordinate, as a function of the noises."""

    extent: Float[Array, ""]
    """How far points go, and how fast they may be at first, in a second."""

    def __call__(self, noise: PointNoise) -> Filter:
        prior = Gaussian(jnp.zeros(2), jnp.diag(jnp.square(jnp.stack([2 * self.extent, 5 * self.extent]))))
        observed = jnp.square(noise.sensor)[None, None]
        return extended_kalman(prior, drift, _Drive(noise.drive).__call__, position, observed)


def learn(tracks: Tracks) -> fit.Fit:
    """`PointNoise` of most likelihood, with standard errors."""
    y = Observation(jnp.nan_to_num(tracks.y), jnp.isfinite(tracks.y))
    density = fit.over_sequences(_no_key(), PointFilter(tracks.extent), y, tracks.seconds)
    start = PointNoise(0.05 * tracks.extent, 5 * tracks.extent)
    return fit.maximize(density, start, fit.positive)


class Positions(NamedTuple):
    """Of every coordinate, about the same mean as its track."""

    filtered: Float[Array, "t n"]
    """Given the past and the present."""
    smoothed: Float[Array, "t n"]
    """Given the future, too."""


@jax.jit
def positions(tracks: Tracks, noise: PointNoise) -> Positions:
    """Where the points are, given their tracks and the noises."""
    chosen = PointFilter(tracks.extent)(noise)

    def one(y: Array, seconds: Array) -> Positions:
        _, (beliefs, _) = run(chosen, _no_key(), y, seconds)
        return Positions(beliefs.mean[:, 0], rts(chosen, beliefs, seconds).mean[:, 0])

    return jax.vmap(one, in_axes=-1, out_axes=-1)(tracks.y, tracks.seconds)


def _no_key() -> Array:
    """Gaussian filters draw nothing."""
    return jnp.zeros(2, jnp.uint32)
