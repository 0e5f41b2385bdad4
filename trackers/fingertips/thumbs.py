"""Thumb tests of the tracker: the paper's mean score, and the posterior of a model of posture."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.models.fingertip import thumb
from jaxfilters.models.fingertip.thumb import ThumbAngles, ThumbBelief
from jaxfilters.trackers.fingertips.state import FingertipConfig, ThumbTest


class Score(NamedTuple):
    """What the paper's test remembers of a track."""

    total: Float[Array, "*slots"]
    """Of the increments."""
    frames: Float[Array, "*slots"]


def _no_score(config: FingertipConfig, angles: ThumbAngles) -> Score:
    del config
    return Score(jnp.zeros_like(angles.thumb), jnp.zeros_like(angles.thumb))


def _scored(
    config: FingertipConfig, angles: ThumbAngles, memory: Score, angle: Float[Array, ""], observed: Bool[Array, ""]
) -> Score:
    del config
    more = thumb.increment(jnp.where(observed, angle, 0.0), angles.thumb, angles.forefinger)
    return Score(memory.total + jnp.where(observed, more, 0.0), memory.frames + observed)


def _by_score(
    memories: Score, was_thumb: Bool[Array, " slots"], there: Bool[Array, " slots"]
) -> tuple[Float[Array, " slots"], Bool[Array, " slots"]]:
    del was_thumb
    score = jnp.where(there, memories.total / jnp.maximum(memories.frames, 1), 0.0)
    return score, there & (score >= thumb.THUMB_SCORE) & (memories.frames > 0)


def _unknown(config: FingertipConfig, angles: ThumbAngles) -> ThumbBelief:
    return thumb.unknown(angles, config.posture)


def _observed(
    config: FingertipConfig,
    angles: ThumbAngles,
    memory: ThumbBelief,
    angle: Float[Array, ""],
    observed: Bool[Array, ""],
) -> ThumbBelief:
    del angles
    return thumb.observe(memory, angle, observed, config.posture)


def _by_posterior(
    memories: ThumbBelief, was_thumb: Bool[Array, " slots"], there: Bool[Array, " slots"]
) -> tuple[Float[Array, " slots"], Bool[Array, " slots"]]:
    probability = thumb.probabilities(memories.log_odds, there)
    return probability, there & thumb.decided(was_thumb, probability)


MEAN_SCORE = ThumbTest(_no_score, _scored, _by_score)
"""Oka and Sato 2006, equations 12 and 13: the mean of all increments since the track began, a thumb from 0.5 on."""
POSTERIOR = ThumbTest(_unknown, _observed, _by_posterior)
"""Section 5.4: class models with a drift of their own, forgetting, one thumb a hand, hysteresis."""
