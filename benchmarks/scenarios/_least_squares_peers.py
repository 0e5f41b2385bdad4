"""Least squares within bounds by solvers in C++; each is imported only where it is asked for."""

from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np


class Written(NamedTuple):
    """One problem in numpy, which all solvers outside JAX are given."""

    value: Callable[[np.ndarray], np.ndarray]
    """Residuals (m,) of variables (n,)."""
    jacobian: Callable[[np.ndarray], np.ndarray]
    """(m, n)."""
    lower: np.ndarray
    upper: np.ndarray
    start: np.ndarray
    num_residuals: int


def installed() -> list[str]:
    """Those of Ceres and NLopt that can be imported, by the names of their packages."""
    return [name for name in ("pyceres", "nlopt") if find_spec(name) is not None]


def pyceres(problem: Written, tolerance: float, most_steps: int) -> np.ndarray:
    """Levenberg-Marquardt of Ceres, within bounds, to a projected gradient of `tolerance`; dense QR."""
    library: Any = import_module("pyceres")

    class Residuals(library.CostFunction):
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(problem.num_residuals)
            self.set_parameter_block_sizes([problem.start.size])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            residuals[:] = problem.value(parameters[0])
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = problem.jacobian(parameters[0]).ravel()
            return True

    y, cost, whole = problem.start.copy(), Residuals(), library.Problem()
    whole.add_residual_block(cost, None, [y])
    for i, (low, high) in enumerate(zip(problem.lower, problem.upper, strict=True)):
        whole.set_parameter_lower_bound(y, i, low)
        whole.set_parameter_upper_bound(y, i, high)
    options = library.SolverOptions()
    options.linear_solver_type = library.LinearSolverType.DENSE_QR
    options.logging_type = library.LoggingType.SILENT
    options.gradient_tolerance, options.max_num_iterations, options.num_threads = tolerance, most_steps, 1
    options.function_tolerance, options.parameter_tolerance = 1e-16, 1e-14
    library.solve(options, whole, library.SolverSummary())
    return y


def nlopt(problem: Written, tolerance: float, most_steps: int) -> np.ndarray:
    """Sequential quadratic programming of NLopt on the energy, within bounds.

    It knows no tolerance for gradients, but for steps: a thousandth of it, relative.
    """
    library: Any = import_module("nlopt")
    best: list[Any] = [np.inf, problem.start]

    def energy(y: np.ndarray, gradient: np.ndarray) -> float:
        residuals = problem.value(y)
        if gradient.size:
            gradient[:] = problem.jacobian(y).T @ residuals
        value = 0.5 * float(residuals @ residuals)
        if value < best[0]:
            best[:] = value, y.copy()
        return value

    solver = library.opt(library.LD_SLSQP, problem.start.size)
    solver.set_lower_bounds(problem.lower)
    solver.set_upper_bounds(problem.upper)
    solver.set_min_objective(energy)
    solver.set_xtol_rel(1e-3 * tolerance)
    solver.set_maxeval(most_steps)
    # What it raises where rounding hides all further gain is its way to end.
    with suppress(library.RoundoffLimited):
        solver.optimize(problem.start)
    return best[1]
