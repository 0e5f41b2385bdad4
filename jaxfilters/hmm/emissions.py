"""Emission distributions p(y | s) of hidden Markov models: categorical, Gaussian, and products of them.

An emission is a frozen pytree whose array leaves all have the Q states as their first axis; options of training are
static. Its methods see one observation at a time, except `m_step`, which takes observations of n sequences along the
last axis, with time first, and the responsibilities (T, Q, n): the posterior probability of each state in each frame,
zero where a frame does not count. Any object with the methods of `Emission` can be used.
"""

import math
from dataclasses import field, replace
from functools import reduce
from operator import add
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey


@runtime_checkable
class Emission(Protocol):
    """The distributions p(y | s) of all Q states."""

    def log_likelihood(self, y: Any, /) -> Float[Array, " q"]:
        """Log p(y | s) of one observation for every state; `-inf` for an impossible one."""
        ...

    def sample(self, key: AnyKey, state: Int32[Array, ""], /) -> PyTree:
        """A sample of the observation in one state."""
        ...

    def m_step(self, observations: PyTree, responsibilities: Float[Array, "t q n"], /) -> "Emission":
        """The emission of greatest expected log-likelihood; a state without responsibility keeps its parameters."""
        ...

    def log_prior(self) -> Float[Array, ""]:
        """The log prior that `m_step` adds to the expected log-likelihood, up to a constant."""
        ...


@pytree_dataclass
class Codes:
    """A categorical distribution over S symbols, coded as the integers 0 to S - 1.

    Any other integer has probability zero.
    """

    log_probability: Float[Array, "..."]
    """(Q, S): log probability of each symbol in each state."""
    pseudo_count: float = field(default=0.0, metadata={"static": True})
    """Count that training adds to that of every symbol in every state, so that no probability becomes zero."""

    def log_likelihood(self, y: Array) -> Float[Array, " q"]:
        """Log probability of one symbol in every state.

        Raises:
            TypeError: If `y` is not an integer.
            ValueError: If `y` is not a scalar.
        """
        if not jnp.issubdtype(jnp.result_type(y), jnp.integer):
            raise TypeError(f"observations of hmm.Codes must be integers; got {jnp.result_type(y)}.")
        if jnp.ndim(y):
            raise ValueError(f"an observation of hmm.Codes must be one integer; got shape {jnp.shape(y)}.")
        num_codes = self.log_probability.shape[1]
        known = (y >= 0) & (y < num_codes)
        return jnp.where(known, self.log_probability[:, jnp.where(known, y, 0)], -jnp.inf)

    def sample(self, key: AnyKey, state: Int32[Array, ""]) -> Int32[Array, ""]:
        """A sample of the symbol in one state."""
        return jax.random.categorical(key, self.log_probability[state]).astype(jnp.int32)

    def m_step(self, observations: Int[Array, "t n"], responsibilities: Float[Array, "t q n"]) -> "Codes":
        """Expected relative frequencies, with pseudo-counts."""
        num_codes = self.log_probability.shape[1]
        one_hot = jax.nn.one_hot(observations, num_codes, axis=0, dtype=responsibilities.dtype)
        counts = jnp.einsum("tqn,stn->qs", responsibilities, one_hot, precision="highest") + self.pseudo_count
        totals = jnp.sum(counts, axis=1, keepdims=True)
        possible = counts > 0
        logs = jnp.log(jnp.where(possible, counts, 1.0)) - jnp.log(jnp.where(totals > 0, totals, 1.0))
        return replace(
            self, log_probability=jnp.where(totals > 0, jnp.where(possible, logs, -jnp.inf), self.log_probability)
        )

    def log_prior(self) -> Float[Array, ""]:
        """Log density of a symmetric Dirichlet prior with concentration `1 + pseudo_count`, up to a constant.

        It is `-inf` where a probability is zero, unless the pseudo-count is.
        """
        if not self.pseudo_count:
            return jnp.zeros((), self.log_probability.dtype)
        return self.pseudo_count * jnp.sum(self.log_probability)


