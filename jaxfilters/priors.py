"""Priors that draw a whole ensemble at once.

Every particle filter takes `sample_prior: key -> x` for one particle. With a key for each particle a CPU draws number
by number, without vector instructions. The priors of this module are such functions, too, but also draw a whole
ensemble from one key, about twice as fast.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.particle import checks
from jaxfilters.typing import AnyKey, DrawNoise, SamplePrior, as_pytree


@runtime_checkable
class EnsemblePrior(Protocol):
    """A `SamplePrior` that also draws a whole ensemble; a user's own frozen pytree dataclass may be one.

    Examples:
        >>> from dataclasses import dataclass
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> @jax.tree_util.register_dataclass
        ... @dataclass(frozen=True)
        ... class Flat:
        ...     width: jax.Array
        ...     def __call__(self, key): return self.ensemble(key, 1)[:, 0]
        ...     def ensemble(self, key, num_particles): return self.width * jax.random.uniform(key, (1, num_particles))
        >>> jf.priors.sample_ensemble(jax.random.key(0), Flat(jnp.array(2.0)), 100).shape
        (1, 100)
    """

    def __call__(self, key: AnyKey, /) -> PyTree: ...

    def ensemble(self, key: AnyKey, num_particles: int, /) -> PyTree:
        """Draw independent particles, stacked along the last axis of every leaf."""
        ...


@pytree_dataclass
class FromNoise:
    """A prior whose particles are functions of their own noise; made by `from_noise`."""

    transform: Callable[[Any], PyTree]
    """`noise of one particle -> x`."""
    noise: DrawNoise = field(metadata={"static": True})
    """Draws the noise of an ensemble."""

    def __call__(self, key: AnyKey) -> PyTree:
        """Draw one particle."""
        return jax.tree.map(lambda leaf: leaf[..., 0], self.ensemble(key, 1))

    def ensemble(self, key: AnyKey, num_particles: int) -> PyTree:
        """Draw `num_particles` particles; leaves `(..., num_particles)`."""
        return jax.vmap(self.transform, in_axes=-1, out_axes=-1)(self.noise(key, num_particles))


@pytree_dataclass
class GaussianPrior:
    """A prior that draws vectors of n numbers from a Gaussian; made by `gaussian_prior`."""

    belief: Gaussian

    def __call__(self, key: AnyKey) -> Float[Array, " n"]:
        """Draw one vector."""
        return self.ensemble(key, 1)[:, 0]

    def ensemble(self, key: AnyKey, num_particles: int) -> Float[Array, "n count"]:
        """Draw `num_particles` vectors, one a column."""
        mean = self.belief.mean
        noise = standard_normal(key, (mean.shape[0], num_particles), mean.dtype)
        return mean[:, None] + jnp.matmul(factor.exact_root(self.belief.covariance), noise, precision="highest")


def from_noise(transform: Callable[[Any], PyTree], noise: DrawNoise) -> FromNoise:
    """Build a prior that computes every particle from its own noise.

    Args:
        transform: `noise of one particle -> x`.
        noise: Source of the noise, e.g. `StandardNormal(3)`; compared by equality.

    Returns:
        A prior for the argument `sample_prior` of a filter.

    Raises:
        TypeError: If an argument is not callable.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior = jf.priors.from_noise(lambda noise: {"angle": jnp.pi * noise[0]}, jf.StandardNormal(1))
        >>> prior.ensemble(jax.random.key(0), 1000)["angle"].shape
        (1000,)
    """
    checks.check_callables(transform=transform, noise=noise)
    return FromNoise(as_pytree(transform), noise)


def gaussian_prior(belief: Gaussian) -> GaussianPrior:
    """Build a prior that draws vectors from a Gaussian, differentiable in its mean and covariance.

    Args:
        belief: Gaussian with a mean `(n,)` and a covariance `(n, n)`, positive semidefinite.

    Returns:
        A prior for the argument `sample_prior` of a filter.

    Raises:
        TypeError: If `belief` is not a `Gaussian`, or does not hold floating-point numbers.
        ValueError: If the shapes are others, or the covariance is concrete and not positive semidefinite.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), jnp.eye(2)))
        >>> prior.ensemble(jax.random.key(0), 1000).shape
        (2, 1000)
    """
    checks.check_gaussian("belief", belief)
    return GaussianPrior(belief)


def sample_ensemble(key: AnyKey, sample: SamplePrior, num_particles: int) -> PyTree:
    """Draw `num_particles` particles, stacked along the last axis of every leaf.

    Raises:
        ValueError: If the ensemble that a prior draws has another number of particles.

    Examples:
        >>> import jax, jaxfilters as jf
        >>> one = lambda key: jax.random.normal(key, (3,))
        >>> jf.priors.sample_ensemble(jax.random.key(0), one, 100).shape
        (3, 100)
    """
    if not isinstance(sample, EnsemblePrior):
        return jax.vmap(sample, out_axes=-1)(jax.random.split(key, num_particles))
    particles = sample.ensemble(key, num_particles)
    for path, leaf in jax.tree_util.tree_leaves_with_path(particles):
        name = f"sample_prior.ensemble{jax.tree_util.keystr(path)}"
        if jnp.shape(leaf)[-1:] != (num_particles,):
            raise ValueError(f"{name} must have the shape (..., {num_particles}); got {jnp.shape(leaf)}.")
    return particles
