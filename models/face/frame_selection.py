"""Which frames of a video a face is adjusted to: those that turn most (Sugano 2007), or those that tell most."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters.models.face.bundle import POSE_UNITS, Bundle, Views, frame_residuals
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Person, Prior
from jaxfilters.models.face.rig import CameraRig

TIE = 1e-9
"""Relative difference of two variances up to which they are the same, or some units of rounding if these are more."""


def by_angles(
    angles: Float[Array, "n 2"], new: Float[Array, " 2"], ages: Int[Array, " n"], may_go: Bool[Array, " n"]
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The frame that the new one replaces for the largest variance of the facing direction, and that variance.

    The new frame is always taken.

    Args:
        angles: Yaw and pitch of the frames so far, radians.
        new: Of the new frame.
        ages: Of the frames so far; of sets that are as good the one without the oldest is taken.
        may_go: Frames that may be replaced.
    """

    def spread(replaced: Array) -> Array:
        return jnp.sum(jnp.var(jnp.where(replaced[:, None], new, angles), axis=0))

    spreads = jnp.where(may_go, jax.vmap(spread)(jnp.eye(len(angles), dtype=bool)), -jnp.inf)
    tie = max(TIE, 16 * float(jnp.finfo(angles.dtype).eps))
    best = may_go & (spreads >= jnp.max(spreads) * (1 - tie))
    return jnp.argmax(jnp.where(best, ages, -1)), jnp.max(spreads)


def information_gain(
    information: Float[Array, "n d d"], new: Float[Array, "d d"], prior: Float[Array, "d d"], may_go: Bool[Array, " n"]
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The frame that the new one replaces for the least uncertainty of the identity, and what is gained, in nats.

    The gain is half the growth of the log determinant of the information; where it is not positive the frames so far
    tell more than any set with the new one.

    Args:
        information: Of each frame so far about the person, as `FrameInformation.information`.
        new: Of the new frame.
        prior: Before all frames.
        may_go: Frames that may be replaced.
    """
    total = prior + jnp.sum(information, axis=0)
    log_det = lambda matrix: 2 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(matrix))))
    # One by one: batches of factorisations can stand still on two cores.
    after = jax.lax.map(lambda old: log_det(total - old + new), information)
    gains = jnp.where(may_go & jnp.isfinite(after), 0.5 * (after - log_det(total)), -jnp.inf)
    best = jnp.argmax(gains)
    return best, gains[best]


class FrameInformation(NamedTuple):
    """What one frame tells of a person, in standard deviations of the training set's identities and of the offset."""

    information: Float[Array, "d d"]
    """Once the frame's own pose and expression have had their part: a Schur complement of the normal matrix."""
    response: Float[Array, "6+A d"]
    """How the pose (mm, rad) and the expression found in this frame change with identity and offset."""
    gradient: Float[Array, " d"]
    """Of the frame's energy, in the same units, at the person that the frame was given."""
    by_focal: Float[Array, " 6+A"]
    """How the pose (mm, rad) and the expression change with the logarithm of the focal length."""


def frame_information(
    face: MultilinearFace, rig: CameraRig, view: Views, frame: Bundle, prior: Prior
) -> FrameInformation:
    """The information of one frame about identity and offset, and how its pose depends on the focal length.

    Args:
        face: Model.
        rig: One camera.
        view: Of one frame.
        frame: The pose and expression there, and whose face it is.
        prior: With it the expression is held.
    """
    s_std = face.identity_std
    a_std = face.expression_std
    units = jnp.concatenate([jnp.asarray(POSE_UNITS, a_std.dtype), a_std])
    count = frame.person.identity.size

    def residuals(person: Array, own: Array) -> Array:
        offset = person[count:-1].reshape(frame.person.offset.shape)
        offset = frame.person.offset + prior.offset_deviations * offset
        other = Person(frame.person.identity + s_std * person[:count], offset)
        camera = replace(rig, focal=rig.focal * jnp.exp(person[-1]))
        pose, expression = frame.poses + units[:6] * own[:6], frame.expressions + units[6:] * own[6:]
        # What is known of the person beforehand must not count once for every frame.
        return frame_residuals(face, camera, view, Bundle(pose, expression, other), prior.weight)

    # The last one is the logarithm of the focal length.
    of_person, own = jnp.zeros(count + frame.person.offset.size + 1), jnp.zeros_like(units)
    information, response, gradient = reduced(residuals, of_person, own)
    response = units[:, None] * response
    return FrameInformation(information[:-1, :-1], response[:, :-1], gradient[:-1], response[:, -1])


def reduced(
    residuals: Callable[[Array, Array], Array], kept: Float[Array, " d"], gone: Float[Array, " m"]
) -> tuple[Float[Array, "d d"], Float[Array, "m d"], Float[Array, " d"]]:
    """What residuals tell of some parameters once the others are the likeliest for them: a Schur complement.

    Args:
        residuals: Of both.
        kept: Where they are.
        gone: The same, in units of which some determine a residual of one.

    Returns:
        Information about the first, how the others respond to them, and the gradient of the energy by the first.
    """
    J, L = jax.jacfwd(residuals, (0, 1))(kept, gone)
    r = residuals(kept, gone)
    product = lambda a, b: jnp.matmul(a, b, precision="highest")
    root = (jnp.linalg.cholesky(product(L.T, L) + 1e-6 * jnp.eye(gone.size)), True)
    response = -jax.scipy.linalg.cho_solve(root, product(L.T, J))
    information = product(J.T, J) + product(product(L.T, J).T, response)
    return information, response, product(J.T, r) + product(response.T, product(L.T, r))