@pytree_dataclass
class DiagonalGaussian:
    """A Gaussian distribution of vectors (d,) with independent components."""

    mean: Float[Array, "..."]
    """(Q, d)."""
    variance: Float[Array, "..."]
    """(Q, d), positive."""
    min_variance: float = field(default=1e-4, metadata={"static": True})
    """Lower bound of the variances in training, in the square of the data's unit."""

    def log_likelihood(self, y: Array) -> Float[Array, " q"]:
        """Log density of one vector in every state.

        Raises:
            ValueError: If `y` is not (d,), or `variance` does not have the shape of `mean`.
        """
        _check_vector("hmm.DiagonalGaussian", y, self.mean)
        if self.variance.shape != self.mean.shape:
            raise ValueError(f"variance must have the shape of mean, {self.mean.shape}; got {self.variance.shape}.")
        square = jnp.square(y - self.mean) / self.variance + jnp.log(self.variance)
        return -0.5 * (jnp.sum(square, axis=1) + y.shape[0] * math.log(2 * math.pi))

    def sample(self, key: AnyKey, state: Int32[Array, ""]) -> Float[Array, " d"]:
        """A sample of the vector in one state."""
        noise = jax.random.normal(key, self.mean.shape[1:], self.mean.dtype)
        return self.mean[state] + jnp.sqrt(self.variance[state]) * noise

    def m_step(
        self, observations: Float[Array, "t d n"], responsibilities: Float[Array, "t q n"]
    ) -> "DiagonalGaussian":
        """Weighted means and variances; the variances are at least `min_variance`."""
        mean, weights, has_frames = _weighted_mean(observations, responsibilities, self.mean)
        squares = jnp.square(observations[:, None] - mean[..., None])
        variance = jnp.sum(weights[:, :, None] * squares, axis=(0, 3))
        return replace(
            self, mean=mean, variance=jnp.where(has_frames, jnp.maximum(variance, self.min_variance), self.variance)
        )

    def log_prior(self) -> Float[Array, ""]:
        """Zero: the lower bound of the variances is a constraint, not a prior."""
        return jnp.zeros((), self.mean.dtype)


@pytree_dataclass
class FullGaussian:
    """A Gaussian distribution of vectors (d,) with full covariance."""

    mean: Float[Array, "..."]
    """(Q, d)."""
    covariance: Float[Array, "..."]
    """(Q, d, d), positive definite."""
    min_variance: float = field(default=1e-4, metadata={"static": True})
    """Lower bound of the eigenvalues of the covariances in training, in the square of the data's unit."""

    def log_likelihood(self, y: Array) -> Float[Array, " q"]:
        """Log density of one vector in every state.

        Raises:
            ValueError: If `y` is not (d,), or `covariance` is not (Q, d, d).
        """
        _check_vector("hmm.FullGaussian", y, self.mean)
        if self.covariance.shape != (*self.mean.shape, self.mean.shape[1]):
            expected = (*self.mean.shape, self.mean.shape[1])
            raise ValueError(f"covariance must be {expected}, (Q, d, d); got {self.covariance.shape}.")
        # The factors do not depend on the observation: `vmap` over time computes them once.
        roots = jax.vmap(linalg.cholesky)(self.covariance)
        inverses = jax.vmap(linalg.solve_triangular, (0, None))(roots, jnp.eye(y.shape[0], dtype=y.dtype))
        whitened = jnp.sum(inverses * (y - self.mean)[:, None], axis=2)
        log_scale = jnp.sum(jnp.log(jnp.diagonal(roots, axis1=1, axis2=2)), axis=1)
        return -0.5 * (jnp.sum(jnp.square(whitened), axis=1) + y.shape[0] * math.log(2 * math.pi)) - log_scale

    def sample(self, key: AnyKey, state: Int32[Array, ""]) -> Float[Array, " d"]:
        """A sample of the vector in one state."""
        noise = jax.random.normal(key, self.mean.shape[1:], self.mean.dtype)
        return self.mean[state] + linalg.matmul(linalg.cholesky(self.covariance[state]), noise[:, None])[:, 0]

    def m_step(self, observations: Float[Array, "t d n"], responsibilities: Float[Array, "t q n"]) -> "FullGaussian":
        """Weighted means and covariances; the eigenvalues of the covariances are at least `min_variance`."""
        mean, weights, has_frames = _weighted_mean(observations, responsibilities, self.mean)
        deviation = observations[:, None] - mean[..., None]
        second = jnp.einsum("tqdn,tqen->qde", weights[:, :, None] * deviation, deviation, precision="highest")
        values, vectors = jax.lax.map(lambda matrix: tuple(jnp.linalg.eigh(matrix)), second)
        # Clipping the eigenvalues maximises the likelihood among the covariances that satisfy the bound.
        clipped = jnp.maximum(values, self.min_variance)[:, None]
        covariance = jnp.matmul(vectors * clipped, jnp.swapaxes(vectors, 1, 2), precision="highest")
        return replace(self, mean=mean, covariance=jnp.where(has_frames[..., None], covariance, self.covariance))

    def log_prior(self) -> Float[Array, ""]:
        """Zero: the lower bound of the eigenvalues is a constraint, not a prior."""
        return jnp.zeros((), self.mean.dtype)


