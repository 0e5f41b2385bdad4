r"""Rao-Blackwellized particle filter for models that are linear and Gaussian given a nonlinear part of the state.

The model is triangular, with the nonlinear state $x$ on any manifold (T. Schön, F. Gustafsson and P.-J. Nordlund,
"Marginalized particle filters for mixed linear/nonlinear state-space models", IEEE Transactions on Signal Processing
53, 2005, there called model 2):

$$x_t = f_n(x_{t-1}) \boxplus (A_n l_{t-1} + w_n),\quad l_t = f_l(x_{t-1}) + A_l l_{t-1} + w_l,\quad
  y_t \sim p(y_t \mid x_t)\ \text{or}\ y_t = h(x_t) + C l_t + e.$$

Only $x$ is sampled. The linear state $l$ given the path of $x$ is Gaussian: each particle carries its mean, and either
its own covariance or, where the matrices do not depend on the particle, one that all particles share.
"""

from collections.abc import Callable
from dataclasses import field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla import last_axis
from jaxfilters._xla.materialize import materialized
from jaxfilters._xla.noise import split
from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math.linalg import cholesky, matmul, solve_triangular
from jaxfilters.noise import StandardNormal
from jaxfilters.particle import checks
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Transport
from jaxfilters.particle.mixed_model import LinearObservation as LinearObservation
from jaxfilters.particle.mixed_model import MixedDynamics as MixedDynamics
from jaxfilters.particle.proposals import IncrementProposal, exact
from jaxfilters.particle.resampling import systematic
from jaxfilters.particle.tempering import no_tempering
from jaxfilters.particle.weighting import ParticleInfo, resample, reweight
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import AnyKey, LogLikelihood, ResamplingScheme, SamplePrior, Temper, as_pytree, taking_inputs


class RaoBlackwellState(NamedTuple):
    """Weighted particles of the nonlinear state, each with a Gaussian belief about the linear one."""

    particles: PyTree
    """Leaves `(..., n)`."""
    linear_mean: Float[Array, "l n"]
    """Mean of the linear state of each particle."""
    covariance: Float[Array, "..."]
    """Covariance of the linear state: `(l, l, n)`, or `(l, l)` where all particles share it."""
    log_weights: Float[Array, " n"]
    """After an update `logsumexp(log_weights) == 0`."""
    ancestors: Int32[Array, " n"]
    """Index of each particle's parent in the state before the last prediction."""
    noise: Float[Array, "d n"]
    """Standard normal numbers of the next prediction, drawn one step ahead."""


@pytree_dataclass
class RaoBlackwell:
    """Parameters of a Rao-Blackwellized particle filter."""

    sample_prior: SamplePrior
    linear_prior: Gaussian
    dynamics: Callable
    retract: Callable
    condition: Callable
    temper: Temper
    ess_threshold: ArrayLike
    num_particles: int = field(metadata={"static": True})
    noise: StandardNormal = field(metadata={"static": True})
    proposal: IncrementProposal = field(metadata={"static": True})
    scheme: ResamplingScheme | EnsembleScheme = field(metadata={"static": True})
    covariance_axis: int | None = field(metadata={"static": True})
    """Ensemble axis of the covariance: -1, or `None` where it is shared."""


def add(x: Float[Array, " n"], delta: Float[Array, " n"]) -> Float[Array, " n"]:
    """Move a point of a vector space by an increment."""
    return x + delta


