"""An observation with what is known about it beside its numbers."""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float

from jaxfilters.gaussian import checks


class Observation(NamedTuple):
    """An observation with a mask and a noise of its own; Gaussian filters take a plain array `y` too.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> y = jf.Observation(jnp.array([1.0, 2.0]), mask=jnp.array([True, False]))
    """

    y: Float[Array, " m"]
    """NaN where nothing was read: such components are left out, and counted in `info.num_invalid` unless masked."""
    mask: Bool[Array, " m"] | None = None
    """False for components that are to be left out, whatever `y` holds there; `None` leaves none out."""
    noise: Array | None = None
    """Covariance of the noise of this observation, (m, m), or a root of it, (m, k), in place of the filter's."""


def as_observation(observation: Any) -> Observation:
    """An observation with what is known about it, given as such or as an array."""
    measured = observation if isinstance(observation, Observation) else Observation(observation)
    checks.observation(measured.y, measured.mask)
    return measured
