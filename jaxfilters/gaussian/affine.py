r"""Gaussian models as affine functions of every state of a sequence, and the smoothers of such models.

$$x_t = F_t x_{t-1} + b_t + q_t,\ q_t \sim N(0, Q_t + A_t A_t^T),\qquad
y_t = H_t x_t + d_t + r_t,\ r_t \sim N(0, R_t + C_t C_t^T).$$

Once a model is linearised about a trajectory, no frame depends on another one: linearising is one batch, and smoothing
may run in sequence, or in logarithmic depth.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import Arithmetic, factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import as_observation
from jaxfilters.gaussian.linear import Kalman
from jaxfilters.gaussian.linearize import lower_root
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.gaussian.noise_models import Augmented, NonAdditiveNoise, no_noise
from jaxfilters.gaussian.parallel_in_time import LinearModel, parallel_kalman, parallel_rts
from jaxfilters.math import linalg


class AffineModel(NamedTuple):
    """Every frame of a sequence as affine functions; noises as the arithmetic of the filter writes them."""

    F: Float[Array, "t n n"]
    b: Float[Array, "t n"]
    Q: Float[Array, "t n _"]
    added_Q: Float[Array, "t n _"]
    """Root A of the covariance of the transition's linearisation error."""
    H: Float[Array, "t m n"]
    d: Float[Array, "t m"]
    R: Float[Array, "t m _"]
    added_R: Float[Array, "t m _"]
    """Root C of the covariance of the observation's linearisation error."""
    y: Float[Array, "t m"]
    """0 where nothing was read."""
    read: Bool[Array, "t m"]


@runtime_checkable
class Smoother(Protocol):
    """Smooth an affine model: the beliefs, that before the first observation first, and the log evidence."""

    def __call__(self, prior: Belief, model: AffineModel, arithmetic: Arithmetic, /) -> tuple[Belief, Array]: ...


def affine_model(
    model: Any, trajectory: Belief, observations: PyTree, inputs: PyTree, mask: Bool[Array, " t"] | None
) -> AffineModel:
    """A model linearised about beliefs of t + 1 states, the first of them before the first observation.

    Args:
        model: Parameters of a filter made by `kalman` or `extended_kalman`, of vectors.
        trajectory: Beliefs, (t + 1, n) and (t + 1, n, n).
        observations: Observations, time first.
        inputs: Known inputs, time first.
        mask: False for frames without an observation, (t,).
    """
    earlier, here = (jax.tree.map(lambda leaf, cut=cut: leaf[cut], trajectory) for cut in (slice(-1), slice(1, None)))

    def one(before: Belief, here: Belief, observation: PyTree, inputs: PyTree, is_observed: Array | None):
        y, read, own_noise = read_components(observation)
        read = read if is_observed is None else read & is_observed
        ahead, step = model.linear_transition(before, inputs)
        b = ahead + step.value - factor.apply(step.F, before.mean)
        Q = model.process_noise_of(before, inputs)
        observed = linear_observation(model, here, jnp.where(read, y, 0.0), own_noise, inputs)
        return AffineModel(step.F, b, Q, step.residual_root, *observed, read)

    return jax.vmap(one)(earlier, here, observations, inputs, mask)


class AffineObservation(NamedTuple):
    """One observation as an affine function of the state; fields as of `AffineModel`."""

    H: Float[Array, "m n"]
    d: Float[Array, " m"]
    R: Float[Array, "m _"]
    added_R: Float[Array, "m _"]
    y: Float[Array, " m"]


def read_components(observation: PyTree) -> tuple[Array, Array, Array | None]:
    """An observation, 0 where nothing was read; which components were read; and the noise of its own, if any."""
    y, mask, own_noise = as_observation(observation)
    read = jnp.isfinite(y) if mask is None else jnp.isfinite(y) & mask
    return jnp.where(read, y, 0.0), read, own_noise


def linear_observation(
    model: Any, belief: Belief, y: Float[Array, " m"], own_noise: Array | None, inputs: PyTree
) -> AffineObservation:
    """An observation as an affine function over a belief.

    Residuals that are no differences, as of angles, are linearised from the predicted observation; y is then the
    residual, too.

    Raises:
        ValueError: If the observation has an emission.
    """
    if model.observation_noise is None:
        raise ValueError("the filter must have Gaussian observation noise; it has an emission.")
    R = model.observation_noise_of(belief, inputs) if own_noise is None else own_noise
    if isinstance(model, Kalman):
        step = model.matrices(inputs)
        d = jnp.zeros_like(y) if step.d is None else step.d
        return AffineObservation(step.H, d, R, jnp.zeros((y.size, 0), y.dtype), y)
    observe, linearize = lambda x: model.observe(x, inputs), model.linearize
    if isinstance(model.observe, NonAdditiveNoise):
        observe, linearize = model.observe.at(inputs, R.shape[0], y.dtype), Augmented(R, linearize)
        R = no_noise(belief, y.size)
    is_root = isinstance(belief, GaussianRoot)
    reference = checks.predicted(observe(belief.mean), y, "observation_noise", R, is_root=is_root)
    found = linearize(lambda x, *r: model.residual(observe(x, *r), reference), belief)
    d = found.value - factor.apply(found.F, belief.mean)
    return AffineObservation(found.F, d, R, found.residual_root, model.residual(y, reference))