@pytree_dataclass
class Independent:
    """A tuple of observations that are independent given the state, each with its own emission."""

    parts: tuple[Emission, ...]
    """One emission for each element of the observed tuple."""

    def log_likelihood(self, y: tuple) -> Float[Array, " q"]:
        """The sum of the log densities of the parts.

        Raises:
            ValueError: If `y` has more or fewer elements than there are parts.
        """
        if len(y) != len(self.parts):
            raise ValueError(f"y must be a tuple of {len(self.parts)} observations, one for each part; got {len(y)}.")
        return reduce(add, (part.log_likelihood(one) for part, one in zip(self.parts, y, strict=True)))

    def sample(self, key: AnyKey, state: Int32[Array, ""]) -> tuple:
        """A sample of the tuple in one state."""
        keys = jax.random.split(key, len(self.parts))
        return tuple(part.sample(keys[i], state) for i, part in enumerate(self.parts))

    def m_step(self, observations: tuple, responsibilities: Float[Array, "t q n"]) -> "Independent":
        """The M-step of every part."""
        return Independent(
            tuple(part.m_step(one, responsibilities) for part, one in zip(self.parts, observations, strict=True))
        )

    def log_prior(self) -> Float[Array, ""]:
        """The sum of the log priors of the parts."""
        return reduce(add, (part.log_prior() for part in self.parts))


def check_values(emission: Any, observations: PyTree, observed: np.ndarray) -> None:
    """Reject observations that the built-in emissions cannot use: NaN, and codes out of range. Tracers pass.

    Args:
        emission: The emission; those that are not built in are not checked.
        observations: Leaves with time first, or (T, ..., n) with the sequences last.
        observed: (T,) or (T, n): the frames that count.

    Raises:
        ValueError: Naming the frame and the value.
    """
    if isinstance(emission, Independent):
        for part, one in zip(emission.parts, observations, strict=False):
            check_values(part, one, observed)
        return
    if not isinstance(emission, Codes | DiagonalGaussian | FullGaussian):
        return
    if isinstance(observations, jax.core.Tracer) or not hasattr(observations, "shape"):
        return
    values = np.asarray(observations)
    if isinstance(emission, Codes):
        num_codes = emission.log_probability.shape[1]
        bad, expected = (values < 0) | (values >= num_codes), f"codes from 0 to {num_codes - 1}"
    else:
        bad, expected = ~np.isfinite(values), "finite"
    middle = [1] * (values.ndim - observed.ndim)
    if observed.shape[0] != values.shape[0] or len(middle) + observed.ndim != values.ndim:
        return
    bad = bad & observed.reshape(observed.shape[0], *middle, *observed.shape[1:])
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"observations must be {expected} where mask does not mark them as missing; "
            f"got {values[place]} in frame {place[0]}, and {int(bad.sum())} such values in all."
        )


def _check_vector(name: str, y: Array, mean: Array) -> None:
    if mean.ndim != 2:
        raise ValueError(f"mean of {name} must be (Q, d); got {mean.shape}.")
    if jnp.shape(y) != mean.shape[1:]:
        hint = ": give scalars a last axis of length 1" if jnp.shape(y) == () else ""
        raise ValueError(f"an observation of {name} must be {mean.shape[1:]}, (d,); got {jnp.shape(y)}{hint}.")


def _weighted_mean(observations, responsibilities, otherwise):
    """Means (Q, d), the weight of each frame in its state's mean (T, Q, n), and which states have any frame (Q, 1)."""
    total = jnp.sum(responsibilities, axis=(0, 2))
    has_frames = total > 1e-6
    weights = responsibilities / jnp.where(has_frames, total, 1.0)[:, None]
    mean = jnp.einsum("tqn,tdn->qd", weights, observations, precision="highest")
    return jnp.where(has_frames[:, None], mean, otherwise), weights, has_frames[:, None]
