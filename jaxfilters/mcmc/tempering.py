r"""Tempered sequential Monte Carlo samplers of parameters, standard and waste-free.

The ensemble moves from the prior to the posterior through densities proportional to prior times likelihood to the power
$\beta$, with $\beta$ from 0 to 1 (R. Neal, "Annealed importance sampling", Statistics and Computing 11, 2001; P. Del
Moral, A. Doucet and A. Jasra, "Sequential Monte Carlo samplers", Journal of the Royal Statistical Society B 68, 2006).
"""

from collections.abc import Callable
from dataclasses import field
from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.constraints import free
from jaxfilters.mcmc import checks, ensembles
from jaxfilters.mcmc.conditional_resampling import systematic_at
from jaxfilters.mcmc.ensembles import SMCPosterior, SMCStatus, Target
from jaxfilters.mcmc.metropolis import Point
from jaxfilters.particle.checks import check_callables, check_scalar, concrete
from jaxfilters.typing import AnyKey, SamplePrior, as_pytree


class TemperingInfo(NamedTuple):
    """Diagnostics of the stages; rows that no stage filled are NaN."""

    temperatures: Float[Array, " stages"]
    """Power of the likelihood after each stage."""
    acceptance: Float[Array, " stages"]
    """Mean acceptance probability of the moves of each stage."""
    num_stages: Int32[Array, ""]
    num_invalid: Int32[Array, ""]
    """Number of proposed parameters with a log density of NaN or `+inf`; they were rejected."""


@runtime_checkable
class Temperatures(Protocol):
    """A schedule: `adaptive_temperatures` or `fixed_temperatures`."""

    @property
    def max_stages(self) -> int:
        """Number of stages after which a sampler gives up."""
        ...

    def is_valid(self) -> Array:
        """Whether the schedule can be followed."""
        ...

    def next(self, stage: Array, temperature: Array, log_likelihood: Float[Array, " n"], /) -> Array:
        """The temperature after this one."""
        ...


@pytree_dataclass
class AdaptiveTemperatures:
    """Temperatures from the effective sample size; made by `adaptive_temperatures`."""

    ess_fraction: ArrayLike
    max_stages: int = field(metadata={"static": True})

    def is_valid(self) -> Array:
        """Always."""
        return jnp.ones((), bool)

    def next(self, stage: Array, temperature: Array, log_likelihood: Float[Array, " n"]) -> Array:
        """The largest temperature, at most 1, whose weights have the effective sample size."""
        del stage
        left = 1 - temperature
        n = log_likelihood.size
        target = jnp.asarray(self.ess_fraction, left.dtype) * n
        share = weights.temper_exponent(left * log_likelihood, jnp.zeros(n, left.dtype), target)
        return jnp.where(share >= 1, 1.0, temperature + share * left).astype(temperature.dtype)


@pytree_dataclass
class FixedTemperatures:
    """Temperatures that are known before; made by `fixed_temperatures`."""

    values: Float[Array, " stages"]

    @property
    def max_stages(self) -> int:
        """One for each temperature."""
        return self.values.shape[0]

    def is_valid(self) -> Array:
        """Whether they increase to 1."""
        return jnp.all(jnp.diff(self.values, prepend=0.0) > 0) & (self.values[-1] == 1)

    def next(self, stage: Array, temperature: Array, log_likelihood: Float[Array, " n"]) -> Array:
        """The next value."""
        del log_likelihood
        return self.values[stage].astype(temperature.dtype)


