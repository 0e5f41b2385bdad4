r"""Guided and auxiliary particle filters: proposals, and resampling, that depend on the current observation.

A particle $x_{t-1}$ moves by a proposal $q(x_t \mid x_{t-1}, y_t)$, and its weight is multiplied by

$$\frac{p(y_t \mid x_t)\, p(x_t \mid x_{t-1})}{q(x_t \mid x_{t-1}, y_t)}$$

(A. Doucet, S. Godsill and C. Andrieu, "On sequential Monte Carlo sampling methods for Bayesian filtering", Statistics
and Computing 10, 2000, equation 7). An auxiliary filter also resamples for the observation that comes: with weights
times $\eta_t(x_{t-1}, y_t)$, an approximation of $p(y_t \mid x_{t-1})$, by which the factor above is then divided
(M. Pitt and N. Shephard, "Filtering via simulation: auxiliary particle filters", Journal of the American Statistical
Association 94, 1999). Where $q$ is $p(x_t \mid x_{t-1}, y_t)$ and $\eta$ is $p(y_t \mid x_{t-1})$ the filter is fully
adapted, and all weights are equal after every resampling.

The evidence of a step is the mean of the first stage, over the weights, times the mean of the second stage, over the
resampled particles; its product over the steps is an unbiased estimate whatever q and eta are, as long as they are
positive where the model is. A prediction moves the particles by the transition, for frames without an observation; an
update draws them again from their parents. XLA removes the first of the two where every frame has an observation.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.materialize import materialized
from jaxfilters.filter import Filter
from jaxfilters.noise import random_keys
from jaxfilters.particle import checks
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Transport
from jaxfilters.particle.resampling import systematic
from jaxfilters.particle.smoothing import LogTransition
from jaxfilters.particle.tempering import no_tempering
from jaxfilters.particle.weighting import ParticleInfo, resample, reweight
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import (
    AnyKey,
    DrawNoise,
    LogLikelihood,
    ResamplingScheme,
    SamplePrior,
    SampleTransition,
    Temper,
    as_pytree,
    taking_inputs,
)

_LOWEST_FIRST_STAGE = -50.0
"""Logarithm of the smallest first stage as a fraction of the largest one, so that no particle is excluded by it."""


@runtime_checkable
class EnsembleProposal(Protocol):
    """A proposal that draws and evaluates at once, as those of `jaxfilters.proposals` do."""

    def noise(self, key: AnyKey, particles: PyTree, /) -> PyTree:
        """Draw the randomness of an ensemble; leaves with the ensemble axis last."""
        ...

    def draw(self, randomness: Any, x: PyTree, y: PyTree, inputs: PyTree, /) -> tuple[PyTree, Float[Array, ""]]:
        r"""Draw $x_t \sim q$ for one particle; returns it and $\log q(x_t \mid x_{t-1}, y_t)$."""
        ...


@runtime_checkable
class FirstStage(Protocol):
    r"""Evaluate $\log \eta_t(x_{t-1}, y_t)$, an approximation of $\log p(y_t \mid x_{t-1})$ up to a constant."""

    def __call__(self, *arguments: Any, **options: Any) -> Float[Array, ""]: ...


class Proposal(NamedTuple):
    r"""A proposal $q(x_t \mid x_{t-1}, y_t)$ given by two functions of one particle; a plain pair will do as well."""

    sample: Callable[..., PyTree]
    """`(randomness, x, y[, inputs]) -> x_next`, where `randomness` is what the filter's `noise` draws."""
    log_density: Callable[..., Array]
    """`(x_next, x, y[, inputs]) -> log q(x_next | x, y)`, a scalar, normalised."""


class AuxiliaryState(NamedTuple):
    """Weighted particles and their parents."""

    particles: PyTree
    """Leaves `(..., n)`."""
    log_weights: Float[Array, " n"]
    """After an update `logsumexp(log_weights) == 0`."""
    ancestors: Int32[Array, " n"]
    """Index of each particle's parent in the state before the last prediction."""
    parents: PyTree
    """The particles before the last prediction, from which an update proposes; leaves `(..., n)`."""


@pytree_dataclass
class _FromPair:
    """A proposal made of two functions."""

    sample: Callable
    log_density: Callable
    draw_noise: DrawNoise = field(metadata={"static": True})

    def noise(self, key: AnyKey, particles: PyTree) -> PyTree:
        """What the filter's `noise` draws."""
        return checks.checked_noise(self.draw_noise(key, checks.ensemble_size(particles)), particles)

    def draw(self, randomness: Any, x: PyTree, y: PyTree, inputs: PyTree) -> tuple[PyTree, Array]:
        """A sample, and its density."""
        ahead = self.sample(randomness, x, y, inputs)
        density = self.log_density(ahead, x, y, inputs)
        return ahead, checks.scalar_log_density("log_density of proposal", density)