def rao_blackwell(
    sample_prior: SamplePrior,
    linear_prior: Gaussian,
    dynamics: Callable[..., MixedDynamics],
    log_likelihood: LogLikelihood | None = None,
    *,
    num_particles: int,
    noise_dim: int,
    observe: Callable[..., LinearObservation] | None = None,
    retract: Callable[[PyTree, Array], PyTree] = add,
    proposal: IncrementProposal = exact,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
    temper: Temper | None = None,
) -> Filter:
    """Build a Rao-Blackwellized particle filter in which every particle has its own covariance.

    Args:
        sample_prior: `key -> x`, the nonlinear state.
        linear_prior: Belief about the linear state `(l,)` before the first observation, the same for all particles.
        dynamics: `x -> MixedDynamics`. This and the two functions of observations below may take the inputs of the step
            as one more argument, see `jf.typing`.
        log_likelihood: `(x, y) -> log p(y | x)`, a scalar, for observations that do not depend on the linear state.
        num_particles: Number n of particles.
        noise_dim: Dimension of the tangent space of the nonlinear state.
        observe: `x -> LinearObservation`, for observations that do. Exactly one of the two must be given.
        retract: `(x, delta) -> x`, moves the nonlinear state by an increment; addition by default.
        proposal: How the nonlinear state is drawn: `exact`, `plug_in` or `plug_in_corrected` of `jaxfilters.proposals`.
        scheme: Function of `jaxfilters.resampling`, or `jaxfilters.differentiable_resampling.soft(...)`.
        ess_threshold: Resample before a prediction if the effective sample size is below this fraction of n.
        temper: Tempering of the likelihoods, e.g. `AdaptiveTempering(0.2)`; none by default.

    Returns:
        A filter whose state is a `RaoBlackwellState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: If a callback is not callable, or `linear_prior` is not a `Gaussian` of floating-point numbers.
        ValueError: If an argument is out of range, not exactly one of `log_likelihood` and `observe` is given, or
            `scheme` is transport, which would average Gaussians of different particles; and when the filter is
            traced, if a callback returns an array of the wrong shape or type.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> one = jnp.ones((1, 1))  # the position x is driven by an unknown velocity l
        >>> dynamics = lambda x, dt: jf.MixedDynamics(x, dt * one, 0.01 * one, jnp.zeros(1), one, 0.1 * one)
        >>> log_likelihood = lambda x, y: -0.5 * jnp.sum((y - x) ** 2) / 0.1
        >>> prior = lambda key: jnp.zeros(1)
        >>> velocity = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> pf = jf.rao_blackwell(prior, velocity, dynamics, log_likelihood, num_particles=100, noise_dim=1)
        >>> state, _ = jf.run(pf, jax.random.key(0), jnp.ones((5, 1)), jnp.full(5, 0.1))
    """
    callbacks = (sample_prior, linear_prior, dynamics, retract, _condition_on(log_likelihood, observe), temper)
    return _build(callbacks, ess_threshold, num_particles, noise_dim, proposal, scheme)


def rao_blackwell_shared(
    sample_prior: SamplePrior,
    linear_prior: Gaussian,
    dynamics: Callable[..., MixedDynamics],
    log_likelihood: LogLikelihood | None = None,
    *,
    num_particles: int,
    noise_dim: int,
    observe: Callable[..., LinearObservation] | None = None,
    retract: Callable[[PyTree, Array], PyTree] = add,
    proposal: IncrementProposal = exact,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
    temper: Temper | None = None,
) -> Filter:
    """Build a Rao-Blackwellized particle filter whose particles share one covariance of the linear state.

    For models whose matrices `A_n`, `Q_n`, `A_l`, `Q_l`, `C` and `R` do not depend on the nonlinear state. Every
    particle would carry the same covariance, so that one small matrix recursion a step replaces n of them.

    Args:
        sample_prior: `key -> x`, the nonlinear state.
        linear_prior: Belief about the linear state `(l,)` before the first observation, the same for all particles.
        dynamics: `x` or `(x, inputs) -> MixedDynamics`, whose matrices must not depend on x.
        log_likelihood: `(x, y) -> log p(y | x)`, a scalar, for observations that do not depend on the linear state.
        num_particles: Number n of particles.
        noise_dim: Dimension of the tangent space of the nonlinear state.
        observe: `x -> LinearObservation`, for observations that do, whose `C` and `R` must not depend on x.
        retract: `(x, delta) -> x`, moves the nonlinear state by an increment; addition by default.
        proposal: As for `rao_blackwell`.
        scheme: As for `rao_blackwell`.
        ess_threshold: As for `rao_blackwell`.
        temper: As for `rao_blackwell`.

    Returns:
        A filter whose state is a `RaoBlackwellState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: As `rao_blackwell`.
        ValueError: As `rao_blackwell`; and when the filter is traced, if one of the matrices depends on x.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> one, velocity = jnp.ones((1, 1)), jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> dynamics = lambda x, dt: jf.MixedDynamics(x, dt * one, 0.01 * one, jnp.zeros(1), one, 0.1 * one)
        >>> pf = jf.rao_blackwell_shared(
        ...     lambda key: jnp.zeros(1), velocity, dynamics, lambda x, y: -jnp.sum((y - x) ** 2),
        ...     num_particles=100, noise_dim=1,
        ... )
        >>> jf.run(pf, jax.random.key(0), jnp.ones((5, 1)), jnp.full(5, 0.1))[0].covariance.shape
        (1, 1)
    """
    callbacks = (sample_prior, linear_prior, dynamics, retract, _condition_on(log_likelihood, observe), temper)
    own = _build(callbacks, ess_threshold, num_particles, noise_dim, proposal, scheme)
    return replace(own, params=replace(own.params, covariance_axis=None))


