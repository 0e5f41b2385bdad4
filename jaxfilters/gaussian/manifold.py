r"""States that are not vectors: points that increments move, with beliefs whose covariance is about the increments.

A belief on a manifold has its mean there, as an array of numbers, and its covariance in the tangent space at the mean:
$x = m \boxplus \delta$, $\delta \sim N(0, P)$ (C. Hertzberg et al., "Integrating generic sensor fusion algorithms with
sound state representations through encapsulation of manifolds", Information Fusion 14(1), 2013).
"""

from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.math import lie, linalg
from jaxfilters.typing import as_pytree

Belief = Gaussian | GaussianRoot


@pytree_dataclass
class Manifold:
    """How increments move points, and which increment leads from one point to another."""

    retract: Callable[[Array, Array], Array]
    """`(x, delta) -> x`; increments have as many components as the tangent space has dimensions."""
    local: Callable[[Array, Array], Array]
    """`(x, other) -> delta`, with `retract(x, local(x, other)) == other`."""
    flat: bool = field(default=False, metadata={"static": True})
    """Whether the manifold is a vector space, where increments mean the same at every point."""


def add(x: Float[Array, " n"], delta: Float[Array, " n"]) -> Float[Array, " n"]:
    """Move a point of a vector space."""
    return x + delta


def displacement(x: Float[Array, " n"], other: Float[Array, " n"]) -> Float[Array, " n"]:
    """The increment from one point of a vector space to another."""
    return other - x


euclidean = Manifold(add, displacement, flat=True)


class Block(NamedTuple):
    """A run of numbers in a state that moves on a manifold of its own."""

    manifold: Manifold
    size: int
    """How many numbers a point has."""
    dimension: int
    """How many an increment has."""


rotation = Block(Manifold(lie.so3_retract, lie.so3_local), 4, 3)
"""A unit quaternion `(w, x, y, z)`, turned by rotation vectors in radians about axes that turn with it."""


def vector(size: int) -> Block:
    """Numbers without further structure."""
    return Block(euclidean, size, size)


def product(*blocks: Block) -> Manifold:
    """States that are runs of numbers one behind the other, each on its own manifold.

    A rigid body's pose and velocity: `product(vector(3), rotation, vector(6))`, 13 numbers with 12 dimensions.

    Raises:
        ValueError: If there is no block.
    """
    if not blocks:
        raise ValueError("product needs at least one block; got none.")
    both = _Product(blocks)
    return Manifold(both.retract, both.local, flat=all(block.manifold.flat for block in blocks))


@pytree_dataclass
class _Product:
    blocks: tuple[Block, ...] = field(metadata={"static": True})

    def retract(self, x: Array, delta: Array) -> Array:
        sizes, dimensions = [block.size for block in self.blocks], [block.dimension for block in self.blocks]
        parts = zip(self.blocks, _runs(x, sizes), _runs(delta, dimensions), strict=True)
        return jnp.concatenate([block.manifold.retract(*pair) for block, *pair in parts])

    def local(self, x: Array, other: Array) -> Array:
        sizes = [block.size for block in self.blocks]
        parts = zip(self.blocks, _runs(x, sizes), _runs(other, sizes), strict=True)
        return jnp.concatenate([block.manifold.local(*pair) for block, *pair in parts])


def _runs(x, sizes):
    stops = [sum(sizes[: i + 1]) for i in range(len(sizes))]
    return [x[stop - size : stop] for size, stop in zip(sizes, stops, strict=True)]


def hashable(manifold: Manifold) -> Manifold:
    """The manifold with its functions as pytrees: their parameters are leaves."""
    return Manifold(as_pytree(manifold.retract), as_pytree(manifold.local), manifold.flat)


def increments(belief: Belief) -> Belief:
    """Belief in the increment from the mean: the same covariance about zero."""
    return with_mean(belief, jnp.zeros(dimension(belief), belief.mean.dtype))


def dimension(belief: Belief) -> int:
    """Dimensions of the tangent space."""
    return (belief.covariance if isinstance(belief, Gaussian) else belief.root).shape[0]


def with_mean(belief: Belief, mean: Float[Array, " size"], J: Float[Array, "m n"] | None = None) -> Belief:
    """Belief with this mean, its covariance `J P J^T` where a J is given."""
    if isinstance(belief, Gaussian):
        return Gaussian(mean, belief.covariance if J is None else factor.turned(J, belief.covariance))
    return GaussianRoot(mean, belief.root if J is None else linalg.matmul(J, belief.root))


def retract_belief(manifold: Manifold, x: Array, belief: Belief) -> Belief:
    """Belief in `x ⊞ delta`, given that in delta: its mean moved, its covariance in the tangent space there."""
    mean = manifold.retract(x, belief.mean)
    if manifold.flat:
        return with_mean(belief, mean)
    return with_mean(
        belief, mean, jax.jacfwd(lambda delta: manifold.local(mean, manifold.retract(x, delta)))(belief.mean)
    )


def to_tangent(manifold: Manifold, x: Array, belief: Belief) -> Belief:
    """Belief in the increment delta from x, given that in `x ⊞ delta`; the inverse of `settle`."""
    mean = manifold.local(x, belief.mean)
    if manifold.flat:
        return with_mean(belief, mean)
    zero = jnp.zeros(dimension(belief), mean.dtype)
    return with_mean(belief, mean, jax.jacfwd(lambda e: manifold.local(x, manifold.retract(belief.mean, e)))(zero))
