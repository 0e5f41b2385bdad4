"""Tempering: likelihoods raised to a power below 1, so that a very sharp one leaves more than a few particles.

What a filter tempers is the whole factor by which an update multiplies the weights: the likelihood, and for a filter
with a `guided` proposal also the importance correction of that proposal. The power is counted against the weights
before that factor, so that a guide whose correction is uneven is tempered together with the likelihood that it serves.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass


def no_tempering(log_factor: Float[Array, " n"], log_weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the factors as they are: the default of every filter."""
    del log_weights
    return log_factor


@pytree_dataclass
class AdaptiveTempering:
    r"""Raise the factors of an update to the largest power, at most 1, that retains a fraction of the effective size.

    With weights $W_i$ before an update and factors $g_i$, the update uses $W_i g_i^\beta$ with the largest
    $\beta \le 1$ for which the effective sample size (ESS) of $W_i g_i^\beta$ is at least `ess_fraction` times that of
    the $W_i$ with $g_i > 0$: no power brings back a particle that is impossible. The factor $g_i$ is the likelihood
    $p(y \mid x_i)$, times the ratio of transition and proposal density where the proposal is `guided`: at a small power
    the particles then stay where the guide put them, and are not returned to the prediction. The choice of a power by
    the effective sample size follows A. Jasra, D. A. Stephens, A. Doucet and T. Tsagaris, "Inference for Levy-driven
    stochastic volatility models via adaptive sequential Monte Carlo", Scandinavian Journal of Statistics 38, 2011.
    Wherever the power is below 1 the posterior is wider than the exact one, and the log evidence is that of the
    tempered model.

    Builders reject an `ess_fraction` outside (0, 1] where its value is concrete.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> temper = jf.AdaptiveTempering(0.5)
        >>> tempered = temper(jnp.array([0.0, -100.0, -200.0, -300.0]), jnp.zeros(4))
        >>> round(float(jf.weights.effective_sample_size(tempered)), 3)
        2.0
    """

    ess_fraction: float | Float[Array, ""]
    """Fraction that is retained of the effective sample size of the possible particles before the update, in (0, 1]."""

    def __call__(self, log_factor: Float[Array, " n"], log_weights: Float[Array, " n"]) -> Float[Array, " n"]:
        """Log factors `(n,)` times the power, which is a constant to differentiation."""
        possible = jnp.where(log_factor > -jnp.inf, log_weights, -jnp.inf)
        target = self.ess_fraction * weights.effective_sample_size(possible)
        exponent = weights.temper_exponent(log_factor, log_weights, target)
        return jax.lax.stop_gradient(exponent) * log_factor
