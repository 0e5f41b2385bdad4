r"""Observations that are counts or classes, for Gaussian filters: Poisson, binomial, Bernoulli and categorical.

An emission is what `extended_kalman`, `unscented_kalman` and `cubature_kalman` take as `observe`, in place of a
function with Gaussian noise. It is written by its natural parameter $\eta(x)$, a logarithm of a rate or log odds, so
that no state has a negative rate or a probability above 1. Two updates are available:

- *Conditional moments*, by default: the observation is replaced by a Gaussian one with the mean and the covariance of
  the emission over the predicted belief, by the linearisation of the filter (M. Tronarp, A. F. García-Fernández and
  S. Särkkä, "Iterative filtering and smoothing in nonlinear and non-Gaussian systems using conditional moments", IEEE
  Signal Processing Letters 25(3), 2018). Sigma points are the safer linearisation of a steep rate.
- *Laplace's method*, by `jf.extended_kalman(..., iterations=10, iterate_to="mode")`: damped Newton steps to the mode of
  the posterior, with the Fisher information there as the curvature of the likelihood. For a linear $\eta$ these are
  Newton's own steps. It is the one to use where counts are small, or far from what is predicted.

Neither log evidence is that of the Gaussian that replaces the emission: it is
$\log p(y \mid \hat x) + \log N(\hat x; m, P) - \log N(\hat x; \hat x, \hat P)$ at the posterior mean $\hat x$ with the
posterior covariance $\hat P$, a probability, by Laplace's method (L. Tierney and J. B. Kadane, Journal of the American
Statistical Association 81, 1986).

Components of an observation that are NaN, or masked by `Observation(y, mask)`, are missing. Values that the emission
cannot produce (negative, not integer, too large) have the log evidence `-inf`; they leave the belief as it is, and are
counted in `info.num_invalid`.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.typing import taking_inputs


@runtime_checkable
class Family(Protocol):
    """A family of distributions, by its natural parameter."""

    def encoded(self, y: Array, eta: Array) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
        """The observation as a vector of m numbers, NaN where it is missing, and which of them are possible."""
        ...

    def mean(self, eta: Float[Array, " k"]) -> Float[Array, " m"]:
        """Mean of the encoded observation."""
        ...

    def covariance(self, eta: Float[Array, " k"]) -> Float[Array, "m m"]:
        """Covariance of the encoded observation."""
        ...

    def log_probability(self, eta: Float[Array, " k"], y: Float[Array, " m"]) -> Float[Array, " m"]:
        """Terms of the log probability of an encoded observation, of which those of missing components do not count."""
        ...


@pytree_dataclass
class Emission:
    """A distribution of observations given the state; made by `poisson`, `binomial`, `bernoulli`, `categorical`.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> emission = jf.emissions.poisson(lambda x: 2.0 * x)
        >>> log_rate = emission.of_step(None)
        >>> log_rate(jnp.array([1.5])).tolist()
        [3.0]
    """

    natural: Callable
    """`(x, inputs) -> eta`."""
    family: Any

    def of_step(self, inputs: PyTree) -> Callable[[Array], Array]:
        """`x -> eta` of one step."""

        def natural(x: Array) -> Array:
            eta = self.natural(x, inputs)
            checks.floating("the natural parameter of the emission", eta)
            if eta.ndim != 1:
                raise ValueError(
                    f"the function of an emission must return an array of shape (m,); got the shape {eta.shape}."
                )
            return eta

        return natural


@pytree_dataclass
class _Poisson:
    def encoded(self, y: Array, eta: Array) -> tuple[Array, Array]:
        y = _vector(y, eta)
        return y, _is_count(y)

    def mean(self, eta: Array) -> Array:
        return jnp.exp(eta)

    def covariance(self, eta: Array) -> Array:
        return factor.diagonal_matrix(jnp.exp(eta))

    def log_probability(self, eta: Array, y: Array) -> Array:
        return y * eta - jnp.exp(eta) - gammaln(y + 1)


@pytree_dataclass
class _Binomial:
    num_trials: Array

    def encoded(self, y: Array, eta: Array) -> tuple[Array, Array]:
        y = _vector(y, eta)
        return y, _is_count(y) & (y <= self.num_trials)

    def mean(self, eta: Array) -> Array:
        return self.num_trials * jax.nn.sigmoid(eta)

    def covariance(self, eta: Array) -> Array:
        # As a product of two sigmoids it keeps its digits where one of them is close to 1.
        return factor.diagonal_matrix(self.num_trials * jax.nn.sigmoid(eta) * jax.nn.sigmoid(-eta))

    def log_probability(self, eta: Array, y: Array) -> Array:
        n = self.num_trials
        choices = gammaln(n + 1) - gammaln(y + 1) - gammaln(n - y + 1)
        return choices + y * eta - n * jax.nn.softplus(eta)


@pytree_dataclass
class _Categorical:
    """Encoded as indicators of all classes but the last, whose covariance is not singular."""

    def encoded(self, y: Array, eta: Array) -> tuple[Array, Array]:
        if jnp.shape(y) != ():
            raise ValueError(f"the observation of a categorical emission must be one label, (); got {jnp.shape(y)}.")
        label = jnp.asarray(y, eta.dtype)
        indicators = (label == jnp.arange(eta.size - 1)).astype(eta.dtype)
        possible = _is_count(label) & (label < eta.size)
        missing = jnp.isnan(label)
        return jnp.where(missing, jnp.nan, indicators), jnp.broadcast_to(possible, indicators.shape)

    def mean(self, eta: Array) -> Array:
        return jax.nn.softmax(eta)[:-1]

    def covariance(self, eta: Array) -> Array:
        p = jax.nn.softmax(eta)[:-1]
        rest = 1 - p if p.size == 1 else _others(eta)
        return factor.diagonal_matrix(p * rest) - jnp.outer(p, p) * (1 - jnp.eye(p.size, dtype=p.dtype))

    def log_probability(self, eta: Array, y: Array) -> Array:
        logs = jax.nn.log_softmax(eta)
        last = 1 - jnp.sum(y)
        return jnp.concatenate([y[:1] * logs[:1] + last * logs[-1:], y[1:] * logs[1:-1]])


def _others(eta: Array) -> Array:
    """Probability of all classes but each, without the cancellation of 1 - p."""
    p = jax.nn.softmax(eta)
    return dot(1 - jnp.eye(eta.size, dtype=eta.dtype), p)[:-1]


def poisson(log_rate: Callable) -> Emission:
    """Counts with a Poisson distribution, each independent of the others given the state.

    Args:
        log_rate: `x` or `(x, inputs)` to the logarithms of the expected counts, (m,).

    Returns:
        The emission, for the argument `observe` of a Gaussian filter. Observations are counts (m,), integer or float.

    Raises:
        TypeError: If `log_rate` is no such function.

    Examples:
        Spikes of three neurons whose rates follow one hidden signal.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> log_rate = lambda x: jnp.array([1.0, 0.5, -0.5]) * x + 1.0
        >>> filter = jf.unscented_kalman(prior, lambda x: x, 0.01 * jnp.eye(1), jf.emissions.poisson(log_rate))
        >>> last, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.array([[4, 3, 2], [5, 3, 1]]))
        >>> beliefs.mean.shape, infos.log_evidence.shape
        ((2, 1), (2,))
    """
    return _emission("log_rate", log_rate, _Poisson())


def binomial(logits: Callable, num_trials: Any) -> Emission:
    """Numbers of successes with a binomial distribution, each independent of the others given the state.

    Args:
        logits: `x` or `(x, inputs)` to the log odds of success, (m,).
        num_trials: Number of trials, at least 1; or (m,), one for each component.

    Returns:
        The emission. Observations are numbers of successes (m,), integer or float.

    Raises:
        ValueError: If `num_trials` is not a positive integer where its value is known, or not of the shape () or (m,).
        TypeError: If `logits` is no such function.

    Examples:
        >>> import jaxfilters as jf
        >>> emission = jf.emissions.binomial(lambda x: 2.0 * x, num_trials=10)
    """
    if jnp.ndim(num_trials) > 1:
        raise ValueError(f"num_trials must be one number, or (m,); got the shape {jnp.shape(num_trials)}.")
    known = checks.concrete(num_trials)
    if known is not None and not ((known >= 1) & (known == known.round())).all():
        raise ValueError(f"num_trials must be integers of at least 1; got {num_trials}.")
    return _emission("logits", logits, _Binomial(jnp.asarray(num_trials, float)))


def bernoulli(logits: Callable) -> Emission:
    """Successes and failures, 1 and 0, each independent of the others given the state.

    Args:
        logits: `x` or `(x, inputs)` to the log odds of success, (m,).

    Returns:
        The emission. Observations are 0 or 1, or booleans, (m,).

    Raises:
        TypeError: If `logits` is no such function.

    Examples:
        >>> import jaxfilters as jf
        >>> emission = jf.emissions.bernoulli(lambda x: x[:1])
    """
    return binomial(logits, 1)


def categorical(logits: Callable) -> Emission:
    """One of K classes, with probabilities that are the softmax of K numbers.

    Args:
        logits: `x` or `(x, inputs)` to the logarithms of the probabilities but for a constant, (K,), K at least 2.

    Returns:
        The emission. An observation is one label from 0 to K - 1, of shape (), integer or float.

    Raises:
        TypeError: If `logits` is no such function.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> emission = jf.emissions.categorical(lambda x: jnp.array([0.0, x[0], x[1]]))
    """
    return _emission("logits", logits, _Categorical())


def _emission(name: str, natural: Any, family: Family) -> Emission:
    checks.function(name, natural)
    return Emission(taking_inputs(name, natural, "x"), family)


def _vector(y: Any, eta: Array) -> Array:
    if not hasattr(y, "shape") or y.shape != eta.shape:
        shape = getattr(y, "shape", type(y).__name__)
        raise ValueError(f"the observation y must have the shape {eta.shape}, that of its parameter; got {shape}.")
    return jnp.asarray(y, eta.dtype)


def _is_count(y: Array) -> Array:
    return (y >= 0) & (y == jnp.round(y)) & jnp.isfinite(y)
