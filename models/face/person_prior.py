"""What is known of a face before the images: the sizes of faces, how they differ, and estimates of this one.

A small face near by looks like a large one far away. Its millimetres are fewer, too, and whatever counts in squared
millimetres likes it better for that, which is no evidence. So a face is held by its size, and by what it differs by
from the mean person beside that in proportion to the size: of two faces that look alike neither is likelier but by how
many people are as large.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfilters.models.face import square_root_prior as past
from jaxfilters.models.face.landmarks import EYES
from jaxfilters.models.face.misplacement import Misplacement
from jaxfilters.models.face.multilinear import MultilinearFace, expression_basis, shape
from jaxfilters.models.face.square_root_prior import SquareRootPrior


class Person(NamedTuple):
    """Whose face it is."""

    identity: Float[Array, " S"]
    offset: Float[Array, "K 3"]
    """What the model lacks of this face in every expression, model frame, millimetres."""


class Prior(NamedTuple):
    """What holds a bundle beside the images; a weight of 0 lets go, 1 is Bayes' rule."""

    weight: Float[ArrayLike, ""]
    """Of identity and expressions about those of the training set, with their covariances."""
    offset_std: Float[ArrayLike, ""]
    """Millimetres: of each coordinate of the offset, for a face as large as the mean one; 0 for none."""
    eyes_apart: Float[ArrayLike, ""] = 0.0
    """Millimetres between the centres of the eyes, if that is known: the size of everything follows from it."""
    eyes_apart_std: Float[ArrayLike, ""] = 0.0
    """Millimetres; 0 where it is not known."""
    past: SquareRootPrior | None = None
    """Information of frames that are no longer adjusted about `parameters`."""
    misplaced: Misplacement | None = None
    """Of the offset, in place of `offset_std`, where a detector placed the landmarks."""

    @property
    def offset_deviations(self) -> Float[Array, "*K3"]:
        """Standard deviations of the offset of a face as large as the mean one, millimetres."""
        return jnp.asarray(self.offset_std if self.misplaced is None else self.misplaced.std)

    @property
    def offset_mean(self) -> Float[Array, "*K3"]:
        """Of the same."""
        return jnp.zeros(()) if self.misplaced is None else jnp.asarray(self.misplaced.mean)


def posed_shape(face: MultilinearFace, person: Person, expression: Float[Array, " A"]) -> Float[Array, "K 3"]:
    """Landmarks of a person with an expression in the model frame, millimetres ([4.15] and the offset)."""
    return shape(face, person.identity, expression) + person.offset


def parameters(person: Person) -> Float[Array, " d"]:
    """Identity, then offset."""
    return jnp.concatenate([person.identity, person.offset.ravel()])


def nothing_past(face: MultilinearFace) -> SquareRootPrior:
    """Of a person who is new."""
    return past.nothing(face.num_identities + face.mean.size, face.mean.dtype)


@jax.jit
def eyes_apart(face: MultilinearFace, person: Person) -> Float[Array, ""]:
    """Millimetres between the middles of the corners of either eye."""
    corners = posed_shape(face, person, face.expression_mean)[jnp.asarray(EYES)]
    right, left = jnp.mean(corners[:2], axis=0), jnp.mean(corners[2:], axis=0)
    return jnp.sqrt(jnp.sum(jnp.square(left - right)))


def log_size(
    face: MultilinearFace, identity: Float[Array, " S"], expression: Float[Array, " A"] | None = None
) -> Float[Array, ""]:
    """Logarithm of how widely the landmarks spread across the line of sight of a face that looks into the camera.

    Args:
        face: Model.
        identity: Whose face.
        expression: The training set's mean if none.
    """
    across = shape(face, identity, face.expression_mean if expression is None else expression)[:, :2]
    return 0.5 * jnp.log(jnp.sum(jnp.square(across - jnp.mean(across, axis=0))))


@jax.jit
def observed_size(
    face: MultilinearFace, identity: Float[Array, " S"], expressions: Float[Array, "n A"]
) -> Float[Array, ""]:
    """How large a face is in frames with these expressions, their geometric mean, beside the mean person's."""
    each = jax.vmap(lambda a: log_size(face, identity, a))(expressions)
    return jnp.exp(jnp.mean(each) - log_size(face, face.identity_mean))