@pytree_dataclass
class Auxiliary:
    """Parameters of a guided or auxiliary particle filter: the user's callbacks, and how to resample."""

    sample_prior: SamplePrior
    sample_transition: SampleTransition
    log_transition: LogTransition | None
    log_likelihood: LogLikelihood
    proposal: EnsembleProposal | None
    """`None` proposes by the transition."""
    log_first_stage: FirstStage | None
    """`None` resamples by the weights alone."""
    temper: Temper
    ess_threshold: ArrayLike
    num_particles: int = field(metadata={"static": True})
    noise: DrawNoise = field(metadata={"static": True})
    scheme: ResamplingScheme | EnsembleScheme = field(metadata={"static": True})


def guided(
    sample_prior: SamplePrior,
    sample_transition: SampleTransition,
    log_likelihood: LogLikelihood,
    *,
    log_transition: LogTransition,
    proposal: EnsembleProposal | Proposal | tuple[Callable, Callable],
    num_particles: int,
    noise: DrawNoise = random_keys,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
    temper: Temper | None = None,
) -> Filter:
    """Build a guided particle filter, whose particles are proposed given the current observation.

    Like `bootstrap`, with the density of the transition and a proposal in addition. A proposal must be positive where
    transition and likelihood are, with tails that are no lighter, or the variance of the weights is not finite.

    Args:
        sample_prior: `key -> x`; or one of `jaxfilters.priors`, which draw all particles at once, twice as fast.
        sample_transition: `(randomness, x[, inputs]) -> x`, one step of the model; it moves the particles in frames
            without an observation.
        log_likelihood: `(x, y[, inputs]) -> log p(y | x)`, a scalar.
        log_transition: `(x_next, x[, inputs]) -> log p(x_next | x)`, a scalar, normalised.
        proposal: A pair `(sample, log_density)`, see `Proposal`; or one of `jaxfilters.proposals`: `linearized`, which
            is optimal where the observation is linear, or `laplace`.
        num_particles: Number n of particles.
        noise: Source of `randomness` of the transition, and of a proposal that is a pair.
        scheme: Function of `jaxfilters.resampling`, or a scheme of `jaxfilters.differentiable_resampling`.
        ess_threshold: Resample before the move if the effective sample size is below this fraction of n; 1 or more
            resamples always, 0 never.
        temper: Tempering of likelihood and importance ratio together, e.g. `AdaptiveTempering(0.2)`; none by default.

    Returns:
        A filter whose state is an `AuxiliaryState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: If a callback is not callable, or `proposal` is neither a pair nor a proposal of this library.
        ValueError: If `num_particles < 1`, or `ess_threshold` or a parameter of `temper` is out of range; and when the
            filter is traced, if a callback returns an array of the wrong shape or type.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> from jax.scipy.stats import norm
        >>> move = lambda noise, x: 0.9 * x + 0.5 * noise
        >>> log_transition = lambda x_next, x: norm.logpdf(x_next, 0.9 * x, 0.5).sum()
        >>> log_likelihood = lambda x, y: norm.logpdf(y, x, 0.1).sum()
        >>> near_y = (lambda noise, x, y: y + 0.2 * noise, lambda z, x, y: norm.logpdf(z, y, 0.2).sum())
        >>> pf = jf.guided(
        ...     lambda key: jnp.zeros(1), move, log_likelihood, log_transition=log_transition, proposal=near_y,
        ...     num_particles=1000, noise=jf.StandardNormal(1),
        ... )
        >>> state, infos = jf.run(pf, jax.random.key(0), jnp.ones((5, 1)), collect=jf.keep_info)
        >>> infos.log_evidence.shape
        (5,)
    """
    if isinstance(sample_prior, Filter):
        raise TypeError("guided takes a model; to guide a Rao-Blackwellized filter, call jf.guided_rao_blackwell.")
    if proposal is None or log_transition is None:
        raise TypeError(f"{'proposal' if proposal is None else 'log_transition'} must be given; got None.")
    callbacks = (sample_prior, sample_transition, log_transition, log_likelihood, proposal, None)
    return _build(callbacks, num_particles, noise, scheme, ess_threshold, temper)


