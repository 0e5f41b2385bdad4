"""What every estimate starts from: the particles' mode, the prediction, and the landmarks looked for about it."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxfilters import weights
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.alignment import Alignment, align, relocated
from jaxfilters.models.face.patches import Patches, Slopes
from jaxfilters.models.face.rig import CameraRig, project_shape
from jaxfilters.models.face.shape_model import FaceModel, shape
from jaxfilters.particle.adaptive import AdaptiveDiffusionState
from jaxfilters.trackers.head.common import recent
from jaxfilters.trackers.head.common.search import KAPPA
from jaxfilters.trackers.head.common.state import POSE, Recent
from jaxfilters.trackers.innovations import correction_counts

UNKNOWN_STD = 0.01
"""Millimetres: of the coefficient of a mode that is not estimated yet, or not used."""


@runtime_checkable
class Looks(Protocol):
    """What a state knows of how landmarks look."""

    @property
    def registered(self) -> Any:
        """With `patches`."""
        ...

    @property
    def slopes(self) -> Slopes: ...

    @property
    def recent(self) -> Recent: ...

    @property
    def residual_scale(self) -> Array: ...


def spread(search: AdaptiveDiffusionState) -> Gaussian:
    """The mean around the particles' mode, with the spread of the particles."""
    x = search.estimate
    apart = jnp.where(jnp.isfinite(search.log_weights), search.particles - x[:, None], 0.0)
    return Gaussian(x, jnp.matmul(apart * weights.linear(search.log_weights), apart.T, precision="highest"))


def predicted(
    search: AdaptiveDiffusionState, before: Gaussian, model: FaceModel, moved: Float[Array, " 6"]
) -> Gaussian:
    """Of this frame before its images: the last belief, moved on, and no deformation too large.

    Args:
        search: After this frame's update.
        before: The last belief, of pose and mode coefficients.
        model: With the modes that may be used.
        moved: What the head was predicted to move since, millimetres and radians.
    """
    pose_covariance = before.covariance[:POSE, :POSE] + jnp.diag(jnp.square(search.spread[:POSE]))
    usual = jnp.square(jnp.where(model.deviation > 0, model.deviation, UNKNOWN_STD))
    walked = jnp.maximum(jnp.diagonal(before.covariance)[POSE:], 0.0) + KAPPA**2 * usual
    variance = 1 / (1 / walked + 1 / usual)
    mean = jnp.concatenate([before.mean[:POSE] + moved, variance / walked * before.mean[POSE:]])
    covariance = jnp.zeros_like(before.covariance).at[:POSE, :POSE].set(pose_covariance)
    return Gaussian(mean, covariance.at[POSE:, POSE:].set(jnp.diag(variance)))


def pose_corrections(
    search: AdaptiveDiffusionState, before: Gaussian, moved: Float[Array, " 6"], belief: Gaussian
) -> Int[Array, "2"]:
    """`correction_counts` of the pose in this frame.

    Args:
        search: After this frame's update.
        before: The last belief, of pose and mode coefficients.
        moved: What the head was predicted to move since, millimetres and radians.
        belief: After the frame.
    """
    of_pose = lambda covariance: jnp.diagonal(covariance)[:POSE]
    variance = of_pose(before.covariance) + jnp.square(search.spread[:POSE])
    correction = belief.mean[:POSE] - before.mean[:POSE] - moved
    return correction_counts(correction, variance, of_pose(belief.covariance))


def anywhere(
    patches: Patches,
    slopes: Slopes,
    images: Float[Array, "C rows cols"],
    uv: Float[Array, "C K 2"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    rig: CameraRig,
    *,
    beyond: Bool[ArrayLike, ""] = True,
) -> Alignment:
    """Landmarks aligned from where they are expected (`align`), and those that were not found also from elsewhere.

    The latter may be left out: `beyond`.
    """
    found = align(patches, slopes, images, uv, shape, pose, rig)
    return relocated(patches, slopes, images, found, uv, shape, pose, rig, beyond)


def looked_for(
    aligner: Callable[..., Alignment],
    state: Looks,
    model: FaceModel,
    images: Float[Array, "C rows cols"],
    rig: CameraRig,
    x: Float[Array, " n"],
    drift: recent.Drift = recent.DRIFT_PX,
) -> tuple[Alignment, Bool[Array, "C K"], Bool[Array, "C K"]]:
    """Landmarks in the images, which of them look as registered, and which are followed from the last frame.

    Args:
        aligner: `align` or `anywhere`.
        state: Before this frame.
        model: Of the face.
        images: Grey levels.
        rig: Cameras.
        x: Pose and mode coefficients near which they are looked for.
        drift: Of those that are followed, pixels.
    """
    M = shape(model, x[POSE:])
    uv, _ = project_shape(rig, M, x[:POSE])
    found = aligner(state.registered.patches, state.slopes, images, uv, M, x[:POSE], rig)
    anchored = recent.is_anchored(found)
    found, is_followed = recent.followed(state.recent, found, state.slopes, images, uv, M, x[:POSE], rig)
    drifted = recent.drifted(state.recent, is_followed, drift)[..., None, None] * jnp.eye(2)
    return found._replace(covariance=state.residual_scale * found.covariance + drifted), anchored, is_followed
