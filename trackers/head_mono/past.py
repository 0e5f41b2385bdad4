"""What frames that leave the window told of the person: a Gaussian that is the same whoever it is taken for."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Past, Person, Prior, parameters
from jaxfilters.trackers.head_mono.state import Window


def units(face: MultilinearFace, prior: Prior) -> Float[Array, " d"]:
    """Standard deviations of identity and offset, in which a window counts its information."""
    return jnp.concatenate([face.identity_std, jnp.full(face.mean.size, prior.offset_std, face.mean.dtype)])


def left_behind(
    stranger: MultilinearFace,
    face: MultilinearFace,
    window: Window,
    person: Person,
    place: Int[Array, ""],
    prior: Prior,
) -> Past:
    """What one frame of the window told, about the offset from the stranger's face.

    Args:
        stranger: The model.
        face: Whom the window is about: the same, or somebody who is remembered.
        window: Informed of the person.
        person: About that face.
        place: Of the frame.
        prior: What holds the person.
    """
    unit = units(face, prior)
    inverse = jnp.where(unit > 0, 1 / jnp.where(unit > 0, unit, 1.0), 0.0)
    information = inverse[:, None] * window.information[place] * inverse
    person = person._replace(offset=person.offset + face.mean - stranger.mean)
    told = jnp.matmul(information, parameters(person), precision="highest")
    return Past(information, told - inverse * window.gradient[place])


def joined(past: Past, more: Past) -> Past:
    """Both."""
    return Past(past.information + more.information, past.pull + more.pull)


def seen_by(past: Past, stranger: MultilinearFace, face: MultilinearFace) -> Past:
    """The same about the offset from another face."""
    offset = (face.mean - stranger.mean).ravel()
    moved = jnp.concatenate([jnp.zeros_like(face.identity_mean), offset])
    return Past(past.information, past.pull - jnp.matmul(past.information, moved, precision="highest"))