def auxiliary(
    sample_prior: SamplePrior,
    sample_transition: SampleTransition,
    log_likelihood: LogLikelihood,
    *,
    log_first_stage: FirstStage,
    log_transition: LogTransition | None = None,
    proposal: EnsembleProposal | Proposal | tuple[Callable, Callable] | None = None,
    num_particles: int,
    noise: DrawNoise = random_keys,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
    temper: Temper | None = None,
) -> Filter:
    """Build an auxiliary particle filter (M. Pitt and N. Shephard 1999), which resamples for the next observation.

    Particles are chosen by their weights times `log_first_stage`, an approximation of log p(y | x of the step before),
    moved by the proposal, and weighted by what remains. With `proposal=p, log_first_stage=p.log_predictive` for
    `p = jf.proposals.linearized(...)` of a linear observation the filter is fully adapted: all weights are equal. A
    first stage that is too sharp makes the filter worse than `bootstrap`: it may be rough, but should have heavy tails.

    Args:
        sample_prior: As for `guided`, like all arguments that are not described here.
        sample_transition: One step of the model.
        log_likelihood: `(x, y[, inputs]) -> log p(y | x)`.
        log_first_stage: `(x, y[, inputs]) -> log eta`, a scalar, where x is the state of the step before. NaN, `+inf`
            and what is below e^-50 of the largest count as e^-50 of it, so that no particle is excluded.
        log_transition: Density of the transition; needed where a proposal is given.
        proposal: `None` proposes by the transition.
        num_particles: Number n of particles.
        noise: Source of randomness.
        scheme: Resampling scheme; optimal transport is rejected, because the average of several particles has another
            first stage.
        ess_threshold: Resample if the effective sample size of the weights of the first stage is below this fraction of
            n; 1 or more resamples always.
        temper: Tempering of the factors of the second stage.

    Returns:
        A filter whose state is an `AuxiliaryState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: As `guided`.
        ValueError: As `guided`; also if only one of `log_transition` and `proposal` is given, or `scheme` is transport.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> move = lambda noise, x: 0.9 * x + 0.1 * noise
        >>> log_likelihood = lambda x, y: -0.5 * jnp.sum((y - x) ** 2)
        >>> pf = jf.auxiliary(
        ...     lambda key: jnp.zeros(1), move, log_likelihood, num_particles=1000, noise=jf.StandardNormal(1),
        ...     log_first_stage=lambda x, y: log_likelihood(0.9 * x, y),
        ... )
        >>> state, infos = jf.run(pf, jax.random.key(0), jnp.ones((5, 1)), collect=jf.keep_info)
        >>> infos.effective_sample_size.shape
        (5,)
    """
    if log_first_stage is None:
        raise TypeError("log_first_stage must be given; got None. A filter without a first stage is jf.guided.")
    if (proposal is None) != (log_transition is None):
        missing, given = ("proposal", "log_transition") if proposal is None else ("log_transition", "proposal")
        raise ValueError(f"{missing} must be given too where {given} is: the weight is a ratio of both densities.")
    if isinstance(scheme, Transport):
        raise ValueError("scheme must choose ancestors: transport averages particles, whose first stages differ.")
    callbacks = (sample_prior, sample_transition, log_transition, log_likelihood, proposal, log_first_stage)
    return _build(callbacks, num_particles, noise, scheme, ess_threshold, temper)


def _build(
    callbacks: tuple,
    num_particles: int,
    noise: DrawNoise,
    scheme: ResamplingScheme | EnsembleScheme,
    ess_threshold: ArrayLike,
    temper: Temper | None,
) -> Filter:
    sample_prior, sample_transition, log_transition, log_likelihood, proposal, log_first_stage = callbacks
    checks.check_callables(sample_prior=sample_prior, sample_transition=sample_transition)
    checks.check_callables(log_likelihood=log_likelihood, log_transition=log_transition)
    checks.check_callables(log_first_stage=log_first_stage, noise=noise)
    checks.check_ensemble(num_particles, ess_threshold, scheme, temper)
    params = Auxiliary(
        as_pytree(sample_prior),
        taking_inputs("sample_transition", sample_transition, "randomness", "x"),
        None if log_transition is None else taking_inputs("log_transition", log_transition, "x_next", "x"),
        taking_inputs("log_likelihood", log_likelihood, "x", "y"),
        None if proposal is None else _as_proposal(proposal, noise),
        None if log_first_stage is None else taking_inputs("log_first_stage", log_first_stage, "x", "y"),
        as_pytree(temper or no_tempering),
        ess_threshold,
        num_particles,
        noise,
        scheme,
    )
    return Filter(params, _init, _predict, _update)


