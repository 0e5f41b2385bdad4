r"""Whether the covariances of a filter fit its errors: normalised errors squared, and their chi-square bands.

Y. Bar-Shalom, X. R. Li and T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section
5.4. Of a consistent filter, errors squared in units of the covariance have a chi-square distribution: too large means
overconfident, too small underconfident.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammainc, gammaln, ndtri
from jaxtyping import Array, ArrayLike, Float

from jaxfilters.gaussian import checks
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.math import linalg

_ITERATIONS = 60
"""Halvings of an interval: more than the digits of a double-precision number."""


class Band(NamedTuple):
    """Limits between which a statistic lies with some probability."""

    low: Float[Array, "..."]
    high: Float[Array, "..."]


def nees(truth: Float[Array, "*batch n"], beliefs: Gaussian | GaussianRoot) -> Float[Array, "*batch"]:
    r"""Normalised estimation error squared, $(x - m)^T P^{-1} (x - m)$: chi-square with n degrees of freedom.

    Directions of no variance are left out.

    Args:
        truth: True states, (..., n).
        beliefs: Beliefs with the same leading axes, e.g. over time.

    Returns:
        One number a belief, (...); compare it with `chi_square_band(n)`.

    Raises:
        ValueError: If the shapes differ.
        TypeError: If `beliefs` is of another kind.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> beliefs = jf.Gaussian(jnp.zeros((3, 2)), jnp.broadcast_to(4.0 * jnp.eye(2), (3, 2, 2)))
        >>> jf.diagnostics.nees(jnp.full((3, 2), 2.0), beliefs).tolist()
        [2.0, 2.0, 2.0]
    """
    if not isinstance(beliefs, Gaussian | GaussianRoot):
        raise TypeError(f"beliefs must be a Gaussian or a GaussianRoot; got a {type(beliefs).__name__}.")
    checks.shaped("truth", truth, beliefs.mean.shape, ", that of the means of beliefs")
    if isinstance(beliefs, GaussianRoot):
        return _length("beliefs.root", truth - beliefs.mean, beliefs.root, linalg.tria)
    return _length("beliefs.covariance", truth - beliefs.mean, beliefs.covariance, linalg.cholesky)


def nis(innovations: Float[Array, "*batch m"], covariances: Float[Array, "*batch m m"]) -> Float[Array, "*batch"]:
    r"""Normalised innovation squared, $e^T S^{-1} e$: chi-square with m degrees of freedom.

    The infos of Gaussian filters hold it as `infos.nis`, with the degrees of freedom `infos.rank`.

    Args:
        innovations: Observations minus their predictions, (..., m).
        covariances: Covariances of the innovations, (..., m, m). Components of no variance are left out.

    Returns:
        One number an innovation, (...).

    Raises:
        ValueError: If the shapes do not fit one another.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> float(jf.diagnostics.nis(jnp.array([2.0, 0.0]), jnp.diag(jnp.array([4.0, 1.0]))))
        1.0
    """
    checks.floating("innovations", innovations)
    checks.shaped("covariances", covariances, (*innovations.shape, *innovations.shape[-1:]), ", (..., m, m)")
    return _length("covariances", innovations, covariances, linalg.cholesky)


def chi_square_band(dof: ArrayLike, *, probability: ArrayLike = 0.95, num_runs: ArrayLike = 1) -> Band:
    """The band of a chi-square statistic, or of the mean of several independent ones, with equal tails outside.

    Args:
        dof: Degrees of freedom of one statistic, positive: n for `nees`, `infos.rank` for `infos.nis`.
        probability: Probability inside, in (0, 1).
        num_runs: Number of independent runs over which the statistic is averaged; or of steps, for the time average of
            a `nis`, whose terms are independent in a consistent filter.

    Returns:
        The limits.

    Raises:
        ValueError: If a concrete argument is outside its range.

    Examples:
        >>> import jaxfilters as jf
        >>> low, high = jf.diagnostics.chi_square_band(2, num_runs=50)
        >>> round(float(low), 2), round(float(high), 2)
        (1.48, 2.59)
    """
    between("probability", probability, 0.0, 1.0)
    between("num_runs", num_runs, 0.0, np.inf)
    tail = 0.5 * (1 - jnp.asarray(probability, dtype=float))
    between("dof", dof, 0.0, np.inf)
    total = jnp.asarray(dof, dtype=float) * num_runs
    return Band(*(chi_square_quantile(share, total) / num_runs for share in (tail, 1 - tail)))


def chi_square_quantile(probability: ArrayLike, dof: ArrayLike) -> Float[Array, "..."]:
    """The number below which a chi-square variable lies with a given probability; a constant to differentiation.

    By bisection of the distribution function about the approximation of E. B. Wilson and M. M. Hilferty (1931).

    Args:
        probability: In (0, 1).
        dof: Degrees of freedom, positive. The two are broadcast.

    Returns:
        The quantiles, to a few roundings of the type.

    Raises:
        ValueError: If a concrete argument is outside its range.

    Examples:
        >>> import jaxfilters as jf
        >>> round(float(jf.diagnostics.chi_square_quantile(0.95, 3)), 3)
        7.815
    """
    between("probability", probability, 0.0, 1.0)
    between("dof", dof, 0.0, np.inf)
    p, dof = jnp.broadcast_arrays(*(jax.lax.stop_gradient(jnp.asarray(v, dtype=float)) for v in (probability, dof)))
    spread = 2 / (9 * dof)
    guess = dof * jnp.maximum(1 - spread + ndtri(p) * jnp.sqrt(spread), 1e-3) ** 3
    # Of few degrees of freedom the lower quantiles follow the leading power of the distribution function.
    small = 2 * jnp.exp((jnp.log(p) + gammaln(0.5 * dof + 1)) / (0.5 * dof))
    low, high = jnp.log(0.2 * jnp.minimum(guess, small)), jnp.log(2 * jnp.maximum(guess, small) + 1)

    def halve(_: Array, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = 0.5 * (low + high)
        below = gammainc(0.5 * dof, 0.5 * jnp.exp(middle)) < p
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = jax.lax.fori_loop(0, _ITERATIONS, halve, (low, high))
    return jnp.exp(0.5 * (low + high))


def _length(name, deviations, spreads, root_of):
    lead = deviations.shape[:-1]
    if spreads.shape[:-1] != deviations.shape:
        raise ValueError(f"{name} must have a row for each deviation {deviations.shape}; got {spreads.shape}.")

    def one(deviation: Array, spread: Array) -> Array:
        whitened = linalg.solve_triangular(root_of(spread), deviation)
        return jnp.sum(whitened * whitened)

    flat = [values.reshape(-1, *values.shape[len(lead) :]) for values in (deviations, spreads)]
    return jax.vmap(one)(*flat).reshape(lead)


def between(name: str, value: Any, low: float, high: float) -> None:
    """Raise a `ValueError` unless all concrete values lie inside an interval."""
    known = checks.concrete(value)
    if known is not None and not np.all((known > low) & (known < high)):
        raise ValueError(f"{name} must be in ({low}, {high}); got {known.tolist()}.")
