"""A bank of Gaussian filters, one for each mode of a system that switches between several models.

Filters of one builder whose parameters have the same shapes differ in numbers only. They are run as one filter with
a batch of parameters, which is a program of the size of one filter; others run one after another.
"""

from collections.abc import Callable, Sequence
from dataclasses import field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.manifold import Manifold, euclidean
from jaxfilters.typing import only_inputs

_TOLERANCE = 1e-4
"""Of sums of probabilities: far above the rounding of float32, far below a mistake."""


@pytree_dataclass
class Separate:
    """Filters that run one after another."""

    filters: tuple[Filter, ...]

    @property
    def count(self) -> int:
        """Number of filters."""
        return len(self.filters)

    def apply(self, function: Callable[..., Any], *columns: Sequence[PyTree]) -> tuple[Any, ...]:
        """Results of `function(filter, *row)` for each filter, with its row of the columns."""
        return tuple(map(function, self.filters, *columns))

    def apply_to_ensemble(self, function: Callable[..., Any], ensemble: PyTree) -> Any:
        """Results of `function(filter, element)` along the last axis, whose equal parts are those of the filters."""
        parts = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], self.count, -1), ensemble)
        found = [
            jax.vmap(partial(function, filter), -1, -1)(jax.tree.map(lambda leaf, i=i: leaf[..., i, :], parts))
            for i, filter in enumerate(self.filters)
        ]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=-1), *found)


@pytree_dataclass
class Stacked:
    """Filters that differ in numbers only, as one whose parameters are batched along the last axis."""

    filter: Filter
    axes: tuple[int | None, ...] = field(metadata={"static": True})
    """For each leaf of the parameters -1, or None where all filters share it."""
    count: int = field(metadata={"static": True})

    def apply(self, function: Callable[..., Any], *columns: Sequence[PyTree]) -> tuple[Any, ...]:
        """Results of `function(filter, *row)` for each filter, with its row of the columns."""
        stacked = [jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1), *column) for column in columns]
        found = jax.vmap(function, (self._filter_axes(), *[-1] * len(columns)), -1)(self.filter, *stacked)
        return tuple(jax.tree.map(lambda leaf, i=i: leaf[..., i], found) for i in range(self.count))

    def apply_to_ensemble(self, function: Callable[..., Any], ensemble: PyTree) -> Any:
        """Results of `function(filter, element)` along the last axis, whose equal parts are those of the filters."""
        size = jax.tree.leaves(ensemble)[0].shape[-1] // self.count
        rows = zip(jax.tree.leaves(self.filter), self.axes, strict=True)
        repeated = [leaf if axis is None else jnp.repeat(leaf, size, axis=axis) for leaf, axis in rows]
        filter = jax.tree.unflatten(jax.tree.structure(self.filter), repeated)
        return jax.vmap(function, (self._filter_axes(), -1), -1)(filter, ensemble)

    def _filter_axes(self) -> Any:
        return jax.tree.unflatten(jax.tree.structure(self.filter), self.axes)


Bank = Separate | Stacked