def _build(
    callbacks: tuple,
    ess_threshold: ArrayLike,
    num_particles: int,
    noise_dim: int,
    proposal: IncrementProposal,
    scheme: ResamplingScheme | EnsembleScheme,
) -> Filter:
    sample_prior, linear_prior, dynamics, retract, condition, temper = callbacks
    checks.check_callables(sample_prior=sample_prior, dynamics=dynamics, retract=retract, proposal=proposal)
    checks.check_ensemble(num_particles, ess_threshold, scheme, temper)
    checks.check_num_particles(noise_dim, name="noise_dim")
    checks.check_gaussian("linear_prior", linear_prior)
    if isinstance(scheme, Transport):
        raise ValueError("scheme must choose ancestors: transport averages particles, and so their Gaussians.")
    params = RaoBlackwell(
        as_pytree(sample_prior),
        linear_prior,
        taking_inputs("dynamics", dynamics, "x"),
        as_pytree(retract),
        condition,
        as_pytree(temper or no_tempering),
        ess_threshold,
        num_particles,
        StandardNormal(noise_dim),
        proposal,
        scheme,
        covariance_axis=-1,
    )
    return Filter(params, init, _predict, _update)


class Increments(NamedTuple):
    """How one prediction moved the particles: what `guided_rao_blackwell` needs to draw the increments again."""

    origin: PyTree
    """The next nonlinear state for a zero increment, `f_n`; leaves `(..., k)` for k particles."""
    drift: Float[Array, "d k"]
    """Mean of the increment, A_n m for the mean m of the linear state."""
    delta: Float[Array, "d k"]
    """Deviation from that mean that was drawn."""
    spread: Float[Array, "..."]
    """Covariance N of the increment given the past, `(d, d)` or `(d, d, k)`; see `condition_on_increment`."""
    gain: Float[Array, "..."]
    """Gain L: what one unit of `delta` adds to the mean of the linear state, `(l, d)` or `(l, d, k)`."""


def condition_on_increment(covariance: Float[Array, "l l"], step: MixedDynamics) -> tuple[Array, Array, Array]:
    r"""Covariance $N$ of the increment, gain $L$, and covariance of the linear state one step later.

    With $z = A_n l + w_n$ the increment and $P$ the covariance of $l$: $N = A_n P A_n^T + Q_n$, $L = A_l P A_n^T
    N^{-1}$, and the next covariance is $(A_l - L A_n) P (A_l - L A_n)^T + L Q_n L^T + Q_l$. This is the recursion of
    Schön, Gustafsson and Nordlund 2005 for independent noises, in Joseph form to avoid cancellation.
    """
    ahead = matmul(step.A_n, covariance)
    spread = matmul(ahead, step.A_n.T) + step.Q_n
    root = cholesky(spread)
    gain = matmul(step.A_l, solve_triangular(root, solve_triangular(root, ahead), transpose=True).T)
    kept = materialized(step.A_l - matmul(gain, step.A_n))
    conditioned = matmul(matmul(kept, covariance), kept.T) + matmul(matmul(gain, step.Q_n), gain.T)
    return spread, gain, conditioned + step.Q_l


