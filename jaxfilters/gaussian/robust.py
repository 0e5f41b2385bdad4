r"""Gaussian filters for observations with outliers: each observation is weighted by the probability that it is none.

$$y_t = h(x_t) + r_t,\qquad r_t \sim (1 - \epsilon) N(0, R) + \epsilon N(0, R_o),$$

the contaminated normal (J. W. Tukey, "A survey of sampling from contaminated distributions", in "Contributions to
Probability and Statistics", 1960). The posterior is a mixture of those that the two noises give, and is replaced by one
Gaussian with the same mean and covariance. It is a smooth function of the parameters, so that the share of outliers
and their noise can be estimated by gradients; and as outliers keep some weight, a filter that has diverged recovers.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import Observation
from jaxfilters.gaussian.model import GaussianModel, model_of
from jaxfilters.typing import AnyKey


class RobustInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """Log density of the observation under both noises, given all observations before it."""
    inner: KalmanInfo
    """Diagnostics of the update with the inlier noise."""
    inlier_probability: Float[Array, ""]
    """Probability that the observation is no outlier; 1 - `outlier_probability` where nothing was read."""


@pytree_dataclass
class Robust:
    """Parameters of a filter made by `robust`; its arguments describe them."""

    inner: Filter
    outlier_probability: Float[Array, ""]
    outlier_noise: Float[Array, "..."]


def robust(inner: Filter, outlier_probability: float | Float[Array, ""], outlier_noise: Float[Array, "m m"]) -> Filter:
    """Gaussian filter `inner` for observations of which a share are outliers with another, larger noise.

    An observation is an outlier as a whole; components that fail one by one are observations of their own. The state
    is the `Gaussian` of `inner`, the info a `RobustInfo`.

    Args:
        inner: Filter made by `extended_kalman`, `unscented_kalman`, `cubature_kalman` or `kalman` with a `Gaussian`
            prior, i.e. not for `jf.arithmetic.square_root`.
        outlier_probability: Share of the observations that are outliers, in (0, 1).
        outlier_noise: Covariance of the noise of outliers, (m, m).

    Returns:
        The filter.

    Raises:
        ValueError: If `inner` is another kind of filter; if `outlier_probability` is outside (0, 1); if `outlier_noise`
            is no covariance or has another shape than the observation noise of `inner`.
        TypeError: If `inner` is no filter, or `outlier_noise` no array of floating-point numbers.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> inner = jf.extended_kalman(prior, lambda x: x, 0.1 * jnp.eye(1), lambda x: x, 0.1 * jnp.eye(1))
        >>> filter = jf.robust(inner, 0.05, 100.0 * jnp.eye(1))
        >>> y = jnp.array([[0.1], [30.0], [0.2]])
        >>> _, (beliefs, infos) = jf.run(filter, jax.random.key(0), y)
        >>> (infos.inlier_probability > 0.5).tolist()
        [True, False, True]
    """
    checks.is_filter("inner", inner)
    model = model_of(inner, "inner")
    if not isinstance(model.prior, Gaussian):
        raise ValueError(
            "inner must be made by kalman or extended_kalman (or unscented_kalman, cubature_kalman) with a Gaussian "
            f"prior; its prior is a {type(model.prior).__name__}."
        )
    if model.observation_noise is None:
        raise ValueError("inner must have Gaussian observation noise; it has an emission.")
    checks.probability("outlier_probability", outlier_probability)
    if not callable(model.observation_noise):
        shape = jnp.shape(model.observation_noise)
        checks.shaped("outlier_noise", outlier_noise, shape, ", that of the observation noise of inner")
    checks.noise("outlier_noise", outlier_noise, None, is_root=False)
    return Filter(Robust(inner, jnp.asarray(outlier_probability), outlier_noise), _init, _predict, _update)


def _init(model: Robust, key: AnyKey) -> Gaussian:
    return model.inner.init(model.inner.params, key)


def _predict(model: Robust, key: AnyKey, belief: Gaussian, inputs: PyTree) -> Gaussian:
    return model.inner.predict(model.inner.params, key, belief, inputs)


def _update(
    model: Robust, key: AnyKey, belief: Gaussian, observation: PyTree, inputs: PyTree
) -> tuple[Gaussian, RobustInfo]:
    inner = model.inner.params
    observed = observation if isinstance(observation, Observation) else Observation(observation)
    inlier, inlier_info = model.inner.update(inner, key, belief, observed, inputs)
    outlier, outlier_info = model.inner.update(inner, key, belief, observed._replace(noise=model.outlier_noise), inputs)
    log_inlier = jnp.log1p(-model.outlier_probability) + inlier_info.log_evidence
    log_outlier = jnp.log(model.outlier_probability) + outlier_info.log_evidence
    # Where neither noise explains the observation, both updates are the prediction.
    possible = jnp.isfinite(log_inlier) | jnp.isfinite(log_outlier)
    log_odds = jnp.where(possible, log_inlier, 0.0) - jnp.where(possible, log_outlier, 0.0)
    inlier_probability = jnp.where(possible, jax.nn.sigmoid(log_odds), 1 - model.outlier_probability)
    return _merged(inner, inlier, outlier, inlier_probability), RobustInfo(
        jnp.logaddexp(log_inlier, log_outlier), inlier_info, inlier_probability
    )


def _merged(model: GaussianModel, inlier: Gaussian, outlier: Gaussian, probability: Float[Array, ""]) -> Gaussian:
    """One Gaussian with the moments of both; on a manifold the tangent spaces at the two means are taken to be one."""
    apart = model.manifold.local(outlier.mean, inlier.mean)
    covariance = probability * inlier.covariance + (1 - probability) * outlier.covariance
    spread = probability * (1 - probability) * factor.outer(apart[:, None], apart[:, None])
    return Gaussian(model.manifold.retract(outlier.mean, probability * apart), covariance + spread)
