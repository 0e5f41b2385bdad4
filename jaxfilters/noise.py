"""Sources of the randomness that moves an ensemble: what the argument `noise` of a particle filter takes."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._xla.noise import standard_normal
from jaxfilters.particle.checks import check_sizes
from jaxfilters.typing import AnyKey


def random_keys(key: AnyKey, num_particles: int) -> PyTree:
    """Draw one random key for each particle, stacked along the last axis.

    Examples:
        >>> import jax, jaxfilters as jf
        >>> jf.noise.random_keys(jax.random.key(0), 1000).shape
        (1000,)
    """
    keys = jax.random.split(key, num_particles)
    return jnp.moveaxis(keys, 0, -1)


@dataclass(frozen=True)
class StandardNormal:
    """Source of independent standard normal numbers: an array of a fixed shape for each particle.

    `StandardNormal(3)` passes a vector `(3,)` to the transition of each particle, `StandardNormal(())` one number of
    shape `()`.

    Raises:
        ValueError: If a size is not an integer of at least 0.

    Examples:
        >>> import jax, jaxfilters as jf
        >>> jf.StandardNormal(3)(jax.random.key(0), 1000).shape
        (3, 1000)
    """

    shape: int | tuple[int, ...]
    """Shape of the array of one particle; a number d stands for `(d,)`."""

    def __post_init__(self) -> None:
        check_sizes("shape of StandardNormal", self.shape)

    def __call__(self, key: AnyKey, num_particles: int) -> Float[Array, "... n"]:
        """Draw for a whole ensemble, whose axis is the last one."""
        shape = (self.shape,) if isinstance(self.shape, int) else self.shape
        return standard_normal(key, (*shape, num_particles))