def _as_proposal(proposal: Any, noise: DrawNoise) -> EnsembleProposal:
    if isinstance(proposal, EnsembleProposal):
        return proposal
    if not isinstance(proposal, tuple) or len(proposal) != 2:
        raise TypeError(f"proposal must be a pair (sample, log_density) or one of jf.proposals; got {proposal!r}.")
    sample, log_density = proposal
    checks.check_callables(**{"sample of proposal": sample, "log_density of proposal": log_density})
    return _FromPair(
        taking_inputs("sample of proposal", sample, "randomness", "x", "y"),
        taking_inputs("log_density of proposal", log_density, "x_next", "x", "y"),
        noise,
    )


def _init(model: Auxiliary, key: AnyKey) -> AuxiliaryState:
    particles = sample_ensemble(key, model.sample_prior, model.num_particles)
    return AuxiliaryState(particles, weights.uniform(model.num_particles), _identity(model), particles)


def _identity(model: Auxiliary) -> Int32[Array, " n"]:
    return jnp.arange(model.num_particles, dtype=jnp.int32)


def _predict(model: Auxiliary, key: AnyKey, state: AuxiliaryState, inputs: PyTree) -> AuxiliaryState:
    moved = _moved(model, key, state.particles, inputs)
    return AuxiliaryState(moved, state.log_weights, _identity(model), state.particles)


def _moved(model: Auxiliary, key: AnyKey, particles: PyTree, inputs: PyTree) -> PyTree:
    transition = checks.checked_transition(model.sample_transition)
    noise = _stored(checks.checked_noise(model.noise(key, model.num_particles), particles))
    return jax.vmap(transition, in_axes=(-1, -1, None), out_axes=-1)(noise, particles, inputs)


def _update(
    model: Auxiliary, key: AnyKey, state: AuxiliaryState, observation: PyTree, inputs: PyTree
) -> tuple[AuxiliaryState, ParticleInfo]:
    resample_key, draw_key = jax.random.split(key)
    parents, log_weights, ancestors = _select(model, resample_key, state, observation, inputs)
    particles, log_ratio = _propose(model, draw_key, parents, observation, inputs)
    log_likelihood = checks.checked_log_likelihood(model.log_likelihood)
    log_factor = jax.vmap(log_likelihood, in_axes=(-1, None, None))(particles, observation, inputs) + log_ratio
    log_weights, info = reweight(log_weights, log_factor, ancestors, model.temper)
    return AuxiliaryState(particles, log_weights, ancestors, parents), info


def _select(
    model: Auxiliary, key: AnyKey, state: AuxiliaryState, y: PyTree, inputs: PyTree
) -> tuple[PyTree, Float[Array, " n"], Int32[Array, " n"]]:
    """Parents resampled by the first stage, their weights divided by it, and their indices."""
    log_first_stage = model.log_first_stage
    if log_first_stage is None:
        return resample(key, state.parents, state.log_weights, model.scheme, model.ess_threshold)

    def evaluated(x: PyTree) -> Array:
        return checks.scalar_log_density("log_first_stage", log_first_stage(x, y, inputs))

    first = jax.vmap(evaluated, in_axes=-1)(state.parents)
    usable = jnp.isfinite(first)
    peak = jax.lax.stop_gradient(jnp.max(jnp.where(usable, first, -jnp.inf)))
    lowest = jnp.where(jnp.isfinite(peak), peak + _LOWEST_FIRST_STAGE, 0.0)
    first = jnp.where(usable & (first > lowest), first, lowest)
    (parents, first), log_weights, ancestors = resample(
        key, (state.parents, first), state.log_weights + first, model.scheme, model.ess_threshold
    )
    return parents, log_weights - first, ancestors


def _propose(
    model: Auxiliary, key: AnyKey, parents: PyTree, y: PyTree, inputs: PyTree
) -> tuple[PyTree, Float[Array, " n"] | float]:
    """Particles, and the logarithms of the ratio of transition and proposal density there."""
    proposal, log_transition = model.proposal, model.log_transition
    if proposal is None or log_transition is None:
        return _moved(model, key, parents, inputs), 0.0

    def draw(randomness: Any, x: PyTree) -> tuple[PyTree, Array]:
        ahead, log_density = proposal.draw(randomness, x, y, inputs)
        ahead = checks.like("the result of sample of proposal", ahead, x, "x")
        return ahead, checks.scalar_log_density("log_transition", log_transition(ahead, x, inputs)) - log_density

    noise = _stored(proposal.noise(key, parents))
    return jax.vmap(draw, in_axes=(-1, -1), out_axes=(-1, -1))(noise, parents)


def _stored(noise: PyTree) -> PyTree:
    """Noise that is in memory before it is used: XLA would fuse its generator into the move, without vectors."""
    is_number = lambda leaf: jnp.issubdtype(leaf.dtype, jnp.floating)
    return jax.tree.map(lambda leaf: materialized(leaf) if is_number(leaf) else leaf, noise)
