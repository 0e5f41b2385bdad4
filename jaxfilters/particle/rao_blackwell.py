r"""Rao-Blackwellized particle filter for mixed linear/nonlinear models.

The model is the triangular "model 2" of Schön, Gustafsson and Nordlund 2005, with the nonlinear state on any manifold:

$$x_t = f_n(x_{t-1}) \boxplus (A_n l_{t-1} + w_n),\quad l_t = f_l(x_{t-1}) + A_l l_{t-1} + w_l,\quad
  y_t \sim p(y_t \mid x_t)\ \text{or}\ y_t = h(x_t) + C l_t + e.$$

Only `x` is sampled. The linear state `l` given the path of `x` is Gaussian: each particle carries its mean, and either
its own covariance or, where the matrices do not depend on the particle, one that all of them share.
"""

from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla import last_axis
from jaxfilters._xla.last_axis import batch_last
from jaxfilters._xla.materialize import materialized
from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math.linalg import cholesky, matmul, solve_triangular
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import ParticleInfo, check_ensemble, resample, reweight, untempered
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Transport
from jaxfilters.particle.proposals import Proposal, exact
from jaxfilters.particle.resampling import systematic
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import AnyKey, LogLikelihood, ResamplingScheme, SamplePrior, Temper, as_pytree


class MixedDynamics(NamedTuple):
    """One step of the model for one particle, about its nonlinear state."""

    f_n: PyTree
    """Where the nonlinear state goes by itself, a point like `x`."""
    A_n: Float[Array, "n l"]
    Q_n: Float[Array, "n n"]
    f_l: Float[Array, " l"]
    A_l: Float[Array, "l l"]
    Q_l: Float[Array, "l l"]


class LinearObservation(NamedTuple):
    """y = h + C l + e with e ~ N(0, R), for one particle."""

    h: Float[Array, " m"]
    C: Float[Array, "m l"]
    R: Float[Array, "m m"]


class RaoBlackwellState(NamedTuple):
    """Weighted particles of the nonlinear state, each with a Gaussian over the linear one."""

    particles: PyTree
    """Leaves `(..., N)`."""
    linear_mean: Float[Array, "l n"]
    covariance: Float[Array, "..."]
    """Of the linear state: `(l, l, N)`, or `(l, l)` where all particles share it."""
    log_weights: Float[Array, " n"]
    """After an update `logsumexp(log_weights) == 0`."""
    ancestors: Int32[Array, " n"]
    noise: Float[Array, "d n"]


@pytree_dataclass
class RaoBlackwell:
    """Parameters of a Rao-Blackwellized particle filter."""

    sample_prior: SamplePrior
    linear_prior: Gaussian
    dynamics: Callable
    retract: Callable
    condition: Callable
    temper: Temper
    ess_threshold: float
    num_particles: int = field(metadata={"static": True})
    noise: StandardNormal = field(metadata={"static": True})
    proposal: Proposal = field(metadata={"static": True})
    scheme: ResamplingScheme | EnsembleScheme = field(metadata={"static": True})
    covariance_axis: int | None = field(metadata={"static": True})
    """Ensemble axis of the covariance: -1, or `None` where it is shared."""


def add(x: Float[Array, " n"], delta: Float[Array, " n"]) -> Float[Array, " n"]:
    """Move a point of a vector space."""
    return x + delta


def rao_blackwell(
    sample_prior: SamplePrior,
    linear_prior: Gaussian,
    dynamics: Callable[[PyTree, PyTree], MixedDynamics],
    log_likelihood: LogLikelihood | None = None,
    *,
    num_particles: int,
    noise_dim: int,
    observe: Callable[[PyTree], LinearObservation] | None = None,
    retract: Callable[[PyTree, Array], PyTree] = add,
    proposal: Proposal = exact,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: float = 0.5,
    temper: Temper | None = None,
) -> Filter:
    """Rao-Blackwellized particle filter in which every particle has its own covariance.

    Args:
        sample_prior: `key -> x`, the nonlinear state.
        linear_prior: Belief about the linear state before the first observation, the same for all particles.
        dynamics: `(x, control) -> MixedDynamics`.
        log_likelihood: `(x, y) -> log p(y | x)`, for observations that do not see the linear state.
        num_particles: Size N of the ensemble.
        noise_dim: Dimension n of the tangent space of the nonlinear state.
        observe: `x -> LinearObservation`, for observations that do. Exactly one of the two must be given.
        retract: `(x, delta) -> x`, how an increment moves the nonlinear state; addition by default.
        proposal: How the nonlinear state is drawn: `exact` (default), `paper` or `paper_corrected` of
            `jaxfilters.proposals`.
        scheme: Resampling scheme; of `jaxfilters.differentiable_resampling`, `soft`.
        ess_threshold: Resample before a prediction if the effective sample size is below this share of N.
        temper: Flattens log-likelihoods, e.g. `TemperToShare(0.2)`.

    Raises:
        ValueError: If an argument is out of range, not exactly one of `log_likelihood` and `observe` is given, or
            `scheme` is transport, which would average Gaussians of different particles.
    """
    check_ensemble(num_particles, ess_threshold)
    if isinstance(scheme, Transport):
        raise ValueError("scheme must choose ancestors: transport averages particles, and so their Gaussians.")
    return Filter(
        RaoBlackwell(
            as_pytree(sample_prior),
            linear_prior,
            as_pytree(dynamics),
            as_pytree(retract),
            _condition_on(log_likelihood, observe),
            as_pytree(temper or untempered),
            float(ess_threshold),
            num_particles,
            StandardNormal(noise_dim),
            proposal,
            scheme,
            -1,
        ),
        init,
        _predict,
        _update,
    )


