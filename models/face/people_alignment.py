"""Faces of several people in one model frame: each person's to the neutral one, the neutral ones to their mean."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.models.face.rigid import align

ROUNDS = 5
"""Alignments to the mean, which changes with them."""


def aligned_people(shapes: Float[Array, "S A K 3"], neutral: int, skull: Float[Array, " K"]) -> Float[Array, "S A K 3"]:
    """Shapes without the motion of their heads, millimetres about the centroid of the mean neutral face.

    Sizes stay as they are: only rotations and translations are taken out, on the landmarks of the skull from face to
    face of a person, on all landmarks from person to person. The first person says which way the faces look. Missing
    faces, which are NaN, stay so.

    Args:
        shapes: S people with A expressions, millimetres.
        neutral: Index of the neutral expression, which everybody must have.
        skull: Weights of the landmarks, such as 1 for eye corners and nostrils, 0 for the others.
    """
    missing = jnp.isnan(shapes).any(axis=(2, 3), keepdims=True)
    filled = jnp.where(missing, shapes[:, neutral, None], shapes)
    to_neutral = lambda face, own: _moved(face, *align(face, own, skull))
    faces = jax.vmap(lambda person: jax.vmap(lambda face: to_neutral(face, person[neutral]))(person))(filled)

    def closer(_: Array | int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        faces, mean = carry
        moved = jax.vmap(lambda person: _together(person, *align(person[neutral], mean)))(faces)
        return moved, jnp.mean(moved[:, neutral], axis=0)

    first = faces[0, neutral]
    faces, mean = jax.lax.fori_loop(0, ROUNDS, closer, (faces, first))
    return jnp.where(missing, jnp.nan, faces - jnp.mean(mean, axis=0))


def _together(person, R, t):
    return jax.vmap(lambda face: _moved(face, R, t))(person)


def _moved(shape, R, t):
    return jnp.matmul(shape, R.T, precision="highest") + t
