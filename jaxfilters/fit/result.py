"""The result of a fit, and its report as a table."""

from dataclasses import field

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.parametrization import Parametrization, leaf_names
from jaxfilters.fit.search import Method, SearchState
from jaxfilters.fit.uncertainty import ErrorStatus, GradientCheck

_MAX_ROWS = 40


@pytree_dataclass
class Fit:
    """Estimated parameters, their uncertainty and the search that found them. Printed, it is the table of `report`."""

    theta: PyTree
    """The parameters at the maximum."""
    standard_errors: PyTree
    """A tree like `theta`: from the observed information; NaN where there is none, 0 if fixed or at a bound."""
    standard_error_status: PyTree
    """A tree like `theta` of `ErrorStatus` codes: why a standard error is NaN or 0."""
    lower: PyTree
    """A tree like `theta`: lower ends of 95 % intervals."""
    upper: PyTree
    """A tree like `theta`: upper ends of 95 % intervals. The interval of a number with a coordinate of its own is that
    of the coordinate, mapped, and never leaves the constraint."""
    log_density: Float[Array, "..."]
    """The log density at `theta`; of one with fresh keys, with the random numbers of the step after the last one."""
    covariance: Float[Array, "..."]
    """(d, d): covariance of the coordinates."""
    search: SearchState
    parametrization: Parametrization
    method: Method = field(metadata={"static": True})
    is_noisy: bool = field(default=False, metadata={"static": True})
    """Whether the log density has fresh keys, so that the standard errors are those of one random draw."""

    @property
    def num_steps(self) -> Int[Array, "..."]:
        """Number of steps taken, including those before a restart."""
        return self.search.step

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Whether the method's convergence criterion ended the search."""
        return self.search.converged

    @property
    def loss_history(self) -> np.ndarray:
        """(num_steps,): minus the log density in every step since the last start. Not for a batch of fits."""
        return np.asarray(self.search.losses)[: int(self.search.step - self.search.first_step)]

    @property
    def termination(self) -> str:
        """Why the search ended, in words. Not for a batch of fits."""
        steps = int(self.num_steps)
        if bool(self.search.failed):
            names = self.parametrization.names
            affected = list(dict.fromkeys(names[i] for i in np.flatnonzero(self.search.not_finite)))
            what = f"gradient of {', '.join(affected)}" if affected else "log density"
            return f"{what} not finite in step {steps - 1}; kept the last finite value"
        return f"converged after {steps} steps" if bool(self.converged) else f"stopped after {steps} steps"

    @property
    def missing_errors(self) -> dict[str, str]:
        """The parameters whose standard error is NaN, and why. Not for a batch of fits."""
        missing = {}
        leaves = zip(leaf_names(self.theta), jax.tree.leaves(self.standard_error_status), strict=True)
        for name, status in leaves:
            for index, code in np.ndenumerate(np.asarray(status)):
                if ErrorStatus.AT_BOUND < code < ErrorStatus.FIXED:
                    missing[_indexed(name, index)] = ErrorStatus(int(code)).reason
        return missing

    def __str__(self) -> str:
        return report(self)


def report(fit: Fit, check: GradientCheck | None = None) -> str:
    """A table of the parameters with standard errors and 95 % intervals, and how the search ended.

    Where a parameter has no standard error the table says why. Only the first 40 numbers are shown. Not for a batch of
    fits.

    Args:
        fit: The fit.
        check: A check of the gradient, whose error is then reported.

    Examples:
        >>> import jaxfilters as jf
        >>> fit = jf.fit.maximize(lambda theta: -0.5 * (theta - 3.0) ** 2, 0.0)
        >>> jf.fit.report(fit).splitlines()[1].split()[:3]  # the estimate and its standard error
        ['theta', '3', '1']
    """
    lines = [f"{'parameter':24}{'estimate':>14}{'std. error':>14}    95 % interval"]
    rows = _rows(fit)
    lines += rows[:_MAX_ROWS]
    if len(rows) > _MAX_ROWS:
        lines.append(f"... and {len(rows) - _MAX_ROWS} more")
    start = -fit.loss_history[0]
    lines.append(f"log density {float(fit.log_density):.6g}, {start:.6g} at the start; {fit.termination}")
    missing = fit.missing_errors
    if missing:
        names = list(missing)
        shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        lines.append(f"no standard error for {len(names)} of {len(rows)} parameters: {shown}")
    if fit.is_noisy:
        lines.append("log density and standard errors are those of one random draw")
    if check is not None:
        lines.append(f"gradient and differences agree to {check.error:.1g}")
    return "\n".join(lines)


def _rows(fit: Fit) -> list[str]:
    rows = []
    trees = (fit.theta, fit.standard_errors, fit.standard_error_status, fit.lower, fit.upper)
    for name, *arrays in zip(leaf_names(fit.theta), *map(jax.tree.leaves, trees), strict=True):
        for index in np.ndindex(np.shape(arrays[0])):
            value, error, status, lower, upper = (float(np.asarray(array)[index]) for array in arrays)
            reason = ErrorStatus(int(status)).reason
            shown = f"{error:14.3g}" if status == ErrorStatus.DETERMINED else f"{'-':>14}"
            interval = reason or f"{lower:.6g} .. {upper:.6g}"
            rows.append(f"{_indexed(name, index):24}{value:14.6g}{shown}    {interval}")
    return rows


def _indexed(name: str, index: tuple[int, ...]) -> str:
    return f"{name}[{','.join(map(str, index))}]" if index else name or "theta"
