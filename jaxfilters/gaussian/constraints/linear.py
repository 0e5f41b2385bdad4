"""Linear inequalities `lower <= normals x <= upper`, checked on the host before anything is traced."""

from collections.abc import Sequence
from dataclasses import field
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy.optimize import linprog

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot

Numbers = ArrayLike | Sequence[Any]
"""An array, or what makes one: a number, a list, a list of lists."""


@pytree_dataclass
class LinearConstraints:
    """Intervals `lower <= normals x <= upper`, a row each. `linear_constraints` makes checked ones."""

    normals: Float[Array, "..."]
    """(k, n); their lengths do not matter."""
    lower: Float[Array, "..."]
    """(k,), `-inf` where there is none. A row without both bounds has no effect."""
    upper: Float[Array, "..."]
    """(k,), `inf` where there is none."""
    names: tuple[str, ...] = field(metadata={"static": True})
    """What messages call the rows."""


def linear_constraints(
    normals: Numbers, lower: Numbers, upper: Numbers, names: Sequence[str] | None = None
) -> LinearConstraints:
    """Constraints `lower <= normals x <= upper` of which every row can be satisfied.

    Args:
        normals: (k, n), no row all zeros.
        lower: (k,) or one number for all rows; may be `-inf`.
        upper: As `lower`; may be `inf`.
        names: What to call the rows in messages; by default their numbers.

    Raises:
        ValueError: A shape does not fit, a number is not finite, a normal is zero, or a lower bound is above its
            upper bound; the message names the row.
    """
    normals = np.asarray(normals, dtype=float)
    if normals.ndim != 2 or len(normals) == 0:
        raise ValueError(f"normals: expected (k, n), a row for each constraint; got shape {normals.shape}.")
    rows = len(normals)
    names = tuple(f"row {k}" for k in range(rows)) if names is None else tuple(names)
    if len(names) != rows:
        raise ValueError(f"names: expected {rows}, one for each row of normals; got {len(names)}.")
    least, most = _bounds("lower", lower, rows), _bounds("upper", upper, rows)
    _refuse("normals", names, ~np.isfinite(normals).all(axis=1), "expected finite numbers", normals)
    _refuse("normals", names, ~normals.any(axis=1), "expected a direction; got zeros", None)
    _refuse("lower", names, np.isnan(least) | (least == np.inf), "expected a number or -inf", least)
    _refuse("upper", names, np.isnan(most) | (most == -np.inf), "expected a number or inf", most)
    _refuse("lower, upper", names, least > most, "expected lower <= upper", np.stack([least, most], axis=1))
    as_floats = partial(jnp.asarray, dtype=float)
    return LinearConstraints(as_floats(normals), as_floats(least), as_floats(most), names)


def feasible(constraints: LinearConstraints) -> bool:
    """Whether some x satisfies all rows together, by a linear program on the host."""
    return _some_point_satisfies(*_on_host(constraints))


def check_feasible(constraints: LinearConstraints) -> None:
    """Nothing where `feasible`; otherwise an error that names rows which contradict each other.

    Of these rows none can be spared: without any one of them the others can be satisfied (deletion filter: J. Chinneck,
    E. Dravnieks, "Locating minimal infeasible constraint sets in linear programs", 1991).

    Raises:
        ValueError: No x satisfies all rows.
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
    # The solver's tolerance is absolute: of unit normals it is one in units of x.
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    sides = np.concatenate([normals, -normals]) / np.tile(lengths, (2, 1))
    bounds = bounds / np.tile(lengths[:, 0], 2)
    present = np.isfinite(bounds)
    if not present.any():
        return True
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
