r"""Rao-Blackwellized particle filter with a proposal that depends on the current observation.

With many dimensions and few particles, hardly any sample of the transition falls where the likelihood is high. Here a
`guide` computes from the observation a Gaussian approximation of the likelihood, or several about its maxima. Every
particle is drawn from the product of this approximation and its own transition: see `jaxfilters.particle.guidance`. A
rough guide costs efficiency, not correctness.

The increments may be heavy-tailed: with a small probability a particle jumps, which adds a wide normal number to its
increment (a scale mixture; D. F. Andrews and C. L. Mallows, "Scale mixtures of normal distributions", Journal of the
Royal Statistical Society B 36, 1974). What is not observed then stays where it is, while a sudden movement is followed.
"""

from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.filter import Filter
from jaxfilters.math.linalg import cholesky, matmul, solve_triangular
from jaxfilters.particle import checks, rao_blackwell
from jaxfilters.particle.guidance import Guide, as_mixture, draw
from jaxfilters.particle.proposals import exact
from jaxfilters.particle.rao_blackwell import Increments, RaoBlackwell, RaoBlackwellState
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.typing import AnyKey, as_pytree, only_inputs, taking_inputs


class Jump(NamedTuple):
    """A rare increment of the nonlinear state on top of the usual one, in all of its coordinates at once."""

    probability: Float[Array, ""]
    """Of a jump in one step, in (0, 1)."""
    covariance: Float[Array, "n n"]
    """Of the jump, in the tangent space, added to that of the usual increment."""


class Jumps(NamedTuple):
    """Which particles jumped in the last prediction, and the distribution of the increments of those that did."""

    jumped: Bool[Array, " k"]
    spread: Float[Array, "n n"]
    """Covariance of the increment of a particle that jumps, given the past."""
    gain: Float[Array, "l n"]
    """What one unit of its increment adds to the mean of its linear state."""


class GuidedState(NamedTuple):
    """The ensemble, and the increments by which the last prediction moved it."""

    ensemble: RaoBlackwellState
    increments: Increments
    jumps: Jumps | None = None
    """`None` for a filter without jumps."""


@pytree_dataclass
class Guided:
    """Parameters of a guided filter."""

    inner: RaoBlackwell
    guide: Guide
    local: Callable
    jump: Callable | None
    prior_share: float = field(metadata={"static": True})


def subtract(x: Float[Array, " n"], other: Float[Array, " n"]) -> Float[Array, " n"]:
    """The increment from one point of a vector space to another."""
    return other - x


