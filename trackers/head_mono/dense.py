"""A start from the 68 landmarks of iBUG, of which the tracker goes on with ten.

Many landmarks tell more of a face than the ten that can be followed: who it is, and so how large. What they tell of the
identity is kept as a Gaussian (`Past`), in which nothing else is left of them: the frames that the face is adjusted to
later must not count the same detections again.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.models.face.bundle import (
    Adjustment,
    Bundle,
    Past,
    Person,
    Prior,
    Reach,
    Views,
    adjust,
    nothing_past,
    posed_shape,
    projected,
)
from jaxfilters.models.face.frame_selection import told
from jaxfilters.models.face.landmarks import FROM_68, NUM_LANDMARKS
from jaxfilters.models.face.multilinear import MultilinearFace, restricted
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.head_mono.start import WIDE, Start

NUM_DENSE = 68
STEPS, ROUNDS = (5, 15), 3
"""Of both stages of each adjustment; adjustments."""
REACH = WIDE._replace(identity=12.0, deviations=12.0)
"""Of the adjustment, which sets out from that to the ten; wide, as the push moves the mean by several deviations."""


class Dense(NamedTuple):
    """Landmarks in n frames, beside the ten."""

    uv: Float[np.ndarray, "n 68 2"]
    """Pixels, in iBUG's order."""
    covariance: Float[np.ndarray, "n 68 2 2"]
    """Pixels squared."""
    seen: Bool[np.ndarray, "n 68"]
    """Not what a detector does not give, or not reliably."""
    misplaced_mm: float
    """By how much they lie beside the model's landmarks, the same in all frames: standard deviation of a coordinate."""


class Size(NamedTuple):
    """A push of the logarithm of a face's size, which is linear in the identity here."""

    strength: Float[Array, ""]
    """What the logarithm gets: the push of as many parameters that the images determine."""
    slope: Float[Array, " S"]
    """Of the logarithm, by the identity."""
    center: Float[Array, ""]
    """Of slope times identity: where the push was made."""

    @property
    def information(self) -> Float[Array, "S S"]:
        """About the identity."""
        return self.strength * self.slope[:, None] * self.slope

    @property
    def pull(self) -> Float[Array, " S"]:
        """As `Past.pull`: at the center it leads towards larger faces."""
        return self.strength * (1 + self.center) * self.slope


class DenseStart(NamedTuple):
    """What many landmarks say."""

    start: Start
    """Of the ten."""
    past: Past
    """What they tell of the identity of the ten's face."""


def tracked(face: MultilinearFace) -> MultilinearFace:
    """The model of the ten landmarks that are followed.

    Raises:
        ValueError: if the model is neither of them nor of the 68 of iBUG.
    """
    if face.num_landmarks == NUM_LANDMARKS:
        return face
    if face.num_landmarks != NUM_DENSE:
        raise ValueError(
            f"face must have {NUM_LANDMARKS} landmarks, or the {NUM_DENSE} of iBUG; got {face.num_landmarks}."
        )
    return restricted(face, FROM_68)


def start_densely(face: MultilinearFace, rig: CameraRig, start: Start, dense: Dense, prior: Prior) -> DenseStart:
    """A start of the ten landmarks, better than what they say themselves.

    Args:
        face: Model of the 68.
        rig: One camera, which is the world.
        start: From the ten alone: where the search sets out.
        dense: Landmarks in the same frames.
        prior: What holds the face; its weight is not 0.
    """
    numbers = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, start.uv.dtype), tree)
    views = Views(numbers(dense.uv), numbers(dense.covariance), jnp.asarray(dense.seen))
    return _adjusted(face, rig, start, views, numbers(dense.misplaced_mm), numbers(prior), numbers(REACH))


@jax.jit
def _adjusted(
    face: MultilinearFace, rig: CameraRig, start: Start, views: Views, misplaced: Array, prior: Prior, reach: Reach
) -> DenseStart:
    offset_std = jnp.asarray(prior.offset_std)
    both_std = jnp.hypot(offset_std, misplaced)
    # The distance of the eyes is that of landmarks among the ten: the tracker's own prior has it.
    prior = prior._replace(offset_std=both_std, eyes_apart_std=jnp.zeros_like(offset_std))
    begun = start.bundle._replace(person=Person(start.bundle.person.identity, jnp.zeros_like(face.mean)))

    def closer(_: Array | int, carry: tuple[Bundle, Adjustment, Size]) -> tuple[Bundle, Adjustment, Size]:
        bundle, info = adjust(_pushed(face, carry[2], prior), rig, views, carry[0], prior, reach, steps=STEPS)
        return bundle, info, _unshrunk(face, rig, views, bundle, prior)

    zero = jnp.zeros((), start.uv.dtype)
    unadjusted = Adjustment(zero, zero, jnp.zeros((), jnp.int32))
    # Nearly as many as the images have coordinates of landmarks: a search that sets out too small comes back slowly.
    many = 2.0 * jnp.sum(jnp.any(views.seen, axis=0)).astype(zero.dtype)
    first = begun, unadjusted, _push_at(face, begun.person, many)
    found, info, size = jax.lax.fori_loop(0, ROUNDS, closer, first)
    ten = restricted(face, FROM_68)
    # The rest of the offset is the detector's, and no part of the face.
    of_face = jnp.square(offset_std / jnp.where(both_std > 0, both_std, 1.0))
    person = Person(found.person.identity, of_face * found.person.offset[jnp.asarray(FROM_68)])
    bundle = Bundle(found.poses, found.expressions, person)
    information, pull = told_of_identity(face, rig, views, found, prior)
    none, count = nothing_past(ten), face.num_identities
    past = Past(
        none.information.at[:count, :count].set(information + size.information),
        none.pull.at[:count].set(pull + size.pull),
    )
    return DenseStart(Start(bundle, info, projected(ten, rig, bundle)), past)


