r"""SMC$^2$: sequential Monte Carlo on parameters, each of which has a filter of its own.

With particle filters it is exact for any number of their particles (N. Chopin, P. Jacob and O. Papaspiliopoulos,
"SMC$^2$: an efficient algorithm for sequential analysis of state space models", Journal of the Royal Statistical
Society B 75, 2013). With exact filters it is iterated batch importance sampling (N. Chopin, "A sequential particle
filter method for static models", Biometrika 89, 2002).
"""

from collections.abc import Callable, Sequence
from dataclasses import field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int32, PyTree

from jaxfilters import filter as filters
from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.fit.constraints import free
from jaxfilters.mcmc import checks, ensembles
from jaxfilters.mcmc.conditional_resampling import systematic_at
from jaxfilters.mcmc.ensembles import SMCPosterior, SMCStatus, Target
from jaxfilters.mcmc.metropolis import Point
from jaxfilters.particle.checks import check_callables, check_scalar
from jaxfilters.typing import AnyKey, SamplePrior, as_pytree


class SMC2Info(NamedTuple):
    """Diagnostics of every frame."""

    log_evidence: Float[Array, " t"]
    """log p(y_t | y_1:t-1), with the parameters integrated out."""
    effective_sample_size: Float[Array, " t"]
    """Of the weights of the parameters, before they were moved."""
    moved: Bool[Array, " t"]
    """Whether the parameters were resampled and moved."""
    acceptance: Float[Array, " t"]
    """Mean acceptance probability of the moves; NaN where there were none."""
    num_invalid: Int32[Array, " t"]
    """Number of parameters whose log evidence was NaN or `+inf`, which lost their weight, and of such proposals."""
    filter_index: Int32[Array, " t"]
    """Which of the filters of `filter_of` was used, from 0."""


FilterOf = Callable[[PyTree], Filter]


@pytree_dataclass
class _Problem:
    sample_prior: SamplePrior
    log_prior: Callable[[PyTree], Array]
    filters: tuple[FilterOf, ...]
    """By increasing number of particles."""
    observations: PyTree
    inputs: PyTree
    mask: PyTree
    ess_threshold: ArrayLike
    min_acceptance: ArrayLike
    num_particles: int = field(metadata={"static": True})
    num_moves: int = field(metadata={"static": True})
    constraints: tuple = field(metadata={"static": True})


class _Carry(NamedTuple):
    ensemble: Point
    """With the states of the filters as `auxiliary`."""
    log_weights: Float[Array, " n"]
    status: Int32[Array, ""]
    time: Int32[Array, ""]
    """Of the next frame."""
    enlarge: Bool[Array, ""]
    """Whether the filters of this number of particles have become too inexact."""
    info: SMC2Info


def smc2(
    key: AnyKey,
    filter_of: FilterOf | Sequence[FilterOf],
    sample_prior: SamplePrior,
    log_prior: Callable[[PyTree], Array],
    observations: PyTree,
    inputs: PyTree = None,
    *,
    num_particles: int,
    mask: Bool[Array, " t"] | None = None,
    num_moves: int = 3,
    ess_threshold: ArrayLike = 0.5,
    min_acceptance: ArrayLike = 0.2,
    constraints: PyTree = free,
) -> SMCPosterior:
    """Draw parameters from their posterior after every observation, and estimate the evidence of the model.

    Every frame advances the filters of all parameters, which weights these. Where the effective sample size falls
    below the threshold, parameters are resampled and moved by particle marginal Metropolis-Hastings steps: a random
    walk in unconstrained coordinates with the covariance of the ensemble, and a new filter from the first frame to the
    present one for each proposed parameter.

    The longer the sequence, the less exact is the evidence of a particle filter, and the fewer moves are accepted. A
    sequence of functions `filter_of` is a ladder of filters with ever more particles: where the acceptance of the moves
    falls below `min_acceptance`, every parameter gets a new filter of the next kind from the first frame on, and its
    weight is multiplied by the ratio of the new evidence to the old one (the exchange step of Chopin, Jacob and
    Papaspiliopoulos 2013, section 3.3).

    Args:
        key: Random key.
        filter_of: `theta -> Filter`: of particles, with an unbiased evidence, or an exact one; or a sequence of such
            functions by increasing number of particles, usually twice as many each.
        sample_prior: `key -> theta`, or one of `jaxfilters.priors`.
        log_prior: `theta -> log p(theta)`, the density of theta itself of which `sample_prior` draws.
        observations: Pytree whose leaves have time as their first axis, (t, ...).
        inputs: Pytree of known inputs, time first, or `None`.
        num_particles: Number n of parameters.
        mask: Booleans (t,), `False` for frames without an observation.
        num_moves: Number of Metropolis-Hastings steps at a time.
        ess_threshold: Move the parameters if the effective sample size is below this fraction of n; 0 never.
        min_acceptance: Mean acceptance probability of moves, in [0, 1], below which the next filter is used.
        constraints: Constraints of `jaxfilters.fit`: one, a tree of them like theta, or a prefix of it.

    Returns:
        The weighted parameters after the last observation, the evidence, and an `SMC2Info`.

    Raises:
        TypeError: If a callback is not callable.
        ValueError: If a count is not an integer of at least 1 (2 for `num_particles`), `ess_threshold` is negative,
            `min_acceptance` is not in [0, 1], `filter_of` is an empty sequence, or the lengths of the sequences differ;
            or, where results are known, if a draw of the prior is outside the
            support of `log_prior` or the constraints, its density is NaN, or no parameter explains a frame. Under
            `jit` and `vmap` `status` says which.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> def filter_of(noise):
        ...     return jf.bootstrap(
        ...         lambda key: jax.random.normal(key), lambda e, x: x + 0.1 * e[0],
        ...         lambda x, y: jax.scipy.stats.norm.logpdf(y, x, noise), num_particles=50, noise=jf.StandardNormal(1))
        >>> posterior = jf.mcmc.smc2(
        ...     jax.random.key(0), filter_of, jax.random.exponential, jax.scipy.stats.expon.logpdf,
        ...     jnp.array([0.1, 0.8, -0.4, 0.9]), num_particles=100, constraints=jf.fit.positive)
        >>> posterior.theta.shape, posterior.info.log_evidence.shape
        ((100,), (4,))
    """
    filters = (filter_of,) if callable(filter_of) else tuple(filter_of)
    if not filters:
        raise ValueError("filter_of must be a function, or a sequence of at least one; got an empty sequence.")
    check_callables(sample_prior=sample_prior, log_prior=log_prior)
    for function in filters:
        check_callables(filter_of=function)
    checks.check_count("num_particles", num_particles, 2)
    checks.check_count("num_moves", num_moves)
    check_scalar("ess_threshold", ess_threshold, "a fraction of num_particles, at least 0", lambda share: share >= 0)
    check_scalar("min_acceptance", min_acceptance, "in [0, 1]", lambda share: (share >= 0) & (share <= 1))
    checks.shared_length(observations=observations, inputs=inputs, mask=mask)
    leaves, structure = jax.tree.flatten(constraints)
    problem = _Problem(
        as_pytree(sample_prior),
        as_pytree(log_prior),
        tuple(map(as_pytree, filters)),
        observations,
        inputs,
        mask,
        ess_threshold,
        min_acceptance,
        num_particles,
        num_moves,
        (tuple(leaves), structure),
    )
    return ensembles.announced(_run(key, problem))


