"""Equally spaced strengths of an expression out of a sequence of one person's shapes."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.math.multilinear import check_finite
from jaxfilters.models.face.landmarks import BROWS, EYES, MOUTH, NOSTRILS
from jaxfilters.models.face.rigid import align

LEVELS = 5
"""Of each action."""
_SKULL = np.zeros(10)
_SKULL[[*EYES, *NOSTRILS]] = 1


def mouth_width(shape: Float[Array, "10 3"]) -> Float[Array, ""]:
    """Distance between the mouth's corners, millimetres: what horizontal motion of the mouth changes."""
    return jnp.linalg.norm(shape[MOUTH[0]] - shape[MOUTH[1]])


def face_length(shape: Float[Array, "10 3"]) -> Float[Array, ""]:
    """Distance of the midpoints of brows and mouth corners, millimetres: what brows and an opened mouth change."""
    return jnp.linalg.norm((shape[BROWS[0]] + shape[BROWS[1]] - shape[MOUTH[0]] - shape[MOUTH[1]]) / 2)


def deformation_rate(lengths: Float[Array, " T"]) -> Float[Array, " T"]:
    """How far an action has gone in each frame, from 0 at the shortest length to 1 at the longest.

    Raises:
        ValueError: if the lengths are not finite, or all the same.
    """
    check_finite("lengths", lengths)
    least, span = jnp.min(lengths), jnp.max(lengths) - jnp.min(lengths)
    if not isinstance(lengths, jax.core.Tracer) and not span > 0:
        raise ValueError(f"lengths must differ, or there is no action; all are {float(least):g}.")
    return (lengths - least) / span


def sampled_levels(
    shapes: Float[Array, "T K 3"],
    neutral: Float[Array, "K 3"],
    length: Callable[[Array], Array],
    *,
    levels: int = LEVELS,
    skull: Float[np.ndarray, " K"] = _SKULL,
) -> Float[Array, "levels K 3"]:
    """Shapes of a person at equally spaced rates of one action, without the motion of the head.

    Every shape is first aligned rigidly to the neutral face on the landmarks of the skull. Between the two frames whose
    rates are nearest, coordinates are interpolated linearly.

    Args:
        shapes: The action, back and forth as often as it was done, millimetres.
        neutral: The person's neutral face, millimetres in the model frame.
        length: What the action changes, such as `mouth_width` and `face_length`.
        levels: How many rates, from 0 to 1.
        skull: Weights of the landmarks in the alignment; eye corners and nostrils of the ten by default.

    Raises:
        ValueError: if a number is not finite, there are fewer than two levels, or `length` does not change.
    """
    check_finite("shapes", shapes)
    check_finite("neutral", neutral)
    if levels < 2:
        raise ValueError(f"levels must be 2 or more; got {levels}.")
    weights = jnp.asarray(skull, shapes.dtype)
    aligned = jax.lax.map(lambda one: _aligned(one, neutral, weights), shapes)
    rates = deformation_rate(jax.vmap(length)(aligned))
    order = jnp.argsort(rates)
    wanted = jnp.linspace(0, 1, levels, dtype=shapes.dtype)
    columns = aligned[order].reshape(len(shapes), -1)
    at = lambda column: jnp.interp(wanted, rates[order], column)
    return jax.vmap(at, in_axes=1, out_axes=1)(columns).reshape(levels, *neutral.shape)


def _aligned(shape, neutral, weights):
    R, t = align(shape, neutral, weights)
    return jnp.matmul(shape, R.T, precision="highest") + t
