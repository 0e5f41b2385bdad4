r"""Gaussian filters of models with Student-t noise: heavy tails of the observations, of the process, or of both.

$$y_t = h(x_t) + r_t,\ r_t \sim t_\nu(0, R),\qquad x_t = f(x_{t-1}) + q_t,\ q_t \sim t_\mu(0, Q).$$

Student's t is a scale mixture, $r \mid \lambda \sim N(0, R / \lambda)$ with $\lambda \sim \Gamma(\nu/2, \nu/2)$ (the
models of G. Agamennoni, J. I. Nieto and E. M. Nebot, "Approximate inference in state-space models with heavy-tailed
noise", IEEE Transactions on Signal Processing 60(10), 2012, and of M. Roth, E. Özkan and F. Gustafsson, "A Student's t
filter for heavy tailed process and measurement noise", ICASSP 2013). The integral over $\lambda$ is a sum over a few
scales, spaced evenly in $\log \lambda$: the trapezoidal rule, which converges exponentially here. The posterior is
then a mixture of Gaussians, one for each scale, which is replaced by one Gaussian with the same mean and covariance.
Nothing is iterated, an outlier has no abrupt effect, and the log evidence is a smooth function of all parameters, the
degrees of freedom among them.
"""

from dataclasses import field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, DTypeLike, Float, PyTree

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import Observation
from jaxfilters.gaussian.manifold import Belief, dimension, increments, retract_belief
from jaxfilters.gaussian.model import model_of
from jaxfilters.gaussian.noise_models import NonAdditiveNoise
from jaxfilters.typing import AnyKey

_SPACING = 1.25
"""Distance of the scales, in standard deviations of log lambda given the observation: the error of the trapezoidal
rule is exp(-2 pi^2 / 1.25^2) = 3e-6 for a Gaussian, and 1e-3 for the skewed distributions of few degrees of freedom."""


class StudentTInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """Log density of the observation under the scale mixture, given all observations before it. It is that of the
    model with t noise but for the trapezoidal rule (1e-3), and for the Gaussian that replaces each posterior."""
    inner: KalmanInfo
    """Diagnostics of the update with all noises at their scale matrices, lambda = 1."""
    observation_weight: Float[Array, ""]
    """Expected lambda of the observation noise: about 1 for inliers, near 0 for outliers; 1 where it is Gaussian."""
    process_weight: Float[Array, ""]
    """Expected lambda of the process noise of the step: near 0 after a jump; 1 where it is Gaussian."""


class HeavyTailState(NamedTuple):
    """Belief of a filter with t process noise, and its parts by the scale of that noise in the last prediction."""

    belief: Gaussian
    """The Gaussian with the moments of all parts."""
    parts: Gaussian
    """Leaves `(k, ...)`; all alike after an update."""


@pytree_dataclass
class StudentT:
    """Parameters of a filter made by `student_t`; its arguments describe them."""

    inner: Filter
    observation_dof: Array | None
    process_dof: Array | None
    num_scales: int = field(metadata={"static": True})