@jax.jit
def _run(key: AnyKey, problem: _Problem) -> SMCPosterior:
    prior_key, state_key, scan_key = jax.random.split(key, 3)
    leaves, structure = problem.constraints
    theta, chart = ensembles.prior_draws(
        prior_key, problem.sample_prior, jax.tree.unflatten(structure, leaves), problem.num_particles
    )
    target = Target(problem.log_prior, partial(_start, problem.filters[0]), chart)
    ensemble = ensembles.points(state_key, target, theta)
    status = ensembles.status_of_start(target, ensemble)
    log_weights = weights.uniform(problem.num_particles, ensemble.log_prior.dtype)
    length = checks.shared_length(observations=problem.observations)
    carry = _Carry(ensemble, log_weights, status, jnp.int32(0), jnp.zeros((), bool), _no_info(length, log_weights))
    for i, filter_of in enumerate(problem.filters):
        if i > 0:
            carry = _exchanged(jax.random.fold_in(scan_key, length + i), problem, filter_of, chart, carry)
        is_last = i == len(problem.filters) - 1
        carry = jax.lax.while_loop(partial(_is_usable, is_last), partial(_frame, problem, i, chart, scan_key), carry)
    evidence = jnp.sum(carry.info.log_evidence)
    return SMCPosterior(carry.ensemble.theta, carry.log_weights, evidence, carry.info, carry.status)


def _is_usable(is_last: bool, carry: _Carry) -> Array:
    """Whether there is a next frame for filters of this number of particles."""
    return (carry.time < carry.info.moved.shape[0]) & (is_last | ~carry.enlarge)


def _no_info(length: int, like: Array) -> SMC2Info:
    zeros, counts = jnp.zeros(length, like.dtype), jnp.zeros(length, jnp.int32)
    return SMC2Info(zeros, zeros, jnp.zeros(length, bool), zeros, counts, counts)


def _start(filter_of: FilterOf, key: AnyKey, theta: PyTree) -> tuple[Array, PyTree]:
    """The log evidence of no observations, and the state before the first."""
    return jnp.zeros(()), filters.init(filter_of(theta), key)


