"""Parameters by maximum likelihood, or with a prior by maximum a posteriori, and how certain they are."""

from collections.abc import Callable
from dataclasses import field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.chart import Chart, boxed, chart_about, check_inside
from jaxfilters.fit.constraints import free
from jaxfilters.fit.density import at_step, is_noisy
from jaxfilters.fit.methods import FirstOrder, LeastSquares, Residuals, bfgs
from jaxfilters.fit.search import Method, Search, begin, descend
from jaxfilters.fit.uncertainty import Errors, intervals, observed_information
from jaxfilters.typing import as_pytree


@pytree_dataclass
class Fit:
    """Parameters, how certain they are, and how they were found. Printed, it is a table."""

    theta: PyTree
    standard_errors: PyTree
    """Like `theta`: from the observed information; NaN where the search did not end at a maximum."""
    lower: PyTree
    upper: PyTree
    """Like `theta`: 95 % intervals. Of numbers with a coordinate of their own they are the mapped intervals of that
    coordinate, and never leave the constraint."""
    log_density: Float[Array, "..."]
    """At `theta`."""
    covariance: Float[Array, "..."]
    """(d, d): of the coordinates."""
    search: Search
    chart: Chart
    method: Method = field(metadata={"static": True})

    @property
    def num_steps(self) -> Int[Array, "..."]:
        """Steps taken, those before a restart among them."""
        return self.search.step

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Whether the method's own criterion ended the search."""
        return self.search.done

    @property
    def trajectory(self) -> np.ndarray:
        """Minus the log density at every step since the last start; for a fit that is not batched."""
        return np.asarray(self.search.losses)[: int(self.search.step - self.search.first)]

    @property
    def ending(self) -> str:
        """Why the search ended, in words; for a fit that is not batched."""
        steps = int(self.num_steps)
        if bool(self.search.failed):
            names = self.chart.names
            wrong = list(dict.fromkeys(names[i] for i in np.flatnonzero(self.search.not_finite)))
            what = f"gradient of {', '.join(wrong)}" if wrong else "log density"
            return f"{what} not finite in step {steps - 1}; kept the last good value"
        return f"converged after {steps} steps" if bool(self.converged) else f"stopped after {steps} steps"

    def __str__(self) -> str:
        from jaxfilters.fit.report import report

        return report(self)


def maximize(
    log_density: Callable,
    start: PyTree,
    constraints: PyTree = free,
    *,
    method: Method | None = None,
    errors: Errors = observed_information,
) -> Fit:
    """Parameters at a maximum of a log density, with their standard errors.

    Under `vmap`, over starts, data or both, the `Fit` has stacked leaves, and values are not checked.

    Args:
        log_density: `theta -> log p`, or what `log_evidence`, `common_random_numbers`, `fresh_keys`, `with_prior` or
            `residuals` make. Functions are compared by identity: data belong in a pytree or a `Partial`.
        start: Parameters to start from, or a `Fit` to continue.
        constraints: One constraint for every leaf of `start`, or for a whole branch. A `Fit` keeps its own.
        method: `bfgs()` (default), `lbfgsb()`, `adam()`, `first_order(...)` or `least_squares()`.
        errors: How certain the parameters are: `observed_information` or `no_errors`.

    Raises:
        ValueError: If `start` is outside its constraints, or the method does not serve the log density.
    """
    method = bfgs() if method is None else method
    _check_method(method, log_density)
    log_density = as_pytree(log_density)
    if isinstance(start, Fit) and start.method == method:
        return _continue(log_density, start, errors)
    if isinstance(start, Fit):
        start, constraints = start.theta, jax.tree.unflatten(jax.tree.structure(start.theta), start.chart.constraints)
    chart = chart_about(start, constraints)
    check_inside(chart)
    return _start(log_density, boxed(chart) if method.knows_bounds else chart, method, errors)


@pytree_dataclass
class _Negative:
    """Minus the log density in the coordinates."""

    log_density: Callable
    chart: Chart

    def __call__(self, step, z):
        return -at_step(self.log_density, step, self.chart.point(z))

    def residuals(self, z):
        return self.log_density.function(self.chart.point(z))


@partial(jax.jit, static_argnames=("method", "errors"))
def _start(log_density: Callable, chart: Chart, method: Method, errors: Errors) -> Fit:
    loss, bounds = _Negative(log_density, chart), chart.bounds()
    search = begin(method, loss, chart.coordinates(chart.origin), bounds)
    return _finished(loss, descend(method, loss, search, bounds), method, errors)


@partial(jax.jit, static_argnames="errors")
def _continue(log_density: Callable, fit: Fit, errors: Errors) -> Fit:
    loss = _Negative(log_density, fit.chart)
    search = fit.search._replace(failed=jnp.zeros((), bool))
    return _finished(loss, descend(fit.method, loss, search, fit.chart.bounds()), fit.method, errors)


def _finished(loss: _Negative, search: Search, method: Method, errors: Errors) -> Fit:
    here = partial(loss, search.step)
    lower_bound, upper_bound = loss.chart.bounds()
    held = (search.z <= lower_bound) | (search.z >= upper_bound)

    def of_the_rest(z):
        return here(jnp.where(held, search.z, z)) + 0.5 * jnp.sum(jnp.where(held, z, 0.0) ** 2)

    # What a bound holds is as if it were known.
    covariance = jnp.where(held[:, None] | held, 0.0, errors(of_the_rest, search.z))
    theta = loss.chart.point(search.z)
    spread, lower, upper = intervals(loss.chart, search.z, covariance)
    return Fit(theta, spread, lower, upper, -here(search.z), covariance, search, loss.chart, method)


def _check_method(method: Method, log_density: Callable) -> None:
    if is_noisy(log_density) and not isinstance(method, FirstOrder):
        raise ValueError(
            f"method must be of first order, such as fit.adam(), for a log density with fresh keys; got "
            f"{type(method).__name__}. Or take fit.common_random_numbers."
        )
    if isinstance(method, LeastSquares) and not isinstance(log_density, Residuals):
        raise ValueError(f"log_density must be made by fit.residuals for least squares; got {log_density!r}.")