def rao_blackwell_shared(*args: PyTree, **options: PyTree) -> Filter:
    """Rao-Blackwellized particle filter whose particles share one covariance; arguments as `rao_blackwell`.

    For models whose matrices `A_n, Q_n, A_l, Q_l, C, R` do not depend on the particle, where every particle would carry
    the same covariance: one small matrix recursion a frame instead of N. A model that breaks the rule is rejected when
    it is traced.
    """
    own = rao_blackwell(*args, **options)
    fields = {name: getattr(own.params, name) for name in own.params.__dataclass_fields__}
    return Filter(RaoBlackwell(**{**fields, "covariance_axis": None}), init, _predict, _update)


class Move(NamedTuple):
    """How one prediction moved the particles: what a proposal needs that looks at the observation and draws again."""

    origin: PyTree
    """Where the nonlinear state would go by itself, `f_n`."""
    drift: Float[Array, "d n"]
    """Mean of its increment, A_n m."""
    delta: Float[Array, "d n"]
    """What was drawn beyond the mean."""
    spread: Float[Array, "..."]
    """Covariance of the increment given the past, N [26]."""
    gain: Float[Array, "..."]
    """What one unit of `delta` adds to the mean of the linear state, A_l K = L [27]."""


def condition_on_increment(covariance: Float[Array, "l l"], step: MixedDynamics) -> tuple[Array, Array, Array]:
    r"""Spread $N$, gain $L$ and next covariance of the linear state, eqs. [26], [27] (corrected) and [29].

    Conditions on $z = A_n l + w_n$ with gain $P A_n^T N^{-1}$, in Joseph form, then propagates through $A_l$: the same
    as the general recursion of Schön, Gustafsson and Nordlund 2005, without its cancellation.
    """
    ahead = matmul(step.A_n, covariance)
    spread = matmul(ahead, step.A_n.T) + step.Q_n
    root = cholesky(spread)
    gain = matmul(step.A_l, solve_triangular(root, solve_triangular(root, ahead), transpose=True).T)
    kept = materialized(step.A_l - matmul(gain, step.A_n))
    conditioned = matmul(matmul(kept, covariance), kept.T) + matmul(matmul(gain, step.Q_n), gain.T)
    return spread, gain, conditioned + step.Q_l


def propagate(belief: Gaussian, delta: Float[Array, " n"], step: MixedDynamics) -> Gaussian:
    r"""Belief about the linear state one step on, given $\delta = z - A_n m$ of the nonlinear one [28], [29]."""
    _, gain, covariance = condition_on_increment(belief.covariance, step)
    return Gaussian(step.f_l + step.A_l @ belief.mean + gain @ delta, covariance)


def init(model: RaoBlackwell, key: AnyKey) -> RaoBlackwellState:
    """Ensemble drawn from the prior."""
    prior_key, noise_key = jax.random.split(key)
    count = model.num_particles
    prior = model.linear_prior
    mean = jnp.broadcast_to(prior.mean[:, None], (prior.mean.shape[0], count))
    covariance = prior.covariance
    if model.covariance_axis is not None:
        covariance = jnp.broadcast_to(covariance[..., None], (*covariance.shape, count))
    return RaoBlackwellState(
        sample_ensemble(prior_key, model.sample_prior, count),
        mean,
        covariance,
        weights.uniform(count),
        jnp.arange(count, dtype=jnp.int32),
        model.noise(noise_key, count),
    )


def _predict(model: RaoBlackwell, key: AnyKey, state: RaoBlackwellState, control: PyTree) -> RaoBlackwellState:
    return move(model, key, state, control)[0]