def _unshrunk(face: MultilinearFace, rig: CameraRig, views: Views, bundle: Bundle, prior: Prior) -> Size:
    """What keeps a face from shrinking for no reason.

    A small face near by looks like a large one far away. What it differs by from the average then differs by fewer
    millimetres, too, which the priors like better: every squared term of theirs falls with the square of the size.
    That is no evidence. Integrals over those parameters instead of their likeliest values would have factors of the
    size that make up for it, one for each parameter that the images determine; so here the logarithm of the size gets
    as much of a push as it is pulled: by offset and expressions as they are, by the identity as its parameters are
    determined.
    """
    person, weight2 = bundle.person, jnp.square(prior.weight)
    apart = bundle.expressions - face.expression_mean
    by_expressions = jnp.sum(apart.T * jnp.linalg.solve(face.expression_covariance, apart.T))
    known = jnp.asarray(prior.offset_std) > 0
    by_offset = jnp.sum(jnp.square(jnp.where(known, person.offset / jnp.where(known, prior.offset_std, 1.0), 0.0)))
    information, _ = told_of_identity(face, rig, views, bundle, prior)
    beforehand = weight2 * jnp.linalg.inv(face.identity_covariance)
    determined = jnp.trace(jnp.linalg.solve(information + beforehand, information))
    pulled = weight2 * (by_expressions + determined) + by_offset
    return _push_at(face, person, pulled)


def _push_at(face: MultilinearFace, person: Person, strength: Array) -> Size:
    slope = jax.grad(lambda identity: log_size(face, Person(identity, person.offset)))(person.identity)
    return Size(strength, slope, jnp.sum(slope * person.identity))


def _pushed(face: MultilinearFace, size: Size, prior: Prior) -> MultilinearFace:
    """The model with people as they are likely before the images and after the push."""
    weight2 = jnp.square(prior.weight)
    beforehand = weight2 * jnp.linalg.inv(face.identity_covariance)
    covariance = jnp.linalg.inv(beforehand + size.information)
    mean = jnp.matmul(
        covariance, jnp.matmul(beforehand, face.identity_mean, precision="highest") + size.pull, precision="highest"
    )
    return replace(face, identity_mean=mean, identity_covariance=weight2 * (covariance + covariance.T) / 2)


def log_size(face: MultilinearFace, person: Person) -> Float[Array, ""]:
    """Logarithm of how widely the landmarks spread across the line of sight of a face that looks into the camera."""
    across = posed_shape(face, person, face.expression_mean)[:, :2]
    return 0.5 * jnp.log(jnp.sum(jnp.square(across - jnp.mean(across, axis=0))))


def told_of_identity(
    face: MultilinearFace, rig: CameraRig, views: Views, bundle: Bundle, prior: Prior
) -> tuple[Float[Array, "S S"], Float[Array, " S"]]:
    """Information and pull of all views together once poses, expressions and offset have had their part."""
    person, std, size = bundle.person, face.identity_std, face.num_identities

    def one(inputs: tuple) -> tuple[Array, Array]:
        view, pose, expression = jax.tree.map(lambda leaf: leaf[None], inputs)
        of_frame = told(face, rig, view, Bundle(pose, expression, person), prior)
        return of_frame.information, of_frame.gradient

    # One by one: batches of factorisations can stand still on two cores.
    each = jax.lax.map(one, (views, bundle.poses, bundle.expressions))
    information, gradient = (jnp.sum(part, axis=0) for part in each)
    known = jnp.asarray(prior.offset_std) > 0
    held = jnp.where(known, person.offset.ravel() / jnp.where(known, prior.offset_std, 1.0), 0.0)
    product = lambda a, b: jnp.matmul(a, b, precision="highest")
    of_offset = information[size:, size:] + jnp.eye(held.size, dtype=held.dtype)
    root = (jnp.linalg.cholesky(of_offset), True)
    share = jax.scipy.linalg.cho_solve(root, information[size:, :size])
    about = information[:size, :size] - product(share.T, information[size:, :size])
    slope = gradient[:size] - product(share.T, gradient[size:] + held)
    about = (about + about.T) / 2 / std[:, None] / std
    return about, product(about, person.identity) - slope / std