def expression_residuals(
    face: MultilinearFace, identity: Float[Array, " S"], expressions: Float[Array, "n A"]
) -> Float[Array, "n A"]:
    """Of expressions, in standard deviations, for what they move in proportion to the size of the face in each frame.

    Whoever moves farther for his size with the same parameters than the mean person has stronger expressions.
    """
    root = jnp.linalg.cholesky(face.expression_covariance)
    deviations = jax.scipy.linalg.solve_triangular(root, (expressions - face.expression_mean).T, lower=True).T

    def strength(identity: Array) -> Array:
        moved = jnp.matmul(expression_basis(face, identity), root, precision="highest")
        return jnp.sqrt(jnp.sum(jnp.square(moved)))

    sizes = jax.vmap(lambda a: observed_size(face, identity, a[None]))(expressions)
    return deviations * strength(identity) / strength(face.identity_mean) / sizes[:, None]


def residuals(
    face: MultilinearFace, person: Person, expressions: Float[Array, "n A"], prior: Prior
) -> Float[Array, " rows"]:
    """Of identity, offset and size, and of the information of past frames, in standard deviations.

    Args:
        face: Model.
        person: Whose face.
        expressions: In the images. They change its size, too: it would shrink by them if they did not count.
        prior: What is known.
    """
    offset = _of_offset(person, observed_size(face, person.identity, expressions), prior)
    size = _of_eyes(face, person, prior)
    before = jnp.zeros(0, offset.dtype) if prior.past is None else past.residuals(prior.past, parameters(person))
    identity = prior.weight * _of_identity(face, person.identity)
    return jnp.concatenate([identity, offset.ravel(), size[None], before])


@jax.jit
def own_offset(person: Person, prior: Prior) -> Float[Array, "K 3"]:
    """The part of the offset that is the face's, without what the detector misplaced, millimetres."""
    if prior.misplaced is None:
        return person.offset
    whitening = prior.misplaced.whitening
    away = jnp.matmul(whitening, (person.offset - prior.offset_mean).ravel(), precision="highest")
    share = jnp.matmul(whitening.T, away, precision="highest")
    return jnp.square(jnp.asarray(prior.offset_std)) * share.reshape(person.offset.shape)


def _of_eyes(face: MultilinearFace, person: Person, prior: Prior) -> Array:
    """Of the known distance between the eyes, in standard deviations; 0 where it is not known.

    It is that of the face. Where a detector placed the landmarks, they say how far apart it puts the eyes, and what of
    that is the face's own is known but for the rest of the offset's variance, about its conditional mean.
    """
    measured = jnp.asarray(prior.eyes_apart_std) > 0
    wrong = eyes_apart(face, person._replace(offset=own_offset(person, prior))) - prior.eyes_apart
    variance = jnp.square(jnp.asarray(prior.eyes_apart_std)) + _unknown_of_eyes(prior)
    return jnp.where(measured, wrong / jnp.sqrt(jnp.where(measured, variance, 1.0)), 0.0)


def _unknown_of_eyes(prior: Prior) -> Array:
    """Variance of what is the face's own of the distance between the eyes, given all of the offset, mm^2."""
    if prior.misplaced is None:
        return jnp.zeros(())
    whitening, variance = prior.misplaced.whitening, jnp.square(jnp.asarray(prior.offset_std))
    apart = jnp.zeros(whitening.shape[0] // 3).at[jnp.asarray(EYES)].set(jnp.array([-0.5, -0.5, 0.5, 0.5]))
    across = jnp.kron(apart, jnp.array([1.0, 0.0, 0.0]))
    share = jnp.matmul(whitening, across, precision="highest")
    return variance * (jnp.sum(jnp.square(across)) - variance * jnp.sum(jnp.square(share)))


def _of_offset(person: Person, size: Array, prior: Prior) -> Float[Array, "K 3"]:
    """In independent standard deviations, in proportion to the size."""
    if prior.misplaced is not None:
        away = (person.offset / size - prior.offset_mean).ravel()
        return jnp.matmul(prior.misplaced.whitening, away, precision="highest").reshape(person.offset.shape)
    known = jnp.asarray(prior.offset_std) > 0
    return jnp.where(known, person.offset / jnp.where(known, size * prior.offset_std, 1.0), 0.0)


def _of_identity(face: MultilinearFace, identity: Array) -> Array:
    """In independent standard deviations: the size by its logarithm, the rest in proportion to the size."""
    mean, root = face.identity_mean, jnp.linalg.cholesky(face.identity_covariance)
    away = jax.scipy.linalg.solve_triangular(root, identity - mean, lower=True)
    # What standard deviations change the logarithm of the size by; the rest is at right angles to it.
    slope = jnp.matmul(root.T, jax.grad(lambda s: log_size(face, s))(mean), precision="highest")
    std2 = jnp.sum(jnp.square(slope))
    beside = away - slope * jnp.sum(slope * away) / std2
    log_ratio = log_size(face, identity) - log_size(face, mean)
    return beside / jnp.exp(log_ratio) + slope * log_ratio / std2
