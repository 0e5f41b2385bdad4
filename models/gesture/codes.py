"""A moving fingertip as one of 17 codes a frame."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters.hmm import Codes

NUM_DIRECTIONS = 16
STILL = 17
"""The code of a fingertip that hardly moves."""
MOST_TIPS = 5
"""Of a hand."""


def direction_code(displacement: Float[Array, "... 2"], still: float | Float[Array, ""] = 1.5) -> Int32[Array, "..."]:
    """1 to 16 for the direction of an image displacement, 17 where it is shorter than `still`.

    Sector 1 is centred on +x; the codes grow counter-clockwise as a person sees the image, whose y points down.

    Args:
        displacement: (x, y) in pixels a frame. One that is not finite is still.
        still: Length below which there is no direction, in pixels a frame.
    """
    x, y = displacement[..., 0], displacement[..., 1]
    moves = x * x + y * y >= jnp.square(still)
    angle = jnp.arctan2(jnp.where(moves, -y, 0.0), jnp.where(moves, x, 1.0))
    sector = jnp.floor(angle / (2 * jnp.pi / NUM_DIRECTIONS) + 0.5)
    return jnp.where(moves, 1 + jnp.mod(sector, NUM_DIRECTIONS), STILL).astype(jnp.int32)


def blurred(codes: Codes, spread: float | Float[Array, ""] = 1.0) -> Codes:
    """Emissions whose 16 directions are blurred around the circle; what is fitted to one writer then suits others.

    Args:
        codes: Of 17 symbols, direction 1 first and still last.
        spread: Standard deviation of the blur in sectors of 22.5 degrees, positive.

    Raises:
        ValueError: If `codes` has another number of symbols.
    """
    if codes.log_probability.shape[-1] != STILL:
        raise ValueError(f"codes must have {STILL} symbols; got {codes.log_probability.shape[-1]}.")
    apart = jnp.arange(NUM_DIRECTIONS)
    apart = jnp.minimum(apart, NUM_DIRECTIONS - apart)
    kernel = jnp.exp(-0.5 * jnp.square(apart / spread))
    rows = (jnp.arange(NUM_DIRECTIONS)[:, None] - jnp.arange(NUM_DIRECTIONS)) % NUM_DIRECTIONS
    blur = (kernel / jnp.sum(kernel))[rows]
    probability = jnp.exp(codes.log_probability)
    directions = jnp.matmul(probability[..., :NUM_DIRECTIONS], blur, precision="highest")
    blurry = jnp.concatenate([directions, probability[..., NUM_DIRECTIONS:]], axis=-1)
    possible = blurry > 0
    return replace(codes, log_probability=jnp.where(possible, jnp.log(jnp.where(possible, blurry, 1.0)), -jnp.inf))


def displacements(tips: Float[Array, "t f 2"], present: Bool[Array, "t f"]) -> Float[Array, "t 2"]:
    """How a hand moved since the frame before: the mean over the tips that were observed in both, pixels.

    Zero where there is none, as in the first frame. Their running sum is the path of the hand.

    Args:
        tips: (x, y) of each finger in pixels; anything where it is not visible.
        present: Whether each finger is visible.
    """
    both = (present[1:] & present[:-1])[..., None]
    moved = jnp.where(both, tips[1:], 0.0) - jnp.where(both, tips[:-1], 0.0)
    mean = jnp.sum(moved, axis=1) / jnp.maximum(jnp.sum(both, axis=1), 1)
    return jnp.concatenate([jnp.zeros((1, 2), mean.dtype), mean])


def observed(
    tips: Float[Array, "t f 2"], present: Bool[Array, "t f"], still: float | Float[Array, ""] = 1.5
) -> tuple[Int32[Array, " t"], Int32[Array, " t"]]:
    """Direction code and number of fingertips of a hand in every frame; the first frame is still.

    Args:
        tips: (x, y) of each finger in pixels; anything where it is not visible.
        present: Whether each finger is visible, at most five at once.
        still: Length of a displacement below which there is no direction, in pixels a frame.
    """
    counts = jnp.sum(present, axis=1, dtype=jnp.int32)
    return direction_code(displacements(tips, present), still), jnp.minimum(counts, MOST_TIPS)
