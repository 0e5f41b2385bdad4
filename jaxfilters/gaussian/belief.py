"""Gaussian beliefs, by covariance and by a root of it, with the same verbs.

`indices` choose components and are static: a list or tuple of numbers. The shapes on the fields are those of one
belief; stacked over time or an ensemble the leaves have more axes, and the methods are for `vmap`.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math import linalg

Key = PRNGKeyArray | Array


@pytree_dataclass
class Gaussian:
    """A Gaussian by mean and covariance."""

    mean: Float[Array, "..."]
    """(n,)."""
    covariance: Float[Array, "..."]
    """(n, n), symmetric, positive semidefinite: a zero variance says that the component is known."""

    def logpdf(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """Log density at `x`, over the directions that have any variance."""
        return logpdf(x - self.mean, linalg.cholesky(self.covariance))

    def sample(self, key: Key, count: int) -> Float[Array, "n count"]:
        """Independent draws, one a column."""
        return GaussianRoot(self.mean, linalg.cholesky(self.covariance)).sample(key, count)

    def marginal(self, indices: Sequence[int]) -> "Gaussian":
        """Belief in the chosen components, in that order."""
        chosen = np.asarray(indices)
        return Gaussian(self.mean[chosen], self.covariance[np.ix_(chosen, chosen)])

    def condition(self, indices: Sequence[int], values: Float[Array, " k"]) -> "Gaussian":
        """Belief in the other components, in their order, once the chosen ones are known to have these values."""
        known, rest = _split(indices, self.mean.size)
        L = linalg.cholesky(self.covariance[np.ix_(known, known)])
        gain_root = linalg.solve_triangular(L, self.covariance[np.ix_(known, rest)])
        shift = gain_root.T @ linalg.solve_triangular(L, values - self.mean[known])
        return Gaussian(
            self.mean[rest] + shift, self.covariance[np.ix_(rest, rest)] - linalg.matmul(gain_root.T, gain_root)
        )


@pytree_dataclass
class GaussianRoot:
    """A Gaussian by mean and any root of its covariance."""

    mean: Float[Array, "..."]
    """(n,)."""
    root: Float[Array, "..."]
    """(n, m): `root root^T` is the covariance. Any width does; what this library returns is lower with n columns."""

    def logpdf(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """Log density at `x`, over the directions that have any variance."""
        return logpdf(x - self.mean, linalg.tria(self.root))

    def sample(self, key: Key, count: int) -> Float[Array, "n count"]:
        """Independent draws, one a column."""
        noise = jax.random.normal(key, (self.root.shape[1], count), self.mean.dtype)
        return self.mean[:, None] + jnp.matmul(self.root, noise, precision="highest")

    def marginal(self, indices: Sequence[int]) -> "GaussianRoot":
        """Belief in the chosen components, in that order; the root keeps its width."""
        chosen = np.asarray(indices)
        return GaussianRoot(self.mean[chosen], self.root[chosen])

    def condition(self, indices: Sequence[int], values: Float[Array, " k"]) -> "GaussianRoot":
        """Belief in the other components, in their order, once the chosen ones are known to have these values."""
        known, rest = _split(indices, self.mean.size)
        k = known.size
        L = linalg.tria(self.root[np.concatenate([known, rest])])
        whitened = linalg.solve_triangular(L[:k, :k], values - self.mean[known])
        return GaussianRoot(self.mean[rest] + L[k:, :k] @ whitened, L[k:, k:])


def logpdf(deviation: Float[Array, " n"], root: Float[Array, "n n"]) -> Float[Array, ""]:
    """Log density of a deviation from the mean, given a lower root.

    Taken over the components whose diagonal element is not zero: one that is certain adds nothing.
    """
    whitened = linalg.solve_triangular(root, deviation)
    diagonal = jnp.diagonal(root)
    certain = diagonal == 0
    log_scale = jnp.where(certain, 0.0, jnp.log(jnp.where(certain, 1.0, diagonal)) + 0.5 * math.log(2 * math.pi))
    return -0.5 * jnp.sum(whitened * whitened) - jnp.sum(log_scale)


def _split(indices, n):
    known = np.asarray(indices)
    return known, np.setdiff1d(np.arange(n), known)