def adaptive_temperatures(ess_fraction: ArrayLike = 0.5, *, max_stages: int = 200) -> AdaptiveTemperatures:
    """Choose every temperature by bisection, so that a share of the effective sample size is left.

    The rule is that of A. Jasra, D. A. Stephens, A. Doucet and T. Tsagaris, "Inference for Levy-driven stochastic
    volatility models via adaptive sequential Monte Carlo", Scandinavian Journal of Statistics 38, 2011. The evidence
    then has a bias of the order of one over the number of particles.

    Args:
        ess_fraction: Share of the number of particles, in (0, 1).
        max_stages: Number of stages after which a sampler gives up.

    Returns:
        A schedule for `tempered_smc` and `waste_free_smc`.

    Raises:
        ValueError: If `ess_fraction` is not in (0, 1), or `max_stages` not an integer of at least 1.

    Examples:
        Where all particles are equally likely, the first temperature is the last one.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> schedule = jf.mcmc.adaptive_temperatures(0.5)
        >>> float(jax.jit(schedule.next)(jnp.array(0), jnp.array(0.0), jnp.zeros(10)))
        1.0
    """
    check_scalar("ess_fraction", ess_fraction, "in (0, 1)", lambda share: 0 < share < 1)
    checks.check_count("max_stages", max_stages)
    return AdaptiveTemperatures(ess_fraction, max_stages)


def fixed_temperatures(values: ArrayLike) -> FixedTemperatures:
    """Temperatures that do not depend on the ensemble.

    Args:
        values: (stages,), strictly increasing within (0, 1], the last one 1.

    Returns:
        A schedule for `tempered_smc` and `waste_free_smc`.

    Raises:
        ValueError: If `values` is no such vector.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> jf.mcmc.fixed_temperatures(jnp.array([0.1, 0.5, 1.0])).max_stages
        3
    """
    values = jnp.asarray(values, float)
    if values.ndim != 1 or not values.size:
        raise ValueError(f"temperatures must be a vector of at least one number; got the shape {values.shape}.")
    known = concrete(values)
    if known is not None and not (np.all(np.diff(known, prepend=0.0) > 0) and known[-1] == 1):
        raise ValueError(f"{SMCStatus.SCHEDULE.reason}; got {known.tolist()}.")
    return FixedTemperatures(values)


def tempered_smc(
    key: AnyKey,
    sample_prior: SamplePrior,
    log_prior: Callable[[PyTree], Array],
    log_likelihood: Callable[[PyTree], Array],
    *,
    num_particles: int,
    num_moves: int = 10,
    constraints: PyTree = free,
    temperatures: Temperatures | None = None,
) -> SMCPosterior:
    """Draw parameters from a posterior, and estimate its evidence, by tempered sequential Monte Carlo.

    Every stage raises the temperature, resamples, and moves all particles by random-walk Metropolis steps in
    unconstrained coordinates, with the covariance of the ensemble.

    Args:
        key: Random key.
        sample_prior: `key -> theta`, or one of `jaxfilters.priors`.
        log_prior: `theta -> log p(theta)`, the density of theta itself of which `sample_prior` draws.
        log_likelihood: `theta -> log p(observations | theta)`, e.g. what `jaxfilters.fit.log_evidence` returns.
        num_particles: Number n of particles.
        num_moves: Number of Metropolis steps a stage.
        constraints: Constraints of `jaxfilters.fit`: one, a tree of them like theta, or a prefix of it.
        temperatures: `adaptive_temperatures(...)`, the default, or `fixed_temperatures(...)`.

    Returns:
        Parameters with equal weights, the evidence, and a `TemperingInfo`.

    Raises:
        TypeError: If a callback is not callable.
        ValueError: If a count is not an integer of at least 1 (2 for `num_particles`); or, where results are known, if
            a draw of the prior is outside the support of `log_prior` or the constraints, its density is NaN, no draw
            has any likelihood, or the stages did not suffice. Under `jit` and `vmap` `status` says which.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> normal = jax.scipy.stats.norm.logpdf
        >>> posterior = jf.mcmc.tempered_smc(
        ...     jax.random.key(0), jax.random.normal, normal, lambda theta: normal(2.0, theta, 0.1), num_particles=1000)
        >>> exact = normal(2.0, 0.0, 1.01**0.5)
        >>> bool(abs(posterior.log_evidence - exact) < 0.2), bool(abs(posterior.theta.mean() - 1.98) < 0.02)
        (True, True)
    """
    checks.check_count("num_particles", num_particles, 2)
    checks.check_count("num_moves", num_moves)
    problem = _problem(sample_prior, log_prior, log_likelihood, temperatures)
    return ensembles.announced(_standard(key, problem, _Sizes(num_particles, num_moves), _hashable(constraints)))


