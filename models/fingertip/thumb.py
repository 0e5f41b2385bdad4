"""Whether a finger is the thumb: by the direction in which it leaves the palm, over all the frames of its track.

After K. Oka, Y. Sato, H. Koike, IEEE Computer Graphics and Applications 22(6), 2002.

Angles are from the arm axis to the line from the palm
to the base of the finger, positive on the side of the thumb, in radians. `increment` and `score` are the paper's; the
posterior of `ThumbBelief` knows that a hand's posture drifts, that a person holds the hand at an angle of their own,
and that a hand has one thumb.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.gaussian import arithmetic
from jaxfilters.gaussian.belief import Gaussian

THUMB_SCORE = 0.5
"""Score from which on a finger is taken for the thumb."""

FAR_SDS = 2.0
"""By how many of the drift's standard deviations an angle counts as beyond a thumb or a forefinger, at most: the other
fingers are beyond the forefinger."""


class ThumbAngles(NamedTuple):
    """The open hand of a person: what its thumb and its forefinger measured, and how far that can be trusted."""

    thumb: Float[Array, ""]
    forefinger: Float[Array, ""]
    offset: Float[Array, ""]
    """By which this person's angles are greater than people's: what was measured, shrunk by its uncertainty."""
    offset_variance: Float[Array, ""]


class Posture(NamedTuple):
    """What is known of angles over all people, in radians."""

    open_thumb: float = math.radians(55)
    open_forefinger: float = math.radians(15)
    """Of an open hand."""
    thumb: float = math.radians(51.5)
    forefinger: float = math.radians(19.5)
    """Of a hand at work."""
    person_sd: float = math.radians(4)
    drift_sd: float = math.radians(6)
    correlation: float = 0.95
    """Of the drift from a frame to the next."""
    measurement_sd: float = math.radians(4)
    exchange: float = 1e-4
    """Probability a frame that a track goes on as another finger: old evidence is forgotten."""


POSTURE = Posture()


class ThumbBelief(NamedTuple):
    """What is known of one finger."""

    angle: Gaussian
    """Of drift and person's offset, once taken for a forefinger and once for a thumb: means (2, 2)."""
    log_odds: Float[Array, ""]
    """Of being a thumb, from this finger's angles alone."""


def base_angle(
    base: Float[Array, "2"], palm: Float[Array, "2"], axis: Float[Array, "2"], side: float | Float[Array, ""] = 1.0
) -> Float[Array, ""]:
    """Angle from the axis to the direction from the palm to a point; counter-clockwise as a person sees the image.

    Args:
        base: Pixels, y down.
        palm: Pixels.
        axis: Of the forearm, towards the hand.
        side: -1 mirrors, for the hand whose thumb is on the other side.
    """
    x, y = base[0] - palm[0], base[1] - palm[1]
    along, across = x * axis[0] + y * axis[1], axis[1] * x - axis[0] * y
    nowhere = (along == 0) & (across == 0)
    return side * jnp.arctan2(jnp.where(nowhere, 0.0, across), jnp.where(nowhere, 1.0, along))


def increment(
    angle: Float[Array, "*b"], thumb: float | Float[Array, ""], index: float | Float[Array, ""]
) -> Float[Array, "*b"]:
    """S'_T: 0 up to the angle of the forefinger, 1 from that of the thumb, a ramp in between.

    Oka and Sato 2006, equation 12.

    Raises:
        ValueError: If both are Python numbers and `thumb` is not above `index`.
    """
    if isinstance(thumb, float | int) and isinstance(index, float | int) and not thumb > index:
        raise ValueError(f"thumb must be greater than index; got {thumb} and {index}.")
    return jnp.clip((angle - index) / (thumb - index), 0.0, 1.0)


def score(increments: Float[Array, "n *b"]) -> Float[Array, "n *b"]:
    """S_T after each frame: the mean of all increments so far (Oka and Sato 2006, equation 13)."""
    frames = jnp.arange(1, len(increments) + 1).reshape(-1, *[1] * (increments.ndim - 1))
    return jnp.cumsum(increments, axis=0) / frames


def usual(posture: Posture = POSTURE) -> ThumbAngles:
    """A person of whom nothing was measured."""
    thumb, index = jnp.asarray(posture.open_thumb, float), jnp.asarray(posture.open_forefinger, float)
    return ThumbAngles(thumb, index, jnp.zeros_like(thumb), jnp.asarray(posture.person_sd**2, float))