def propagate(belief: Gaussian, delta: Float[Array, " n"], step: MixedDynamics) -> Gaussian:
    r"""Belief about the linear state one step later, given the deviation $\delta = z - A_n m$ of the increment."""
    _, gain, covariance = condition_on_increment(belief.covariance, step)
    return Gaussian(step.f_l + dot(step.A_l, belief.mean) + dot(gain, delta), covariance)


def init(model: RaoBlackwell, key: AnyKey) -> RaoBlackwellState:
    """Draw the ensemble from the prior."""
    prior_key, noise_key = jax.random.split(key)
    count, prior = model.num_particles, model.linear_prior
    covariance, shared = prior.covariance, model.covariance_axis is None
    covariance = covariance if shared else jnp.broadcast_to(covariance[..., None], (*covariance.shape, count))
    return RaoBlackwellState(
        sample_ensemble(prior_key, model.sample_prior, count),
        jnp.broadcast_to(prior.mean[:, None], (prior.mean.shape[0], count)),
        covariance,
        weights.uniform(count),
        jnp.arange(count, dtype=jnp.int32),
        model.noise(noise_key, count),
    )


def _predict(model: RaoBlackwell, key: AnyKey, state: RaoBlackwellState, inputs: PyTree) -> RaoBlackwellState:
    return predict_ensemble(model, key, state, inputs)[0]


@checks.names_matrices_that_cannot_be_shared
def predict_ensemble(
    model: RaoBlackwell, key: AnyKey, state: RaoBlackwellState, inputs: PyTree
) -> tuple[RaoBlackwellState, Increments]:
    """Predict one step; returns the ensemble and the increments that moved it."""
    resample_key, noise_key = split(key)
    axis = model.covariance_axis
    carried = (state.particles, state.linear_mean, None if axis is None else state.covariance)
    (particles, linear_mean, covariance), log_weights, ancestors = resample(
        resample_key, carried, state.log_weights, model.scheme, model.ess_threshold
    )
    # The gather writes one particle after another; materialising transposes its result once, not in every use.
    linear_mean = materialized(linear_mean)
    covariance = state.covariance if axis is None else materialized(covariance)
    step_axes = MixedDynamics._make((-1, axis, axis, -1, axis, axis))
    small = max(state.linear_mean.shape[0], *state.noise.shape[:-1]) <= factor.UNROLLED
    mapped = last_axis.vmap if small else jax.vmap
    dynamics = checks.checked_dynamics(model.dynamics, model.noise.shape, state.linear_mean.shape[0])
    steps = mapped(dynamics, in_axes=(-1, None), out_axes=step_axes)(particles, inputs)

    def advance(step: MixedDynamics, mean: Array, covariance: Array, noise: Array) -> tuple:
        spread, gain, covariance = condition_on_increment(covariance, step)
        delta, log_correction = model.proposal(noise, spread, step.Q_n)
        drift = dot(step.A_n, mean)
        mean = step.f_l + dot(step.A_l, mean) + dot(gain, delta)
        x = checks.like("the result of retract", model.retract(step.f_n, drift + delta), step.f_n, "x")
        return x, mean, covariance, log_correction, Increments(step.f_n, drift, delta, spread, gain)

    increments_axes = Increments._make((-1, -1, -1, axis, axis))
    particles, linear_mean, covariance, log_correction, increments = mapped(
        advance, in_axes=(step_axes, -1, axis, -1), out_axes=(-1, -1, axis, -1, increments_axes)
    )(steps, linear_mean, covariance, state.noise)
    noise = model.noise(noise_key, model.num_particles)
    log_weights = log_weights + log_correction
    return RaoBlackwellState(particles, linear_mean, covariance, log_weights, ancestors, noise), increments


