"""Patches of skin as the cameras saw them at registration, and how their pictures change when the head turns.

A patch is taken for a small piece of a curved surface. From the pose follows how its picture is stretched and turned,
an affine map for each camera and landmark, and how it bends. How the surface is inclined is known only roughly at
first, from an average head, and how it is curved not at all; what a turned head shows of both is estimated (`Slopes`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxfilters._full_precision import einsum
from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.face.correlation import cut
from jaxfilters.models.face.rig import CameraRig, jacobian, project_shape

SKIN_NORMALS = np.array(
    [
        *((-0.54, 0.23, -0.81), (-0.35, -0.08, -0.93), (0.35, -0.08, -0.93), (0.54, 0.23, -0.81)),
        *((-0.50, 0.15, -0.86), (0.50, 0.15, -0.86), (-0.51, -0.14, -0.85), (0.51, -0.14, -0.85)),
        *((-0.09, -0.02, -1.0), (0.09, -0.02, -1.0)),
    ]
)
"""Outward normals of the skin within 9 mm of each landmark, on the mean head of the ICT face model (light-stage scans;
R. Li et al., "Learning formation of physically-based face attributes", 2020; MIT License, see the file `NOTICE`)."""
SIZE, WIDE_SIZE = 16, 24
"""Pixels of a window; of what is kept of the first image, so that a window is still full when its picture shrinks."""
REACH_PX = 6
"""Lag from which on the residual at two pixels counts as uncorrelated."""
SLOPE_STD = 0.35
"""Of the slopes before the head has turned: skin is within some 20 degrees of where it is on the mean head."""
LEAST_SLOPE_STD = 0.02
"""Skin is no smooth surface."""
STEEPEST = 1.0
CURVATURE_STD = 0.04
"""1/mm, of the curvatures before the head has turned: a ball of 25 mm."""
LEAST_CURVATURE_STD, MOST_CURVED = 0.001, 0.12
NUM_RELIEF = 5
"""Two slopes, and the curvatures along the first direction, across, and along the second one."""


@pytree_dataclass
class Patches:
    """The images at registration; C cameras, K landmarks, windows of T x T pixels in TT numbers."""

    wide: Float[Array, "C K W W"]
    """Grey levels of a larger window."""
    template: Float[Array, "C K TT"]
    """Grey levels of the window without their mean."""
    gradient: Float[Array, "C K TT 2"]
    """Of the template along (u, v), without what gain and offset could explain."""
    inverse: Float[Array, "C K 2 2"]
    """Inverse of the gradient's second moments: shift for each unit of correlation with the gradient."""
    overlap: Float[Array, "C K lags lags 2 2"]
    """Sum over all pixels of the gradient there times that some pixels further on, by (v, u) lags from `-REACH_PX + 1`
    to `REACH_PX - 1`; the larger the lag, the less it counts (Bartlett)."""
    tangents: Float[Array, "C K 3 2"]
    """Millimetres on the skin, in the model frame, for each pixel of the template."""
    lift: Float[Array, "C K 3"]
    """Along the line of sight at registration, in the model frame: as far as takes a point 1 mm out of the plane."""
    plan: Float[Array, "C K 2 2"]
    """Millimetres along two directions within the plane for each pixel of the template."""
    normals: Float[Array, "K 3"]
    """Outward, in the model frame."""


class Slopes(NamedTuple):
    """How the skin rises out of the plane that was assumed for it, estimated while the head turns.

    At a mm along the first direction within the plane and b mm along the second one it rises by
    `s_1 a + s_2 b + s_3 a^2 / 2 + s_4 a b + s_5 b^2 / 2` mm.
    """

    mean: Float[Array, "K S"]
    """Slopes, and curvatures in 1/mm."""
    covariance: Float[Array, "K S S"]


