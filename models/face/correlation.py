"""Normalised correlation of small grey windows with templates: one by one, or over boxes of windows at once.

A window of T x T pixels centred at (u, v) has its top left pixel at (u, v) - (T - 1) / 2; between pixels it is
interpolated bilinearly, and beyond the border the image goes on as at the border. Grey levels are those of 8 bits.

`score_points` cuts a window for every point. `window_sums` and `score_sums` come to the same scores without: numerator,
mean and variance of an interpolated window follow from sums over windows at whole pixels, which transforms and
running sums yield for a whole box.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Num

Image = Num[Array, "rows cols"]


def ncc(a: Num[Array, "*shape"], b: Num[Array, "*shape"]) -> Float[Array, ""]:
    """Normalised correlation in [-1, 1] of two patches with their means removed (section 2.6); 0 if one is flat."""
    a, b = _floats(a), _floats(b)
    a_centred, b_centred = a - jnp.mean(a), b - jnp.mean(b)
    aa, bb = jnp.sum(a_centred**2), jnp.sum(b_centred**2)
    rounding = (16 * jnp.finfo(a.dtype).eps) ** 2
    flat = (aa <= rounding * jnp.sum(a**2)) | (bb <= rounding * jnp.sum(b**2))
    scale = lax.rsqrt(jnp.where(flat, 1.0, aa)) * lax.rsqrt(jnp.where(flat, 1.0, bb))
    return jnp.where(flat, 0.0, jnp.clip(jnp.sum(a_centred * b_centred) * scale, -1.0, 1.0))


def inside(image_shape: Sequence[int], points: Float[Array, "*batch 2"], size: int) -> Bool[Array, "*batch"]:
    """Which windows of `size` pixels about points (u, v) lie in the image wholly; none about NaN does."""
    rows, cols = image_shape
    top_left = points - (size - 1) / 2
    u, v = top_left[..., 0], top_left[..., 1]
    return (u >= 0) & (v >= 0) & (u <= cols - size) & (v <= rows - size)


def cut(image: Image, points: Float[Array, "K 2"], size: int = 16) -> Float[Array, "K {size} {size}"]:
    """Windows of the image about points (u, v); about NaN they are finite and mean nothing."""
    margin = size + 1
    padded = jnp.pad(image, margin, mode="edge")
    rows, cols = image.shape
    limit = jnp.array([cols, rows])

    def window(point):
        top_left = jnp.where(jnp.isfinite(point), point, 0.0) - (size - 1) / 2
        corner = jnp.floor(top_left)
        f = (top_left - corner).astype(point.dtype)
        # One window's width beyond the border everything is the border: so far the margin reaches.
        u, v = jnp.clip(corner, -margin, limit).astype(jnp.int32) + margin
        w = lax.dynamic_slice(padded, (v, u), (margin, margin)).astype(point.dtype)
        w = w[:, :-1] * (1 - f[0]) + w[:, 1:] * f[0]
        return w[:-1] * (1 - f[1]) + w[1:] * f[1]

    return jax.vmap(window)(points)


def score_points(image: Image, template: Num[Array, "T T"], points: Float[Array, "N 2"]) -> Float[Array, " N"]:
    """Correlation of a template with the windows about points (u, v), cut one by one; -1 where they leave the image."""
    size = template.shape[0]
    scores = jax.vmap(ncc, (0, None))(cut(image, points, size), template)
    return jnp.where(inside(image.shape, points, size), scores, -1.0)


class WindowSums(NamedTuple):
    """Sums over the windows that start at each pixel of a box, grey levels measured from the box's mean."""

    template: Float[Array, "rows cols"]
    """Product with the template, itself of mean 0 and norm 1; of norm 0 if it is flat."""
    grey: Float[Array, "rows cols"]
    square: Float[Array, "rows cols"]
    across: Float[Array, "rows cols-1"]
    """Products of each pixel with its right neighbour."""
    down: Float[Array, "rows-1 cols"]
    """Products of each pixel with the one below."""
    falling: Float[Array, "rows-1 cols-1"]
    """Products of each pixel with the one below on the right."""
    rising: Float[Array, "rows-1 cols-1"]
    """Products of the right neighbour with the one below."""


def window_sums(box: Float[Array, "height width"], template: Float[Array, "T T"]) -> WindowSums:
    """The sums from which `score_sums` has scores anywhere in a box of the image.

    The product with the template is a product of Fourier transforms: round the box's ends only windows that leave it
    are wrong. Single precision is enough, since the transform's error, at most a millionth of the contrast of the
    box, is small beside the contrast of a window.
    """
    size = template.shape[0]
    x = box - jnp.mean(box)
    product = jnp.fft.rfft2(x) * jnp.conj(jnp.fft.rfft2(_normalised(template), s=x.shape))
    rows, cols = x.shape[0] - size + 1, x.shape[1] - size + 1
    return WindowSums(
        jnp.fft.irfft2(product, s=x.shape)[:rows, :cols],
        _sum_windows(x, size),
        _sum_windows(x * x, size),
        _sum_windows(x[:, :-1] * x[:, 1:], size),
        _sum_windows(x[:-1] * x[1:], size),
        _sum_windows(x[:-1, :-1] * x[1:, 1:], size),
        _sum_windows(x[:-1, 1:] * x[1:, :-1], size),
    )