def _update(
    model: RaoBlackwell, key: AnyKey, state: RaoBlackwellState, observation: PyTree, inputs: PyTree
) -> tuple[RaoBlackwellState, ParticleInfo]:
    del key
    return update_ensemble(model, state, observation, inputs)


@checks.names_matrices_that_cannot_be_shared
def update_ensemble(
    model: RaoBlackwell,
    state: RaoBlackwellState,
    observation: PyTree,
    inputs: PyTree,
    log_ratio: Float[Array, " n"] | None = None,
) -> tuple[RaoBlackwellState, ParticleInfo]:
    """Condition every particle's linear state on the observation, and multiply its weight by the resulting evidence.

    Args:
        model: Parameters of the filter.
        state: Predicted ensemble.
        observation: The observation.
        inputs: Inputs of the step.
        log_ratio: Log importance ratios of a proposal that depends on the observation; tempered with the evidence.
    """

    def condition(mean: Array, covariance: Array, x: PyTree) -> tuple[Array, Array, Array]:
        belief, log_likelihood = model.condition(Gaussian(mean, covariance), x, observation, inputs)
        return belief.mean, belief.covariance, log_likelihood

    axis = model.covariance_axis
    # `last_axis.vmap` pays for small arrays only, not for the likelihood of an image.
    small = sum(map(jnp.size, jax.tree.leaves(observation))) <= factor.UNROLLED**2
    mapped = last_axis.vmap if small else jax.vmap
    linear_mean, covariance, log_likelihood = mapped(condition, in_axes=(-1, axis, -1), out_axes=(-1, axis, -1))(
        state.linear_mean, state.covariance, state.particles
    )
    log_factor = log_likelihood if log_ratio is None else log_likelihood + log_ratio
    log_weights, info = reweight(state.log_weights, log_factor, state.ancestors, model.temper)
    return state._replace(linear_mean=linear_mean, covariance=covariance, log_weights=log_weights), info


def _condition_on(log_likelihood: LogLikelihood | None, observe: Callable | None) -> Callable:
    checks.check_callables(log_likelihood=log_likelihood, observe=observe)
    if log_likelihood is not None and observe is None:
        return jax.tree_util.Partial(_by_log_likelihood, taking_inputs("log_likelihood", log_likelihood, "x", "y"))
    if observe is not None and log_likelihood is None:
        return jax.tree_util.Partial(_by_linear_observation, taking_inputs("observe", observe, "x"))
    raise ValueError(
        "Exactly one of log_likelihood (of the nonlinear state alone) and observe (linear in the linear state) must be "
        f"given; got {'neither' if observe is None else 'both'}."
    )


def _by_log_likelihood(
    log_likelihood: LogLikelihood, belief: Gaussian, x: PyTree, y: PyTree, inputs: PyTree
) -> tuple[Gaussian, Array]:
    return belief, checks.scalar_log_density("log_likelihood", log_likelihood(x, y, inputs))


def _by_linear_observation(
    observe: Callable, belief: Gaussian, x: PyTree, y: Array, inputs: PyTree
) -> tuple[Gaussian, Array]:
    linear = observe(x, inputs)
    checks.check_linear_observation(linear, y, belief.mean.shape[0])
    h, C, R = linear
    condition = last_axis.batch_last(_condition) if max(C.shape) <= factor.UNROLLED else _condition
    return condition(belief, y - h, C, R, jnp.isfinite(y).all())


def _condition(belief: Gaussian, innovation: Array, C: Array, R: Array, observed: Array) -> tuple[Gaussian, Array]:
    innovation = innovation - dot(C, belief.mean)
    usable = jnp.all(jnp.isfinite(innovation))  # Otherwise weights are invalid, and means do not change.
    found = arithmetic.joseph.condition(belief.covariance, C, R, jnp.where(usable, innovation, 0.0))
    covariance = jnp.where(observed, found.covariance, belief.covariance)  # No particle changes a shared one.
    return Gaussian(belief.mean + found.shift, covariance), jnp.where(usable, found.log_density, jnp.nan)
