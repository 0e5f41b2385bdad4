"""Localisation of an ensemble Kalman filter: sample covariances between what is far apart are damped to zero.

An ensemble of N samples estimates a covariance of zero with a standard deviation of about one over the root of N. Where
a state has many more numbers than there are samples, these errors add up to more than the observations say.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxfilters.gaussian import checks
from jaxfilters.math.linalg import safe_norm


class Localization(NamedTuple):
    """Factors of sample covariances, from 0 to 1.

    Examples:
        Each of two observations changes only the number of the state that it measures, and no observation the third.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> factors = jf.ensemble.Localization(state=jnp.eye(3)[:, :2], observation=jnp.eye(2))
        >>> factors.state.tolist()
        [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]
    """

    state: Float[Array, "n m"]
    """Between each number of the state and each observation."""
    observation: Float[Array, "m m"]
    """Between observations; positive semidefinite."""


def gaspari_cohn(distance: ArrayLike, radius: ArrayLike) -> Float[Array, "*shape"]:
    """Correlation that falls from one to zero at `radius`, a polynomial of order five that resembles a Gaussian.

    G. Gaspari and S. E. Cohn, "Construction of correlation functions in two and three dimensions", Quarterly Journal of
    the Royal Meteorological Society 125, 1999, equation 4.10 with c half of the radius; as a Gaussian its standard
    deviation would be about 0.27 times the radius.

    Args:
        distance: Distances, not negative.
        radius: Distance from which on the correlation is zero, positive, in the same unit.

    Returns:
        Correlations of the shape of the distances.

    Raises:
        ValueError: If a concrete radius is not positive, or a concrete distance is negative.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> [round(float(c), 4) for c in jf.ensemble.gaspari_cohn(jnp.array([0.0, 0.5, 1.0]), 1.0)]
        [1.0, 0.2083, 0.0]
    """
    known = checks.concrete(radius)
    if known is not None and not np.all(known > 0):
        raise ValueError(f"radius must be positive; got {radius}.")
    known = checks.concrete(distance)
    if known is not None and not np.all(known >= 0):
        raise ValueError(f"distance must not be negative; got {known.min()}.")
    z = 2 * jnp.asarray(distance, dtype=float) / radius
    near = 1 + z**2 * (-5 / 3 + z * (5 / 8 + z * (1 / 2 - z / 4)))
    outer = jnp.clip(z, 1.0, 2.0)
    # (2 - z)^4 (z^2 + 2 z - 1/2) / (12 z) is the outer polynomial in the form that cancels nothing near its end.
    far = (2 - outer) ** 4 * (outer**2 + 2 * outer - 0.5) / (12 * outer)
    return jnp.where(z < 1, near, far)


def euclidean(a: Float[Array, " k"], b: Float[Array, " k"]) -> Float[Array, ""]:
    """The Euclidean distance of two points."""
    return safe_norm(a - b)


def localization(
    state_coordinates: ArrayLike,
    observation_coordinates: ArrayLike,
    radius: ArrayLike,
    *,
    distance: Callable[[Float[Array, " k"], Float[Array, " k"]], Float[Array, ""]] = euclidean,
    taper: Callable[[Array, ArrayLike], Array] = gaspari_cohn,
) -> Localization:
    """Localisation by distance, for `jf.ensemble_kalman`.

    Args:
        state_coordinates: Where each number of the state belongs, (n, k).
        observation_coordinates: Where each observation is made, (m, k).
        radius: Distance from which on nothing is correlated, positive, in the unit of the coordinates.
        distance: `(a, b) -> distance` of two points (k,): Euclidean, unless the space is a circle or a sphere.
        taper: `(distances, radius) -> correlations`; that of Gaspari and Cohn by default.

    Returns:
        The factors of the covariances.

    Raises:
        ValueError: If coordinates are not (n, k) and (m, k), or a concrete radius is not positive.
        TypeError: If `distance` or `taper` is no function.

    Examples:
        Every second of forty points on a circle is observed.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> around = lambda a, b: jnp.minimum(abs(a - b), 40 - abs(a - b))[0]
        >>> points = jnp.arange(40.0)[:, None]
        >>> factors = jf.ensemble.localization(points, points[::2], 15.0, distance=around)
        >>> factors.state.shape, factors.observation.shape
        ((40, 20), (20, 20))
    """
    checks.function("distance", distance)
    checks.function("taper", taper)
    points = [jnp.asarray(coordinates, dtype=float) for coordinates in (state_coordinates, observation_coordinates)]
    if any(p.ndim != 2 for p in points) or points[0].shape[1] != points[1].shape[1]:
        shapes = tuple(p.shape for p in points)
        raise ValueError(
            "state_coordinates and observation_coordinates must have the shapes (n, k) and (m, k); "
            f"got {shapes[0]} and {shapes[1]}."
        )
    among = jax.vmap(jax.vmap(distance, (None, 0)), (0, None))
    return Localization(*(taper(among(a, points[1]), radius) for a in points))
