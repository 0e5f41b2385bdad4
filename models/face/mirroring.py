"""Landmarks as pairs of right and left: the ten of the trackers, and the 68 of iBUG; symmetric halves of a shape."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.face.landmarks import MEAN_SHAPE, MIRROR

Pairs = Sequence[tuple[int, int]]
"""(right, left) indices of landmarks, in the subject's sense; the others lie on the midline."""

PAIRS = tuple((k, other) for k, other in enumerate(MIRROR) if MEAN_SHAPE[k, 0] < 0)
"""Of the ten landmarks."""
PAIRS_68 = (
    *((k, 16 - k) for k in range(8)),
    *((17 + k, 26 - k) for k in range(5)),
    *((31, 35), (32, 34)),
    *((36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46)),
    *((48, 54), (49, 53), (50, 52), (59, 55), (58, 56)),
    *((60, 64), (61, 63), (67, 65)),
)
"""Of iBUG's 68, counted from 0: jaw, brows, nostrils, eyes, outer and inner lips."""


def mirror_map(pairs: Pairs, num_landmarks: int) -> tuple[int, ...]:
    """The landmark on the other side of the face for each landmark; itself on the midline.

    Raises:
        ValueError: if an index is none of `num_landmarks`, or comes twice.
    """
    flat = [index for pair in pairs for index in pair]
    if len(set(flat)) != len(flat) or not all(0 <= index < num_landmarks for index in flat):
        raise ValueError(f"pairs must name each of {num_landmarks} landmarks at most once; got {list(pairs)}.")
    mirror = list(range(num_landmarks))
    for right, left in pairs:
        mirror[right], mirror[left] = left, right
    return tuple(mirror)


def mirrored(shape: Float[Array, "K 3"], pairs: Pairs = PAIRS) -> Float[Array, "K 3"]:
    """A shape reflected at x = 0, its landmarks in their usual order."""
    flip = jnp.array([-1, 1, 1], shape.dtype)
    return shape[np.array(mirror_map(pairs, shape.shape[0]))] * flip


def symmetrised(shape: Float[Array, "K 3"], pairs: Pairs = PAIRS) -> Float[Array, "2 K 3"]:
    """Two symmetric shapes: the right half with its mirror image, and the left half with its own.

    The shape is cut at x = 0; landmarks on the midline are moved there.

    Args:
        shape: Millimetres, x to the subject's left.
        pairs: (right, left) indices.

    Raises:
        ValueError: as `mirror_map`.
    """
    on_midline = np.array(mirror_map(pairs, shape.shape[0])) == np.arange(shape.shape[0])
    shape = jnp.where(on_midline[:, None], shape * jnp.array([0, 1, 1], shape.dtype), shape)
    other = mirrored(shape, pairs)
    is_right = np.zeros(shape.shape[0], bool)
    is_right[[right for right, _ in pairs]] = True
    takes_right, takes_left = is_right | on_midline, ~is_right | on_midline
    return jnp.stack([jnp.where(side[:, None], shape, other) for side in (takes_right, takes_left)])