def waste_free_smc(
    key: AnyKey,
    sample_prior: SamplePrior,
    log_prior: Callable[[PyTree], Array],
    log_likelihood: Callable[[PyTree], Array],
    *,
    num_particles: int,
    chain_length: int,
    constraints: PyTree = free,
    temperatures: Temperatures | None = None,
) -> SMCPosterior:
    """Draw parameters from a posterior, and estimate its evidence, by waste-free sequential Monte Carlo.

    Every stage resamples `num_particles / chain_length` particles only, moves each along a chain, and keeps all states
    of all chains as its particles (H.-D. Dau and N. Chopin, "Waste-free sequential Monte Carlo", Journal of the Royal
    Statistical Society B 84, 2022, algorithm 2).

    Args:
        key: Random key.
        sample_prior: As for `tempered_smc`.
        log_prior: As for `tempered_smc`.
        log_likelihood: As for `tempered_smc`.
        num_particles: Number n of particles, a multiple of `chain_length`.
        chain_length: Number of states of each chain, the resampled particle among them; at least 2.
        constraints: As for `tempered_smc`.
        temperatures: As for `tempered_smc`.

    Returns:
        As `tempered_smc`.

    Raises:
        TypeError: As `tempered_smc`.
        ValueError: As `tempered_smc`, or if `num_particles` is not a multiple of `chain_length`.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> normal = jax.scipy.stats.norm.logpdf
        >>> posterior = jf.mcmc.waste_free_smc(
        ...     jax.random.key(0), jax.random.normal, normal, lambda theta: normal(2.0, theta, 0.1),
        ...     num_particles=1000, chain_length=20)
        >>> bool(abs(posterior.log_evidence - normal(2.0, 0.0, 1.01**0.5)) < 0.2)
        True
    """
    checks.check_count("num_particles", num_particles, 2)
    checks.check_count("chain_length", chain_length, 2)
    if num_particles % chain_length:
        raise ValueError(
            f"num_particles must be a multiple of chain_length; got {num_particles} particles and {chain_length}."
        )
    problem = _problem(sample_prior, log_prior, log_likelihood, temperatures)
    return ensembles.announced(
        _waste_free(key, problem, _Sizes(num_particles, chain_length - 1), _hashable(constraints))
    )


@pytree_dataclass
class _Problem:
    sample_prior: SamplePrior
    log_prior: Callable[[PyTree], Array]
    log_likelihood: Callable[[PyTree], Array]
    temperatures: Temperatures

    def evaluate(self, key: AnyKey, theta: PyTree) -> tuple[Array, PyTree]:
        """The likelihood, which leaves nothing behind."""
        del key
        return self.log_likelihood(theta), ()


class _Sizes(NamedTuple):
    num_particles: int
    num_moves: int


class _Stage(NamedTuple):
    """State of a sampler between two stages."""

    number: Int32[Array, ""]
    temperature: Float[Array, ""]
    ensemble: Point
    log_evidence: Float[Array, ""]
    status: Int32[Array, ""]
    info: TemperingInfo


def _problem(sample_prior, log_prior, log_likelihood, temperatures):
    check_callables(sample_prior=sample_prior, log_prior=log_prior, log_likelihood=log_likelihood)
    temperatures = adaptive_temperatures() if temperatures is None else temperatures
    if not callable(getattr(temperatures, "next", None)):
        raise TypeError(
            f"temperatures must be adaptive_temperatures(...) or fixed_temperatures(...); got {temperatures!r}."
        )
    return _Problem(as_pytree(sample_prior), as_pytree(log_prior), as_pytree(log_likelihood), temperatures)


def _hashable(constraints):
    """A tree of constraints as a static argument."""
    leaves, structure = jax.tree.flatten(constraints)
    return tuple(leaves), structure


@partial(jax.jit, static_argnames=("sizes", "constraints"))
def _standard(key, problem, sizes, constraints):
    def moved(key, target, chosen, root, temperature):
        def step(ensemble, step_key):
            return ensembles.metropolis(step_key, target, ensemble, root, temperature)

        return jax.lax.scan(step, chosen, jax.random.split(key, sizes.num_moves))

    return _tempered(key, problem, sizes.num_particles, constraints, sizes.num_particles, moved)


