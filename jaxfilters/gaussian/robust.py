r"""Observations of which some are wild: a Gaussian filter that asks of each how far it may be trusted.

$$y_t = h(x_t) + r_t,\qquad r_t \sim (1 - \epsilon) N(0, R) + \epsilon N(0, R_o),$$

the contaminated normal (J. Tukey, "A survey of sampling from contaminated distributions", 1960). The belief is the
mixture of what the two noises would make of it, as one Gaussian with the same mean and covariance. All of it is
smooth, so that the share of outliers and their noise can be learnt; and as an outlier still says something, a filter
that has gone astray comes back.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.arithmetic import KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import Observation
from jaxfilters.gaussian.model import GaussianModel, model_of
from jaxfilters.typing import AnyKey


class RobustInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """Log density of the observation, wild or not."""
    inner: KalmanInfo
    """Of the update that trusts the observation."""
    inlier_probability: Float[Array, ""]
    """Probability that it is not wild; 1 - `outlier_probability` where nothing was seen."""


@pytree_dataclass
class Robust:
    """Parameters of a filter whose observations may be wild."""

    inner: Filter
    outlier_probability: Float[Array, ""]
    outlier_noise: Float[Array, "..."]


def robust(inner: Filter, outlier_probability: float | Float[Array, ""], outlier_noise: Float[Array, "m m"]) -> Filter:
    """The filter `inner` for observations of which a share has another, larger noise.

    An observation is wild as a whole: rows that go astray one by one are observations of their own.

    Args:
        inner: Made by `extended`, with covariances (not `kalman.square_root`).
        outlier_probability: Share of observations that are wild, in (0, 1).
        outlier_noise: Covariance of their noise.

    Raises:
        ValueError: If `inner` is another kind of filter, or `outlier_noise` no covariance.
    """
    trusted = model_of(inner, "inner")
    if not isinstance(trusted.prior, Gaussian):
        raise ValueError(f"inner must have a Gaussian prior; got a {type(trusted.prior).__name__}.")
    if jnp.shape(outlier_noise) != jnp.shape(trusted.observation_noise):
        raise ValueError(
            f"outlier_noise must be shaped as inner's observation_noise, "
            f"{jnp.shape(trusted.observation_noise)}; got {jnp.shape(outlier_noise)}."
        )
    return Filter(Robust(inner, jnp.asarray(outlier_probability), outlier_noise), _init, _predict, _update)


def _init(model: Robust, key: AnyKey) -> Gaussian:
    return model.inner.init(model.inner.params, key)


def _predict(model: Robust, key: AnyKey, belief: Gaussian, control: PyTree) -> Gaussian:
    return model.inner.predict(model.inner.params, key, belief, control)


def _update(model: Robust, key: AnyKey, belief: Gaussian, observation: PyTree) -> tuple[Gaussian, RobustInfo]:
    inner = model.inner.params
    wildly = (observation if isinstance(observation, Observation) else Observation(observation))._replace(
        noise=model.outlier_noise
    )
    trusting, info = model.inner.update(inner, key, belief, observation)
    doubting, wild_info = model.inner.update(inner, key, belief, wildly)
    usual = jnp.log1p(-model.outlier_probability) + info.log_evidence
    wild = jnp.log(model.outlier_probability) + wild_info.log_evidence
    inlier_probability = jax.nn.sigmoid(usual - wild)
    return _merged(inner, doubting, trusting, inlier_probability), RobustInfo(
        jnp.logaddexp(usual, wild), info, inlier_probability
    )


def _merged(
    model: GaussianModel, doubting: Gaussian, trusting: Gaussian, inlier_probability: Float[Array, ""]
) -> Gaussian:
    """One Gaussian for both; on a manifold the two tangent spaces are taken for one, as far as they are apart."""
    moved = model.manifold.local(doubting.mean, trusting.mean)
    covariance = inlier_probability * trusting.covariance + (1 - inlier_probability) * doubting.covariance
    spread = inlier_probability * (1 - inlier_probability) * factor.outer(moved[:, None], moved[:, None])
    return Gaussian(model.manifold.retract(doubting.mean, inlier_probability * moved), covariance + spread)
