"""A pytree of parameters as one vector of coordinates without limits, and back."""

import math
from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.constraints import Box, Constraint, Fixed, Interval, bounds


@pytree_dataclass
class Chart:
    """Coordinates of parameters about those where a search began."""

    origin: PyTree
    constraints: tuple[Constraint, ...] = field(metadata={"static": True})
    """One for each leaf, in order."""

    def coordinates(self, theta: PyTree) -> Float[Array, " d"]:
        """The coordinates, one leaf behind the other."""
        triples = zip(self.constraints, jax.tree.leaves(theta), self.leaves, strict=True)
        return jnp.concatenate([jnp.zeros(0)] + [c.coordinates(leaf, origin).ravel() for c, leaf, origin in triples])

    def point(self, z: Float[Array, " d"]) -> PyTree:
        """The parameters with these coordinates."""
        points, start = [], 0
        for constraint, shape, origin in zip(self.constraints, self.shapes, self.leaves, strict=True):
            stop = start + math.prod(shape)
            points.append(constraint.point(z[start:stop].reshape(shape), origin))
            start = stop
        return jax.tree.unflatten(jax.tree.structure(self.origin), points)

    def bounds(self) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
        """Lower and upper bounds of the coordinates."""
        pairs = [bounds(c, jnp.zeros(math.prod(s))) for c, s in zip(self.constraints, self.shapes, strict=True)]
        lower, upper = zip(*pairs, strict=True)
        return jnp.concatenate(lower), jnp.concatenate(upper)

    @property
    def leaves(self) -> list[Array]:
        """Those of the origin."""
        return jax.tree.leaves(self.origin)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Shapes of the leaves' coordinates."""
        return [
            jax.eval_shape(constraint.coordinates, leaf, leaf).shape
            for constraint, leaf in zip(self.constraints, self.leaves, strict=True)
        ]

    @property
    def names(self) -> list[str]:
        """Path of the leaf of each coordinate."""
        counts = [math.prod(shape) for shape in self.shapes]
        return [path for path, count in zip(paths(self.origin), counts, strict=True) for _ in range(count)]


def chart_about(start: PyTree, constraints: PyTree) -> Chart:
    """Chart about `start` with `constraints`, one constraint for every leaf or for every branch.

    Raises:
        ValueError: If `constraints` is no prefix of `start`, or holds something else.
    """
    try:
        spread = jax.tree.map(
            lambda constraint, branch: jax.tree.map(lambda _: constraint, branch),
            constraints,
            start,
            is_leaf=lambda node: isinstance(node, Constraint),
        )
    except ValueError as error:
        raise ValueError(f"constraints must be like start, or a prefix of it: {error}") from None
    each = jax.tree.leaves(spread, is_leaf=lambda node: isinstance(node, Constraint))
    for constraint in each:
        if not isinstance(constraint, Constraint):
            raise ValueError(f"constraints must hold constraints such as fit.positive; got {constraint!r}.")
    pairs = zip(each, jax.tree.leaves(start), strict=True)
    leaves = [jnp.asarray(leaf, None if isinstance(c, Fixed) else float) for c, leaf in pairs]
    origin = jax.tree.unflatten(jax.tree.structure(start), leaves)
    return Chart(origin, tuple(each))


def boxed(chart: Chart) -> Chart:
    """The chart with intervals as boxes, in their own coordinates."""
    boxes = [Box(c.lower, c.upper) if isinstance(c, Interval) else c for c in chart.constraints]
    return Chart(chart.origin, tuple(boxes))


def check_inside(chart: Chart) -> None:
    """Reject an origin outside its constraints; under `vmap` and `jit`, where values are not known, do nothing.

    Raises:
        ValueError: Naming the leaf, what it must be and what it is.
    """
    for path, constraint, leaf in zip(paths(chart.origin), chart.constraints, chart.leaves, strict=True):
        if not isinstance(leaf, jax.core.Tracer) and not constraint.contains(np.asarray(leaf)):
            shown = np.array2string(np.asarray(leaf), precision=6, threshold=20)
            raise ValueError(f"start{path} must be {constraint.wanted}; got {shown}.")


def paths(tree: PyTree) -> list[str]:
    """Path of every leaf, as in `['noise'][0]`."""
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)]
