"""Which shapes the deformation model learns from, and what it becomes."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.math import incremental_pca
from jaxfilters.models.face.landmarks import RIGID_WEIGHTS
from jaxfilters.models.face.recalculation import patches, recalculate
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.rigid import remove_rigid
from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.trackers.head.common.search import LEAST_DEVIATION
from jaxfilters.trackers.head.common.state import NUM_MODES, Learner

MOST_YAW, MOST_PITCH = math.radians(25.0), math.radians(20.0)
"""Of a face that is turned to the cameras."""
LEAST_SCORE = 0.5
"""Mean correlation from which on a shape is measured. An unseen deformation alone costs up to 0.4."""
Still = Callable[[Array, Array], Array]
LEAST_CHANGE = 6.0
"""Millimetres, root of the sum over all landmarks: what counts as a deformation."""


def without_weighted_motion(change: Float[Array, "K 3"], mean: Float[Array, "K 3"]) -> Float[Array, "K 3"]:
    """Least squares with weights for landmarks that keep still."""
    return remove_rigid(change, mean, jnp.asarray(RIGID_WEIGHTS, change.dtype))


def empty_learner(shape: Float[Array, "K 3"], windows: Float[Array, "C K T T"]) -> Learner:
    """The learner at registration: the registered shape is the first."""
    return Learner(
        incremental_pca.start(shape.size, NUM_MODES), jnp.ones((), jnp.int32), shape, windows, jnp.zeros((), bool)
    )


def measurable(pose: Float[Array, " 6"], score: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether the face is visible well enough to measure its shape."""
    return (jnp.abs(pose[4]) <= MOST_YAW) & (jnp.abs(pose[5]) <= MOST_PITCH) & (score >= LEAST_SCORE)


def recalculated(
    learner: Learner,
    estimated: Float[Array, "K 3"],
    images: Float[Array, "C rows cols"],
    templates: Float[Array, "C K T T"],
    pose: Float[Array, " 6"],
    rig: CameraRig,
) -> tuple[Float[Array, "K 3"], Float[Array, "C K T T"]]:
    """Shape by recalculation from grey levels, and the windows about its images.

    Oka and Sato 2006, equations 25 to 28.
    """
    start = jnp.where(learner.is_fresh, learner.shape, estimated)
    previous = jnp.where(learner.is_fresh, learner.windows, templates)
    shape, _ = recalculate(start, estimated, images, previous, templates, pose, rig)
    return shape, patches(images, shape, pose, rig)


def learned(
    learner: Learner,
    model: FaceModel,
    shape: Float[Array, "K 3"],
    windows: Float[Array, "C K T T"],
    is_measured: Bool[Array, ""],
    follow: float,
    still: Still,
) -> tuple[Learner, FaceModel]:
    """Learner and model after a shape, if it was measured at all.

    What the skull's own motion may have left in the shape is taken out; shapes far from the mean change the modes.

    Args:
        learner: Before.
        model: Before.
        shape: Measured, model frame, millimetres.
        windows: Grey levels about its images.
        is_measured: Whether there is a shape.
        follow: How far the mean goes along with the shapes: 1 makes it their mean, as published; 0 keeps it at the
            registered face, which a face comes back to whenever it is at rest.
        still: `(change, mean) -> change` without the skull's own motion.
    """
    change = still(shape - model.mean, model.mean)
    usable = is_measured & jnp.all(jnp.isfinite(change))
    change = jnp.where(usable, change, 0.0)
    count = learner.num_shapes + usable.astype(jnp.int32)
    far = jnp.sqrt(jnp.sum(change**2)) > LEAST_CHANGE
    modes = jax.lax.cond(
        far, lambda: incremental_pca.update(learner.subspace, change.ravel()), lambda: learner.subspace
    )
    found = incremental_pca.principal_components(modes)
    deviation = jnp.where(found.variances > 0, jnp.maximum(jnp.sqrt(found.variances), LEAST_DEVIATION), 0.0)
    after = Learner(modes, count, jnp.where(usable, shape, learner.shape), windows, usable)
    return after, FaceModel(model.mean + follow / count * change, found.basis, deviation, model.templates)


def carried(x: Float[Array, "B n"], before: FaceModel, after: FaceModel) -> Float[Array, "B n"]:
    """Mode coefficients of the same shapes, or the nearest, in a model that has changed."""
    return incremental_pca.change_basis(x, before.mean.ravel(), before.basis, after.mean.ravel(), after.basis)


def turning(before: FaceModel, after: FaceModel) -> Float[Array, "B B"]:
    """What happens to deviations of the coefficients."""
    return jnp.matmul(after.basis.T, before.basis, precision="highest")


def contribution(learner: Learner) -> Array:
    """Share of the deformation that the modes explain, 0 to 1."""
    return incremental_pca.explained_variance_ratio(learner.subspace)
