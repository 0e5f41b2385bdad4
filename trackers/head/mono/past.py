"""Information about the person of frames that leave the window: a Gaussian, the same whoever it is taken for."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Person, Prior, parameters
from jaxfilters.models.face.square_root_prior import SquareRootPrior, of_energy, shifted
from jaxfilters.trackers.head.mono.state import Window


def units(face: MultilinearFace, prior: Prior) -> Float[Array, " d"]:
    """Standard deviations of identity and offset, in which a window counts its information."""
    offset = prior.offset_deviations * jnp.ones_like(face.mean)
    return jnp.concatenate([face.identity_std, offset.ravel()])


def marginalize_frame(
    unknown: MultilinearFace,
    face: MultilinearFace,
    window: Window,
    person: Person,
    place: Int[Array, ""],
    prior: Prior,
) -> SquareRootPrior:
    """Information of one frame of the window, about the offset from the unknown person's face.

    Args:
        unknown: The model, which is the face of an unknown person.
        face: Whom the window is about: the same, or an enrolled person.
        window: Informed of the person.
        person: About that face.
        place: Of the frame.
        prior: What holds the person.
    """
    person = person._replace(offset=person.offset + face.mean - unknown.mean)
    return of_energy(window.information[place], window.gradient[place], parameters(person), units(face, prior))


def about_face(past: SquareRootPrior, unknown: MultilinearFace, face: MultilinearFace) -> SquareRootPrior:
    """The same about the offset from another face."""
    offset = (face.mean - unknown.mean).ravel()
    return shifted(past, jnp.concatenate([jnp.zeros_like(face.identity_mean), offset]))
