"""How far confidences can be trusted, and when a stroke is no symbol: both from strokes of people left out of training.

Confidences are a softmax of tempered log-likelihoods (C. Guo et al., "On calibration of modern neural networks", ICML
2017), mixed with a lapse: a share of strokes that may be any symbol, whatever they look like. Without it the few that
are drawn as another symbol, or labelled wrongly, decide the temperature of all. Both maximise the likelihood of the
right symbols. A symbol is accepted if it beats the threshold
model by what its own strokes usually do, less `SDS` standard deviations of that.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize
from scipy.special import log_softmax, logsumexp

SDS = 2.5
"""Below the mean lead of a symbol's strokes from which on they are no such symbol: 0.6 % of a Gaussian."""
PRIOR_STROKES = 5.0
"""Strokes that the spread over all symbols counts for in the spread of one."""
SHARPNESS_RANGE, LAPSE_RANGE = (1e-4, 10.0), (1e-4, 0.5)
NUM_BINS, FEWEST_IN_BIN = 15, 30


class Calibration(NamedTuple):
    """What turns scores into confidences and decisions."""

    sharpness: float
    """Share of a log-likelihood that counts towards confidence."""
    lapse: float
    """Probability that a stroke is any of the symbols, each as likely as the other."""
    margins: Float[np.ndarray, " k"]
    """Of every symbol: nats a point by which it has to beat the threshold model."""


class Scores(NamedTuple):
    """Of strokes by models to which their people contributed nothing."""

    log_likelihood: Float[np.ndarray, "k n"]
    """Nats, of the best model of every symbol."""
    lead: Float[np.ndarray, " n"]
    """Nats a point by which the best symbol beats the threshold model."""
    truth: Int[np.ndarray, " n"]
    """The right symbol."""

    @property
    def best(self) -> Int[np.ndarray, " n"]:
        """The symbol of greatest likelihood."""
        return np.argmax(self.log_likelihood, axis=0)

    @property
    def is_right(self) -> Bool[np.ndarray, " n"]:
        """Whether that is the right one."""
        return self.best == self.truth


def fitted(scores: Scores) -> Calibration:
    """The temperature of greatest likelihood, and the margin of every symbol.

    Raises:
        ValueError: If there is no stroke whose likelihoods are finite.
    """
    own = scores.log_likelihood[scores.truth, np.arange(len(scores.truth))]
    possible = np.isfinite(own) & np.isfinite(scores.lead)
    if not possible.any():
        raise ValueError(f"scores must have a stroke with finite log-likelihoods; got {len(scores.truth)} without.")
    usable = Scores(scores.log_likelihood[:, possible], scores.lead[possible], scores.truth[possible])
    return Calibration(*softness(usable), lead_margins(usable))


def softness(scores: Scores) -> tuple[float, float]:
    """Sharpness and lapse that give the right symbols the greatest likelihood."""
    logits, which = scores.log_likelihood, np.arange(len(scores.truth))

    def loss(params: Float[np.ndarray, "2"]) -> float:
        share, lapse = np.exp(params)
        own = np.exp(log_softmax(share * logits, axis=0)[scores.truth, which])
        return -float(np.log((1 - lapse) * own + lapse / len(logits)).mean())

    bounds = [tuple(np.log(ends)) for ends in (SHARPNESS_RANGE, LAPSE_RANGE)]
    found = minimize(loss, np.log([0.1, 0.01]), method="Nelder-Mead", bounds=bounds)
    share, lapse = np.exp(found.x)
    return float(share), float(lapse)


def lead_margins(scores: Scores) -> Float[np.ndarray, " k"]:
    """Of every symbol, from the leads of the strokes of it that are recognised; of one without any, from all."""
    right = scores.is_right if scores.is_right.any() else np.ones(len(scores.truth), bool)
    leads, classes = scores.lead[right], scores.truth[right]
    means = {k: leads[classes == k].mean() for k in np.unique(classes)}
    deviations = leads - np.array([means[k] for k in classes])
    pooled = float(np.mean(deviations**2))
    margins = np.full(len(scores.log_likelihood), leads.mean() - SDS * leads.std())
    for k, mean in means.items():
        own = deviations[classes == k]
        variance = (np.sum(own**2) + PRIOR_STROKES * pooled) / (len(own) + PRIOR_STROKES)
        # The mean of few strokes is uncertain, too.
        margins[k] = mean - SDS * np.sqrt(variance * (1 + 1 / len(own)))
    return margins


def confidences(scores: Scores, share: float, lapse: float = 0.0) -> Float[np.ndarray, " n"]:
    """Of the best symbol of every stroke, by sharpness and lapse."""
    tempered = share * scores.log_likelihood
    best = np.exp(tempered.max(axis=0) - logsumexp(tempered, axis=0))
    return (1 - lapse) * best + lapse / len(tempered)


def calibration_error(confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> float:
    """Mean distance between confidence and share of right ones over bins of as many strokes, `NUM_BINS` at most.

    The expected calibration error with bins of equal mass (M. Nixon et al., "Measuring calibration in deep learning",
    CVPR workshops 2019); of n strokes that are calibrated it is about sqrt(2 p (1 - p) NUM_BINS / (pi n)), not zero,
    so that there are fewer bins of few strokes.
    """
    order = np.argsort(confidence, kind="stable")
    bins = np.array_split(order, int(np.clip(len(order) // FEWEST_IN_BIN, 1, NUM_BINS)))
    gaps = [len(own) * abs(confidence[own].mean() - right[own].mean()) for own in bins if len(own)]
    return float(sum(gaps) / max(len(order), 1))
