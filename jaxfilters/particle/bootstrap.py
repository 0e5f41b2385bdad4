"""Bootstrap particle filter: samples that are moved by the transition, weighted by the likelihood and resampled.

The ensemble axis is the last axis of every leaf.
"""

from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.noise import random_keys
from jaxfilters.particle import checks
from jaxfilters.particle.differentiable_resampling import EnsembleScheme
from jaxfilters.particle.resampling import systematic
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


class ParticleState(NamedTuple):
    """Weighted particles."""

    particles: PyTree
    """Leaves `(..., n)`."""
    log_weights: Float[Array, " n"]
    """After an update `logsumexp(log_weights) == 0`."""
    ancestors: Int32[Array, " n"]
    """Index of each particle's parent in the state before the last prediction."""
    noise: PyTree
    """Randomness of the next prediction, leaves `(..., n)`. It is drawn one step ahead, because XLA would otherwise
    fuse the random generator into the transition and evaluate it without vector instructions, three times slower on a
    CPU."""


@pytree_dataclass
class Bootstrap:
    """Parameters of a bootstrap particle filter: the user's callbacks, and how to resample."""

    sample_prior: SamplePrior
    sample_transition: SampleTransition
    log_likelihood: LogLikelihood
    temper: Temper
    ess_threshold: ArrayLike
    num_particles: int = field(metadata={"static": True})
    noise: DrawNoise = field(metadata={"static": True})
    scheme: ResamplingScheme | EnsembleScheme = field(metadata={"static": True})


def bootstrap(
    sample_prior: SamplePrior,
    sample_transition: SampleTransition,
    log_likelihood: LogLikelihood,
    *,
    num_particles: int,
    noise: DrawNoise = random_keys,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
    temper: Temper | None = None,
) -> Filter:
    """Build a bootstrap particle filter (N. Gordon, D. Salmond and A. Smith, IEE Proceedings F 140, 1993).

    The state of one particle is any pytree of arrays; its shapes and types must not change in a transition.

    Args:
        sample_prior: `key -> x`; or one of `jaxfilters.priors`, which draw all particles at once, twice as fast.
        sample_transition: `(randomness, x) -> x`, the state one step later with its process noise.
        log_likelihood: `(x, y) -> log p(y | x)`, a scalar. Both may take the inputs of the step as one more argument,
            see `jf.typing`.
        num_particles: Number n of particles.
        noise: Source of `randomness`: by default a random key for each particle. `StandardNormal(d)` passes d standard
            normal numbers instead and is several times faster.
        scheme: Function of `jaxfilters.resampling`, or a scheme of `jaxfilters.differentiable_resampling`.
        ess_threshold: Resample before a prediction if the effective sample size is below this fraction of n; 1 or more
            resamples always, 0 never.
        temper: Tempering of the likelihoods, e.g. `AdaptiveTempering(0.2)`; none by default.

    Returns:
        A filter whose state is a `ParticleState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: If a callback is not callable.
        ValueError: If `num_particles < 1`, or `ess_threshold` or a parameter of `temper` is out of range; and when the
            filter is traced, if a callback returns an array of the wrong shape or type.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> move = lambda noise, x: 0.9 * x + 0.5 * noise
        >>> log_likelihood = lambda x, y: -0.5 * jnp.sum((y - x) ** 2)
        >>> pf = jf.bootstrap(
        ...     lambda key: jnp.zeros(1), move, log_likelihood, num_particles=1000, noise=jf.StandardNormal(1)
        ... )
        >>> state, (states, infos) = jf.run(pf, jax.random.key(0), jnp.ones((5, 1)))
    """
    checks.check_callables(sample_prior=sample_prior, sample_transition=sample_transition)
    checks.check_callables(log_likelihood=log_likelihood, noise=noise)
    checks.check_ensemble(num_particles, ess_threshold, scheme, temper)
    params = Bootstrap(
        as_pytree(sample_prior),
        taking_inputs("sample_transition", sample_transition, "randomness", "x"),
        taking_inputs("log_likelihood", log_likelihood, "x", "y"),
        as_pytree(temper or no_tempering),
        ess_threshold,
        num_particles,
        noise,
        scheme,
    )
    return Filter(params, _init, _predict, _update)


def _init(model: Bootstrap, key: AnyKey) -> ParticleState:
    prior_key, noise_key = jax.random.split(key)
    count = model.num_particles
    particles = sample_ensemble(prior_key, model.sample_prior, count)
    noise = checks.checked_noise(model.noise(noise_key, count), particles)
    return ParticleState(particles, weights.uniform(count), jnp.arange(count, dtype=jnp.int32), noise)


def _predict(model: Bootstrap, key: AnyKey, state: ParticleState, inputs: PyTree) -> ParticleState:
    resample_key, noise_key = jax.random.split(key)
    particles, log_weights, ancestors = resample(
        resample_key, state.particles, state.log_weights, model.scheme, model.ess_threshold
    )
    transition = checks.checked_transition(model.sample_transition)
    move = jax.vmap(transition, in_axes=(-1, -1, None), out_axes=-1)
    return ParticleState(
        move(state.noise, particles, inputs), log_weights, ancestors, model.noise(noise_key, model.num_particles)
    )


def _update(
    model: Bootstrap, key: AnyKey, state: ParticleState, observation: PyTree, inputs: PyTree
) -> tuple[ParticleState, ParticleInfo]:
    del key
    log_likelihood = checks.checked_log_likelihood(model.log_likelihood)
    log_likelihoods = jax.vmap(log_likelihood, in_axes=(-1, None, None))(state.particles, observation, inputs)
    log_weights, info = reweight(state.log_weights, log_likelihoods, state.ancestors, model.temper)
    return state._replace(log_weights=log_weights), info