def guided_rao_blackwell(
    inner: Filter,
    guide: Guide,
    *,
    local: Callable[[PyTree, PyTree], Float[Array, " n"]] = subtract,
    jump: Callable[[PyTree], Jump] | None = None,
    prior_share: float = 0.2,
) -> Filter:
    """Give a filter made by `rao_blackwell_shared` a proposal that depends on the current observation.

    A tempered `inner` tempers the likelihood and the importance correction of the proposal together, against the
    weights before both: see `AdaptiveTempering`.

    With `jump`, the nonlinear state is sampled from its exact posterior distribution. The covariance of the linear
    state, which is smaller after a usual increment than after a jump, remains one that all particles share: the mean of
    both, weighted by their probabilities (moment matching, as in generalized pseudo-Bayesian filters). The evidence is
    differentiable with respect to the probability by its score function, which acts until the next resampling.

    Args:
        inner: A filter made by `rao_blackwell_shared` with the proposal `exact`.
        guide: `(particles, log_weights, y) -> Guidance`, or a `GuidanceMixture` where the likelihood has several
            maxima; leaves of `particles` have the ensemble axis last. It may take the inputs of the step as one more
            argument, see `jf.typing`.
        local: `(x, other) -> delta`, the inverse of the filter's `retract`; subtraction by default.
        jump: `inputs -> Jump`, the jumps of a step; none by default.
        prior_share: Fraction of the particles that are drawn from the transition alone, in (0, 1). No importance
            correction is larger than `1 / prior_share`.

    Returns:
        A filter whose state is a `GuidedState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: If a callback is not callable.
        ValueError: If `inner` is another kind of filter, or `prior_share` is out of range; and when the filter is
            traced, if `guide`, `local` or `jump` returns an array of the wrong shape, or a wrong value.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> one, R = jnp.ones((1, 1)), 0.001
        >>> dynamics = lambda x: jf.MixedDynamics(x, 0.1 * one, 0.03 * one, jnp.zeros(1), one, one)
        >>> log_likelihood = lambda x, y: -0.5 * jnp.sum((y - x) ** 2) / R
        >>> prior, velocity = lambda key: jnp.zeros(1), jf.Gaussian(jnp.zeros(1), one)
        >>> inner = jf.rao_blackwell_shared(prior, velocity, dynamics, log_likelihood, num_particles=100, noise_dim=1)
        >>> pf = jf.guided_rao_blackwell(inner, lambda particles, log_weights, y: jf.Guidance(y, one / R))
        >>> state, _ = jf.run(pf, jax.random.key(0), jnp.ones((5, 1)))
    """
    params = getattr(inner, "params", None)
    if not isinstance(params, RaoBlackwell) or params.covariance_axis is not None or params.proposal is not exact:
        raise ValueError("inner must be a filter made by rao_blackwell_shared with the exact proposal.")
    checks.check_callables(guide=guide, local=local, jump=jump)
    if isinstance(prior_share, bool) or not 0 < prior_share < 1:
        raise ValueError(f"prior_share must be between 0 and 1; got {prior_share!r}.")
    guide = taking_inputs("guide", guide, "particles", "log_weights", "y")
    jump = None if jump is None else only_inputs("jump", jump)
    return Filter(Guided(params, guide, as_pytree(local), jump, float(prior_share)), _init, _predict, _update)


def _init(model: Guided, key: AnyKey) -> GuidedState:
    ensemble = rao_blackwell.init(model.inner, key)
    increments = _zero_increments(ensemble)
    if model.jump is None:
        return GuidedState(ensemble, increments)
    jumped = jnp.zeros(model.inner.num_particles, bool)
    return GuidedState(ensemble, increments, Jumps(jumped, increments.spread, increments.gain))


def _zero_increments(ensemble: RaoBlackwellState) -> Increments:
    """The increments of an ensemble that was never predicted."""
    zeros = jnp.zeros_like(ensemble.noise)
    size, linear_size = zeros.shape[0], ensemble.linear_mean.shape[0]
    return Increments(ensemble.particles, zeros, zeros, jnp.zeros((size, size)), jnp.zeros((linear_size, size)))


def _predict(model: Guided, key: AnyKey, state: GuidedState, inputs: PyTree) -> GuidedState:
    if model.jump is None:
        return GuidedState(*rao_blackwell.predict_ensemble(model.inner, key, state.ensemble, inputs))
    key, choice_key, noise_key = jax.random.split(key, 3)
    ensemble, increments = rao_blackwell.predict_ensemble(model.inner, key, state.ensemble, inputs)
    jump = model.jump(inputs)
    checks.check_jump(jump, increments.delta.shape[0])
    probability = jnp.asarray(jump.probability, ensemble.log_weights.dtype)
    jumped = jax.random.uniform(choice_key, ensemble.log_weights.shape) < probability
    spread, gain, larger = _of_jumps(increments, jump.covariance)
    jumps = Jumps(jumped, spread, gain)
    noise = dot(cholesky(jump.covariance), standard_normal(noise_key, increments.delta.shape))
    delta = increments.delta + jnp.where(jumped, noise, 0.0)
    ensemble = ensemble._replace(
        covariance=ensemble.covariance + probability * larger,
        log_weights=ensemble.log_weights + _score(jnp.where(jumped, probability, 1 - probability)),
    )
    shift = _shift(increments, jumps, delta) - _shift(increments, None, increments.delta)
    return _moved(model, GuidedState(ensemble, increments, jumps), delta, shift)


