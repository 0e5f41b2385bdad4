"""Gaussian beliefs, by covariance and by a root of it, with the same methods.

`indices` choose components and are static: a list or tuple of integers. The shapes of the fields are those of one
belief; beliefs that are stacked over time or an ensemble have more axes, and need `jax.vmap` for the methods.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters.math import linalg

Key = PRNGKeyArray | Array


@pytree_dataclass
class Gaussian:
    """A Gaussian by mean and covariance.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> belief = jf.Gaussian(jnp.array([0.0, 1.0]), jnp.array([[1.0, 0.5], [0.5, 2.0]]))
        >>> belief.condition([0], jnp.array([1.0])).mean.tolist()
        [1.5]
    """

    mean: Float[Array, "..."]
    """Mean, (n,); on a manifold, a point of it."""
    covariance: Float[Array, "..."]
    """Covariance, (n, n), symmetric and positive semidefinite; a component of variance zero is known."""

    def logpdf(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """Log density at `x`, (n,), over the directions of positive variance."""
        return logpdf(x - self.mean, linalg.cholesky(self.covariance))

    def sample(self, key: Key, count: int) -> Float[Array, "n count"]:
        """Independent draws, (n, count): one per column."""
        # That package imports this module.
        from jaxfilters.gaussian.arithmetic import factor

        return GaussianRoot(self.mean, factor.exact_root(self.covariance)).sample(key, count)

    def marginal(self, indices: Sequence[int]) -> "Gaussian":
        """Belief about the chosen components, in that order."""
        chosen = np.asarray(indices)
        return Gaussian(self.mean[chosen], self.covariance[np.ix_(chosen, chosen)])

    def condition(self, indices: Sequence[int], values: Float[Array, " k"]) -> "Gaussian":
        """Belief about the other components, in their order, given the values (k,) of the chosen ones."""
        known, rest = _split(indices, self.mean.size)
        L = linalg.cholesky(self.covariance[np.ix_(known, known)])
        gain_root = linalg.solve_triangular(L, self.covariance[np.ix_(known, rest)])
        shift = dot(gain_root.T, linalg.solve_triangular(L, values - self.mean[known]))
        return Gaussian(
            self.mean[rest] + shift, self.covariance[np.ix_(rest, rest)] - linalg.matmul(gain_root.T, gain_root)
        )


@pytree_dataclass
class GaussianRoot:
    """A Gaussian by mean and any root of its covariance, for `jf.arithmetic.square_root`.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> belief = jf.GaussianRoot(jnp.array([0.0, 1.0]), jnp.array([[1.0, 0.0], [0.5, 1.0]]))
        >>> belief.condition([0], jnp.array([1.0])).mean.tolist()
        [1.5]
    """

    mean: Float[Array, "..."]
    """Mean, (n,); on a manifold, a point of it."""
    root: Float[Array, "..."]
    """Root of the covariance, (n, m) of any width m: `root @ root.T` is the covariance. It need not be triangular."""

    def logpdf(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """Log density at `x`, (n,), over the directions of positive variance."""
        return logpdf(x - self.mean, linalg.tria(self.root))

    def sample(self, key: Key, count: int) -> Float[Array, "n count"]:
        """Independent draws, (n, count): one per column."""
        noise = jax.random.normal(key, (self.root.shape[1], count), self.mean.dtype)
        return self.mean[:, None] + jnp.matmul(self.root, noise, precision="highest")

    def marginal(self, indices: Sequence[int]) -> "GaussianRoot":
        """Belief about the chosen components, in that order; the root keeps its width."""
        chosen = np.asarray(indices)
        return GaussianRoot(self.mean[chosen], self.root[chosen])

    def condition(self, indices: Sequence[int], values: Float[Array, " k"]) -> "GaussianRoot":
        """Belief about the other components, in their order, given the values (k,) of the chosen ones."""
        known, rest = _split(indices, self.mean.size)
        k = known.size
        L = linalg.tria(self.root[np.concatenate([known, rest])])
        whitened = linalg.solve_triangular(L[:k, :k], values - self.mean[known])
        return GaussianRoot(self.mean[rest] + dot(L[k:, :k], whitened), L[k:, k:])


def logpdf(deviation: Float[Array, " n"], root: Float[Array, "n n"]) -> Float[Array, ""]:
    """Log density of a deviation from the mean, given a lower root of the covariance.

    It is taken over the components whose diagonal element is not zero: one that is certain adds nothing.
    """
    whitened = linalg.solve_triangular(root, deviation)
    diagonal = jnp.diagonal(root)
    certain = diagonal == 0
    log_scale = jnp.where(certain, 0.0, jnp.log(jnp.where(certain, 1.0, diagonal)) + 0.5 * math.log(2 * math.pi))
    return -0.5 * jnp.sum(whitened * whitened) - jnp.sum(log_scale)


def _split(indices, n):
    known = np.arange(n)[np.asarray(indices)]  # from the end where they are negative
    if len(set(known.tolist())) != known.size:
        raise ValueError(f"indices must name different components; got {list(indices)} of {n}.")
    return known, np.setdiff1d(np.arange(n), known)
