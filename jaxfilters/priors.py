"""Priors of particle filters: one particle at a time, or all of them at once.

Every builder takes `sample_prior: key -> x`. With a key for each particle a CPU draws number by number, without vector
instructions. What is here is such a function, too, but knows how to draw a whole ensemble from one key:

    bootstrap(gaussian_prior(Gaussian(mean, covariance)), ...)
    bootstrap(from_noise(start, StandardNormal(3)), ...)          # start: three normal numbers -> x
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, DrawNoise, SamplePrior, as_pytree


@runtime_checkable
class EnsemblePrior(Protocol):
    """A `SamplePrior` that also draws a whole ensemble; a user's own frozen pytree dataclass may be one."""

    def __call__(self, key: AnyKey, /) -> PyTree: ...

    def ensemble(self, key: AnyKey, num_particles: int, /) -> PyTree:
        """Independent draws, stacked along the last axis of every leaf."""
        ...


@pytree_dataclass
class FromNoise:
    """Particles made of noise."""

    transform: Callable[[Any], PyTree]
    """`noise of one particle -> x`."""
    noise: DrawNoise = field(metadata={"static": True})

    def __call__(self, key: AnyKey) -> PyTree:
        """One particle."""
        return jax.tree.map(lambda leaf: leaf[..., 0], self.ensemble(key, 1))

    def ensemble(self, key: AnyKey, num_particles: int) -> PyTree:
        """All of them."""
        return jax.vmap(self.transform, in_axes=-1, out_axes=-1)(self.noise(key, num_particles))


@pytree_dataclass
class GaussianPrior:
    """Vectors of n numbers."""

    belief: Gaussian

    def __call__(self, key: AnyKey) -> Float[Array, " n"]:
        """One vector."""
        return self.ensemble(key, 1)[:, 0]

    def ensemble(self, key: AnyKey, num_particles: int) -> Float[Array, "n count"]:
        """One a column."""
        mean = self.belief.mean
        noise = standard_normal(key, (mean.shape[0], num_particles), mean.dtype)
        return mean[:, None] + jnp.matmul(linalg.cholesky(self.belief.covariance), noise, precision="highest")


def from_noise(transform: Callable[[Any], PyTree], noise: DrawNoise) -> FromNoise:
    """A prior that makes every particle of its own noise, as `bootstrap` does with transitions.

    Args:
        transform: `noise of one particle -> x`.
        noise: How that of an ensemble is drawn, e.g. `StandardNormal(3)`; compared by equality.
    """
    return FromNoise(as_pytree(transform), noise)


def gaussian_prior(belief: Gaussian) -> GaussianPrior:
    """A prior that draws vectors from a Gaussian; differentiable in its mean and covariance.

    Raises:
        ValueError: If the covariance is no `(n, n)` for a mean of `(n,)`.
    """
    sizes = jnp.shape(belief.mean), jnp.shape(belief.covariance)
    if len(sizes[0]) != 1 or sizes[1] != sizes[0] * 2:
        raise ValueError(f"belief must have a mean (n,) and a covariance (n, n); got {sizes[0]} and {sizes[1]}.")
    return GaussianPrior(belief)


def sample_ensemble(key: AnyKey, sample: SamplePrior, num_particles: int) -> PyTree:
    """Draw `num_particles` samples, stacked along the last axis of every leaf."""
    if isinstance(sample, EnsemblePrior):
        return sample.ensemble(key, num_particles)
    return jax.vmap(sample, out_axes=-1)(jax.random.split(key, num_particles))
