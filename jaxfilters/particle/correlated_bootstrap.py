r"""Particle filter for observations with errors that last: the errors of all rows are integrated out exactly.

$$y_t = h(x_t) + b_t + r_t,\qquad r_t \sim N(0, R),$$

with a Gauss-Markov process b of independent rows. Given the path of x the rows are independent, and each is a scalar
linear Gaussian model: the filter is Rao-Blackwellized, with one mean for each row and particle and one variance for
each row, and its cost grows linearly with the number of rows. `rao_blackwell` with the matrices of `GaussMarkov` takes
errors that are correlated between rows, or shared by them.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.correlated import check_dt
from jaxfilters.gaussian.gauss_markov import GaussMarkov, check_process
from jaxfilters.noise import random_keys
from jaxfilters.particle import checks
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Transport
from jaxfilters.particle.resampling import systematic
from jaxfilters.particle.tempering import no_tempering
from jaxfilters.particle.weighting import ParticleInfo, resample, reweight
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import (
    AnyKey,
    DrawNoise,
    ResamplingScheme,
    SamplePrior,
    SampleTransition,
    Temper,
    as_pytree,
    only_inputs,
    taking_inputs,
)


class CorrelatedState(NamedTuple):
    """Weighted particles, each with its belief about the lasting errors."""

    particles: PyTree
    """Leaves `(..., n)`."""
    error_mean: Float[Array, "m n"]
    """Mean of the error of each row, given the path of each particle."""
    error_variance: Float[Array, " m"]
    """Variance of the error of each row, given a path: the same for all particles."""
    log_weights: Float[Array, " n"]
    ancestors: Int32[Array, " n"]
    noise: PyTree


@pytree_dataclass
class CorrelatedBootstrap:
    """Parameters of a filter made by `correlated_bootstrap`; its arguments describe them."""

    sample_prior: SamplePrior
    sample_transition: SampleTransition
    observe: Callable
    variance: Float[Array, " m"]
    process: GaussMarkov
    dt: Any
    temper: Temper
    ess_threshold: ArrayLike
    num_particles: int = field(metadata={"static": True})
    noise: DrawNoise = field(metadata={"static": True})
    scheme: ResamplingScheme | EnsembleScheme = field(metadata={"static": True})

    def step(self, inputs: PyTree) -> tuple[Array, Array]:
        """Factors and added variances of the errors in one step."""
        dt = self.dt(inputs) if callable(self.dt) else self.dt
        return self.process.decay(dt), self.process.added(dt)


def correlated_bootstrap(
    sample_prior: SamplePrior,
    sample_transition: SampleTransition,
    observe: Callable[..., Array],
    variance: Float[Array, " m"],
    process: GaussMarkov,
    *,
    num_particles: int,
    dt: ArrayLike | Callable = 1.0,
    noise: DrawNoise = random_keys,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
    temper: Temper | None = None,
) -> Filter:
    """Bootstrap particle filter for Gaussian observations whose errors last from step to step.

    A. Doucet, N. de Freitas, K. Murphy and S. Russell, "Rao-Blackwellised particle filtering for dynamic Bayesian
    networks", UAI 2000, with the errors as the part that is integrated out.

    Args:
        sample_prior: `key -> x`.
        sample_transition: `(randomness, x) -> x`, or `(randomness, x, inputs) -> x`, as for `bootstrap`.
        observe: `x -> y` or `(x, inputs) -> y` without noise, (m,). Rows of the observation that are NaN are missing.
        variance: Variances R of the white noise of the rows, (m,), positive or zero.
        process: The process of the lasting errors, with m independent components: a covariance of shape (m,), and one
            time constant or m of them.
        num_particles: Number n of particles.
        dt: Length of a step in the unit of the time constants, or a function `inputs -> length`.
        noise: Source of `randomness`, as for `bootstrap`.
        scheme: Resampling scheme that chooses ancestors.
        ess_threshold: As for `bootstrap`.
        temper: As for `bootstrap`.

    Returns:
        A filter whose state is a `CorrelatedState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: If an argument is of another kind.
        ValueError: If a number is out of range, the components of `process` are not independent, or, when the filter is
            traced, if a function returns an array of another shape.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> move = lambda noise, x: x + 0.1 * noise
        >>> lasting = jf.GaussMarkov(jnp.array(20.0), jnp.array([1.0, 1.0]))
        >>> pf = jf.correlated_bootstrap(
        ...     lambda key: jax.random.normal(key, (1,)), move, lambda x: jnp.concatenate([x, x]), 0.1 * jnp.ones(2),
        ...     lasting, num_particles=500, noise=jf.StandardNormal(1),
        ... )
        >>> state, _ = jf.run(pf, jax.random.key(0), jnp.ones((5, 2)))
        >>> state.error_mean.shape
        (2, 500)
    """
    checks.check_callables(sample_prior=sample_prior, sample_transition=sample_transition, noise=noise)
    checks.check_ensemble(num_particles, ess_threshold, scheme, temper)
    if not callable(observe):
        raise TypeError(f"observe must be callable; got {observe!r}.")
    if isinstance(scheme, Transport):
        raise ValueError("scheme must choose ancestors: transport averages particles, and so the beliefs beside them.")
    check_process("process", process)
    if process.covariance.ndim != 1 or jnp.ndim(process.time_constant) > 1:
        raise ValueError(
            "process must have independent components, with a covariance of shape (m,) and time constants of shape () "
            f"or (m,); got the shapes {process.covariance.shape} and {jnp.shape(process.time_constant)}."
        )
    checks.check_shape("variance", variance, (process.size,), "a number for each component of process")
    checks.check_floating("variance", variance)
    checks.check_values("variance", variance, "finite and at least 0", lambda v: np.isfinite(v) & (v >= 0))
    check_dt(dt)
    params = CorrelatedBootstrap(
        as_pytree(sample_prior),
        taking_inputs("sample_transition", sample_transition, "randomness", "x"),
        taking_inputs("observe", observe, "x"),
        variance,
        process,
        only_inputs("dt", dt) if callable(dt) else dt,
        as_pytree(temper or no_tempering),
        ess_threshold,
        num_particles,
        noise,
        scheme,
    )
    return Filter(params, _init, _predict, _update)


def _init(model: CorrelatedBootstrap, key: AnyKey) -> CorrelatedState:
    prior_key, noise_key = jax.random.split(key)
    count, B = model.num_particles, model.process.covariance
    particles = sample_ensemble(prior_key, model.sample_prior, count)
    noise = checks.checked_noise(model.noise(noise_key, count), particles)
    ancestors = jnp.arange(count, dtype=jnp.int32)
    return CorrelatedState(particles, jnp.zeros((B.size, count), B.dtype), B, weights.uniform(count), ancestors, noise)


def _predict(model: CorrelatedBootstrap, key: AnyKey, state: CorrelatedState, inputs: PyTree) -> CorrelatedState:
    resample_key, noise_key = jax.random.split(key)
    (particles, mean), log_weights, ancestors = resample(
        resample_key, (state.particles, state.error_mean), state.log_weights, model.scheme, model.ess_threshold
    )
    move = jax.vmap(checks.checked_transition(model.sample_transition), in_axes=(-1, -1, None), out_axes=-1)
    decay, added = model.step(inputs)
    return CorrelatedState(
        move(state.noise, particles, inputs),
        decay[:, None] * mean,
        decay * decay * state.error_variance + added,
        log_weights,
        ancestors,
        model.noise(noise_key, model.num_particles),
    )


def _update(
    model: CorrelatedBootstrap, key: AnyKey, state: CorrelatedState, observation: Array, inputs: PyTree
) -> tuple[CorrelatedState, ParticleInfo]:
    del key
    checks.check_shape("the observation y", observation, (model.process.size,), "a number for each row")
    predicted = jax.vmap(model.observe, in_axes=(-1, None), out_axes=-1)(state.particles, inputs)
    checks.check_shape("the result of observe", predicted, state.error_mean.shape, "(m,) for each particle")
    read = jnp.isfinite(observation)
    total = state.error_variance + model.variance
    # A row that nothing is uncertain of adds nothing, as in the Gaussian filters.
    counts = read & (total > 0)
    S = jnp.where(counts, total, 1.0)
    innovation = jnp.where(counts, jnp.where(read, observation, 0.0), 0.0)[:, None] - jnp.where(
        counts[:, None], predicted + state.error_mean, 0.0
    )
    terms = -0.5 * (innovation * innovation / S[:, None] + jnp.log(2 * jnp.pi * S)[:, None])
    log_likelihood = jnp.sum(jnp.where(counts[:, None], terms, 0.0), axis=0)
    log_weights, info = reweight(state.log_weights, log_likelihood, state.ancestors, model.temper)
    gain = jnp.where(counts, state.error_variance / S, 0.0)
    variance = jnp.where(counts, state.error_variance * model.variance / S, state.error_variance)
    mean = state.error_mean + gain[:, None] * innovation
    return state._replace(error_mean=mean, error_variance=variance, log_weights=log_weights), info
