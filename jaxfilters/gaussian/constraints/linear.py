"""Linear inequalities `lower <= normals x <= upper`, validated before anything is traced."""

from collections.abc import Sequence
from dataclasses import field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot

Numbers = ArrayLike | Sequence[Any]
"""An array, a number, or nested lists of numbers."""


@pytree_dataclass
class LinearConstraints:
    """Intervals `lower <= normals x <= upper`, one a row. `linear_constraints` makes validated ones.

    Examples:
        >>> import jaxfilters as jf
        >>> rows = jf.constraints.linear_constraints([[1.0, 0.0], [0.0, 1.0]], lower=0.0, upper=[1.0, 2.0])
        >>> rows.lower.tolist(), rows.upper.tolist()
        ([0.0, 0.0], [1.0, 2.0])
    """

    normals: Float[Array, "..."]
    """(k, n), one normal a row. The result does not depend on their lengths."""
    lower: Float[Array, "..."]
    """(k,), `-inf` where there is none. A row that has neither bound has no effect."""
    upper: Float[Array, "..."]
    """(k,), `inf` where there is none."""
    names: tuple[str, ...] = field(metadata={"static": True})
    """(k,), the names of the rows in messages."""


def linear_constraints(
    normals: Numbers, lower: Numbers, upper: Numbers, names: Sequence[str] | None = None
) -> LinearConstraints:
    """Linear constraints `lower <= normals x <= upper` on a state x, of which each row alone can be satisfied.

    Args:
        normals: (k, n), no row all zeros.
        lower: (k,) or one number for all rows; may be `-inf`.
        upper: (k,) or one number for all rows; may be `inf`.
        names: Names of the rows for messages; by default their numbers.

    Returns:
        The constraints, with arrays of JAX's default float type.

    Raises:
        ValueError: A shape does not fit, a number is not finite, a normal is zero, or a lower bound is above its
            upper bound; the message names the row.

    Examples:
        A first component in [0, 1], and a second one that is at most the first:

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> rows = jf.constraints.linear_constraints([[1.0, 0.0], [-1.0, 1.0]], [0.0, -jnp.inf], [1.0, 0.0])
        >>> rows.names
        ('row 0', 'row 1')
    """
    normals = np.asarray(normals, dtype=float)
    if normals.ndim != 2 or len(normals) == 0:
        raise ValueError(f"normals: expected (k, n), a row for each constraint; got shape {normals.shape}.")
    rows = len(normals)
    names = tuple(f"row {k}" for k in range(rows)) if names is None else tuple(names)
    if len(names) != rows:
        raise ValueError(f"names: expected {rows}, one for each row of normals; got {len(names)}.")
    least, most = _bounds("lower", lower, rows), _bounds("upper", upper, rows)
    _check_values(normals, least, most, names)
    as_floats = partial(jnp.asarray, dtype=float)
    return LinearConstraints(as_floats(normals), as_floats(least), as_floats(most), names)


def check_rows(constraints: LinearConstraints) -> None:
    """Reject constraints whose fields do not fit one another; where values are known, also invalid numbers.

    Raises:
        TypeError: `constraints` is not a `LinearConstraints`.
        ValueError: As for `linear_constraints`.
    """
    if not isinstance(constraints, LinearConstraints):
        raise TypeError(f"constraints: expected LinearConstraints; got {type(constraints).__name__}.")
    rows = len(constraints.names)
    for name, expected in (("normals", 2), ("lower", 1), ("upper", 1)):
        shape = jnp.shape(getattr(constraints, name))
        if len(shape) != expected or shape[0] != rows:
            form = f"({rows}, n)" if expected == 2 else f"({rows},)"
            raise ValueError(f"{name}: expected {form}, one for each row; got shape {shape}.")
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(constraints)):
        normals, lower, upper = _on_host(constraints)
        _check_values(normals, lower, upper, constraints.names)


def feasible(constraints: LinearConstraints) -> bool:
    """Whether some x satisfies all rows together, by a linear program of SciPy.

    Args:
        constraints: The rows. Their values must be known: this function cannot be traced.

    Examples:
        No number is at most 0 and at least 1.

        >>> import jaxfilters as jf
        >>> inf = float("inf")
        >>> rows = jf.constraints.linear_constraints([[1.0], [1.0]], lower=[-inf, 1.0], upper=[0.0, inf])
        >>> jf.constraints.feasible(rows)
        False
    """
    return _some_point_satisfies(*_on_host(constraints))


