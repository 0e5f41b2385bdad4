"""Sources of the randomness that moves an ensemble: what `noise=` of a particle filter takes."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._xla.noise import standard_normal
from jaxfilters.typing import AnyKey


def random_keys(key: AnyKey, num_particles: int) -> PyTree:
    """Noise: one random key for each particle."""
    keys = jax.random.split(key, num_particles)
    return jnp.moveaxis(keys, 0, -1)


@dataclass(frozen=True)
class StandardNormal:
    """Noise: `shape` independent standard normal numbers for each particle."""

    shape: int | tuple[int, ...]

    def __call__(self, key: AnyKey, num_particles: int) -> Float[Array, "... n"]:
        shape = (self.shape,) if isinstance(self.shape, int) else self.shape
        return standard_normal(key, (*shape, num_particles))