def move(model: RaoBlackwell, key: AnyKey, state: RaoBlackwellState, control: PyTree) -> tuple[RaoBlackwellState, Move]:
    """Predict one step, and say how."""
    resample_key, noise_key = jax.random.split(key)
    axis = model.covariance_axis
    carried = (state.particles, state.linear_mean, None if axis is None else state.covariance)
    (particles, linear_mean, covariance), log_weights, ancestors = resample(
        resample_key, carried, state.log_weights, model.scheme, model.ess_threshold
    )
    # Gathered in rows of one particle each; to be turned round once.
    linear_mean = materialized(linear_mean)
    covariance = state.covariance if axis is None else materialized(covariance)
    step_axes = MixedDynamics._make((-1, axis, axis, -1, axis, axis))
    small = max(state.linear_mean.shape[0], *state.noise.shape[:-1]) <= factor.UNROLLED
    mapped = last_axis.vmap if small else jax.vmap
    steps = mapped(model.dynamics, in_axes=(-1, None), out_axes=step_axes)(particles, control)

    def advance(step: MixedDynamics, mean: Array, covariance: Array, noise: Array) -> tuple:
        spread, gain, covariance = condition_on_increment(covariance, step)
        delta, log_correction = model.proposal(noise, spread, step.Q_n)
        drift = step.A_n @ mean
        mean = step.f_l + step.A_l @ mean + gain @ delta
        x = model.retract(step.f_n, drift + delta)
        return x, mean, covariance, log_correction, Move(step.f_n, drift, delta, spread, gain)

    particles, linear_mean, covariance, log_correction, moved = mapped(
        advance, in_axes=(step_axes, -1, axis, -1), out_axes=(-1, -1, axis, -1, Move._make((-1, -1, -1, axis, axis)))
    )(steps, linear_mean, covariance, state.noise)
    noise = model.noise(noise_key, model.num_particles)
    log_weights = log_weights + log_correction
    return RaoBlackwellState(particles, linear_mean, covariance, log_weights, ancestors, noise), moved


def _update(
    model: RaoBlackwell, key: AnyKey, state: RaoBlackwellState, observation: PyTree
) -> tuple[RaoBlackwellState, ParticleInfo]:
    del key
    return weigh(model, state, observation)


def weigh(model: RaoBlackwell, state: RaoBlackwellState, observation: PyTree) -> tuple[RaoBlackwellState, ParticleInfo]:
    """Condition every particle's linear state on the observation, and weight it by the evidence of that."""

    def condition(mean: Array, covariance: Array, x: PyTree) -> tuple[Array, Array, Array]:
        belief, log_likelihood = model.condition(Gaussian(mean, covariance), x, observation)
        return belief.mean, belief.covariance, log_likelihood

    axis = model.covariance_axis
    # The likelihood of an image is not arithmetic on small arrays.
    small = sum(map(jnp.size, jax.tree.leaves(observation))) <= factor.UNROLLED**2
    mapped = last_axis.vmap if small else jax.vmap
    linear_mean, covariance, log_likelihood = mapped(condition, in_axes=(-1, axis, -1), out_axes=(-1, axis, -1))(
        state.linear_mean, state.covariance, state.particles
    )
    log_weights, info = reweight(state.log_weights, log_likelihood, state.ancestors, model.temper)
    return state._replace(linear_mean=linear_mean, covariance=covariance, log_weights=log_weights), info


def _condition_on(log_likelihood: LogLikelihood | None, observe: Callable | None) -> Callable:
    if log_likelihood is not None and observe is None:
        return jax.tree_util.Partial(_unseen, as_pytree(log_likelihood))
    if observe is not None and log_likelihood is None:
        return jax.tree_util.Partial(_seen, as_pytree(observe))
    raise ValueError("Exactly one of log_likelihood and observe must be given: whether the linear state is seen.")


def _unseen(log_likelihood: LogLikelihood, belief: Gaussian, x: PyTree, y: PyTree) -> tuple[Gaussian, Array]:
    return belief, log_likelihood(x, y)


def _seen(observe: Callable, belief: Gaussian, x: PyTree, y: Array) -> tuple[Gaussian, Array]:
    h, C, R = observe(x)
    given = batch_last(_given) if max(C.shape) <= factor.UNROLLED else _given
    return given(belief, y - h, C, R)


def _given(belief: Gaussian, read: Array, C: Array, R: Array) -> tuple[Gaussian, Array]:
    found = arithmetic.joseph.condition(belief.covariance, C, R, read - C @ belief.mean)
    return Gaussian(belief.mean + found.shift, found.covariance), found.log_density