def _exchanged(key: AnyKey, problem: _Problem, filter_of: FilterOf, chart, carry: _Carry) -> _Carry:
    """Parameters with other filters of the frames before the present one, and the weights that this gives them."""
    old = carry.ensemble
    target = Target(problem.log_prior, partial(_until, problem, filter_of, carry.time), chart)
    # Without frames to come nothing is needed but the shapes.
    start = Target(problem.log_prior, partial(_start, filter_of), chart)
    is_needed = carry.enlarge & (carry.time < carry.info.moved.shape[0])
    new = jax.lax.cond(
        is_needed,
        lambda: ensembles.points(key, target, old.theta),
        lambda: ensembles.points(key, start, old.theta),
    )
    # The mean of the ratios belongs to the estimate of the evidence, which it keeps unbiased.
    ratio = new.log_likelihood - old.log_likelihood
    ratio = jnp.where(jnp.isfinite(ratio), ratio, -jnp.inf)
    log_weights, log_mean = weights.normalize(carry.log_weights + ratio)
    info = carry.info._replace(log_evidence=carry.info.log_evidence.at[carry.time - 1].add(log_mean))
    kept = carry._replace(ensemble=new._replace(theta=old.theta), enlarge=jnp.zeros((), bool))
    return kept._replace(
        log_weights=jnp.where(is_needed, log_weights, carry.log_weights),
        info=jax.tree.map(partial(jnp.where, is_needed), info, carry.info),
    )


def _advance(
    problem: _Problem, filter_of: FilterOf, key: AnyKey, theta: PyTree, state: PyTree, time: Array
) -> tuple[Array, PyTree]:
    """Log evidence of one frame, and the state after it."""
    frame = jax.tree.map(lambda leaf: leaf[time][None], (problem.observations, problem.inputs, problem.mask))
    observations, inputs, mask = frame
    filter = filter_of(theta)
    state, info = filters.run(filter, key, observations, inputs, mask=mask, state=state, collect=filters.keep_info)
    return info.log_evidence[0], state


def _until(problem: _Problem, filter_of: FilterOf, time: Array, key: AnyKey, theta: PyTree) -> tuple[Array, PyTree]:
    """Log evidence of all frames before one, by a new filter, and its state."""
    init_key, key = jax.random.split(key)

    def advance(frame: Array, carry: tuple[Array, PyTree]) -> tuple[Array, PyTree]:
        total, state = carry
        log_evidence, state = _advance(problem, filter_of, jax.random.fold_in(key, frame), theta, state, frame)
        return total + log_evidence, state

    return jax.lax.fori_loop(0, time, advance, _start(filter_of, init_key, theta))


def _frame(problem: _Problem, filter_index: int, chart, scan_key: AnyKey, carry: _Carry) -> _Carry:
    filter_key, move_key = jax.random.split(jax.random.fold_in(scan_key, carry.time))
    n, ensemble, time = problem.num_particles, carry.ensemble, carry.time
    filter_of = problem.filters[filter_index]
    advance = jax.vmap(partial(_advance, problem, filter_of), in_axes=(0, -1, -1, None), out_axes=-1)
    increments, states = advance(jax.random.split(filter_key, n), ensemble.theta, ensemble.auxiliary, time)
    invalid = jnp.isnan(increments) | jnp.isposinf(increments)
    increments = jnp.where(invalid, -jnp.inf, increments)
    log_weights, log_evidence = weights.normalize(carry.log_weights + increments)
    size = weights.effective_sample_size(log_weights)
    ensemble = ensemble._replace(log_likelihood=ensemble.log_likelihood + increments, auxiliary=states)
    target = Target(problem.log_prior, partial(_until, problem, filter_of, time + 1), chart)

    def move() -> tuple[Point, Array, Array, Array]:
        return _moved(move_key, problem, target, ensemble, log_weights)

    def stay() -> tuple[Point, Array, Array, Array]:
        return ensemble, log_weights, jnp.full((), jnp.nan, log_weights.dtype), jnp.zeros((), jnp.int32)

    uneven = size < problem.ess_threshold * n
    ensemble, after, acceptance, num_rejected = jax.lax.cond(uneven, move, stay)
    hopeless = (log_evidence == -jnp.inf) & (carry.status == SMCStatus.FINISHED)
    status = jnp.where(hopeless, SMCStatus.NO_WEIGHT, carry.status).astype(jnp.int32)
    num_invalid = jnp.sum(invalid, dtype=jnp.int32) + num_rejected
    new = SMC2Info(log_evidence, size, uneven, acceptance, num_invalid, jnp.int32(filter_index))
    info = jax.tree.map(lambda of_all, value: of_all.at[time].set(value), carry.info, new)
    return _Carry(ensemble, after, status, time + 1, uneven & (acceptance < problem.min_acceptance), info)


def _moved(
    key: AnyKey, problem: _Problem, target: Target, ensemble: Point, log_weights: Array
) -> tuple[Point, Array, Array, Array]:
    resample_key, steps_key = jax.random.split(key)
    root = ensembles.root_of(target, ensemble.theta, log_weights)
    chosen = systematic_at(jax.random.uniform(resample_key), log_weights)

    def step(ensemble: Point, step_key: AnyKey) -> tuple[Point, tuple[Array, Array]]:
        ensemble, info = ensembles.metropolis(step_key, target, ensemble, root, 1.0)
        return ensemble, (jnp.mean(info.acceptance_probability), jnp.sum(info.invalid, dtype=jnp.int32))

    keys = jax.random.split(steps_key, problem.num_moves)
    moved, (acceptance, num_invalid) = jax.lax.scan(step, ensembles.taken(ensemble, chosen), keys)
    return moved, weights.uniform(log_weights.size, log_weights.dtype), jnp.mean(acceptance), jnp.sum(num_invalid)
