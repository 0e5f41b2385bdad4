"""How well posed and deformed faces explain the images: template scores of an ensemble, and its weights."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Num

from jaxfilters.models.face.correlation import inside, score_points, score_sums, window_sums

BOXES = (64, 128)
"""Sides of the boxes, pixels, in which windows are summed. The smallest that holds the windows of every landmark is
taken; where none does they are cut one by one, with the same result in ten times the time."""


def scores(
    images: Num[Array, "C rows cols"], templates: Num[Array, "C K T T"], uv: Float[Array, "C K 2 N"]
) -> Float[Array, "C K N"]:
    """Correlation of each landmark's template with the window about each of its N images (section 2.6).

    -1 where a window leaves the image, and for NaN, the image of what lies behind a camera.

    Args:
        images: Grey levels.
        templates: Grey levels about the landmarks.
        uv: Where N candidates put the landmarks, pixels.
    """
    size, image_shape = templates.shape[-1], images.shape[1:]
    observed = inside(image_shape, jnp.moveaxis(uv, 2, -1), size)
    held = observed[:, :, None]
    top_left = jnp.where(held, uv - (size - 1) / 2, 0.0)
    low = jnp.floor(jnp.min(jnp.where(held, top_left, jnp.inf), axis=-1))
    reach = jnp.max(jnp.where(held, top_left, -jnp.inf), axis=-1) - low
    low = jnp.where(jnp.isfinite(low), low, 0.0)
    needed = jnp.max(reach, axis=(0, 1)) + size
    too_small = [jnp.any(needed > jnp.array(_box_shape(side, image_shape))[::-1]) for side in BOXES]
    in_box = lambda side: jax.vmap(partial(_score_in_box, _box_shape(side, image_shape)), (None, 0, 0, 0))
    scorers = [jax.vmap(in_box(side)) for side in BOXES] + [jax.vmap(_score_one_by_one)]
    found = lax.switch(jnp.sum(jnp.stack(too_small)), scorers, images, templates.astype(uv.dtype), low, top_left)
    return jnp.where(observed, found, -1.0)


def log_weights(
    score_sum: Float[Array, " N"],
    deformation: Float[Array, "B N"],
    deviation: Float[Array, " B"],
    *,
    num_scores: int,
    sigma: float | Float[Array, ""] = 3.0,
) -> Float[Array, " N"]:
    """Log weights, not normalised: `-(n - c)^2 / (2 sigma^2) - sum_b (a_b / mu_b)^2 / 2`.

    Oka and Sato 2006, equation 17; Sugano 2007, equation 3.27.

    Args:
        score_sum: c, sum of the scores over cameras and landmarks.
        deformation: a, coefficients of the modes, millimetres.
        deviation: mu, their standard deviations, millimetres; a mode whose deviation is 0 does not count.
        num_scores: n, how many scores are summed: cameras times landmarks.
        sigma: Standard deviation of the sum of scores.

    Raises:
        ValueError: if `sigma` or `num_scores` is not positive.
    """
    if num_scores <= 0 or (not isinstance(sigma, jax.core.Tracer) and sigma <= 0):
        raise ValueError(f"num_scores and sigma must be positive; got {num_scores} and {sigma}.")
    learned = deviation > 0
    relative = jnp.where(learned[:, None], deformation / jnp.where(learned, deviation, 1.0)[:, None], 0.0)
    return -0.5 * ((num_scores - score_sum) / sigma) ** 2 - 0.5 * jnp.sum(relative**2, axis=0)


def _box_shape(side, image_shape):
    """Rows and columns of a box; one that is as large as the image holds everything."""
    return tuple(min(side, length) for length in image_shape)


def _score_in_box(shape, image, template, low, top_left):
    corner = jnp.clip(low, 0, jnp.array([image.shape[1] - shape[1], image.shape[0] - shape[0]])).astype(jnp.int32)
    box = lax.dynamic_slice(image, (corner[1], corner[0]), shape).astype(top_left.dtype)
    return score_sums(window_sums(box, template), top_left - corner[:, None], template.shape[0])


def _score_one_by_one(image, templates, _, top_left):
    # Landmark after landmark: the windows of all of them at once would not fit in a processor's cache.
    points = jnp.swapaxes(top_left, -1, -2) + (templates.shape[-1] - 1) / 2
    return lax.map(lambda each: score_points(image, *each), (templates, points))