def calibrated(
    thumb: Float[np.ndarray, " n"], index: Float[np.ndarray, " n"], posture: Posture = POSTURE
) -> ThumbAngles:
    """A person's angles from n frames of an open hand, held over time as the posture drifts.

    The offset is the mean deviation from people's open hands, weighted with its variance: neighbouring frames drift
    together and say little more than one.

    Raises:
        ValueError: If there is no frame, the numbers differ, an angle is not finite, or the thumb is not beyond the
            forefinger.
    """
    thumb, index = np.asarray(thumb, float), np.asarray(index, float)
    if thumb.ndim != 1 or thumb.shape != index.shape or not thumb.size:
        raise ValueError(f"thumb and index must be of the same frames, at least one; got {thumb.shape}, {index.shape}.")
    if not (np.all(np.isfinite(thumb)) and np.all(np.isfinite(index)) and thumb.mean() > index.mean()):
        raise ValueError(f"thumb must be finite and beyond index; got means {thumb.mean()} and {index.mean()}.")
    apart = np.abs(np.subtract.outer(np.arange(thumb.size), np.arange(thumb.size)))
    drifting = posture.drift_sd**2 * np.mean(posture.correlation**apart)
    variance = (drifting + posture.measurement_sd**2 / thumb.size) / 2
    deviation = (thumb.mean() + index.mean() - posture.open_thumb - posture.open_forefinger) / 2
    share = posture.person_sd**2 / (posture.person_sd**2 + variance)
    numbers = (thumb.mean(), index.mean(), share * deviation, share * variance)
    return ThumbAngles(*(jnp.asarray(number, dtype=float) for number in numbers))


def unknown(angles: ThumbAngles, posture: Posture = POSTURE) -> ThumbBelief:
    """A finger before its first angle."""
    variances = jnp.stack([jnp.asarray(posture.drift_sd**2, float), angles.offset_variance])
    mean = jnp.stack([jnp.zeros_like(angles.offset), angles.offset])
    both = Gaussian(jnp.broadcast_to(mean, (2, 2)), jnp.broadcast_to(jnp.diag(variances), (2, 2, 2)))
    return ThumbBelief(both, jnp.zeros_like(angles.offset))


def observe(
    belief: ThumbBelief, angle: Float[Array, ""], is_observed: Bool[Array, ""], posture: Posture = POSTURE
) -> ThumbBelief:
    """What is known after one more frame; the drift goes on where no angle `is_observed`.

    One Kalman filter for each thing that the finger may be, whose evidence tells which; their beliefs interact as the
    track may have become another finger (H. Blom, Y. Bar-Shalom, "The interacting multiple model algorithm", 1988).
    """
    a = posture.correlation
    F, Q = jnp.diag(jnp.array([a, 1.0])), jnp.diag(jnp.array([posture.drift_sd**2 * (1 - a * a), 0.0]))
    H, R = jnp.ones((1, 2)), jnp.full((1, 1), posture.measurement_sd**2)
    reach = FAR_SDS * posture.drift_sd
    angle = jnp.clip(angle, posture.forefinger - reach, posture.thumb + reach)
    deviations = angle - jnp.asarray([posture.forefinger, posture.thumb], dtype=float)
    log_odds, newly = _exchanged(belief.log_odds, posture.exchange)

    def one(before: Gaussian, newly: Array, deviation: Array) -> tuple[Gaussian, Array]:
        predicted = _partly_new(before, newly, posture)
        innovation = jnp.where(is_observed, deviation - jnp.sum(predicted.mean), 0.0)
        found = arithmetic.joseph.condition(predicted.covariance, H, R, innovation[None])
        covariance = jnp.where(is_observed, found.covariance, predicted.covariance)
        corrected = Gaussian(predicted.mean + found.shift, covariance)
        return arithmetic.joseph.predict(corrected, F, Q), found.log_density

    following, evidence = jax.vmap(one)(belief.angle, jnp.where(is_observed, newly, 0.0), deviations)
    return ThumbBelief(following, jnp.where(is_observed, log_odds + evidence[1] - evidence[0], belief.log_odds))


def probabilities(log_odds: Float[Array, " tracks"], there: Bool[Array, " tracks"]) -> Float[Array, " tracks"]:
    """Of each finger of one hand to be the thumb, 0 where no finger is `there`: at most one is."""
    log_odds = jnp.where(there, log_odds, -jnp.inf)
    most = jnp.maximum(jnp.max(log_odds, initial=-jnp.inf), 0.0)
    weights = jnp.exp(log_odds - most)
    return weights / (jnp.exp(-most) + jnp.sum(weights))


def decided(
    was_thumb: Bool[Array, " *b"],
    probability: Float[Array, " *b"],
    *,
    low: float = 0.45,
    high: float = 0.55,
) -> Bool[Array, " *b"]:
    """Whether it is the thumb, with hysteresis: what it was holds between `low` and `high`."""
    return jnp.where(was_thumb, probability > low, probability > high)


def _exchanged(log_odds, exchange):
    """Log odds once the track may have become another finger, and how likely each, if it is so now, is new."""
    was = jnp.stack([jax.nn.sigmoid(-log_odds), jax.nn.sigmoid(log_odds)])
    now = (1 - exchange) * was + exchange * was[::-1]
    return jnp.log(now[1]) - jnp.log(now[0]), exchange * was[::-1] / now


def _partly_new(before: Gaussian, share: Array, posture: Posture) -> Gaussian:
    """Mean and covariance of a mixture with a finger whose drift is unknown; the person's offset stays."""
    mean, P = before.mean, before.covariance
    old = 1 - share
    drift_variance = old * P[0, 0] + share * posture.drift_sd**2 + share * old * jnp.square(mean[0])
    # The new drift does not depend on the offset.
    both = old * P[0, 1]
    covariance = jnp.stack([jnp.stack([drift_variance, both]), jnp.stack([both, P[1, 1]])])
    return Gaussian(jnp.stack([old * mean[0], mean[1]]), covariance)