def _of_jumps(usual: Increments, covariance: Float[Array, "n n"]) -> tuple[Array, Array, Array]:
    r"""Spread and gain of what jumps, and how much larger the covariance of its linear state is.

    With $N$ and $L$ of a usual increment and $J$ of a jump: $L N$ is the covariance of linear state and increment,
    whatever noise the increment has, so that $L_J = L N (N + J)^{-1}$, and the covariance of the linear state is larger
    by $L N L^T - L_J (N + J) L_J^T$.
    """
    spread = usual.spread + covariance
    root = cholesky(spread)
    shared = matmul(usual.gain, usual.spread)
    whitened = solve_triangular(root, shared.T)
    gain = solve_triangular(root, whitened, transpose=True).T
    return spread, gain, matmul(usual.gain, shared.T) - matmul(whitened.T, whitened)


def _score(probability: Float[Array, " k"]) -> Float[Array, " k"]:
    """Zeros, whose derivative is that of the logarithm of the probability of what was drawn."""
    log_probability = jnp.log(probability)
    return log_probability - jax.lax.stop_gradient(log_probability)


def _shift(increments: Increments, jumps: Jumps | None, delta: Float[Array, "n k"]) -> Float[Array, "l k"]:
    """What increments add to the means of the linear state."""
    usual = dot(increments.gain, delta)
    return usual if jumps is None else jnp.where(jumps.jumped, dot(jumps.gain, delta), usual)


def _moved(model: Guided, state: GuidedState, delta: Float[Array, "n k"], shift: Float[Array, "l k"]) -> GuidedState:
    """The state with other increments than those that moved it, and the means of the linear state shifted."""
    ensemble, increments, jumps = state
    retract = jax.vmap(model.inner.retract, in_axes=-1, out_axes=-1)
    ensemble = ensemble._replace(
        particles=retract(increments.origin, increments.drift + delta), linear_mean=ensemble.linear_mean + shift
    )
    return GuidedState(ensemble, increments._replace(delta=delta), jumps)


def _update(
    model: Guided, key: AnyKey, state: GuidedState, observation: PyTree, inputs: PyTree
) -> tuple[GuidedState, ParticleInfo]:
    ensemble, predicted, jumps = state
    guidance = model.guide(ensemble.particles, ensemble.log_weights, observation, inputs)
    size = predicted.delta.shape[0]
    checks.check_guidance(guidance, jax.tree.map(lambda leaf: leaf[..., 0], ensemble.particles), size)
    mixture = as_mixture(guidance)

    def to_point(origin: PyTree, point: PyTree) -> Array:
        delta = model.local(origin, point)
        checks.check_shape("the result of local", delta, (size,), "noise_dim of inner")
        return delta

    of_each_particle = jax.vmap(to_point, in_axes=(-1, None), out_axes=-1)
    towards = jax.vmap(of_each_particle, in_axes=(None, 0))(predicted.origin, mixture.points) - predicted.drift
    if jumps is None:
        delta, log_ratio = draw(key, predicted.spread, mixture, towards, model.prior_share)
    else:
        both = jnp.stack([predicted.spread, jumps.spread])  # traced once for both
        drawn = jax.vmap(lambda spread: draw(key, spread, mixture, towards, model.prior_share))(both)
        delta, log_ratio = (jnp.where(jumps.jumped, wide, usual) for usual, wide in drawn)
    state = _moved(model, state, delta, _shift(predicted, jumps, delta - predicted.delta))
    ensemble, info = rao_blackwell.update_ensemble(model.inner, state.ensemble, observation, inputs, log_ratio)
    return state._replace(ensemble=ensemble), info
