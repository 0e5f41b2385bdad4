"""People who may come back: each is a model of the face of its own, whose identity is known to within a little.

The training set's people are not a Gaussian: whoever is among them is exactly one of them. A mixture of narrow
components about those of the gallery and a wide one for unknown people says so.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.models.face.mirroring import PAIRS, Pairs
from jaxfilters.models.face.multilinear import PEOPLE_MODE, MultilinearFace, shape_tensor
from jaxfilters.models.face.multilinear_fit import likeliest


class Gallery(NamedTuple):
    """P people, of whom a model of the face knows who they are."""

    identity: Float[Array, "P S"]
    covariance: Float[Array, "P S S"]
    """Of what is not known of the identity."""
    offset: Float[Array, "P K 3"]
    """What the model lacks of each face, millimetres."""


def remember(face: MultilinearFace, shapes: Float[Array, "P A K 3"], pairs: Pairs = PAIRS) -> Gallery:
    """People by measured shapes of their faces, with any expressions.

    A shape is taken as the mean of its two symmetric halves, which is all that the model can form.

    Args:
        face: Model.
        shapes: Millimetres in the model frame.
        pairs: (right, left) indices of landmarks.

    Raises:
        ValueError: if the landmarks are not the model's, or a shape is not finite.
    """
    if shapes.ndim != 4 or shapes.shape[2:] != face.mean.shape:
        raise ValueError(f"shapes must be (P, A, {face.num_landmarks}, 3), as the model's; got {shapes.shape}.")
    if not bool(jnp.all(jnp.isfinite(shapes))):
        raise ValueError("shapes must be finite.")
    return of_tensor(face, shape_tensor(shapes, pairs))


def of_tensor(face: MultilinearFace, tensor: Float[Array, "K 3 halves A"]) -> Gallery:
    """The people of a data tensor (`jaxfilters.models.face.multilinear.shape_tensor`)."""
    right, left = jnp.split(tensor, 2, axis=PEOPLE_MODE)
    both = jnp.moveaxis((right + left) / 2, (2, 3), (0, 1))
    # One by one: batches of factorisations can stand still on two cores.
    fit, covariance, left_over = jax.lax.map(lambda own: likeliest(face, own), both)
    return Gallery(fit.identity, covariance, left_over)


def joined(*people: Gallery) -> Gallery:
    """All of them."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *people)


def hypotheses(face: MultilinearFace, people: Gallery) -> MultilinearFace:
    """Models for an unknown person, first, and for each of the people, stacked: leaves (1 + P, ...)."""

    def known(identity: Array, covariance: Array, offset: Array) -> MultilinearFace:
        return replace(face, mean=face.mean + offset, identity_mean=identity, identity_covariance=covariance)

    return jax.tree.map(lambda own, others: jnp.concatenate([own[None], others]), face, jax.vmap(known)(*people))