def student_t(
    inner: Filter,
    observation_dof: ArrayLike | None,
    *,
    process_dof: ArrayLike | None = None,
    num_scales: int = 16,
) -> Filter:
    """Gaussian filter `inner` whose observation noise, process noise or both have a Student-t distribution.

    The noises of `inner` are the scale matrices: the covariance of a t distribution is `dof / (dof - 2)` times as
    large. An observation is an outlier as a whole; components that fail one by one are observations of their own. The
    info is a `StudentTInfo`. The state is the `Gaussian` of `inner`, or a `HeavyTailState` with a `process_dof`.

    Args:
        inner: Filter made by `extended_kalman`, `unscented_kalman`, `cubature_kalman` or `kalman` with a `Gaussian`
            prior, i.e. not for `jf.arithmetic.square_root`, and with additive noise.
        observation_dof: Degrees of freedom of the observation noise, positive; 3 to 5 are usual. None is Gaussian.
        process_dof: Degrees of freedom of the process noise, above 2; None is Gaussian.
        num_scales: Number of scales of each noise, at least 4. Every update costs that many updates of `inner` with
            one linearisation for all, and their product where both noises are heavy-tailed. With 16 the tail is that
            of the t distribution up to a hundred standard deviations for `dof` 4, and Gaussian beyond.

    Returns:
        The filter.

    Raises:
        ValueError: If `inner` is another kind of filter, both noises are Gaussian, degrees of freedom are out of range
            where they are known, or `num_scales < 4`.
        TypeError: If `inner` is no filter.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> inner = jf.kalman(prior, jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), 0.1 * jnp.eye(1))
        >>> filter = jf.student_t(inner, 4.0)
        >>> _, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.array([[0.1], [30.0], [0.2]]))
        >>> (infos.observation_weight > 0.5).tolist()
        [True, False, True]
    """
    checks.is_filter("inner", inner)
    model = model_of(inner, "inner")
    additive = not any(isinstance(getattr(model, name, None), NonAdditiveNoise) for name in ("transition", "observe"))
    if not isinstance(model.prior, Gaussian) or model.observation_noise is None or not additive:
        raise ValueError(
            "inner must have a Gaussian prior and additive noise with covariances, not an emission, a NonAdditiveNoise "
            f"or a GaussianRoot; its prior is a {type(model.prior).__name__}."
        )
    if observation_dof is None and process_dof is None:
        raise ValueError("observation_dof or process_dof must be a number; both are None, which is inner itself.")
    if isinstance(num_scales, bool) or not isinstance(num_scales, int) or num_scales < 4:
        raise ValueError(f"num_scales must be an integer of at least 4; got {num_scales!r}.")
    dofs = _checked("observation_dof", observation_dof, 0.0), _checked("process_dof", process_dof, 2.0)
    params = StudentT(inner, *dofs, num_scales)
    if process_dof is None:
        return Filter(params, _init, _predict, _update)
    return Filter(params, _init_parts, _predict_parts, _update_parts)


def _checked(name: str, dof: Any, above: float) -> Array | None:
    if dof is None:
        return None
    known = checks.concrete(dof)
    if jnp.shape(dof) != () or (known is not None and not above < known < jnp.inf):
        raise ValueError(f"{name} must be one finite number above {above:g}; got {dof!r}.")
    return jnp.asarray(dof, dtype=float)


