"""Standard errors of parameters that maximise a sum of log scores, whose terms are correlated from frame to frame."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.fit.composite import correlation_lags, score_covariance
from jaxfilters.fit.result import Fit
from jaxfilters.fit.uncertainty import ErrorStatus, Uncertainty, intervals
from jaxfilters.math import linalg

_LONGER = 2
"""Times the lags of `correlation_lags`: the correlation of a filter's errors decays exponentially, and weights that
fall linearly to zero at 6.4 of its time constants count 84 % of its sum, 3.2 of them only 70 %."""


def with_score_errors(fit: Fit, scores: Float[Array, "t r d"], mask: Bool[Array, "t r"]) -> Fit:
    """The fit with the standard errors of Godambe, J^-1 K J^-1, in place of those of the curvature J alone.

    Recordings are independent, and K adds products of the scores of a recording up to the lag at which they are no
    longer correlated; where they stay correlated, over whole recordings, of which there must be four.

    Args:
        fit: The maximum of the sum of scores, with the inverse of J as its covariance.
        scores: Derivatives of each frame's term by the coordinates at the maximum; frames, recordings, coordinates.
        mask: The frames that count.

    Returns:
        The fit. Where K cannot be known, its standard errors are NaN, and their status is `NOT_COMPUTED`.
    """
    scores = jnp.where(mask[..., None], scores, 0.0)
    K = _long_run_covariance(scores, np.asarray(mask))
    variance = jnp.diagonal(fit.covariance)
    determined = jnp.isfinite(variance)
    inverse = jnp.where(determined[:, None] & determined, fit.covariance, 0.0)
    covariance = linalg.matmul(linalg.matmul(inverse, K), inverse)
    covariance = jnp.where(determined[:, None] & determined, covariance, jnp.nan)
    # Whatever the reason is that a coordinate has no error, the status of the fit keeps it.
    known = jnp.isfinite(jnp.diagonal(covariance))
    status = jnp.where(known, jnp.where(variance > 0, ErrorStatus.DETERMINED, ErrorStatus.AT_BOUND), ErrorStatus.FLAT)
    found = intervals(fit.parametrization, fit.search.z, Uncertainty(covariance, status.astype(jnp.int32)))
    statuses = jax.tree.map(
        lambda old, error: jnp.where((old == ErrorStatus.DETERMINED) & jnp.isnan(error), ErrorStatus.NOT_COMPUTED, old),
        fit.standard_error_status,
        found.standard_errors,
    )
    return replace(
        fit,
        covariance=covariance,
        standard_errors=found.standard_errors,
        standard_error_status=statuses,
        lower=found.lower,
        upper=found.upper,
    )


def _long_run_covariance(scores: Float[Array, "t r d"], mask: np.ndarray) -> Float[Array, "d d"]:
    d, longest = scores.shape[-1], int(mask.sum(axis=0).max())
    chains = np.where(mask[..., None], np.asarray(scores, float), np.nan)
    # One recording after the other, with a gap as long as the largest lag between them.
    chains = np.concatenate([chains, np.full_like(chains, np.nan)]).transpose(2, 1, 0).reshape(d, -1)
    try:
        lags = [correlation_lags(chain, most=longest - 1)[0] for chain in chains if np.nanstd(chain) > 0]
        return score_covariance(scores, (min(_LONGER * max(lags, default=0), longest - 1), 0))
    except ValueError:
        pass
    try:
        return score_covariance(jnp.sum(scores, axis=0), 0)
    except ValueError:
        return jnp.full((d, d), jnp.nan, scores.dtype)
