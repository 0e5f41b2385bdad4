"""The width of the irises, which is nearly the same in all people, as a measure of a face's size.

An iris that is w pixels wide is `f 11.7 mm / w` away. Where the face as adjusted so far has its eyes farther or nearer,
the whole face is larger or smaller in proportion: one number for a person, as good as people's irises are alike.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.bundle import Views, projected
from jaxfilters.models.face.landmarks import EYES
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Prior, log_size, nothing_past, posed_shape
from jaxfilters.models.face.pose import place
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.square_root_prior import SquareRootPrior
from jaxfilters.trackers.head.mono.adjustment import moved_person, of_frames, with_measurement
from jaxfilters.trackers.head.mono.start import Start

IRIS_MM, IRIS_STD_MM = 11.7, 0.5
"""Horizontal width of the iris in people (F. Ruefer, A. Schroeder, C. Erb, "White-to-white corneal diameter", 2005)."""
MEASURED_SHARE, MEASURED_PX = 0.02, 1.0
"""Standard deviation of a detector's widths, a share and pixels: the same in all frames, so that more do not help."""
BEFORE_MM = 5.0
"""By how much an iris is nearer than the middle of the eye's corners; assumed."""


def with_irises(
    face: MultilinearFace,
    rig: CameraRig,
    start: Start,
    views: Views,
    past: SquareRootPrior | None,
    iris_px: Float[np.ndarray, "n 2"],
    prior: Prior,
) -> tuple[Start, SquareRootPrior]:
    """The start as large as the irises say, weighed against what else tells the size; and what is known beside `views`.

    Args:
        face: Model of the ten landmarks.
        rig: One camera, which is the world.
        start: From the landmarks.
        views: Those of them that count.
        past: What is known beside them, if anything.
        iris_px: Widths of the right and the left iris in each frame, pixels.
        prior: What holds the face; its weight is not 0.
    """
    numbers = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, start.uv.dtype), tree)
    past = nothing_past(face) if past is None else past
    return _resized(face, rig, start, views, past, numbers(iris_px), numbers(prior))


@compiled_quickly
def _resized(
    face: MultilinearFace,
    rig: CameraRig,
    start: Start,
    views: Views,
    past: SquareRootPrior,
    iris_px: Array,
    prior: Prior,
) -> tuple[Start, SquareRootPrior]:
    bundle, person = start.bundle, start.bundle.person
    larger, std = measured(face, rig, start, iris_px)
    slope = jax.grad(lambda identity: log_size(face, identity))(person.identity)
    J = jnp.pad(face.identity_std * slope / std, (0, face.mean.size))[None]
    frames = of_frames(face, rig, views, bundle, prior)
    step, past = with_measurement(face, person, frames, past, J, -larger[None] / std, prior)
    moved = moved_person(face, person, step, prior)
    factor = jnp.exp(jnp.sum(slope * (moved.identity - person.identity)))
    bundle = bundle._replace(poses=bundle.poses.at[:, :3].multiply(factor), person=moved)
    return start._replace(bundle=bundle, uv=projected(face, rig, bundle)), past


def measured(
    face: MultilinearFace, rig: CameraRig, start: Start, iris_px: Float[Array, "n 2"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """By how much the irises say that the face is larger than it is in the start, as a logarithm; standard deviation.

    The median over frames and eyes: eyes that look aside or blink are narrower now and then.
    """
    bundle = start.bundle

    def depth(pose: Array, expression: Array) -> Array:
        corners = place(posed_shape(face, bundle.person, expression), pose)[jnp.asarray(EYES)]
        return jnp.stack([jnp.mean(corners[:2, 2]), jnp.mean(corners[2:, 2])]) - BEFORE_MM

    depths = jax.vmap(depth)(bundle.poses, bundle.expressions)
    apart = jnp.log(rig.focal[0, 0] * IRIS_MM / (iris_px * depths))
    width = jnp.median(iris_px)
    variance = (IRIS_STD_MM / IRIS_MM) ** 2 + MEASURED_SHARE**2 + jnp.square(MEASURED_PX / width)
    return jnp.median(apart), jnp.sqrt(variance)
