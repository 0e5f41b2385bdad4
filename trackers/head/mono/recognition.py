"""Who is before the camera: an unknown person, or one of the people of the gallery.

Each is a model of the face of its own (`jaxfilters.models.face.gallery`). The window is adjusted to each, and the
one of most evidence is believed: the density of the window's landmarks with everything else integrated out, by
Laplace's approximation about each adjustment.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.bundle import Bundle
from jaxfilters.models.face.gallery import Gallery, hypotheses
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Person, Prior, own_offset, posed_shape
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.head.common.state import POSE
from jaxfilters.trackers.head.mono.adjustment import fitted, informed, known, prior_information, settled
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.past import units
from jaxfilters.trackers.head.mono.repetition import total_information
from jaxfilters.trackers.head.mono.state import MonoState

STEPS = (10, 20)
"""Of both stages of an adjustment: from one person's face to another's is farther than from frame to frame."""
FAMILIAR = 0.5
"""Prior probability that a face is one of those of the gallery."""


class People(NamedTuple):
    """Whom a face may be taken for."""

    faces: MultilinearFace
    """Of an unknown person and of P people, stacked: leaves (1 + P, ...)."""
    log_prior: Float[Array, " n"]


@compiled_quickly
def one_of(people: People, index: Int[ArrayLike, ""]) -> MultilinearFace:
    """The face of one of them, 0 for an unknown person."""
    return jax.tree.map(lambda leaf: leaf[index], people.faces)


@compiled_quickly
def people(face: MultilinearFace, gallery: Gallery | None) -> People:
    """An unknown person, and everybody of the gallery."""
    if gallery is None or not len(gallery.identity):
        return People(jax.tree.map(lambda leaf: leaf[None], face), jnp.zeros(1, face.mean.dtype))
    count = len(gallery.identity)
    shares = jnp.array([1 - FAMILIAR] + [FAMILIAR / count] * count, face.mean.dtype)
    return People(hypotheses(face, gallery), jnp.log(shares))


@partial(jax.jit, static_argnames="options")
def recognised(people: People, rig: CameraRig, state: MonoState, options: MonoConfig) -> MonoState:
    """The state as it is for whoever the window tells most of; unchanged if nobody's face can be fitted.

    Args:
        people: Whom it may be.
        rig: One camera.
        state: Between two frames; its window has the last adjusted frame.
        options: Constants.
    """
    bundles, log_evidence = tried(people, rig, state, options)
    log_posterior = jnp.where(jnp.isfinite(log_evidence), log_evidence, -jnp.inf) + people.log_prior
    index = jnp.argmax(log_posterior)
    face, bundle = one_of(people, index), jax.tree.map(lambda leaf: leaf[index], bundles)
    # The last frame of the window may lie back a little: what changes there changes in the frame at hand.
    window, place, x = state.window, jnp.argmin(state.window.ages), state.belief.mean
    pose = x[:POSE] + bundle.poses[place] - window.poses[place]
    expression = state.modes.expression(one_of(people, state.face_index), x[POSE:])
    expression = expression + bundle.expressions[place] - window.expressions[place]
    state_of = state._replace(face_index=index.astype(state.face_index.dtype))
    anew = settled(face, rig, state_of, bundle, pose, expression, options)
    sound = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((anew.person, anew.belief, anew.model))]
    changes = jnp.isfinite(log_posterior[index]) & (index != state.face_index) & jnp.all(jnp.stack(sound))
    return jax.tree.map(lambda a, b: jnp.where(changes, a, b), anew, state)


def tried(people: People, rig: CameraRig, state: MonoState, options: MonoConfig) -> tuple[Bundle, Float[Array, " n"]]:
    """The window adjusted to each of the faces, and the logarithms of their evidence but for a common constant.

    Arguments are those of `recognised`.
    """
    now = one_of(people, state.face_index)
    one = lambda face: weighed(one_of(people, 0), face, rig, state, _start(face, now, state), options)
    # One by one: batches of factorisations can stand still on two cores.
    return jax.lax.map(one, people.faces)


def weighed(
    unknown: MultilinearFace,
    face: MultilinearFace,
    rig: CameraRig,
    state: MonoState,
    start: Bundle,
    options: MonoConfig,
) -> tuple[Bundle, Float[Array, ""]]:
    """The window adjusted to one face from a start, and the logarithm of its evidence but for a common constant.

    What is integrated out is identity and offset, by Laplace's approximation; poses count by direction and in
    proportion to the distance, of which no value is likelier than another.

    Args:
        unknown: The model, which is the face of an unknown person.
        face: The same, or an enrolled person.
        rig: One camera.
        state: With the window.
        start: Of all frames.
        options: Constants.
    """
    bundle, info = fitted(unknown, face, rig, state, start, options, STEPS)
    window = state.window._replace(poses=bundle.poses, expressions=bundle.expressions)
    gained = jnp.sum(informed(face, rig, window, bundle.person, state.prior).information, axis=0)
    people = Prior(state.prior.weight, state.prior.offset_std, misplaced=state.prior.misplaced)
    before = prior_information(face, bundle.person, people)
    after = known(face, state.prior, bundle.person) + gained
    return bundle, -info.energy - 0.5 * (_log_det(after) - _log_det(before))


@compiled_quickly
def as_gallery(unknown: MultilinearFace, face: MultilinearFace, state: MonoState) -> Gallery:
    """The person who is followed, as one to remember: identity with what is not known of it, and offset.

    Args:
        unknown: The model, which is the face of an unknown person.
        face: Whom the state is about: the same, or an enrolled person.
        state: With a window that has been informed of that person.
    """
    total = known(face, state.prior, state.person) + total_information(face, state.window)
    unit, count = units(face, state.prior), face.num_identities
    covariance = (unit[:, None] * jnp.linalg.inv(total) * unit)[:count, :count]
    offset = own_offset(state.person, state.prior) + face.mean - unknown.mean
    return Gallery(state.person.identity[None], covariance[None], offset[None])


def _start(face: MultilinearFace, now: MultilinearFace, state: MonoState) -> Bundle:
    """The window for another face: as near to the believed one as may be, and as much farther away as it is larger."""
    most = 2 * face.identity_std
    identity = jnp.clip(state.person.identity, face.identity_mean - most, face.identity_mean + most)
    person = Person(identity, state.person.offset + now.mean - face.mean)
    size = lambda face, person: jnp.sqrt(jnp.sum(jnp.square(posed_shape(face, person, face.expression_mean))))
    ratio = size(face, person) / size(now, state.person)
    return Bundle(state.window.poses.at[:, :3].multiply(ratio), state.window.expressions, person)


def _log_det(A: Array) -> Array:
    return 2 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(A))))


def check_gallery(gallery: Gallery | None, face: MultilinearFace, options: MonoConfig) -> None:
    """Whether people can be recognised with a model by a tracker.

    Raises:
        ValueError: if they are not of the model, or for the tracker of the thesis, which knows nobody.
    """
    if gallery is None:
        return
    if options.is_published:
        raise ValueError('gallery must be None where options.landmarks is not "aligned": that tracker knows nobody.')
    count, num_identities = len(gallery.identity), face.num_identities
    expected = ((count, num_identities), (count, num_identities, num_identities), (count, *face.mean.shape))
    shapes = tuple(jnp.shape(leaf) for leaf in gallery)
    if shapes != expected:
        raise ValueError(f"gallery must be of the model, with shapes {expected}; got {shapes}.")
