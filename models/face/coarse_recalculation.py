"""Recalculation of landmarks from coarse to fine: in blurred images first, which attract them from farther away.

In windows of 16 x 16 pixels steps on the grey levels find landmarks from some 5 pixels away. In images blurred by a
Gaussian, windows say less of where exactly a landmark is, and more of which way it lies.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Num, Real

from jaxfilters.models.face.recalculation import Recalculation, patches, recalculate
from jaxfilters.models.face.rig import CameraRig

LEVELS_PX = (4.0, 2.0, 0.0)
"""Standard deviations of the blur, coarse to fine."""


def blurred(
    images: Num[Array, "C rows cols"], *, levels_px: tuple[float, ...] = LEVELS_PX
) -> Float[Array, "levels C rows cols"]:
    """Images blurred by Gaussians, each with these standard deviations; beyond the border they go on as there.

    Raises:
        ValueError: if there is no level, or one is negative.
    """
    if not levels_px or min(levels_px) < 0:
        raise ValueError(f"levels_px must be one or more numbers from 0 on; got {levels_px}.")
    grey = jnp.asarray(images, float)
    return jnp.stack([_blurred(grey, sigma) for sigma in levels_px])


def windows(
    images: Float[Array, "levels C rows cols"], shape: Float[Array, "K 3"], pose: Float[Array, "6"], rig: CameraRig
) -> Float[Array, "levels C K T T"]:
    """Windows of 16 x 16 pixels about the images of the landmarks of a posed shape, at all levels."""
    return jax.vmap(lambda level: patches(level, shape, pose, rig))(images)


def recalculate_from_coarse(
    start: Float[Array, "K 3"],
    estimated: Float[Array, "K 3"],
    images: Float[Array, "levels C rows cols"],
    previous: Float[Array, "levels C K T T"],
    first: Float[Array, "levels C K T T"],
    pose: Float[Array, "6"],
    rig: CameraRig,
    *,
    rho: Real[ArrayLike, ""] = 4.0,
    epsilon: Real[ArrayLike, ""] = 2000.0,
) -> tuple[Float[Array, "K 3"], Recalculation]:
    """Shape of least energy at the last level, from that of least energy at the level before, and so on.

    Args:
        start: Shape from which the first level starts, millimetres.
        estimated: Shape near which the result stays, millimetres.
        images: Grey levels, as `blurred` has them.
        previous: `windows` about the recalculated landmarks in the frame before.
        first: `windows` about the landmarks in the first frame.
        pose: Of the head in this frame.
        rig: Cameras.
        rho: Weight of the frame before against the first one.
        epsilon: Weight of the distance from `estimated`, grey levels^2 / mm^2.
    """

    def finer(shape: Array, level: tuple[Array, Array, Array]) -> tuple[Array, Recalculation]:
        return recalculate(shape, estimated, *level, pose, rig, rho=rho, epsilon=epsilon)

    shape, infos = lax.scan(finer, start, (images, previous, first))
    return shape, jax.tree.map(lambda leaf: leaf[-1], infos)


def _blurred(images: Array, sigma: float) -> Array:
    if sigma == 0:
        return images
    reach = math.ceil(3 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = jnp.asarray(weights / weights.sum(), images.dtype)
    wide = jnp.pad(images, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    down = lax.conv(wide[:, None], kernel[None, None, :, None], (1, 1), "VALID", precision="highest")
    return lax.conv(down, kernel[None, None, None], (1, 1), "VALID", precision="highest")[:, 0]
