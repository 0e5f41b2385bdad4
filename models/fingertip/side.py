"""On which side of a hand the thumb is, from the order, directions and lengths of its fingertips about the palm."""

import math
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.models.fingertip.observation import MAX_TIPS, HandObservation
from jaxfilters.models.fingertip.thumb import base_angle

ANGLES = tuple(math.radians(angle) for angle in (58.0, 20.0, 0.0, -18.0, -38.0))
"""Of the tips of thumb, forefinger, middle, ring and little finger about the palm, of people's open hands."""
LENGTHS = (1.85, 2.5, 2.75, 2.5, 2.1)
"""Of the same, palm radii from the palm."""
ANGLE_SD, TURN_SD = math.radians(10.0), math.radians(12.0)
"""Of one finger's direction, and of a turn that all fingers share: of the hand about the wrist, or of the axis."""
LENGTH_SD, SCALE_SD = 0.2, 0.3
"""Of the logarithm of one finger's length, and of what all fingers share: of the palm's radius, or of the view."""
FEWEST_TIPS = 4
"""Of fewer fingers both sides are nearly as likely."""

_COMBINATIONS = [
    chosen for count in range(FEWEST_TIPS, MAX_TIPS + 1) for chosen in combinations(range(MAX_TIPS), count)
]
_FINGERS = np.array([np.pad(chosen, (0, MAX_TIPS - len(chosen))) for chosen in _COMBINATIONS])
_COUNTS = np.array([len(chosen) for chosen in _COMBINATIONS])


def thumb_side_log_odds(hand: HandObservation) -> Float[Array, ""]:
    """`side_log_odds` of what an image shows of a hand; 0 where it shows no hand or no arm."""
    angles = jax.vmap(base_angle, in_axes=(0, None, None))(hand.tips, hand.palm, hand.axis)
    lengths = jnp.linalg.norm(hand.tips - hand.palm, axis=1)
    return jnp.where(hand.is_hand & hand.has_axis, side_log_odds(angles, lengths, hand.is_tip), 0.0)


def side_log_odds(
    angles: Float[Array, " tips"], lengths: Float[Array, " tips"], there: Bool[Array, " tips"]
) -> Float[Array, ""]:
    """Log odds that the thumb is where angles are greatest, against where they are least; 0 unless 4 or 5 are there.

    Which fingers the tips are is summed over, in their order; so are a common turn and a common scale.

    Args:
        angles: Of the tips about the palm from the arm's axis, radians, counter-clockwise as a person sees the image.
        lengths: Distances of the tips from the palm, in any unit, above 0 where a tip is.
        there: Which tips there are.
    """
    size = max(0, MAX_TIPS - len(angles))
    angles, lengths = (jnp.pad(values, (0, size), constant_values=1.0) for values in (angles, lengths))
    there = jnp.pad(there, (0, size))
    fits = [_log_likelihood(side * angles, jnp.log(jnp.maximum(lengths, 1e-6)), there) for side in (1.0, -1.0)]
    return jnp.where(jnp.isin(jnp.sum(there), np.unique(_COUNTS)), fits[0] - fits[1], 0.0)


def _log_likelihood(angles: Array, logs: Array, there: Array) -> Array:
    """Of tips in their order, up to a constant that depends on how many there are."""
    order = jnp.argsort(jnp.where(there, -angles, jnp.inf))[:MAX_TIPS]
    counts = jnp.arange(MAX_TIPS) < jnp.minimum(jnp.sum(there), MAX_TIPS)

    def cost(values: Array, usual: np.ndarray, sd: float, common_sd: float) -> Array:
        off = jnp.where(counts, values[order] - jnp.asarray(usual, dtype=float)[_FINGERS], 0.0)
        common = jnp.sum(off, axis=1) / (jnp.sum(counts) + (sd / common_sd) ** 2)
        apart = jnp.where(counts, off - common[:, None], 0.0)
        return jnp.sum(apart**2, axis=1) / sd**2 + common**2 / common_sd**2

    total = cost(angles, np.array(ANGLES), ANGLE_SD, TURN_SD) + cost(logs, np.log(LENGTHS), LENGTH_SD, SCALE_SD)
    return jax.nn.logsumexp(jnp.where(jnp.sum(counts) == _COUNTS, -total / 2, -jnp.inf))
