"""Whether the standard deviations of a tracker fit what it measures: innovations inside the bands that are claimed.

An innovation is what a frame says minus what was predicted of it. If the model is right, 95 % of the innovations lie
within 1.96 of the standard deviations that the filter claims for them (Y. Bar-Shalom, X. R. Li and T. Kirubarajan,
"Estimation with Applications to Tracking and Navigation", 2001, section 5.4). No truth is needed to count them.

A filter whose observation is an image has no residual of a few numbers. There the correction of the mean takes the
place of the innovation. By the law of total variance its variance is what the frame takes away from the variance of the
prediction, for any filter that is right.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfilters.gaussian.arithmetic import KalmanInfo
from jaxfilters.math import linalg

BAND = 1.959964
"""Standard deviations within which 95 % of the values of a normal distribution lie."""
LEAST_GAIN = 1e-3
"""Share of a predicted variance; where a frame takes away less, it says nothing of the coordinate."""
CONSISTENT = (0.90, 0.98)
"""Shares of innovations inside their bands that do not contradict the claim of 95 %."""
CONSISTENT_CLAIM, TOO_FEW = "consistent", "too few innovations"
FEWEST_FRAMES = 20
"""With innovations, below which their share is not compared with the claim."""


def innovation_counts(info: KalmanInfo, unit: float | Float[Array, ""] = 1.0) -> Int[Array, "2"]:
    """How many components of an update have an innovation, and how many of these lie inside their bands.

    Args:
        info: Of the update.
        unit: Standard deviation in which the covariances of the filter are counted.
    """
    return _counted(info.innovation, unit * linalg.safe_norm(info.innovation_root))


def correction_counts(
    correction: Float[Array, " n"], predicted_variance: Float[Array, " n"], variance: Float[Array, " n"]
) -> Int[Array, "2"]:
    """The same of the coordinates of a state, of which a frame has corrected the predicted mean.

    Args:
        correction: Mean after the frame minus the predicted one.
        predicted_variance: Of each coordinate, before the frame.
        variance: After the frame.
    """
    gain = predicted_variance - variance
    measured = gain > LEAST_GAIN * predicted_variance
    return _counted(correction, jnp.where(measured, jnp.sqrt(jnp.where(measured, gain, 1.0)), 0.0))


def _counted(innovations: Float[Array, " n"], deviations: Float[Array, " n"]) -> Int[Array, "2"]:
    read = (deviations > 0) & jnp.isfinite(deviations)
    inside = read & (jnp.abs(innovations) <= BAND * deviations)
    return jnp.stack([jnp.sum(read), jnp.sum(inside)]).astype(jnp.int32)


class InnovationShare(NamedTuple):
    """Of a run."""

    number: int
    """Innovations, of all coordinates and frames."""
    share: float
    """Of them inside their bands; NaN without any."""
    low: float
    high: float
    """Ends of the interval of 95 % of the share, which allows for innovations that are correlated in time; NaN where
    there are too few frames."""

    @property
    def claim(self) -> str:
        """What the share says of the claim."""
        if math.isnan(self.low):
            return TOO_FEW
        if self.high < CONSISTENT[0]:
            return "overconfident"
        return "conservative" if self.low > CONSISTENT[1] else CONSISTENT_CLAIM

    def report(self) -> dict[str, Any]:
        """For `report.json`."""
        known = not math.isnan(self.low)
        return {
            "count": self.number,
            "share_inside_95": round(self.share, 4) if self.number else None,
            "interval": [round(self.low, 4), round(self.high, 4)] if known else None,
            "claim": self.claim,
        }


def contradiction(report: dict[str, Any]) -> str:
    """A line for a person, begun on a new one, where innovations contradict the claim; otherwise nothing.

    Args:
        report: Of `InnovationShare.report`.
    """
    if report["claim"] in (CONSISTENT_CLAIM, TOO_FEW):
        return ""
    share = 100 * report["share_inside_95"]
    return f"\n{share:.1f} % of the innovations are inside their 95 % bands: the filter is {report['claim']}"


def innovation_share(counts: np.ndarray, frame: np.ndarray | None = None) -> InnovationShare:
    """The share of innovations inside their bands.

    Args:
        counts: (rows, 2) of `innovation_counts`, or of `correction_counts`; NaN counts as none.
        frame: (rows,) numbers of frames where several rows belong to a frame; None for a row a frame.
    """
    counts = np.nan_to_num(np.asarray(counts, float)).reshape(-1, 2)
    if frame is not None and len(counts):
        _, place = np.unique(frame, return_inverse=True)
        counts = np.stack([np.bincount(place, weights=column) for column in counts.T], axis=1)
    number, inside = counts[counts[:, 0] > 0].T
    if not len(number):
        return InnovationShare(0, math.nan, math.nan, math.nan)
    share = float(inside.sum() / number.sum())
    if len(number) < FEWEST_FRAMES:
        return InnovationShare(int(number.sum()), share, math.nan, math.nan)
    half = BAND * math.sqrt(_long_run_variance(inside - share * number) / len(number)) / number.mean()
    return InnovationShare(int(number.sum()), share, max(0.0, share - half), min(1.0, share + half))


def _long_run_variance(deviations: np.ndarray) -> float:
    """Variance of the sum over the number of terms, with the weights of Newey and West (Econometrica 55, 1987).

    Lags reach to the square root of the number of frames: innovations of images are correlated for many frames.
    """
    length = len(deviations)
    lags = math.isqrt(length)
    products = [float(deviations[lag:] @ deviations[: length - lag]) / length for lag in range(lags + 1)]
    return max(products[0] + 2 * sum((1 - lag / (lags + 1)) * products[lag] for lag in range(1, lags + 1)), 0.0)
