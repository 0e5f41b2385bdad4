"""What a state lets one observe: codes, Gaussians, and several independent things at once.

An emission is a frozen pytree whose array leaves all have the states as their first axis; what steers training is
static. It sees one observation at a time. `maximized` is the M-step: observations of n sequences along the last axis,
time first, and how probable each state is in each frame, `(T, Q, n)`, zero where a frame is not to count. Whatever
has these methods will do.
"""

import math
from dataclasses import field, replace
from functools import reduce
from operator import add
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey


@runtime_checkable
class Emission(Protocol):
    """p(y | s) of all states."""

    def log_likelihood(self, y: Any, /) -> Float[Array, " q"]:
        """Log p(y | s) of one observation for every state; `-inf` where it is impossible."""
        ...

    def sample(self, key: AnyKey, state: Int32[Array, ""], /) -> PyTree:
        """Draw an observation from one state."""
        ...

    def maximized(self, observations: PyTree, posteriors: Float[Array, "t q n"], /) -> "Emission":
        """The emission that explains the observations best; that of a state without any stays as it is."""
        ...

    def log_prior(self) -> Float[Array, ""]:
        """What `maximized` maximizes beside the expected log-likelihood, up to a constant."""
        ...


@pytree_dataclass
class Codes:
    """One of S symbols, as an integer from 0; any other integer is impossible."""

    log_probability: Float[Array, "..."]
    """(Q, S)."""
    pseudo_count: float = field(default=0.0, metadata={"static": True})
    """Times that training adds to those that each symbol was seen in each state: none is then impossible."""

    def log_likelihood(self, y: Int[Array, ""]) -> Float[Array, " q"]:
        """Logarithm of the probability of the symbol."""
        num_codes = self.log_probability.shape[1]
        known = (y >= 0) & (y < num_codes)
        return jnp.where(known, self.log_probability[:, jnp.where(known, y, 0)], -jnp.inf)

    def sample(self, key: AnyKey, state: Int32[Array, ""]) -> Int32[Array, ""]:
        """Draw a symbol."""
        return jax.random.categorical(key, self.log_probability[state]).astype(jnp.int32)

    def maximized(self, observations: Int[Array, "t n"], posteriors: Float[Array, "t q n"]) -> "Codes":
        """Relative frequencies, with pseudo-counts."""
        num_codes = self.log_probability.shape[1]
        seen = jax.nn.one_hot(observations, num_codes, axis=0, dtype=posteriors.dtype)
        counts = jnp.einsum("tqn,stn->qs", posteriors, seen, precision="highest") + self.pseudo_count
        totals = jnp.sum(counts, axis=1, keepdims=True)
        possible = counts > 0
        logs = jnp.log(jnp.where(possible, counts, 1.0)) - jnp.log(jnp.where(totals > 0, totals, 1.0))
        return replace(
            self, log_probability=jnp.where(totals > 0, jnp.where(possible, logs, -jnp.inf), self.log_probability)
        )

    def log_prior(self) -> Float[Array, ""]:
        """Dirichlet: `pseudo_count` times the sum of the log probabilities."""
        possible = self.log_probability > -jnp.inf
        return self.pseudo_count * jnp.sum(jnp.where(possible, self.log_probability, 0.0))


@pytree_dataclass
class DiagonalGaussian:
    """A vector of d numbers, independent of each other."""

    mean: Float[Array, "..."]
    """(Q, d)."""
    variance: Float[Array, "..."]
    """(Q, d), positive."""
    min_variance: float = field(default=1e-4, metadata={"static": True})
    """Floor of the variances that training finds, in the square of the data's unit."""

    def log_likelihood(self, y: Float[Array, " d"]) -> Float[Array, " q"]:
        """Logarithm of the density."""
        square = jnp.square(y - self.mean) / self.variance + jnp.log(self.variance)
        return -0.5 * (jnp.sum(square, axis=1) + y.shape[0] * math.log(2 * math.pi))

    def sample(self, key: AnyKey, state: Int32[Array, ""]) -> Float[Array, " d"]:
        """Draw a vector."""
        noise = jax.random.normal(key, self.mean.shape[1:], self.mean.dtype)
        return self.mean[state] + jnp.sqrt(self.variance[state]) * noise

    def maximized(self, observations: Float[Array, "t d n"], posteriors: Float[Array, "t q n"]) -> "DiagonalGaussian":
        """Weighted means and variances, the latter at least `min_variance`."""
        mean, share, seen = _weighted_mean(observations, posteriors, self.mean)
        spread = jnp.square(observations[:, None] - mean[..., None])
        variance = jnp.sum(share[:, :, None] * spread, axis=(0, 3))
        return replace(
            self, mean=mean, variance=jnp.where(seen, jnp.maximum(variance, self.min_variance), self.variance)
        )

    def log_prior(self) -> Float[Array, ""]:
        """Zero: the floor of the variances is a bound, not a prior."""
        return jnp.zeros((), self.mean.dtype)


