"""Landmarks that do not look as registered, followed by what they looked like in the last frame.

An eye that closes and a mouth that opens have no likeness to what was registered, but from one frame to the next they
change little. Such a landmark is found by its window of the last frame, at the price of some drift, until it looks as
registered again: the registered picture comes first wherever it fits.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfilters.models.face.alignment import Alignment, align, facing, taken_over
from jaxfilters.models.face.patches import SKIN_NORMALS, Patches, Slopes, patches_of, stretch, turned, windows
from jaxfilters.models.face.rig import CameraRig, jacobian, project_shape
from jaxfilters.trackers.head.common.state import Recent

CHANGED_SCORE = 0.7
"""Normalised correlation below which a landmark may have changed its looks."""
CLEARLY_BETTER = 0.1
"""By how much it must then resemble the last frame better."""
ANCHORED_SCORE = 0.5
"""Normalised correlation from which on a landmark looks as registered."""
MOST_DRIFT_PX = 4.0
"""Standard deviation of a landmark that the model alone has placed."""
FAR_PX = 3.0
"""How far a landmark is from the model's that has left its place."""


class Drift(NamedTuple):
    """How far a landmark is off that is followed from frame to frame: standard deviations of a coordinate."""

    first: Float[ArrayLike, ""]
    """In the first frame."""
    each: Float[ArrayLike, ""]
    """What each frame adds."""
    most: Float[ArrayLike, ""]

    def scaled(self, factor: Float[ArrayLike, ""]) -> "Drift":
        """In other units."""
        return Drift(*(factor * value for value in self))


DRIFT_PX = Drift(0.0, 0.3, MOST_DRIFT_PX)
"""Pixels."""


def nothing_changed(
    images: Float[Array, "C rows cols"], shape: Float[Array, "K 3"], pose: Float[Array, " 6"], rig: CameraRig
) -> Recent:
    """What is known at registration, of a shape posed in these images."""
    uv, _ = project_shape(rig, shape, pose)
    observed = windows(images, uv)
    none = jnp.zeros(uv.shape[:2], uv.dtype)
    return Recent(observed, jnp.zeros_like(uv), observed, none, none > 0, shape, pose)


def followed(
    recent: Recent,
    found: Alignment,
    slopes: Slopes,
    images: Float[Array, "C rows cols"],
    uv: Float[Array, "C K 2"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    rig: CameraRig,
) -> tuple[Alignment, Bool[Array, "C K"]]:
    """The alignment with landmarks that fit badly taken from the last frame on, and which those are.

    Args:
        recent: The last frame.
        found: Alignment of the registered patches.
        slopes: Of the skin.
        images: Grey levels.
        uv: Where the model has the landmarks, pixels.
        shape: Model frame, millimetres.
        pose: Millimetres and radians.
        rig: Cameras.
    """
    doubtful = found.observed & (found.score < CHANGED_SCORE)

    def from_last() -> tuple[Alignment, Array]:
        again = align(_patches(recent.found, recent, rig), slopes, images, uv + recent.apart, shape, pose, rig)
        better = doubtful & again.observed & (again.score > found.score + CLEARLY_BETTER)
        return taken_over(found, again, better), better

    return jax.lax.cond(jnp.any(doubtful), from_last, lambda: (found, jnp.zeros_like(doubtful)))


def is_anchored(found: Alignment) -> Bool[Array, "C K"]:
    """Which landmarks look as registered, by the alignment of the registered patches."""
    return found.observed & (found.score > ANCHORED_SCORE)


def as_observed(
    found: Alignment,
    anchored: Bool[Array, "C K"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    images: Float[Array, "C rows cols"],
    rig: CameraRig,
    drift: Float[Array, "C K"] | None = None,
) -> Recent:
    """What the next frame is compared with: where landmarks were `found` beside those of the posed shape.

    Args:
        found: Landmarks in the images.
        anchored: Which of them look as registered.
        shape: Model frame, millimetres.
        pose: Millimetres and radians.
        images: Grey levels.
        rig: Cameras.
        drift: Variance of landmarks that were followed, pixels squared, 0 of the others; none was if not given.
    """
    uv, _ = project_shape(rig, shape, pose)
    uv = jnp.where(jnp.isfinite(uv), uv, 0.0)
    is_there = found.observed & (found.score > CHANGED_SCORE)
    apart = jnp.where(is_there[..., None], found.uv - uv, 0.0)
    has_left = jnp.linalg.norm(apart, axis=-1) > FAR_PX
    drift = jnp.zeros_like(found.score) if drift is None else drift
    drift = jnp.where(is_there & (drift > 0), drift, jnp.where(anchored, 0.0, MOST_DRIFT_PX**2))
    return Recent(windows(images, uv + apart), apart, windows(images, uv), drift, ~anchored | has_left, shape, pose)


def drifted(recent: Recent, is_followed: Bool[Array, "C K"], drift: Drift = DRIFT_PX) -> Float[Array, "C K"]:
    """Variance of the landmarks that are followed from the last frame on, pixels squared; 0 of the others."""
    first, each, most = (jnp.square(value) for value in drift)
    return jnp.where(is_followed, jnp.minimum(jnp.maximum(recent.drift, first) + each, most), 0.0)


def latest_templates(
    recent: Recent,
    slopes: Slopes,
    templates: Float[Array, "C K T T"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    rig: CameraRig,
) -> Float[Array, "C K T T"]:
    """The templates, but for landmarks that have changed what the last frame showed in their place.

    Args:
        recent: The last frame.
        slopes: Of the skin.
        templates: As registered.
        shape: Expected, millimetres.
        pose: Expected, millimetres and radians.
        rig: Cameras.
    """

    def renewed() -> Array:
        last = _patches(recent.expected, recent, rig)
        by_shape, _ = jacobian(rig, shape, pose)
        usable = (recent.has_changed & facing(last, by_shape))[..., None, None]
        affine = jnp.where(usable, stretch(last, slopes, by_shape), jnp.eye(2))
        return jnp.where(usable, turned(last, affine), templates)

    return jax.lax.cond(jnp.any(recent.has_changed), renewed, lambda: templates)


def _patches(wide: Array, recent: Recent, rig: CameraRig) -> Patches:
    return patches_of(wide, recent.shape, recent.pose, rig, jnp.asarray(SKIN_NORMALS, wide.dtype))
