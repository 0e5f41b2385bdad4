"""Checks of what users pass to samplers: shapes and types when traced, values where they are concrete."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxfilters.filter import Filter
from jaxfilters.particle.bootstrap import Bootstrap
from jaxfilters.particle.checks import concrete
from jaxfilters.particle.tempering import no_tempering


def check_bootstrap(filter: Any, name: str = "filter") -> None:
    """Require a filter made by `bootstrap`, of at least 2 particles, whose likelihoods are not tempered."""
    if not isinstance(filter, Filter) or not isinstance(filter.params, Bootstrap):
        got = f"a {type(filter).__name__} of {type(filter.params).__name__}" if isinstance(filter, Filter) else filter
        raise TypeError(f"{name} must be a Filter made by bootstrap; got {got}.")
    if filter.params.num_particles < 2:
        raise ValueError(f"num_particles of {name} must be at least 2; got {filter.params.num_particles}.")
    if getattr(filter.params.temper, "func", None) is not no_tempering:
        raise ValueError(f"{name} must not temper its likelihoods; got temper={filter.params.temper!r}.")


def shared_length(**arguments: PyTree) -> int:
    """The length that the leaves of all arguments have along their first axis; the first argument must have a leaf."""
    shapes = {
        f"{name}{jax.tree_util.keystr(path)}": jnp.shape(leaf)
        for name, tree in arguments.items()
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
    names = ", ".join(arguments)
    if not jax.tree.leaves(next(iter(arguments.values()))):
        raise ValueError(f"{next(iter(arguments))} must have at least one array with time as its first axis; got none.")
    lengths = {shape[:1] for shape in shapes.values()}
    if len(lengths) != 1 or () in lengths:
        raise ValueError(f"{names} must share one length along their first axis; got shapes {shapes}.")
    return lengths.pop()[0]


def check_path(path: PyTree, particles: PyTree, length: int) -> None:
    """Require a trajectory with a row for each of `length` frames and one before them; `None` passes."""
    if path is None:
        return
    structures: tuple[Any, Any] = (jax.tree.structure(path), jax.tree.structure(particles))
    if structures[0] != structures[1]:
        raise ValueError(
            f"path must have the structure of what sample_prior draws, {structures[1]}; got {structures[0]}."
        )
    for (where, leaf), ensemble in zip(
        jax.tree_util.tree_leaves_with_path(path), jax.tree.leaves(particles), strict=True
    ):
        expected = (length + 1, *jnp.shape(ensemble)[:-1])
        if jnp.shape(leaf) != expected:
            raise ValueError(
                f"path{jax.tree_util.keystr(where)} must have the shape {expected}, a row before the first of {length} "
                f"frames and one for each; got {jnp.shape(leaf)}."
            )


def check_count(name: str, count: Any, at_least: int = 1) -> None:
    """Require a Python integer, not a boolean, of at least `at_least`."""
    if isinstance(count, bool) or not isinstance(count, int) or count < at_least:
        raise ValueError(f"{name} must be an integer of at least {at_least}; got {count!r}.")


def check_where_concrete(value: Any, holds: Callable[[np.ndarray], Any], message: str) -> None:
    """Raise a `ValueError` where a value is concrete and a condition on it fails; `message` has a place for it."""
    known = concrete(value)
    if known is not None and not np.all(holds(known)):
        raise ValueError(message.format(known))


def num_chains(theta: PyTree, name: str = "theta") -> int:
    """The size of the last axis that all leaves share, one element a chain."""
    shapes = {
        f"{name}{jax.tree_util.keystr(path)}": jnp.shape(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(theta)
    }
    counts = {shape[-1:] for shape in shapes.values()}
    if len(counts) != 1 or () in counts:
        raise ValueError(
            f"{name} must have leaves that share their last axis, one element a chain; got shapes {shapes}."
        )
    return counts.pop()[0]


def scalar(name: str, value: Any) -> Any:
    """The result of a callback, which must be one real number."""
    leaves = jax.tree.leaves(value)
    if len(leaves) != 1 or leaves[0] is not value or jnp.issubdtype(jnp.result_type(value), jnp.complexfloating):
        raise TypeError(f"{name} must return one real number; got {value!r}.")
    if jnp.shape(value) != ():
        raise ValueError(f"{name} must return a scalar, of shape (); got the shape {jnp.shape(value)}.")
    return jnp.asarray(value, float)