@pytree_dataclass
class FullGaussian:
    """A vector of d numbers."""

    mean: Float[Array, "..."]
    """(Q, d)."""
    covariance: Float[Array, "..."]
    """(Q, d, d), positive definite."""
    min_variance: float = field(default=1e-4, metadata={"static": True})
    """Floor of the eigenvalues of the covariances that training finds, in the square of the data's unit."""

    def log_likelihood(self, y: Float[Array, " d"]) -> Float[Array, " q"]:
        """Logarithm of the density."""
        # The factors do not depend on the observation: `vmap` over time computes them once.
        roots = jax.vmap(linalg.cholesky)(self.covariance)
        inverses = jax.vmap(linalg.solve_triangular, (0, None))(roots, jnp.eye(y.shape[0], dtype=y.dtype))
        whitened = jnp.sum(inverses * (y - self.mean)[:, None], axis=2)
        log_scale = jnp.sum(jnp.log(jnp.diagonal(roots, axis1=1, axis2=2)), axis=1)
        return -0.5 * (jnp.sum(jnp.square(whitened), axis=1) + y.shape[0] * math.log(2 * math.pi)) - log_scale

    def sample(self, key: AnyKey, state: Int32[Array, ""]) -> Float[Array, " d"]:
        """Draw a vector."""
        noise = jax.random.normal(key, self.mean.shape[1:], self.mean.dtype)
        return self.mean[state] + linalg.matmul(linalg.cholesky(self.covariance[state]), noise[:, None])[:, 0]

    def maximized(self, observations: Float[Array, "t d n"], posteriors: Float[Array, "t q n"]) -> "FullGaussian":
        """Weighted means and covariances, no eigenvalue of the latter below `min_variance`."""
        mean, share, seen = _weighted_mean(observations, posteriors, self.mean)
        deviation = observations[:, None] - mean[..., None]
        second = jnp.einsum("tqdn,tqen->qde", share[:, :, None] * deviation, deviation, precision="highest")
        values, vectors = jax.lax.map(lambda matrix: tuple(jnp.linalg.eigh(matrix)), second)
        # Of all covariances above the floor this one has the greatest likelihood.
        floored = jnp.maximum(values, self.min_variance)[:, None]
        covariance = jnp.matmul(vectors * floored, jnp.swapaxes(vectors, 1, 2), precision="highest")
        return replace(self, mean=mean, covariance=jnp.where(seen[..., None], covariance, self.covariance))

    def log_prior(self) -> Float[Array, ""]:
        """Zero: the floor of the eigenvalues is a bound, not a prior."""
        return jnp.zeros((), self.mean.dtype)


@pytree_dataclass
class Independent:
    """Several observations at once, independent given the state; each with its own emission."""

    parts: tuple[Emission, ...]
    """As many as there are observations in the tuple that is observed."""

    def log_likelihood(self, y: tuple) -> Float[Array, " q"]:
        """Sum of those of the parts.

        Raises:
            ValueError: If there are more or fewer observations than parts.
        """
        if len(y) != len(self.parts):
            raise ValueError(f"y must be a tuple of {len(self.parts)} observations, one a part; got {len(y)}.")
        return reduce(add, (part.log_likelihood(one) for part, one in zip(self.parts, y, strict=True)))

    def sample(self, key: AnyKey, state: Int32[Array, ""]) -> tuple:
        """Draw one observation a part."""
        keys = jax.random.split(key, len(self.parts))
        return tuple(part.sample(keys[i], state) for i, part in enumerate(self.parts))

    def maximized(self, observations: tuple, posteriors: Float[Array, "t q n"]) -> "Independent":
        """Every part on its own."""
        return Independent(
            tuple(part.maximized(one, posteriors) for part, one in zip(self.parts, observations, strict=True))
        )

    def log_prior(self) -> Float[Array, ""]:
        """Sum of those of the parts."""
        return reduce(add, (part.log_prior() for part in self.parts))


def _weighted_mean(observations, posteriors, otherwise):
    """Means (Q, d), the share of each frame in its state's mean (T, Q, n), and which states have any frame (Q, 1)."""
    weight = jnp.sum(posteriors, axis=(0, 2))
    seen = weight > 1e-6
    share = posteriors / jnp.where(seen, weight, 1.0)[:, None]
    mean = jnp.einsum("tqn,tdn->qd", share, observations, precision="highest")
    return jnp.where(seen[:, None], mean, otherwise), share, seen[:, None]
