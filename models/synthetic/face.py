"""Faces of ten landmarks: people who differ, and two expressions, mouth widened and mouth opened with a frown.

Specification of the stereo head tracker, section 4. Millimetres in the model frame: x to the image's right, y down, z
away from the camera, origin at the centroid of the neutral face.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.landmarks import BROWS, EYES, MEAN_SHAPE, MOUTH, NOSTRILS
from jaxfilters.typing import AnyKey

LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Strengths r of an expression in a training set."""
NEUTRAL_LEVELS = (0.4, 0.3)
"""Strengths of the two expressions in a neutral face: e = r - this."""
ASYMMETRY_STD_MM = 0.7
GAIN_LOG_STD = 0.15

_EYES, _OUTER, _MOUTH, _NOSTRILS, _BROWS = (list(group) for group in (EYES, (EYES[0], EYES[3]), MOUTH, NOSTRILS, BROWS))
_SIDE = np.sign(MEAN_SHAPE[:, 0])


@pytree_dataclass
class Identity:
    """A person: the neutral face and how strongly it moves."""

    neutral: Float[Array, "10 3"]
    """Landmarks without expression, millimetres about their centroid."""
    gains: Float[Array, " 2"]
    """(g1, g2): strength of both expressions, 1 for the mean person."""
    curvatures: Float[Array, " 2"]
    """(q1, q2): deviations of the quadratic terms, standard normal among people."""


@compiled_quickly
def make_identity(key: AnyKey) -> Identity:
    """A random person: twelve modes of shape, asymmetry, gains and curvatures."""
    modes, asymmetry, gains, curvatures = jax.random.split(key, 4)
    d = jax.random.normal(modes, (12,))
    x, y, z = jnp.asarray(MEAN_SHAPE, d.dtype).T
    outward = jnp.asarray(_SIDE, d.dtype)
    x, y = x * (1 + 0.035 * d[0]), y * (1 + 0.04 * d[1])
    x = _moved(x, _EYES, 1.8 * d[2] * outward)
    x = _moved(x, _OUTER, 1.5 * d[3] * outward)
    x = _moved(x, _MOUTH, 2.2 * d[4] * outward)
    y, z = _moved(y, _NOSTRILS, 2.0 * d[5]), _moved(z, _NOSTRILS, -1.8 * d[6])
    y = _moved(y, _BROWS, -2.0 * d[7])
    z = _moved(z, _MOUTH, -2.0 * d[8])
    z = _moved(z, _OUTER, 1.5 * d[9])
    x = _moved(x, _NOSTRILS, 1.0 * d[10] * outward)
    x = _moved(x, _BROWS, 1.5 * d[11] * outward)
    shape = jnp.stack([x, y, z], axis=-1) + ASYMMETRY_STD_MM * jax.random.normal(asymmetry, (10, 3))
    return Identity(
        neutral=shape - jnp.mean(shape, axis=0),
        gains=jnp.exp(GAIN_LOG_STD * jax.random.normal(gains, (2,))),
        curvatures=jax.random.normal(curvatures, (2,)),
    )


@jax.jit
def face_shape(identity: Identity, e1: Float[ArrayLike, ""], e2: Float[ArrayLike, ""]) -> Float[Array, "10 3"]:
    """Landmarks of a person with an expression, millimetres about the centroid of the *neutral* face.

    The gains multiply the expressions: a = g1 e1 and b = g2 e2.

    Args:
        identity: Who.
        e1: Mouth widened (positive) or pursed.
        e2: Mouth opened and lowered, brows raised; negative for the opposite. Both are 0 in the neutral face.
    """
    (g1, g2), (q1, q2) = identity.gains, identity.curvatures
    a, b = g1 * e1, g2 * e2
    x, y, z = identity.neutral.T
    outward = jnp.asarray(_SIDE, x.dtype)
    x = _moved(x, _MOUTH, outward * (15 * a - 5 * (1 + 0.3 * q1) * a**2 - 4 * b))
    y = _moved(y, _MOUTH, -4 * a - 4 * a**2 + 14 * b + 3 * (1 + 0.3 * q2) * b**2)
    z = _moved(z, _MOUTH, 5 * a + 3 * b)
    x, y = _moved(x, _NOSTRILS, outward * 1.2 * a), _moved(y, _NOSTRILS, 1.5 * b)
    x, y = _moved(x, _BROWS, outward * b), _moved(y, _BROWS, -(11 * b + 3 * b**2))
    y = _moved(y, _OUTER, -0.8 * b)
    return jnp.stack([x, y, z], axis=-1)


def _moved(coordinate, group, step):
    return coordinate.at[np.array(group)].add(jnp.broadcast_to(step, coordinate.shape)[np.array(group)])