def patches(
    images: Num[Array, "C rows cols"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    rig: CameraRig,
    normals: Float[Array, "K 3"],
) -> Patches:
    """Patches about the images of a posed shape.

    Args:
        images: Grey levels at registration.
        shape: Landmarks in the model frame, millimetres.
        pose: Of the head in these images.
        rig: Cameras.
        normals: Outward normals of the skin at the landmarks, model frame, of any length.
    """
    uv, _ = project_shape(rig, shape, pose)
    return patches_of(windows(images, uv), shape, pose, rig, normals)


def windows(images: Num[Array, "C rows cols"], uv: Float[Array, "C K 2"]) -> Float[Array, "C K W W"]:
    """Grey levels about pixels, as `Patches.wide` holds them."""
    return jax.vmap(lambda image, points: cut(image, points, WIDE_SIZE))(images, uv)


def patches_of(
    wide: Float[Array, "C K W W"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    rig: CameraRig,
    normals: Float[Array, "K 3"],
) -> Patches:
    """Patches from `windows` of a posed shape; the other arguments are those of `patches`."""
    template, gradient, inverse, overlap = _moments(_middle(wide), _grey_slope(wide))
    by_shape, _ = jacobian(rig, shape, pose)
    unit = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    frame = jnp.concatenate([by_shape, jnp.broadcast_to(unit[None, :, None], (*wide.shape[:2], 1, 3))], axis=2)
    # Two columns keep within the plane; the third, of no pixels, goes along the line of sight.
    columns = jnp.linalg.inv(frame)
    plan = einsum("kxi,ckxj->ckij", _within(unit), columns[..., :2])
    return Patches(wide, template, gradient, inverse, overlap, columns[..., :2], columns[..., 2], plan, unit)


def unknown_slopes(num_landmarks: int) -> Slopes:
    """Slopes before the head has turned."""
    variance = jnp.array([SLOPE_STD**2] * 2 + [CURVATURE_STD**2] * 3)
    return Slopes(jnp.zeros((num_landmarks, NUM_RELIEF)), jnp.tile(jnp.diag(variance), (num_landmarks, 1, 1)))


def learn_slopes(slopes: Slopes, information: Float[Array, "K S S"], score: Float[Array, "K S"]) -> Slopes:
    """Slopes after another view, by Bayes' rule.

    Args:
        slopes: Before.
        information: Of the view, about the slopes.
        score: That information times how much they differ from what was assumed.
    """
    return learn_slopes_again(slopes, slopes, information, score)


def learn_slopes_again(
    before: Slopes, assumed: Slopes, information: Float[Array, "K S S"], score: Float[Array, "K S"]
) -> Slopes:
    """Slopes after another view that was taken with others assumed than those that were known before it.

    Args:
        before: What is known without the view.
        assumed: With what the view was taken, as its linear equations have it.
        information: Of the view, about the slopes.
        score: That information times how much they differ from what was assumed.
    """
    eye = jnp.eye(score.shape[-1], dtype=information.dtype)
    prior = jnp.linalg.inv(before.covariance)
    covariance = jnp.linalg.inv(prior + information)
    pull = score + einsum("kij,kj->ki", prior, before.mean - assumed.mean)
    mean = assumed.mean + einsum("kij,kj->ki", covariance, pull)
    # Everything that follows is relative: slopes and curvatures have units of their own.
    least = _of_terms(LEAST_SLOPE_STD, LEAST_CURVATURE_STD, mean)
    most = _of_terms(STEEPEST, MOST_CURVED, mean)
    lacking = jnp.maximum(least**2 - jnp.diagonal(covariance, axis1=1, axis2=2), 0.0)
    return Slopes(jnp.clip(mean, -most, most), covariance + lacking[..., None] * eye)


def stretch(patches: Patches, slopes: Slopes, by_shape: Float[Array, "C K 2 3"]) -> Float[Array, "C K 2 2"]:
    """Pixels of an image for each pixel of the template, for a head whose pixels have the derivatives `by_shape`."""
    rise = einsum("ki,ckij->ckj", slopes.mean[:, :2], patches.plan)
    tangents = patches.tangents + patches.lift[..., None] * rise[:, :, None]
    return einsum("ckix,ckxj->ckij", by_shape, tangents)


def bend(patches: Patches, slopes: Slopes, by_shape: Float[Array, "C K 2 3"]) -> Float[Array, "C K TT 2"]:
    """Pixels by which the curvatures move what each pixel of the template shows, beyond the affine `stretch`."""
    rise = einsum("ks,ckps->ckp", slopes.mean[:, 2:], relief(patches, slopes.mean.shape[1])[..., 2:])
    return rise[..., None] * einsum("ckix,ckx->cki", by_shape, patches.lift)[:, :, None]


def relief(patches: Patches, terms: int) -> Float[Array, "C K TT S"]:
    """Millimetres that the skin rises at each pixel of the template for a unit of each of the first `terms` slopes."""
    a, b = jnp.moveaxis(einsum("ckij,pj->ckpi", patches.plan, window_grid()), -1, 0)
    return jnp.stack([a, b, 0.5 * a * a, a * b, 0.5 * b * b][:terms], axis=-1)


def window_grid() -> Float[Array, "TT 2"]:
    """(u, v) of a window's pixels from its middle, row by row."""
    reach = jnp.arange(SIZE) - (SIZE - 1) / 2
    return jnp.stack(jnp.meshgrid(reach, reach, indexing="xy"), axis=-1).reshape(-1, 2)


def turned(patches: Patches, affine: Float[Array, "C K 2 2"]) -> Float[Array, "C K T T"]:
    """Templates as a head would show them that stretches them by `affine`, at most half a window beyond its border."""
    usable = jnp.abs(jnp.linalg.det(affine)) > 0.05
    inverse = jnp.linalg.inv(jnp.where(usable[..., None, None], affine, jnp.eye(2)))
    middle = (WIDE_SIZE - 1) / 2
    points = jnp.clip(einsum("ckij,pj->ckpi", inverse, window_grid()) + middle, 0.0, WIDE_SIZE - 1.001)
    corner = jnp.floor(points)
    a, b = points[..., 0] - corner[..., 0], points[..., 1] - corner[..., 1]
    flat = patches.wide.reshape(*patches.wide.shape[:2], -1)
    index = (corner[..., 1] * WIDE_SIZE + corner[..., 0]).astype(jnp.int32)
    at = lambda offset: jnp.take_along_axis(flat, index + offset, axis=-1)
    upper, lower = (at(o) * (1 - a) + at(o + 1) * a for o in (0, WIDE_SIZE))
    return (upper * (1 - b) + lower * b).reshape(*affine.shape[:2], SIZE, SIZE)


def slope_of_grey(patches: Patches) -> Float[Array, "C K TT 2"]:
    """Gradient of the template along (u, v), grey levels a pixel, with what gain and offset could explain."""
    return _grey_slope(patches.wide)


def without_light(template: Float[Array, "C K TT"], columns: Float[Array, "C K TT n"]) -> Float[Array, "C K TT n"]:
    """What another gain and another offset of the template, itself of mean 0, do not explain of each column."""
    columns = columns - jnp.mean(columns, axis=2, keepdims=True)
    energy = jnp.maximum(jnp.sum(template * template, axis=2), 1e-6)
    gain = einsum("ckp,ckpi->cki", template, columns) / energy[..., None]
    return columns - template[..., None] * gain[:, :, None]


def _of_terms(slope: float, curvature: float, mean: Array) -> Array:
    return jnp.array([slope] * 2 + [curvature] * 3, mean.dtype)[: mean.shape[-1]]


def _middle(wide: Array) -> Array:
    border = (WIDE_SIZE - SIZE) // 2
    return wide[:, :, border:-border, border:-border]


def _grey_slope(wide: Array) -> Array:
    dv, du = jnp.gradient(wide, axis=(2, 3))
    return jnp.stack([_middle(du), _middle(dv)], axis=-1).reshape(*wide.shape[:2], SIZE * SIZE, 2)


def _moments(window: Array, gradient: Array) -> tuple[Array, Array, Array, Array]:
    """Template, gradient free of gain and offset, inverse of its moments, and their sums over lagged pixels."""
    C, K, size = window.shape[:3]
    flat = (window - jnp.mean(window, axis=(2, 3), keepdims=True)).reshape(C, K, size * size)
    columns = without_light(flat, gradient)
    inverse = jnp.linalg.inv(einsum("ckpi,ckpj->ckij", columns, columns) + 1e-3 * jnp.eye(2))
    squares = lambda a: a.reshape(*a.shape[:2], size, size, -1).transpose(0, 1, 4, 2, 3)
    slopes = squares(columns)
    weight = 1 - np.abs(np.arange(1 - REACH_PX, REACH_PX)) / REACH_PX
    near = np.outer(weight, weight) * lagged(slopes[:, :, :, None], slopes[:, :, None])
    overlap = jnp.moveaxis(near, (2, 3), (4, 5))
    # A residual is free of what the fit has taken: shift, gain and offset. White noise less these has the correlation
    # `taken` beside that of no lag, which would make the covariance too small.
    light = squares(
        jnp.stack(
            [
                flat / jnp.sqrt(jnp.maximum(jnp.sum(flat * flat, axis=2, keepdims=True), 1e-6)),
                jnp.full_like(flat, 1 / size),
            ],
            axis=-1,
        )
    )
    whole = lagged(slopes[:, :, :, None], slopes[:, :, None])
    taken = einsum("ckij,ckijvu->ckvu", inverse, whole) + jnp.sum(lagged(light, light), axis=2)
    share = einsum("ckvu,ckvuij,ckji->ck", taken / size**2, overlap, inverse) / 2
    return flat, columns, inverse, overlap / jnp.maximum(1 - share, 0.3)[..., None, None, None, None]


def lagged(a: Float[Array, "*a T T"], b: Float[Array, "*b T T"]) -> Float[Array, "*c lags lags"]:
    """Sum over all pixels of one square times the other some pixels further on, by lag below `REACH_PX`."""
    size = a.shape[-1] + REACH_PX
    product = jnp.conj(jnp.fft.rfft2(a, s=(size, size))) * jnp.fft.rfft2(b, s=(size, size))
    lags = jnp.roll(jnp.fft.irfft2(product, s=(size, size)), REACH_PX - 1, axis=(-2, -1))
    return lags[..., : 2 * REACH_PX - 1, : 2 * REACH_PX - 1]


def _within(normals: Array) -> Array:
    """Two unit vectors across each normal, as columns."""
    first = jnp.cross(normals, jnp.array([0.0, 1.0, 0.0], normals.dtype))
    first /= jnp.linalg.norm(first, axis=1, keepdims=True)
    return jnp.stack([first, jnp.cross(normals, first)], axis=-1)
