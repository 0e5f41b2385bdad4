"""Unconstrained coordinates of a pytree of parameters: one flat vector that an optimiser moves freely, and back."""

import math
from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.constraints import Box, Constraint, Fixed, Interval, coordinate_bounds

_SAME_COORDINATES = 1e-2
"""Relative difference below which coordinates count as equal; another turn of a rotation differs by far more."""


@pytree_dataclass
class Parametrization:
    """A bijection between constrained parameters and a vector of coordinates, about the start of a search."""

    origin: PyTree
    """The parameters from which the search started."""
    constraints: tuple[Constraint, ...] = field(metadata={"static": True})
    """One constraint for each leaf of `origin`, in the order of `jax.tree.leaves`."""

    def unconstrain(self, theta: PyTree) -> Float[Array, " d"]:
        """The coordinates of parameters: those of all leaves, concatenated."""
        triples = zip(self.constraints, jax.tree.leaves(theta), self.leaves, strict=True)
        return jnp.concatenate([jnp.zeros(0)] + [c.unconstrain(leaf, origin).ravel() for c, leaf, origin in triples])

    def constrain(self, z: Float[Array, " d"]) -> PyTree:
        """The parameters with these coordinates: the inverse of `unconstrain`."""
        values, start = [], 0
        for constraint, shape, origin in zip(self.constraints, self.shapes, self.leaves, strict=True):
            stop = start + math.prod(shape)
            values.append(constraint.constrain(z[start:stop].reshape(shape), origin))
            start = stop
        return jax.tree.unflatten(jax.tree.structure(self.origin), values)

    def log_volume(self, z: Float[Array, " d"], without: type | tuple[type, ...] = ()) -> Float[Array, ""]:
        """Logarithm of the factor by which `constrain` stretches volume about z: the log Jacobian of a density.

        Up to a constant, for sets with fewer dimensions than numbers (probabilities, symmetric matrices, quaternions)
        the volume is that of the set itself. It is `-inf` where coordinates do not belong to one value only: rotation
        vectors longer than half a turn. Leaves whose constraint is an instance of `without` are left out.
        """
        total, start = jnp.zeros((), z.dtype), 0
        for constraint, shape, origin in zip(self.constraints, self.shapes, self.leaves, strict=True):
            stop = start + math.prod(shape)
            if stop > start and not isinstance(constraint, without):
                total = total + _log_volume(constraint, z[start:stop].reshape(shape), origin)
            start = stop
        return total

    def bounds(self) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
        """Lower and upper bounds of the coordinates; infinite except for boxes."""
        pairs = [coordinate_bounds(c, math.prod(s)) for c, s in zip(self.constraints, self.shapes, strict=True)]
        lower, upper = zip(*pairs, strict=True)
        return jnp.concatenate(lower), jnp.concatenate(upper)

    @property
    def leaves(self) -> list[Array]:
        """The leaves of the origin."""
        return jax.tree.leaves(self.origin)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """The shape of the coordinates of each leaf."""
        return [
            jax.eval_shape(constraint.unconstrain, leaf, leaf).shape
            for constraint, leaf in zip(self.constraints, self.leaves, strict=True)
        ]

    @property
    def names(self) -> list[str]:
        """The name of the leaf to which each coordinate belongs."""
        counts = [math.prod(shape) for shape in self.shapes]
        return [name for name, count in zip(leaf_names(self.origin), counts, strict=True) for _ in range(count)]


def _log_volume(constraint: Constraint, coordinates: Array, origin: Array) -> Float[Array, ""]:
    def constrain(coordinates: Array) -> Array:
        return constraint.constrain(coordinates, origin)

    if constraint.elementwise:
        _, slope = jax.jvp(constrain, (coordinates,), (jnp.ones_like(coordinates),))
        return jnp.sum(jnp.log(slope))
    J = jax.jacfwd(lambda flat: constrain(flat.reshape(coordinates.shape)).ravel())(coordinates.ravel())
    _, log_gram = jnp.linalg.slogdet(jnp.matmul(J.T, J, precision="highest"))
    again = constraint.unconstrain(constrain(coordinates), origin)
    apart = jnp.max(jnp.abs(again - coordinates) / (1 + jnp.abs(coordinates)))
    return jnp.where(apart < _SAME_COORDINATES, 0.5 * log_gram, -jnp.inf)


def parametrize(start: PyTree, constraints: PyTree) -> Parametrization:
    """The parametrization about `start` with `constraints`, one constraint for every leaf or for every branch.

    Raises:
        ValueError: If the tree of `constraints` is not a prefix of `start`, or a leaf of it is not a constraint.
    """
    try:
        per_leaf = jax.tree.map(
            lambda constraint, branch: jax.tree.map(lambda _: constraint, branch),
            constraints,
            start,
            is_leaf=lambda node: isinstance(node, Constraint),
        )
    except ValueError as error:
        raise ValueError(f"constraints must have the tree structure of start, or a prefix of it: {error}") from None
    each = jax.tree.leaves(per_leaf, is_leaf=lambda node: isinstance(node, Constraint))
    for constraint in each:
        if not isinstance(constraint, Constraint):
            raise ValueError(f"constraints must hold constraints such as fit.positive; got {constraint!r}.")
    pairs = zip(each, jax.tree.leaves(start), strict=True)
    leaves = [jnp.asarray(leaf, None if isinstance(c, Fixed) else float) for c, leaf in pairs]
    origin = jax.tree.unflatten(jax.tree.structure(start), leaves)
    return Parametrization(origin, tuple(each))


def with_box_bounds(parametrization: Parametrization) -> Parametrization:
    """The same parametrization with intervals as boxes, for methods that support bounds."""
    boxes = [Box(c.lower, c.upper) if isinstance(c, Interval) else c for c in parametrization.constraints]
    return Parametrization(parametrization.origin, tuple(boxes))


def without_box_bounds(parametrization: Parametrization) -> Parametrization:
    """The same parametrization with boxes as intervals: the inverse of `with_box_bounds`."""
    intervals = [Interval(c.lower, c.upper) if isinstance(c, Box) else c for c in parametrization.constraints]
    return Parametrization(parametrization.origin, tuple(intervals))


def check_start(parametrization: Parametrization, argument: str = "start") -> None:
    """Reject an origin that violates its constraints; tracers, whose values are not known, are not checked.

    Raises:
        ValueError: Naming the leaf of `argument`, the condition that it violates and its value.
    """
    names = leaf_names(parametrization.origin)
    for name, constraint, leaf in zip(names, parametrization.constraints, parametrization.leaves, strict=True):
        if not isinstance(leaf, jax.core.Tracer) and not constraint.contains(np.asarray(leaf)):
            value = np.array2string(np.asarray(leaf), precision=6, threshold=20)
            raise ValueError(f"{argument}{name} must be {constraint.description}; got {value}.")


def leaf_names(tree: PyTree) -> list[str]:
    """The path of every leaf as a string, for example `['noise'][0]`."""
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)]