@partial(jax.jit, static_argnames=("sizes", "constraints"))
def _waste_free(key, problem, sizes, constraints):
    def moved(key, target, chosen, root, temperature):
        def step(ensemble, step_key):
            after, info = ensembles.metropolis(step_key, target, ensemble, root, temperature)
            return after, (after, info)

        _, (visited, infos) = jax.lax.scan(step, chosen, jax.random.split(key, sizes.num_moves))
        return jax.tree.map(_side_by_side, chosen, visited), infos

    num_chains = sizes.num_particles // (sizes.num_moves + 1)
    return _tempered(key, problem, sizes.num_particles, constraints, num_chains, moved)


def _side_by_side(first, later):
    """Arrays (..., m) and (p - 1, ..., m) as one, (..., p m)."""
    return jnp.moveaxis(jnp.concatenate([first[None], later]), 0, -2).reshape(*first.shape[:-1], -1)


def _tempered(key, problem, num_particles, constraints, num_resampled, moved) -> SMCPosterior:
    prior_key, stage_key, point_key = jax.random.split(key, 3)
    leaves, structure = constraints
    theta, chart = ensembles.prior_draws(
        prior_key, problem.sample_prior, jax.tree.unflatten(structure, leaves), num_particles
    )
    target = Target(problem.log_prior, problem.evaluate, chart)
    start = ensembles.points(point_key, target, theta)
    status = jnp.where(problem.temperatures.is_valid(), ensembles.status_of_start(target, start), SMCStatus.SCHEDULE)
    empty = jnp.full(problem.temperatures.max_stages, jnp.nan, start.log_prior.dtype)
    none, zero = jnp.zeros((), jnp.int32), jnp.zeros((), empty.dtype)
    first = _Stage(none, zero, start, zero, status, TemperingInfo(empty, empty, none, none))

    def unfinished(stage: _Stage) -> Array:
        within = stage.number < problem.temperatures.max_stages
        return (stage.temperature < 1) & within & (stage.status == SMCStatus.FINISHED)

    def advance(stage: _Stage) -> _Stage:
        return _advanced(jax.random.fold_in(stage_key, stage.number), problem, target, stage, num_resampled, moved)

    last = jax.lax.while_loop(unfinished, advance, first)
    exhausted = (last.temperature < 1) & (last.status == SMCStatus.FINISHED)
    status = jnp.where(exhausted, SMCStatus.UNFINISHED, last.status).astype(jnp.int32)
    equal = weights.uniform(num_particles, empty.dtype)
    return SMCPosterior(
        last.ensemble.theta, equal, last.log_evidence, last.info._replace(num_stages=last.number), status
    )


def _advanced(key, problem, target, stage: _Stage, num_resampled, moved) -> _Stage:
    resample_key, move_key = jax.random.split(key)
    log_likelihood = stage.ensemble.log_likelihood
    temperature = problem.temperatures.next(stage.number, stage.temperature, log_likelihood)
    log_weights, log_sum = weights.normalize((temperature - stage.temperature) * log_likelihood)
    root = ensembles.root_of(target, stage.ensemble.theta, log_weights)
    chosen = systematic_at(jax.random.uniform(resample_key), log_weights, num_resampled)
    ensemble, infos = moved(move_key, target, ensembles.taken(stage.ensemble, chosen), root, temperature)
    info = stage.info
    return _Stage(
        stage.number + 1,
        temperature,
        ensemble,
        stage.log_evidence + log_sum - jnp.log(jnp.asarray(log_weights.size, log_sum.dtype)),
        jnp.where(log_sum == -jnp.inf, SMCStatus.NO_WEIGHT, stage.status).astype(jnp.int32),
        info._replace(
            temperatures=info.temperatures.at[stage.number].set(temperature),
            acceptance=info.acceptance.at[stage.number].set(jnp.mean(infos.acceptance_probability)),
            num_invalid=info.num_invalid + jnp.sum(infos.invalid, dtype=jnp.int32),
        ),
    )