def bank_of(filters: Sequence[Filter]) -> Bank:
    """The filters as one batch where they differ in numbers only."""
    structures: list[Any] = [jax.tree.structure(filter) for filter in filters]
    leaves = [jax.tree.leaves(filter) for filter in filters]
    kinds = [[(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in of] for of in leaves]
    alike = all(structure == structures[0] for structure in structures) and all(kind == kinds[0] for kind in kinds)
    rows = list(zip(*leaves, strict=True)) if alike else []
    axes = tuple(None if all(leaf is row[0] for leaf in row) else -1 for row in rows)
    if set(axes) <= {None}:
        return Separate(tuple(filters))
    joined = [
        row[0] if axis is None else jnp.stack([jnp.asarray(leaf) for leaf in row], axis=axis)
        for row, axis in zip(rows, axes, strict=True)
    ]
    return Stacked(jax.tree.unflatten(structures[0], joined), axes, len(filters))


def check_filters(filters: Any, *, one_size: str | None) -> list[Gaussian | GaussianRoot]:
    """Shapes of the states of a bank, which must be Gaussians in one arithmetic, on one manifold.

    Args:
        filters: What a user passes as the list of filters.
        one_size: What to do where states have different sizes, for the message; `None` allows that.
    """
    if isinstance(filters, Filter) or not isinstance(filters, Sequence):
        raise TypeError(f"filters must be a list of Filters, one for each mode; got a {type(filters).__name__}.")
    if not filters:
        raise ValueError("filters must hold at least one Filter; got an empty list.")
    states = []
    for i, filter in enumerate(filters):
        checks.is_filter(f"filters[{i}]", filter)
        state = jax.eval_shape(filter.init, filter.params, jax.eval_shape(jax.random.key, 0))
        if not isinstance(state, Gaussian | GaussianRoot):
            raise ValueError(
                f"filters[{i}] must be a filter whose state is a Gaussian or a GaussianRoot, such as kalman and "
                f"extended_kalman make; its state is a {type(state).__name__}."
            )
        states.append(state)
    kinds = [type(state).__name__ for state in states]
    if len(set(kinds)) > 1:
        raise ValueError(f"filters must all have states of one kind, Gaussian or GaussianRoot; got {', '.join(kinds)}.")
    types = [str(state.mean.dtype) for state in states]
    if len(set(types)) > 1:
        raise ValueError(f"filters must all have states of one float type; got {', '.join(types)}.")
    sizes = [state.mean.size for state in states]
    if one_size is not None and len(set(sizes)) > 1:
        raise ValueError(f"filters must have states of one size{one_size}; got the sizes {', '.join(map(str, sizes))}.")
    spaces = [manifold_of(filter) for filter in filters]
    structures: list[Any] = [jax.tree.structure(euclidean if space.flat else space) for space in spaces]
    if any(structure != structures[0] for structure in structures):
        raise ValueError("filters must all have states on one manifold; got different ones.")
    return states


def manifold_of(filter: Filter) -> Manifold:
    """The space of the states of a Gaussian filter, or of one that is wrapped around it."""
    params = filter.params
    while not hasattr(params, "manifold") and isinstance(getattr(params, "inner", None), Filter):
        params = params.inner.params
    return getattr(params, "manifold", euclidean)


def transition_of(value: Any, count: int) -> Array | Callable[..., Any]:
    """The transition probabilities of the modes: a checked matrix, or a function of the inputs as a pytree."""
    if callable(value):
        return only_inputs("transition_matrix", value)
    return transition_matrix("transition_matrix", value, count)


def transition_at(transition: Array | Callable[..., Any], inputs: PyTree, count: int) -> Array:
    """The matrix of one step."""
    if not callable(transition):
        return transition
    return transition_matrix("the result of transition_matrix", transition(inputs), count)


def transition_matrix(name: str, value: Any, count: int) -> Array:
    """The matrix, whose rows must be probabilities where it is concrete."""
    matrix = _probabilities(name, value, (count, count), "from the mode of the row to that of the column")
    known = checks.concrete(matrix)
    if known is None or np.all(abs(known.sum(axis=1) - 1) < _TOLERANCE):
        return matrix
    row = int(np.argmax(abs(known.sum(axis=1) - 1)))
    turned = " Its columns (axis 0) do: pass the transpose." if np.all(abs(known.sum(axis=0) - 1) < _TOLERANCE) else ""
    raise ValueError(
        f"{name} must have rows (axis 1) that sum to one, as its element [i, j] is the probability of mode j after "
        f"mode i; row {row} is {known[row].tolist()}, with the sum {known[row].sum():.6g}.{turned}"
    )


def initial_probabilities(name: str, value: Any, count: int) -> Array:
    """The vector, which must be probabilities where it is concrete."""
    vector = _probabilities(name, value, (count,), "one for each of the filters")
    known = checks.concrete(vector)
    if known is not None and abs(known.sum() - 1) >= _TOLERANCE:
        raise ValueError(f"{name} must sum to one; got {known.tolist()}, with the sum {known.sum():.6g}.")
    return vector


def _probabilities(name: str, value: Any, shape: tuple[int, ...], meaning: str) -> Array:
    array = jnp.asarray(value)
    array = array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)
    if array.shape != shape:
        raise ValueError(f"{name} must have the shape {shape}, {meaning}; got {array.shape}.")
    known = checks.concrete(array)
    if known is not None and not np.all((known >= 0) & np.isfinite(known)):
        raise ValueError(f"{name} must be probabilities, finite and not negative; got {known.tolist()}.")
    return array
