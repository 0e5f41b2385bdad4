"""Where each landmark is in each image, to a fraction of a pixel: its patch of the first images, turned with the head.

A few Gauss-Newton steps in the inverse compositional form (S. Baker, I. Matthews, "Lucas-Kanade 20 years on", 2004),
free of gain and offset, find the shift that the predicted pose leaves. What the turned surface does not explain stays
in the residual, and the covariance is that of the shift under a residual that is correlated over neighbouring pixels
as this one is. The same residual says how the surface is inclined and curved.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import einsum
from jaxfilters.models.face.correlation import score_map
from jaxfilters.models.face.patches import (
    SIZE,
    Patches,
    Slopes,
    bend,
    lagged,
    relief,
    slope_of_grey,
    stretch,
    turned,
    window_grid,
    without_light,
)
from jaxfilters.models.face.rig import CameraRig, jacobian

ITERATIONS = 6
MOST_STEP_PX = 2.0
"""A patch is no wider than that for a linear step to be trusted further."""
LEAST_FACING = 0.2
"""Cosine of the angle between a patch's normal and the line of sight from which on it is looked at."""
LEAST_TEACHING_SCORE = 0.7
"""Normalised correlation from which on a residual is taken for a matter of the slopes."""

DOUBTFUL_SCORE = 0.8
"""Normalised correlation below which a landmark may be elsewhere."""
SEARCHED_PX = 24
"""How far from where it is expected it is then searched for."""


class Alignment(NamedTuple):
    """Where the landmarks were found."""

    uv: Float[Array, "C K 2"]
    """Pixels."""
    covariance: Float[Array, "C K 2 2"]
    """Pixels squared."""
    score: Float[Array, "C K"]
    """Normalised correlation there, -1 to 1."""
    observed: Bool[Array, "C K"]
    """Whether the patch faces the camera and lies inside the image."""
    by_slope: Float[Array, "C K 2 S"]
    """How far the place moves, in pixels, with slopes that the skin has beyond those assumed."""
    slope_information: Float[Array, "K S S"]
    slope_score: Float[Array, "K S"]
    """What the residual says of the slopes, as `learn_slopes` takes it."""


