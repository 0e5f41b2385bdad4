"""What the frames of a window tell of the person together: those that show the same view as much as one of them.

What is wrong with a landmark, the skin that a template has slipped to and the light on it, is wrong alike wherever the
head is turned and the face is moved alike. Such frames are no independent measurements of the person. Only what is
claimed depends on this: an adjustment in which such frames weigh less, and a choice of frames that avoids them, were
tried on modelled people and made the errors no smaller.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.trackers.head.mono.state import Window

ALIKE_TURN, ALIKE_EXPRESSION = np.radians(20.0), 2.0
"""How far a head may turn, and its expression move (in standard deviations, root mean square), within one view.

Chosen among 8 degrees with 1 and 20 with 2 on four people of the ICT face model, by the likelihood of the true poses.
Wider ones, 30 degrees up to all views as one, are no likelier once landmarks that have changed count (`claims`): the
log likelihood of a frame falls by 0.03. Without them it rises by 0.05, in place of the 1.4 that they are worth.
"""


def likeness(
    face: MultilinearFace,
    poses: Float[Array, "n 6"],
    expressions: Float[Array, "n A"],
) -> Float[Array, "n n"]:
    """Correlation of what is wrong in two frames: 1 for the same view, 0 for views that have nothing in common.

    Args:
        face: Model, for what its expressions differ by.
        poses: Of the frames, millimetres and radians; places do not count.
        expressions: Of the frames.
    """
    turned = jnp.sum(jnp.square(poses[:, None, 3:] - poses[None, :, 3:]), axis=-1) / ALIKE_TURN**2
    moved = (expressions[:, None] - expressions[None]) / face.expression_std / ALIKE_EXPRESSION
    return jnp.exp(-0.5 * (turned + jnp.mean(jnp.square(moved), axis=-1)))


def shares(face: MultilinearFace, window: Window) -> Float[Array, " n"]:
    """By how much each frame counts, 1 where no other one is like it."""
    return 1 / jnp.sum(likeness(face, window.poses, window.expressions), axis=1)


def total_information(face: MultilinearFace, window: Window) -> Float[Array, "d d"]:
    """What the frames tell of the person together, in standard deviations."""
    return jnp.einsum("n,nde->de", shares(face, window), window.information, precision="highest")
