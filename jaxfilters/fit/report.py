"""A fit as a table for people."""

import jax
import numpy as np

from jaxfilters.fit.chart import paths
from jaxfilters.fit.constraints import Fixed
from jaxfilters.fit.maximum import Fit
from jaxfilters.fit.uncertainty import GradientCheck

_MOST_LINES = 40


def report(fit: Fit, check: GradientCheck | None = None) -> str:
    """Parameters with standard errors and 95 % intervals, how the search went, and the gradient check if there is one.

    Only the first 40 numbers are shown. For a fit that is not batched.
    """
    lines = [f"{'parameter':24}{'estimate':>14}{'std. error':>14}    95 % interval"]
    rows = _rows(fit)
    lines += [f"{name:24}{value:14.6g}{_shown(error)}    {ends}" for name, value, error, ends in rows[:_MOST_LINES]]
    if len(rows) > _MOST_LINES:
        lines.append(f"... and {len(rows) - _MOST_LINES} more")
    path = fit.trajectory
    lines.append(f"log density {float(fit.log_density):.6g}, {-path[0]:.6g} at the start; {fit.ending}")
    if check is not None:
        lines.append(f"gradient and differences agree to {check.error:.1g}")
    return "\n".join(lines)


def _rows(fit: Fit) -> list[tuple[str, float, float, str]]:
    rows = []
    trees = (fit.theta, fit.standard_errors, fit.lower, fit.upper)
    leaves = zip(paths(fit.theta), fit.chart.constraints, *map(jax.tree.leaves, trees), strict=True)
    for path, constraint, *arrays in leaves:
        certain = "fixed" if isinstance(constraint, Fixed) else "at its bound"
        for index in np.ndindex(np.shape(arrays[0])):
            value, error, lower, upper = (float(np.asarray(array)[index]) for array in arrays)
            name = f"{path}[{','.join(map(str, index))}]" if index else path or "theta"
            rows.append((name, value, error, certain if error == 0 else f"{lower:.6g} .. {upper:.6g}"))
    return rows


def _shown(error: float) -> str:
    return f"{'-':>14}" if error == 0 else f"{error:14.3g}"
