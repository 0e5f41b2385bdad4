"""Moments of the smoothing distribution, and the regressions of an M-step, for Gaussian models."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters.filter import Filter, keep_all, run
from jaxfilters.gaussian.smoothing import smoothed_pairs
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey


class Moments(NamedTuple):
    """Smoothed moments of s sequences of t frames, and the data."""

    mean: Float[Array, "s t+1 n"]
    """E[x], from the state before the first observation on."""
    covariance: Float[Array, "s t+1 n n"]
    cross: Float[Array, "s t n n"]
    """Cov(x_t-1, x_t)."""
    y: Float[Array, "s t m"]
    """Observations, 0 where nothing was read."""
    read: Bool[Array, "s t m"]
    inputs: PyTree
    """Inputs, leaves (s, t, ...), or None."""
    inside: Bool[Array, "s t"]
    """Frames before the end of their sequence: their transitions count."""
    log_evidence: Float[Array, ""]
    """Of all sequences."""


def moments(
    filter: Filter, key: AnyKey, y: Float[Array, "t m s"], inputs: PyTree, inside: Bool[Array, "t s"]
) -> Moments:
    """The E-step: filters and smooths every sequence; y is NaN where nothing was read."""

    def one(y: Array, inputs: PyTree) -> tuple:
        _, (beliefs, infos) = run(filter, key, y, inputs, collect=keep_all)
        return *smoothed_pairs(filter, beliefs, inputs), infos.log_evidence.sum()

    mean, covariance, cross, log_evidence = jax.vmap(one, in_axes=-1)(y, inputs)
    read = jnp.isfinite(y)
    data = (jnp.where(read, y, 0.0), read, inputs, inside)
    y, read, inputs, inside = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), data)
    return Moments(mean, covariance, cross, y, read, inputs, inside, log_evidence.sum())


class Imputed(NamedTuple):
    """Observations as affine functions of the states: y = g + G x + e with e ~ N(0, C), given what was read of them."""

    g: Float[Array, "*f m"]
    G: Float[Array, "*f m n"]
    C: Float[Array, "*f m m"]


def imputation(R: Float[Array, "m m"], read: Bool[Array, " m"]) -> tuple[Float[Array, "m m"], Float[Array, "m m"]]:
    """The noise of all components given that of those read: A times it, plus noise of the covariance C.

    A is the identity on the components read. It lets the M-step treat the others as missing, whatever R correlates.
    """
    both = read[:, None] & read
    among = jnp.where(both, R, 0.0)
    root = linalg.cholesky(among)
    solved = linalg.solve_triangular(
        root, linalg.solve_triangular(root, jnp.where(read[:, None], R, 0.0)), transpose=True
    )
    A = jnp.where(read, solved.T, 0.0)
    A = jnp.where(read[:, None], jnp.diag(read.astype(R.dtype)), A)
    C = R - linalg.matmul(A, linalg.matmul(among, A.T))
    return A, jnp.where(read[:, None] | read, 0.0, 0.5 * (C + C.T))


class Pairs(NamedTuple):
    """Moments of many pairs (x, target), the target an affine function of x and noise, for a regression."""

    weight: Float[Array, " f"]
    x: Float[Array, "f n"]
    """E[x]."""
    target: Float[Array, "f k"]
    """E[target]."""
    covariance: Float[Array, "n n"]
    """The weighted sum of Cov(x)."""
    cross: Float[Array, "k n"]
    """The weighted sum of Cov(target, x)."""
    spread: Float[Array, "k k"]
    """The weighted sum of Cov(target)."""


def regression(pairs: Pairs, W: Float[Array, "k n"], b: Float[Array, " k"] | None, free: tuple[bool, bool]) -> tuple:
    """The W and b for which E|target - W x - b|^2, in any norm, is least; those that are not free stay.

    It is computed from residuals about the previous W and b: second moments would lose the digits of large states.
    """
    if not any(free):
        return W, b
    n, weight = W.shape[1], pairs.weight
    residual = _residual(pairs, W, b) * weight[:, None]
    cross = pairs.cross - _product(W, pairs.covariance)
    z = jnp.concatenate([pairs.x, jnp.ones((len(weight), 1), W.dtype)], axis=1)
    moment = _product(residual.T, z).at[:, :n].add(cross)
    square = _product(z.T * weight, z).at[:n, :n].add(pairs.covariance)
    chosen = jnp.asarray([*range(n)] * free[0] + [n] * free[1])
    scale = jnp.sqrt(jnp.diagonal(square)[chosen])
    scaled = square[chosen][:, chosen] / scale / scale[:, None]
    change = jax.scipy.linalg.solve(scaled, (moment[:, chosen] / scale).T, assume_a="pos").T / scale
    W = W + change[:, :n] if free[0] else W
    return W, b + change[:, -1] if free[1] and b is not None else b


def residual_covariance(pairs: Pairs, W: Float[Array, "k n"], b: Float[Array, " k"] | None) -> Float[Array, "k k"]:
    """E[(target - W x - b) (target - W x - b)^T], averaged over the pairs."""
    residual, weight = _residual(pairs, W, b), pairs.weight
    half = _product(pairs.cross, W.T)
    spread = pairs.spread - half - half.T + _product(W, _product(pairs.covariance, W.T))
    return (_product(residual.T * weight, residual) + 0.5 * (spread + spread.T)) / jnp.sum(weight)


def initial_moments(found: Moments, mean: Float[Array, " n"], free: tuple[bool, bool]) -> tuple[Array, Array]:
    """Mean and covariance of the states before the first observations; where it is not free, the given mean."""
    starts = found.mean[:, 0]
    mean = jnp.mean(starts, axis=0) if free[0] else mean
    deviation = starts - mean
    return mean, (_product(deviation.T, deviation) + jnp.sum(found.covariance[:, 0], axis=0)) / len(starts)


def _residual(pairs, W, b):
    residual = pairs.target - _product(pairs.x, W.T)
    return residual if b is None else residual - b


def _product(a, b):
    return jnp.matmul(a, b, precision="highest")