def align(
    patches: Patches,
    slopes: Slopes,
    images: Float[Array, "C rows cols"],
    uv: Float[Array, "C K 2"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    rig: CameraRig,
) -> Alignment:
    """Landmarks in the images, searched from `uv`, for a head of `shape` that is near `pose`."""
    by_shape, _ = jacobian(rig, shape, pose)
    affine = stretch(patches, slopes, by_shape)
    is_facing = facing(patches, by_shape)
    affine = jnp.where(is_facing[..., None, None], affine, jnp.eye(2))
    by_shape = jnp.where(is_facing[..., None, None], by_shape, 0.0)
    offsets = einsum("ckij,pj->ckpi", affine, window_grid()) + bend(patches, slopes, by_shape)

    def iterate(_: Array | int, uv: Array) -> Array:
        shift = _look(patches, images, uv[:, :, None] + offsets)[0]
        step = -einsum("ckij,ckj->cki", affine, shift)
        length = jnp.linalg.norm(step, axis=-1, keepdims=True)
        return uv + step * jnp.minimum(1.0, MOST_STEP_PX / jnp.maximum(length, 1e-6))

    found = jax.lax.fori_loop(0, ITERATIONS, iterate, jnp.where(jnp.isfinite(uv), uv, 0.0))
    _, residual, score = _look(patches, images, found[:, :, None] + offsets)
    observed = is_facing & _inside(images.shape[1:], found, affine) & jnp.isfinite(score)
    covariance, variance = _covariance(patches, residual, affine)
    teaching = observed & (score > LEAST_TEACHING_SCORE)
    by_slope, information, slope_score = _slopes(
        patches, slopes.mean.shape[1], residual, variance, affine, by_shape, teaching
    )
    return Alignment(found, covariance, score, observed, by_slope, information, slope_score)


def relocated(
    patches: Patches,
    slopes: Slopes,
    images: Float[Array, "C rows cols"],
    found: Alignment,
    uv: Float[Array, "C K 2"],
    shape: Float[Array, "K 3"],
    pose: Float[Array, " 6"],
    rig: CameraRig,
    allowed: Bool[ArrayLike, ""] = True,
) -> Alignment:
    """The alignment with landmarks that fit badly searched for all around, up to `SEARCHED_PX` away.

    A mouth that opens is far from where it was within a frame or two. Where a landmark correlates by less than
    `DOUBTFUL_SCORE`, the best place of its turned template nearby is taken instead, if it is convincing.

    Args:
        patches: As for `align`, like the others.
        slopes: Of the skin.
        images: Grey levels.
        found: Alignment from `uv`.
        uv: Where the landmarks are expected, pixels.
        shape: Model frame, millimetres.
        pose: Millimetres and radians.
        rig: Cameras.
        allowed: Whether to search at all.
    """
    doubtful = found.observed & (found.score < DOUBTFUL_SCORE) & allowed
    return jax.lax.cond(
        jnp.any(doubtful),
        lambda: _searched(patches, slopes, images, found, doubtful, uv, shape, pose, rig),
        lambda: found,
    )


def _searched(patches, slopes, images, found, doubtful, uv, shape, pose, rig):
    by_shape, _ = jacobian(rig, shape, pose)
    affine = jnp.where(found.observed[..., None, None], stretch(patches, slopes, by_shape), jnp.eye(2))
    side = 2 * SEARCHED_PX + 1
    expected = jnp.where(jnp.isfinite(uv), uv, 0.0)
    origin = jnp.round(expected - (SIZE - 1) / 2) - SEARCHED_PX
    search = lambda image, template, corner: score_map(image, template, corner, (side, side))
    maps = jax.vmap(jax.vmap(search, (None, 0, 0)))(images, turned(patches, affine), origin)
    best = jnp.argmax(maps.reshape(*maps.shape[:2], -1), axis=-1)
    place = origin + jnp.stack([best % side, best // side], axis=-1) + (SIZE - 1) / 2
    again = align(patches, slopes, images, jnp.where(doubtful[..., None], place, found.uv), shape, pose, rig)
    better = doubtful & again.observed & (again.score > jnp.maximum(found.score, DOUBTFUL_SCORE))
    return taken_over(found, again, better)


def taken_over(found: Alignment, again: Alignment, better: Bool[Array, "C K"]) -> Alignment:
    """The first alignment, but for landmarks that the second measures better; of slopes only the first speaks."""
    pick = lambda a, b: jnp.where(better.reshape(better.shape + (1,) * (a.ndim - 2)), a, b)
    names = ("uv", "covariance", "score", "by_slope")
    return found._replace(**{name: pick(getattr(again, name), getattr(found, name)) for name in names})


def _look(patches: Patches, images: Array, points: Array) -> tuple[Array, Array, Array]:
    """The shift that is left, in pixels of the template; the residual, in its grey levels; the correlation."""
    window = _sample(images, points)
    window -= jnp.mean(window, axis=2, keepdims=True)
    template = patches.template
    energy = jnp.maximum(jnp.sum(template * template, axis=2), 1e-6)
    product = jnp.sum(window * template, axis=2)
    gain = jnp.maximum(product / energy, 1e-3)
    residual = window / gain[..., None] - template
    shift = einsum("ckij,ckpj,ckp->cki", patches.inverse, patches.gradient, residual)
    score = product / jnp.sqrt(jnp.maximum(energy * jnp.sum(window * window, axis=2), 1e-6))
    return shift, residual, score


def _covariance(patches: Patches, residual: Array, affine: Array) -> tuple[Array, Array]:
    """Of the shift; and the variance of a white residual that would say as little, grey levels squared.

    `Q (sum_pq g_p g_q^T c(p - q)) Q` for the gradient g, whose moments have the inverse Q, and the residual's own
    correlation c, which counts the less the farther two pixels are apart (W. Newey, K. West, "A simple, positive
    semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix", 1987).
    """
    C, K, pixels = residual.shape
    square = residual.reshape(C, K, SIZE, SIZE)
    correlation = lagged(square, square) / pixels
    moments = einsum("ckvu,ckvuij->ckij", correlation, patches.overlap)
    moments += 1e-6 * jnp.linalg.inv(patches.inverse)
    per_moment = einsum("ckij,ckjl->ckil", affine, patches.inverse)
    covariance = einsum("ckij,ckjl,ckml->ckim", per_moment, moments, per_moment)
    return covariance, 0.5 * einsum("ckij,ckji->ck", patches.inverse, moments)


def _slopes(
    patches: Patches, terms: int, residual: Array, variance: Array, affine: Array, by_shape: Array, teaching: Array
) -> tuple[Array, Array, Array]:
    """Effect of the slopes on the place, and what the residual says of them once the shift has had its part."""
    rising = einsum("ckix,ckx->cki", by_shape, patches.lift)
    rising = jnp.linalg.solve(affine, rising[..., None])[..., 0]
    # Gain and offset explain some of the picture's change, but only once every pixel has changed as far as it rises.
    along = einsum("ckpi,cki->ckp", slope_of_grey(patches), rising)
    columns = without_light(patches.template, -along[..., None] * relief(patches, terms))
    shift = einsum("ckij,ckpj,ckps->ckis", patches.inverse, patches.gradient, columns)
    left = columns - einsum("ckpi,ckis->ckps", patches.gradient, shift)
    per_variance = jnp.where(teaching, 1 / variance, 0.0)
    information = einsum("ck,ckps,ckpr->ksr", per_variance, left, left)
    score = einsum("ck,ckps,ckp->ks", per_variance, left, residual)
    return -einsum("ckij,ckjs->ckis", affine, shift), information, score


def facing(patches: Patches, by_shape: Float[Array, "C K 2 3"]) -> Bool[Array, "C K"]:
    """Whether the outside of a patch is turned to the camera, before which it lies.

    Args:
        patches: Patches.
        by_shape: Derivatives of the pixels by the model points, NaN behind the camera.
    """
    # The rows of the derivative span the plane across the line of sight; they are NaN behind the camera.
    sight = jnp.cross(by_shape[:, :, 0], by_shape[:, :, 1])
    sight /= jnp.maximum(jnp.linalg.norm(sight, axis=-1, keepdims=True), 1e-12)
    return -jnp.sum(sight * patches.normals, axis=-1) > LEAST_FACING


def _inside(shape: tuple[int, ...], uv: Array, affine: Array) -> Array:
    reach = jnp.sum(jnp.abs(affine), axis=-1) * SIZE / 2
    last = jnp.array([shape[1] - 1, shape[0] - 1], uv.dtype)
    return jnp.all((uv >= reach) & (uv <= last - reach), axis=-1)


def _sample(images: Array, points: Array) -> Array:
    """Grey values at pixels (C, K, n, 2), bilinear; the border goes on beyond the image."""
    rows, cols = images.shape[1:]
    u = jnp.clip(points[..., 0], 0.0, cols - 1.001)
    v = jnp.clip(points[..., 1], 0.0, rows - 1.001)
    column, row = jnp.floor(u).astype(jnp.int32), jnp.floor(v).astype(jnp.int32)
    a, b = u - column, v - row
    camera = jnp.arange(images.shape[0])[:, None, None]
    at = lambda down, right: images[camera, row + down, column + right]
    upper = at(0, 0) * (1 - a) + at(0, 1) * a
    lower = at(1, 0) * (1 - a) + at(1, 1) * a
    return upper * (1 - b) + lower * b
