r"""Manifolds: states that are not vectors, and beliefs whose covariance is about increments.

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
    """A space of states, by how increments move points and which increment leads from one point to another."""

    retract: Callable[[Array, Array], Array]
    """`(x, delta) -> x`; increments have as many components as the tangent space has dimensions."""
    local: Callable[[Array, Array], Array]
    """`(x, other) -> delta`, with `retract(x, local(x, other)) == other`."""
    flat: bool = field(default=False, metadata={"static": True})
    """Whether the manifold is a vector space, where increments mean the same at every point."""


def add(x: Float[Array, " n"], delta: Float[Array, " n"]) -> Float[Array, " n"]:
    """The point of a vector space that an increment leads to.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> jf.manifold.add(jnp.array([1.0, 2.0]), jnp.array([0.5, 0.0])).tolist()
        [1.5, 2.0]
    """
    return x + delta


def displacement(x: Float[Array, " n"], other: Float[Array, " n"]) -> Float[Array, " n"]:
    """The increment from one point of a vector space to another.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> jf.manifold.displacement(jnp.array([1.0, 2.0]), jnp.array([1.5, 2.0])).tolist()
        [0.5, 0.0]
    """
    return other - x


euclidean = Manifold(add, displacement, flat=True)
"""Vector spaces."""


class Block(NamedTuple):
    """A part of a state that has a manifold of its own."""

    manifold: Manifold
    size: int
    """Number of components of a point."""
    dimension: int
    """Number of components of an increment."""


rotation = Block(Manifold(lie.so3_retract, lie.so3_local), 4, 3)
"""A unit quaternion `(w, x, y, z)`; increments are rotation vectors in radians about the axes of the rotated frame."""


def vector(size: int) -> Block:
    """A part that is a vector of `size` components.

    Examples:
        >>> import jaxfilters as jf
        >>> position = jf.manifold.vector(3)
        >>> position.size, position.dimension
        (3, 3)
    """
    return Block(euclidean, size, size)


def product(*blocks: Block) -> Manifold:
    """Manifold of states that are concatenated parts, each with its own manifold.

    Args:
        blocks: The parts, in the order of their components.

    Returns:
        The manifold. Its functions raise a `ValueError` for points and increments of another size.

    Raises:
        ValueError: If there is no block.
        TypeError: If an argument is no `Block`.

    Examples:
        The pose and velocity of a rigid body: 13 components with 12 dimensions.

        >>> import jaxfilters as jf
        >>> pose = jf.manifold.product(jf.manifold.vector(3), jf.manifold.rotation, jf.manifold.vector(6))
    """
    if not blocks:
        raise ValueError("product needs at least one block; got none.")
    for block in blocks:
        if not isinstance(block, Block):
            raise TypeError(f"product needs Blocks, such as rotation and vector(3); got a {type(block).__name__}.")
    whole = _Product(blocks)
    return Manifold(whole.retract, whole.local, flat=all(block.manifold.flat for block in blocks))


@pytree_dataclass
class _Product:
    blocks: tuple[Block, ...] = field(metadata={"static": True})

    def retract(self, x: Array, delta: Array) -> Array:
        sizes, dimensions = [block.size for block in self.blocks], [block.dimension for block in self.blocks]
        parts = zip(self.blocks, _parts("state", x, sizes), _parts("increment", delta, dimensions), strict=True)
        return jnp.concatenate([block.manifold.retract(*pair) for block, *pair in parts])

    def local(self, x: Array, other: Array) -> Array:
        sizes = [block.size for block in self.blocks]
        parts = zip(self.blocks, _parts("state", x, sizes), _parts("state", other, sizes), strict=True)
        return jnp.concatenate([block.manifold.local(*pair) for block, *pair in parts])


def _parts(name, x, sizes):
    if jnp.shape(x) != (sum(sizes),):
        raise ValueError(f"a {name} of this product must have the shape ({sum(sizes)},); got {jnp.shape(x)}.")
    stops = [sum(sizes[: i + 1]) for i in range(len(sizes))]
    return [x[stop - size : stop] for size, stop in zip(sizes, stops, strict=True)]


def hashable(manifold: Manifold) -> Manifold:
    """The manifold with its functions as pytrees, so that arrays in them are parameters of the filter."""
    return Manifold(as_pytree(manifold.retract), as_pytree(manifold.local), manifold.flat)


def increments(belief: Belief) -> Belief:
    """Belief about the increment from the mean: the same covariance about zero.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> belief = jf.manifold.increments(jf.Gaussian(jnp.array([5.0]), 2.0 * jnp.eye(1)))
        >>> belief.mean.tolist(), belief.covariance.tolist()
        ([0.0], [[2.0]])
    """
    return with_mean(belief, jnp.zeros(dimension(belief), belief.mean.dtype))


def dimension(belief: Belief) -> int:
    """Dimension of the tangent space.

    Examples:
        An orientation, as a quaternion of four numbers, has three degrees of freedom.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> jf.manifold.dimension(jf.Gaussian(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.eye(3)))
        3
    """
    return (belief.covariance if isinstance(belief, Gaussian) else belief.root).shape[0]


def with_mean(belief: Belief, mean: Float[Array, " size"], J: Float[Array, "m n"] | None = None) -> Belief:
    """Belief with another mean; its covariance becomes `J P J^T` if J is given.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> belief = jf.Gaussian(jnp.array([1.0]), jnp.eye(1))
        >>> moved = jf.manifold.with_mean(belief, jnp.array([5.0]), J=jnp.array([[2.0]]))
        >>> moved.mean.tolist(), moved.covariance.tolist()
        ([5.0], [[4.0]])
    """
    if isinstance(belief, Gaussian):
        return Gaussian(mean, belief.covariance if J is None else factor.turned(J, belief.covariance))
    return GaussianRoot(mean, belief.root if J is None else linalg.matmul(J, belief.root))


def retract_belief(manifold: Manifold, x: Array, belief: Belief) -> Belief:
    """Belief about `x ⊞ delta`, given that about delta: its covariance is in the tangent space at the new mean.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> delta = jf.Gaussian(jnp.array([1.0]), jnp.eye(1))
        >>> jf.manifold.retract_belief(jf.manifold.euclidean, jnp.array([5.0]), delta).mean.tolist()
        [6.0]
    """
    mean = manifold.retract(x, belief.mean)
    if manifold.flat:
        return with_mean(belief, mean)
    return with_mean(
        belief, mean, jax.jacfwd(lambda delta: manifold.local(mean, manifold.retract(x, delta)))(belief.mean)
    )


def to_tangent(manifold: Manifold, x: Array, belief: Belief) -> Belief:
    """Belief about the increment delta from x, given that about `x ⊞ delta`; the inverse of `retract_belief`.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> belief = jf.Gaussian(jnp.array([6.0]), jnp.eye(1))
        >>> jf.manifold.to_tangent(jf.manifold.euclidean, jnp.array([5.0]), belief).mean.tolist()
        [1.0]
    """
    mean = manifold.local(x, belief.mean)
    if manifold.flat:
        return with_mean(belief, mean)
    zero = jnp.zeros(dimension(belief), mean.dtype)
    return with_mean(belief, mean, jax.jacfwd(lambda e: manifold.local(x, manifold.retract(belief.mean, e)))(zero))
