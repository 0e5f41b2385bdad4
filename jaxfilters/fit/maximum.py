"""Maximum likelihood and maximum a posteriori estimates with standard errors."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.constraints import Box, free
from jaxfilters.fit.density import at_step, explain_not_finite, is_noisy
from jaxfilters.fit.methods import FirstOrder, LeastSquares, Residuals, bfgs
from jaxfilters.fit.parametrization import (
    Parametrization,
    check_start,
    parametrize,
    with_box_bounds,
    without_box_bounds,
)
from jaxfilters.fit.result import Fit
from jaxfilters.fit.search import Method, SearchState, initial_search, minimize
from jaxfilters.fit.uncertainty import Errors, ErrorStatus, Uncertainty, intervals, observed_information
from jaxfilters.typing import as_pytree

_ROUNDING = 16.0
"""Rounding errors by which two evaluations of one log density may differ, each relative to 1 + its size."""


def maximize(
    log_density: Callable,
    start: PyTree,
    constraints: PyTree = free,
    *,
    method: Method | None = None,
    errors: Errors = observed_information,
) -> Fit:
    """Parameters at a local maximum of a log density, with their standard errors.

    Under `vmap`, over starts, data or both, the leaves of the `Fit` are stacked, and values are not checked.

    Args:
        log_density: `theta -> log p`, or what `log_evidence`, `common_random_numbers`, `fresh_keys`, `with_prior` or
            `residuals` return. Functions are compared by identity: data belong in a pytree or a `Partial`.
        start: Parameters from which to start, or a `Fit` to continue.
        constraints: A tree of constraints like `start`, or a prefix of it. A `Fit` keeps its own.
        method: `bfgs()`, `lbfgsb()`, `adam()`, `first_order(...)` or `least_squares()`. By default `bfgs()`, or, if
            `start` is a `Fit` of a search within bounds, the method of that search.
        errors: `observed_information` or `no_errors`.

    Returns:
        The fit. `fit.converged` and `fit.termination` say how the search ended, `fit.missing_errors` which parameters
        have no standard error, and why.

    Raises:
        ValueError: If `start` violates its constraints, the log density is not finite there, or the method does not
            support the log density.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> fit = jf.fit.maximize(lambda x: -0.5 * jnp.sum((x - 3.0) ** 2), jnp.zeros(2))
        >>> print(fit.theta, fit.standard_errors)
        [3. 3.] [1. 1.]
    """
    method = _default_method(start) if method is None else method
    _check_method(method, log_density)
    log_density = as_pytree(log_density)
    if isinstance(start, Fit) and start.method == method:
        found = _continue(log_density, start, errors)
        _check_first_step(log_density, found, start.theta)
        return found
    if isinstance(start, Fit):
        kept = start.parametrization if method.supports_bounds else without_box_bounds(start.parametrization)
        start, constraints = start.theta, jax.tree.unflatten(jax.tree.structure(start.theta), kept.constraints)
    parametrization = parametrize(start, constraints)
    check_start(parametrization)
    parametrization = with_box_bounds(parametrization) if method.supports_bounds else parametrization
    found = _start(log_density, parametrization, method, errors)
    _check_first_step(log_density, found, parametrization.origin)
    return found


@pytree_dataclass
class _Negative:
    """Minus the log density as a function of the coordinates."""

    log_density: Callable
    parametrization: Parametrization

    def __call__(self, step, z):
        return -at_step(self.log_density, step, self.parametrization.constrain(z))

    def residuals(self, z):
        return self.log_density.function(self.parametrization.constrain(z))


@partial(jax.jit, static_argnames=("method", "errors"))
def _start(log_density: Callable, parametrization: Parametrization, method: Method, errors: Errors) -> Fit:
    loss, bounds = _Negative(log_density, parametrization), parametrization.bounds()
    search = initial_search(method, loss, parametrization.unconstrain(parametrization.origin), bounds)
    return _finished(loss, minimize(method, loss, search, bounds), method, errors)


@partial(jax.jit, static_argnames="errors")
def _continue(log_density: Callable, fit: Fit, errors: Errors) -> Fit:
    loss, bounds = _Negative(log_density, fit.parametrization), fit.parametrization.bounds()
    search = fit.search
    # The method's state holds values and gradients of the log density that was searched; another one starts it anew.
    now = loss(search.step, search.z)
    same = jnp.abs(now + fit.log_density) <= _ROUNDING * jnp.finfo(now.dtype).eps * (1 + jnp.abs(now))
    fresh = fit.method.init(loss, search.z, bounds)
    state = jax.tree.map(lambda old, new: jnp.where(same, old, new), search.state, fresh)
    search = search._replace(state=state, failed=jnp.zeros((), bool))
    return _finished(loss, minimize(fit.method, loss, search, bounds), fit.method, errors)


def _finished(loss: _Negative, search: SearchState, method: Method, errors: Errors) -> Fit:
    at_last_step = partial(loss, search.step)
    lower_bound, upper_bound = loss.parametrization.bounds()
    at_bound = (search.z <= lower_bound) | (search.z >= upper_bound)

    def of_interior(z: Array) -> Array:
        # A quadratic term for the coordinates at bounds keeps the information matrix regular.
        return at_last_step(jnp.where(at_bound, search.z, z)) + 0.5 * jnp.sum(jnp.where(at_bound, z, 0.0) ** 2)

    covariance, status = errors(of_interior, search.z)
    # The standard errors are conditional on the active bounds.
    status = jnp.where(at_bound, ErrorStatus.AT_BOUND, status)
    covariance = jnp.where(at_bound[:, None] | at_bound, 0.0, covariance)
    theta = loss.parametrization.constrain(search.z)
    found = intervals(loss.parametrization, search.z, Uncertainty(covariance, status))
    log_density = -at_last_step(search.z)
    noisy = is_noisy(loss.log_density)
    return Fit(theta, *found, log_density, covariance, search, loss.parametrization, method, noisy)


def _default_method(start: PyTree) -> Method:
    within_bounds = isinstance(start, Fit) and any(isinstance(c, Box) for c in start.parametrization.constraints)
    # Other methods cannot start on a bound, where such a search may have ended.
    return start.method if within_bounds else bfgs()


def _check_first_step(log_density: Callable, found: Fit, start: PyTree) -> None:
    """Reject a log density that is not finite where the search starts; tracers are not checked."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(found)):
        return
    search = found.search
    if np.ndim(search.failed) or not search.failed or search.step - search.first_step > 1:
        return
    value = float(at_step(log_density, search.first_step, start))
    if not np.isfinite(value):
        because = explain_not_finite(log_density, start)
        raise ValueError(f"log_density must be finite at start; got {value}{': ' if because else ''}{because}.")


def _check_method(method: Method, log_density: Callable) -> None:
    if is_noisy(log_density) and not isinstance(method, FirstOrder):
        raise ValueError(
            f"method must be of first order, such as fit.adam(), for a log density with fresh keys; got "
            f"{type(method).__name__}. Fixed random numbers, fit.common_random_numbers, suit every method."
        )
    if isinstance(method, LeastSquares) and not isinstance(log_density, Residuals):
        raise ValueError(f"log_density must be made by fit.residuals for least squares; got {log_density!r}.")