def score_sums(sums: WindowSums, top_left: Float[Array, "2 N"], size: int) -> Float[Array, " N"]:
    """Correlation with the windows whose top left pixels are at (u, v) in the box; those beyond it move to its edge.

    With weights c of the four windows at whole pixels around it, an interpolated window has the sums `sum_i c_i s_i`
    and the square `sum_ij c_i c_j s_ij`.
    """
    rows, cols = sums.grey.shape
    limit = jnp.array([[cols - 1], [rows - 1]])
    top_left = jnp.clip(top_left, 0, limit)
    corner = jnp.clip(jnp.floor(top_left), 0, limit - 1)
    f, g = top_left - corner
    u, v = corner.astype(jnp.int32)
    at = lambda a, right, below: a.at[v + below, u + right].get(mode="promise_in_bounds")
    c00, c10, c01, c11 = (1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g
    corners = ((c00, 0, 0), (c10, 1, 0), (c01, 0, 1), (c11, 1, 1))
    numerator, mean = (sum(c * at(a, *o) for c, *o in corners) for a in (sums.template, sums.grey))
    square = (
        sum(c * c * at(sums.square, *o) for c, *o in corners)
        + 2 * (c00 * c10 * at(sums.across, 0, 0) + c01 * c11 * at(sums.across, 0, 1))
        + 2 * (c00 * c01 * at(sums.down, 0, 0) + c10 * c11 * at(sums.down, 1, 0))
        + 2 * (c00 * c11 * at(sums.falling, 0, 0) + c10 * c01 * at(sums.rising, 0, 0))
    )
    return _correlation(numerator, mean, square, size)


def score_map(
    image: Image, template: Num[Array, "T T"], origin: Num[Array, " 2"], shape: tuple[int, int]
) -> Float[Array, "height width"]:
    """Correlation of a template with the windows at whole pixels of a box, whose top left pixels start at (u, v).

    Element (i, j) is the score of the point `origin + (j, i) + (T - 1) / 2`; -1 where the window leaves the image.

    Args:
        image: Grey levels.
        template: Grey levels.
        origin: Top left pixel of the first window, a whole number.
        shape: Rows and columns of the box, static.
    """
    size = template.shape[0]
    height, width = shape[0] + size - 1, shape[1] + size - 1
    u, v = jnp.asarray(origin).astype(jnp.int32)
    rows = jnp.clip(v + jnp.arange(height), 0, image.shape[0] - 1)
    cols = jnp.clip(u + jnp.arange(width), 0, image.shape[1] - 1)
    sums = window_sums(_floats(image[rows[:, None], cols]), _floats(template))
    scores = _correlation(sums.template, sums.grey, sums.square, size)
    i, j = v + jnp.arange(shape[0]), u + jnp.arange(shape[1])
    fits = (i >= 0) & (i <= image.shape[0] - size)
    return jnp.where(fits[:, None] & (j >= 0) & (j <= image.shape[1] - size), scores, -1.0)


def _floats(levels):
    return levels if jnp.issubdtype(levels.dtype, jnp.floating) else levels.astype(float)


def _correlation(numerator, mean, square, size):
    variance = square - mean * mean / size**2
    # A variance under the rounding of what it is the difference of is none.
    flat = variance <= 32 * jnp.finfo(square.dtype).eps * square
    return jnp.where(flat, 0.0, jnp.clip(numerator * lax.rsqrt(jnp.where(flat, 1.0, variance)), -1.0, 1.0))


def _normalised(template):
    t = template - jnp.mean(template)
    square = jnp.sum(t * t)
    flat = square <= (16 * jnp.finfo(t.dtype).eps) ** 2 * jnp.sum(template**2)
    return jnp.where(flat, 0.0, t * lax.rsqrt(jnp.where(flat, 1.0, square)))


def _sum_windows(x, size):
    """Sums over all `size` x `size` windows that fit."""
    return _sum_runs(_sum_runs(x, size, 1), size, 0)


def _sum_runs(x, size, axis):
    """Sums of `size` successive elements, by doubling: few passes, and rounding that does not grow along the axis."""
    part = lambda x, start, length: lax.slice_in_dim(x, start, start + length, axis=axis)
    length = x.shape[axis] - size + 1
    total, done, run = jnp.zeros((), x.dtype), 0, 1
    while done < size:
        if size & run:
            total, done = total + part(x, done, length), done + run
        reach = x.shape[axis] - run
        x, run = part(x, 0, reach) + part(x, run, reach), 2 * run
    return total
