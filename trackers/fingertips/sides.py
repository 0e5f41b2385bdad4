"""On which side of a hand its thumb is from frame to frame: as given, or by its fingers, so that it may turn over."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.models.fingertip.side import thumb_side_log_odds
from jaxfilters.trackers.fingertips.state import FingertipConfig, HandState

FRAME_SHARE = 0.1
"""Of the log odds of a frame of 1/30 s that counts: neighbouring frames show nearly the same posture."""
MOST_ODDS, DECIDED = 4.0, 2.0
"""Log odds of a side at most, so that a hand which turns over is believed within a second, and from which on it
holds."""


def as_given(
    config: FingertipConfig, state: HandState, observed: HandObservation, side: float | Array
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """The thumb stays where it is said to be, as in the paper."""
    del config, observed, side
    return state.turned, state.side_odds


def by_fingers(
    config: FingertipConfig, state: HandState, observed: HandObservation, side: float | Array
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Whether the thumb is on the side other than `side`, and the log odds that it is on that one.

    They are the sum over frames that show four or five tips, from `thumb_side_log_odds`.
    """
    share = min(FRAME_SHARE * config.frame, 1.0)
    evidence = jnp.clip(side * thumb_side_log_odds(observed), -MOST_ODDS, MOST_ODDS)
    odds = jnp.clip(state.side_odds + share * evidence, -MOST_ODDS, MOST_ODDS)
    return jnp.where(jnp.abs(odds) > DECIDED, odds < 0, state.turned), odds