def scales(
    dof: Array | None, size: int | Array, count: int, dtype: DTypeLike
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Values of lambda, and their log probabilities, which sum to 1; one value, 1, for Gaussian noise.

    Args:
        dof: Degrees of freedom; None for Gaussian noise.
        size: Dimension of the noise, which says how much one draw of it can tell about lambda.
        count: Number of values. Three quarters of them are below 1, where the tail is.
        dtype: Type of the values.
    """
    if dof is None:
        return jnp.ones(1, dtype), jnp.zeros(1, dtype)
    dof = dof.astype(dtype)
    steps = (jnp.arange(count) - _at_one(dof, count)).astype(dtype)
    log_scale = _SPACING * jnp.sqrt(2 / (dof + size)) * steps
    # Without the constant -1, which would cost the digits of a distribution that is narrow about 1.
    log_density = -0.5 * dof * (jnp.expm1(log_scale) - log_scale)
    return jnp.exp(log_scale), jax.nn.log_softmax(log_density)


def _num_read(observed: Observation) -> Array:
    """Rows with a reading: the others say nothing about lambda."""
    read = jnp.isfinite(observed.y)
    return jnp.sum(read if observed.mask is None else read & observed.mask)


def _at_one(dof: Array | None, count: int) -> int:
    return 0 if dof is None else 3 * count // 4


def _init(model: StudentT, key: AnyKey) -> Gaussian:
    return model.inner.init(model.inner.params, key)


def _predict(model: StudentT, key: AnyKey, belief: Gaussian, inputs: PyTree) -> Gaussian:
    return model.inner.predict(model.inner.params, key, belief, inputs)


def _update(
    model: StudentT, key: AnyKey, belief: Gaussian, observation: PyTree, inputs: PyTree
) -> tuple[Gaussian, StudentTInfo]:
    return _updated(model, key, jax.tree.map(lambda leaf: leaf[None], belief), observation, inputs)


def _init_parts(model: StudentT, key: AnyKey) -> HeavyTailState:
    return _alike(model, _init(model, key))


def _alike(model: StudentT, belief: Gaussian) -> HeavyTailState:
    spread = lambda leaf: jnp.broadcast_to(leaf, (model.num_scales, *leaf.shape))
    return HeavyTailState(belief, jax.tree.map(spread, belief))


def _predict_parts(model: StudentT, key: AnyKey, state: HeavyTailState, inputs: PyTree) -> HeavyTailState:
    del key
    linear, belief = model.inner.params, state.belief
    checks.state(belief, linear.prior)
    origin, step = linear.linear_transition(belief, inputs)
    Q = linear.process_noise_of(belief, inputs)
    values, log_probabilities = scales(model.process_dof, dimension(belief), model.num_scales, belief.mean.dtype)

    def ahead(scale: Array) -> Belief:
        delta = linear.arithmetic.predict(increments(belief), step.F, Q / scale, step.value, step.residual_root)
        return retract_belief(linear.manifold, origin, delta)

    parts: Any = jax.vmap(ahead)(values)
    return HeavyTailState(_merged(linear, parts, jnp.exp(log_probabilities)), parts)


def _update_parts(
    model: StudentT, key: AnyKey, state: HeavyTailState, observation: PyTree, inputs: PyTree
) -> tuple[HeavyTailState, StudentTInfo]:
    belief, info = _updated(model, key, state.parts, observation, inputs)
    return _alike(model, belief), info


def _updated(
    model: StudentT, key: AnyKey, parts: Gaussian, observation: PyTree, inputs: PyTree
) -> tuple[Gaussian, StudentTInfo]:
    """One Gaussian for the updates of all parts with all scales of the observation noise."""
    linear, count = model.inner.params, model.num_scales
    observed = observation if isinstance(observation, Observation) else Observation(observation)
    noises, log_noises = scales(model.observation_dof, _num_read(observed), count, parts.mean.dtype)
    moves, log_moves = scales(model.process_dof, dimension(linear.prior), count, parts.mean.dtype)

    def update(belief: Gaussian) -> tuple[Gaussian, KalmanInfo]:
        R = linear.observation_noise_of(belief, inputs) if observed.noise is None else observed.noise
        one = lambda scale: model.inner.update(
            model.inner.params, key, belief, observed._replace(noise=R / scale), inputs
        )
        return jax.vmap(one)(noises)

    beliefs, infos = jax.vmap(update)(parts)
    log_weights = log_moves[:, None] + log_noises + infos.log_evidence
    log_evidence = jax.scipy.special.logsumexp(log_weights)
    # Where no scale explains the observation, the prediction is all that is known.
    usable = jnp.isfinite(log_evidence)
    log_prior = log_moves[:, None] + log_noises
    weights = jnp.exp(jnp.where(usable, log_weights - jnp.where(usable, log_evidence, 0.0), log_prior))
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), beliefs)
    nominal = jax.tree.map(
        lambda leaf: leaf[_at_one(model.process_dof, count), _at_one(model.observation_dof, count)], infos
    )
    belief = _merged(linear, flat, weights.reshape(-1))
    return belief, StudentTInfo(log_evidence, nominal, jnp.sum(weights * noises), jnp.sum(weights * moves[:, None]))


def _merged(model: Any, parts: Gaussian, weights: Float[Array, " k"]) -> Gaussian:
    """One Gaussian with the moments of all; on a manifold the tangent spaces at the means are taken to be one."""
    reference = parts.mean[jnp.argmax(weights)]
    apart = jax.vmap(model.manifold.local, (None, 0))(reference, parts.mean)
    mean = dot(weights, apart)
    # Not by the root of the weights, whose derivative is infinite where one underflows.
    weighted, apart = weights[:, None] * (apart - mean), apart - mean
    covariance = jnp.tensordot(weights, parts.covariance, 1, precision="highest") + factor.inner(weighted, apart)
    return Gaussian(model.manifold.retract(reference, mean), covariance)
