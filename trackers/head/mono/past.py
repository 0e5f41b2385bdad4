"""What frames that leave the window told of the person: a Gaussian that is the same whoever it is taken for."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.past import Past, of_energy, seen_from
from jaxfilters.models.face.person_prior import Person, Prior, parameters
from jaxfilters.trackers.head.mono.state import Window


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
    person = person._replace(offset=person.offset + face.mean - stranger.mean)
    return of_energy(window.information[place], window.gradient[place], parameters(person), units(face, prior))


def seen_by(past: Past, stranger: MultilinearFace, face: MultilinearFace) -> Past:
    """The same about the offset from another face."""
    offset = (face.mean - stranger.mean).ravel()
    return seen_from(past, jnp.concatenate([jnp.zeros_like(face.identity_mean), offset]))
