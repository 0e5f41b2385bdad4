"""How much recordings say whose errors last: effective numbers of draws, and intervals over whole recordings."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxfilters._full_precision import einsum
from jaxfilters.diagnostics.consistency import Band, between
from jaxfilters.diagnostics.innovations import autocorrelation
from jaxfilters.gaussian import checks
from jaxfilters.typing import AnyKey


class Draws(NamedTuple):
    """Effective numbers of draws of each component of errors."""

    number: Float[Array, " m"]
    """Between 1 and the number of frames."""
    correlation: Float[Array, " m"]
    """Autocorrelation from one frame that is there to the next."""


def effective_draws(errors: Float[Array, "t m"]) -> Draws:
    r"""How many independent errors a recording holds, if they are a first-order Gauss-Markov process.

    $t (1 - \phi) / (1 + \phi)$ with the autocorrelation $\phi$ at the lag one, about the mean zero that honest errors
    have, and at least one (G. V. Bayley and J. M. Hammersley, "The effective number of independent observations in an
    autocorrelated time series", Supplement to J. R. Statist. Soc. 8, 1946). A mean of a statistic over the recording,
    such as that of `nees`, has about the spread of one over so many independent frames.

    Over gaps, $\phi$ is the correlation from a frame that is there to the next one, and t the number of frames that are
    there. This is exact where gaps are all alike or independent of one another, e.g. frames missing at random, and
    counts too few draws where frames that are there come in short bursts.

    Args:
        errors: Estimates minus truth, time first, (t, m), at least two frames; NaN where there is none.

    Returns:
        The numbers, and the autocorrelations.

    Raises:
        ValueError: If there are fewer than two frames.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> jf.diagnostics.effective_draws(jnp.ones((100, 1))).number.tolist()
        [1.0]
    """
    checks.floating("errors", errors)
    known = jnp.isfinite(errors)
    frames, length = jnp.sum(known, axis=0), errors.shape[0]
    # A stable sort moves the frames that are there to the front, in their order.
    dense = jnp.take_along_axis(errors, jnp.argsort(~known, axis=0, stable=True), axis=0)
    phi = jnp.clip(autocorrelation(dense, 1)[1], 0.0, 1.0)
    # The sample autocorrelation of a constant is 1 - 1 / t. A single frame is one draw.
    phi = jnp.where(frames == 1, 0.0, jnp.minimum(phi * length / max(length - 1, 1), 1.0))
    return Draws(jnp.maximum(frames * (1 - phi) / (1 + phi), 1.0), phi)


def cluster_interval(
    key: AnyKey,
    means: Float[Array, "r *shape"],
    counts: Float[ArrayLike, " r"],
    *,
    probability: float = 0.95,
    num_draws: int = 2000,
) -> Band:
    """Interval of a mean over recordings whose frames are not independent, by drawing whole recordings.

    The bootstrap over clusters (A. C. Davison and D. V. Hinkley, "Bootstrap Methods and their Application", 1997,
    section 3.8): recordings are drawn with replacement, and the mean over their frames is taken anew.

    Args:
        key: Random key of the draws.
        means: Mean of each recording, e.g. its coverage, (r, ...); at least two recordings.
        counts: Number of frames of each recording, (r,).
        probability: Of the interval, in (0, 1).
        num_draws: Number of draws.

    Returns:
        The limits, of the shape (...). With few recordings the interval is too short: with five, 88 percent for 95.

    Raises:
        ValueError: If there is one recording, or `probability` is outside (0, 1).

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> shares = jnp.array([0.9, 1.0, 0.5, 0.95, 0.98, 0.4])
        >>> low, high = jf.diagnostics.cluster_interval(jax.random.key(0), shares, jnp.ones(6))
        >>> bool(low < 0.7), bool(high > 0.9)
        (True, True)
    """
    checks.floating("means", means)
    between("probability", probability, 0.0, 1.0)
    counts = jnp.asarray(counts, means.dtype)
    count = means.shape[0] if means.ndim else 0
    if count < 2 or counts.shape != (count,):
        raise ValueError(
            "means must be those of at least two recordings, and counts one number for each; "
            f"got the shapes {means.shape} and {counts.shape}."
        )
    chosen = jax.random.randint(key, (num_draws, count), 0, count)
    weights = counts[chosen]
    total = einsum("bi,bi...->b...", weights, means[chosen])
    drawn = total / jnp.sum(weights, axis=1).reshape((num_draws,) + (1,) * (means.ndim - 1))
    tail = 0.5 * (1 - probability)
    return Band(jnp.quantile(drawn, tail, axis=0), jnp.quantile(drawn, 1 - tail, axis=0))