def check_feasible(constraints: LinearConstraints) -> None:
    """Raise an error that names contradicting rows, unless some x satisfies all rows together.

    The named rows are an irreducible set: without any one of them the others can be satisfied (deletion filter of
    J. Chinneck, E. Dravnieks, "Locating minimal infeasible constraint sets in linear programs", ORSA Journal on
    Computing, 1991).

    Args:
        constraints: The rows. Their values must be known: this function cannot be traced.

    Raises:
        ValueError: No x satisfies all rows.

    Examples:
        No number is at most 0 and at least 1.

        >>> import jaxfilters as jf
        >>> inf = float("inf")
        >>> rows = jf.constraints.linear_constraints([[1.0], [1.0]], [-inf, 1.0], [0.0, inf], ["low", "high"])
        >>> jf.constraints.check_feasible(rows)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        ValueError: constraints: ... these contradict each other: low in [-inf, 0]; high in [1, inf].
    """
    host = _on_host(constraints)
    if _some_point_satisfies(*host):
        return
    needed = np.ones(len(constraints.names), dtype=bool)
    for k in range(needed.size):
        needed[k] = False
        needed[k] = _some_point_satisfies(*(x[needed] for x in host))
    rows = "; ".join(f"{constraints.names[k]} in [{host[1][k]:g}, {host[2][k]:g}]" for k in np.flatnonzero(needed))
    raise ValueError(f"constraints: expected some x that satisfies all rows; these contradict each other: {rows}.")


def _bounds(name, bound, rows):
    bound = np.asarray(bound, dtype=float)
    if bound.shape not in ((), (rows,)):
        raise ValueError(
            f"{name}: expected a number or ({rows},), one for each row of normals; got shape {bound.shape}."
        )
    return np.broadcast_to(bound, (rows,))


def _check_values(normals, lower, upper, names):
    _refuse("normals", names, ~np.isfinite(normals).all(axis=1), "expected finite numbers", normals)
    _refuse("normals", names, ~normals.any(axis=1), "expected a direction; got zeros", None)
    _refuse("lower", names, np.isnan(lower) | (lower == np.inf), "expected a number or -inf", lower)
    _refuse("upper", names, np.isnan(upper) | (upper == -np.inf), "expected a number or inf", upper)
    _refuse("lower, upper", names, lower > upper, "expected lower <= upper", np.stack([lower, upper], axis=1))


def _refuse(argument, names, wrong, expected, values):
    if wrong.any():
        k = int(np.argmax(wrong))
        got = "" if values is None else f"; got {values[k]}"
        raise ValueError(f"{argument}: {names[k]}: {expected}{got}.")


def _on_host(constraints):
    normals, lower, upper = (
        np.asarray(x, dtype=float) for x in (constraints.normals, constraints.lower, constraints.upper)
    )
    return normals, lower, upper


def _some_point_satisfies(normals, lower, upper):
    bounds = np.concatenate([upper, -lower])
    # The tolerance of the solver is absolute; with unit normals it is in the unit of x.
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    sides = np.concatenate([normals, -normals]) / np.tile(lengths, (2, 1))
    bounds = bounds / np.tile(lengths[:, 0], 2)
    present = np.isfinite(bounds)
    if not present.any():
        return True
    from scipy.optimize import linprog  # a fifth of a second, and trackers have no inequalities to check

    result = linprog(np.zeros(normals.shape[1]), sides[present], bounds[present], bounds=(None, None))
    return result.status == 0


def check_width(belief: Any, constraints: LinearConstraints) -> None:
    """Reject a belief that is not Gaussian, or that the rows do not fit.

    Raises:
        TypeError: `belief` is not a `Gaussian` or `GaussianRoot`.
        ValueError: `constraints.normals` does not have one column for each component of the belief.
    """
    if not isinstance(belief, Gaussian | GaussianRoot):
        raise TypeError(f"belief: expected a Gaussian or a GaussianRoot; got {type(belief).__name__}.")
    shape, n = jnp.shape(constraints.normals), jnp.shape(belief.mean)[-1]
    if len(shape) != 2 or shape[1] != n:
        raise ValueError(
            f"constraints: expected normals of shape (k, {n}), a column for each component of the belief; got {shape}."
        )