def sequential(prior: Belief, model: AffineModel, arithmetic: Arithmetic) -> tuple[Belief, Array]:
    """Filter and smoother frame after frame: the choice for CPUs and short sequences.

    Args:
        prior: Belief before the first observation.
        model: The model.
        arithmetic: Arithmetic of its noises and beliefs.

    Returns:
        The smoothed beliefs of t + 1 states, and the log evidence.

    Examples:
        A constant with the prior N(0, 1), observed as 4 three times with noise of variance 1: its mean is 12 / 4.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior, one = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> filter = jf.extended_kalman(prior, lambda x: x, 0.0 * one, lambda x: x, one)
        >>> smoothed, _ = jf.smoothing.iterated(
        ...     filter, jax.random.key(0), jnp.full((3, 1), 4.0), iterations=1, smoother=jf.smoothing.sequential
        ... )
        >>> [round(float(mean), 3) for mean in smoothed.mean[:, 0]]
        [3.0, 3.0, 3.0]
    """

    def forward(belief: Belief, step: AffineModel) -> tuple[Belief, tuple[Belief, Array]]:
        ahead = arithmetic.predict(belief, step.F, step.Q, step.b, step.added_Q)
        y_hat = factor.apply(step.H, ahead.mean) + step.d
        after, info = arithmetic.update(ahead, step.y, step.H, step.R, y_hat, step.read, step.added_R)
        return after, (belief, info.log_evidence)

    def backward(following: Belief, each: tuple[Belief, AffineModel]) -> tuple[Belief, Belief]:
        belief, step = each
        smoothed = arithmetic.rts(belief, following, step.F, step.Q, step.b, step.added_Q)
        return smoothed, smoothed

    prior = GaussianRoot(prior.mean, linalg.tria(prior.root)) if isinstance(prior, GaussianRoot) else prior
    last, (earlier, evidences) = jax.lax.scan(forward, prior, model)
    _, smoothed = jax.lax.scan(backward, last, (earlier, model), reverse=True)
    return jax.tree.map(lambda most, end: jnp.concatenate([most, end[None]]), smoothed, last), evidences.sum()


def parallel(prior: Belief, model: AffineModel, arithmetic: Arithmetic) -> tuple[Belief, Array]:
    """Filter and smoother in logarithmic depth, `parallel_kalman` and `parallel_rts`: for accelerators.

    Arguments and results are those of `sequential`, whatever the arithmetic; roots of covariances are used within.

    Examples:
        A constant with the prior N(0, 1), observed as 4 three times with noise of variance 1: its mean is 12 / 4.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior, one = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> filter = jf.extended_kalman(prior, lambda x: x, 0.0 * one, lambda x: x, one)
        >>> key, y = jax.random.key(0), jnp.full((3, 1), 4.0)
        >>> smoothed, _ = jf.smoothing.iterated(filter, key, y, iterations=1, smoother=jf.smoothing.parallel)
        >>> [round(float(mean), 3) for mean in smoothed.mean[:, 0]]
        [3.0, 3.0, 3.0]
    """
    covariances = isinstance(prior, Gaussian)

    def root(noise: Array, added: Array) -> Array:
        return linalg.tria(jnp.hstack([factor.root(noise) if covariances else noise, added]))

    root_Q, root_R = jax.vmap(root)(model.Q, model.added_Q), jax.vmap(root)(model.R, model.added_R)
    linear = LinearModel(model.F, root_Q, model.H, root_R, model.b, model.d)
    start = GaussianRoot(prior.mean, lower_root(prior))
    beliefs, evidences = parallel_kalman(start, linear, model.y, model.read)
    smoothed = parallel_rts(beliefs, linear)
    smoothed = smoothed if not covariances else Gaussian(smoothed.mean, jax.vmap(factor.outer)(*[smoothed.root] * 2))
    first, step = (jax.tree.map(lambda leaf: leaf[0], tree) for tree in (smoothed, model))
    before = arithmetic.rts(prior if covariances else start, first, step.F, step.Q, step.b, step.added_Q)
    return jax.tree.map(lambda one, many: jnp.concatenate([one[None], many]), before, smoothed), evidences.sum()
