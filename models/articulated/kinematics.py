"""Where the joints of an articulated hand are: rotations with a scale, and finger chains in the palm frame.

Source: Shimada et al., equations [9], [10]; frames as in `jaxfilters.models.articulated.layout`. Written as sums of
elementwise products: accelerators would round the inputs of matrix products, and one equation for each component makes
programs of thousands of equations out of second derivatives.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.articulated.layout import Layout


class FingerFrames(NamedTuple):
    """Where each finger's chain begins and in which plane it bends, palm frame."""

    origin: Float[Array, "fingers 3"]
    """First joint, in the unit of the lengths."""
    along: Float[Array, "fingers 3"]
    """Unit vector of a straight finger."""
    bend: Float[Array, "fingers 3"]
    """Unit vector towards which it bends."""


Pivot = Callable[[Float[Array, " fingers"], Float[Array, "fingers 3"], Float[Array, "fingers 3 3"]], FingerFrames]
"""What abduction turns the finger about: `(abduction, base, frame) -> FingerFrames`."""


_CROSS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]]
)
"""`_CROSS @ v` is the matrix of the cross product with v from the left."""


@jax.jit  # traced once for each shape, though called at many places of a program
def scaled_rotation(q: Float[Array, " 4"]) -> Float[Array, "3 3"]:
    """|q|^2 times the rotation matrix of q = (w, x, y, z): a polynomial, hence smooth even at q = 0.

    `R R^T = |q|^4 I` and `det R = |q|^6`.
    """
    w, v = q[0], q[1:]
    across = jnp.sum(jnp.asarray(_CROSS, q.dtype) * v, axis=-1)
    square = jnp.eye(3, dtype=q.dtype) * (w * w - jnp.sum(v * v))
    return square + 2 * (v[:, None] * v + w * across)


def unit_rotation(q: Float[Array, " 4"]) -> Float[Array, "3 3"]:
    """The rotation matrix of q, whatever its length; q must not be zero."""
    return scaled_rotation(q) / jnp.sum(q * q)


@jax.jit  # traced once for each shape, though called at many places of a program
def turn(matrix: Float[Array, "3 3"], points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """`matrix` times each point."""
    return jnp.sum(matrix * points[..., None, :], axis=-1)


def pivot_base(
    abduction: Float[Array, " fingers"], base: Float[Array, "fingers 3"], frame: Float[Array, "fingers 3 3"]
) -> FingerFrames:
    """Abduction turns the finger about its own first joint, anatomically: [9] corrected."""
    cos, sin = jnp.cos(abduction)[:, None], jnp.sin(abduction)[:, None]
    return FingerFrames(base, cos * frame[..., 0] - sin * frame[..., 2], frame[..., 1])


def pivot_wrist(
    abduction: Float[Array, " fingers"], base: Float[Array, "fingers 3"], frame: Float[Array, "fingers 3 3"]
) -> FingerFrames:
    """Abduction turns the finger with its first joint about the wrist: [9] as printed."""
    turned = (_turn_y(abduction, vector) for vector in (base, frame[..., 0], frame[..., 1]))
    return FingerFrames(*turned)


def finger_frames(x: Float[Array, " n"], layout: Layout, *, pivot: Pivot = pivot_base) -> FingerFrames:
    """First joints and bending planes of all fingers."""
    width, height, _ = x[layout.palm]
    along, across = jnp.asarray(layout.base_shares, x.dtype).T
    base = jnp.stack([along * height, jnp.zeros_like(along), across * width], axis=1)
    return pivot(layout.angles_of(x)[:, 0], base, jnp.asarray(layout.frame_matrices, x.dtype))


def flexion_sums(x: Float[Array, " n"], layout: Layout) -> Float[Array, "fingers 3"]:
    """Psi of each link [10]: its angle to the straight finger, radians."""
    return _running_sums(layout.angles_of(x)[:, 1:])


def finger_points(x: Float[Array, " n"], layout: Layout, *, pivot: Pivot = pivot_base) -> Float[Array, "fingers 4 3"]:
    """Joints of every finger from its base to its tip in the palm frame, in the unit of the lengths [9], [10]."""
    origin, along, bend = finger_frames(x, layout, pivot=pivot)
    psi, lengths = flexion_sums(x, layout), layout.lengths_of(x)
    forward, inward = _running_sums(lengths * jnp.cos(psi)), _running_sums(lengths * jnp.sin(psi))
    rest = origin[:, None] + forward[..., None] * along[:, None] + inward[..., None] * bend[:, None]
    return jnp.concatenate([origin[:, None], rest], axis=1)


def _turn_y(angle, vectors):
    """Vectors turned about the palm's normal."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    return jnp.stack([cos * x + sin * z, y, cos * z - sin * x], axis=1)


def _running_sums(columns):
    first, second, third = columns[:, 0], columns[:, 1], columns[:, 2]
    return jnp.stack([first, first + second, first + second + third], axis=1)
