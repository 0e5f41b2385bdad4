"""What one writes first in JAX: particles on the leading axis, `vmap` of LAPACK, a search for every ancestor."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.benchmarks.scenarios._filter_models import Mixed
from jaxfilters.typing import AnyKey


def searched(key: AnyKey, log_weights: Float[Array, " n"]) -> Int[Array, " n"]:
    """Systematic ancestors: a running sum, and a search for every grid point."""
    w = jnp.exp(log_weights - jnp.max(log_weights))
    running = jnp.cumsum(w)
    grid = (jnp.arange(w.size) + jax.random.uniform(key, (), w.dtype)) / w.size
    return jnp.minimum(jnp.searchsorted(running, grid * running[-1], side="right"), w.size - 1)


def rao_blackwell(model: Mixed, key: AnyKey, readings: Float[Array, "t n"], num_particles: int) -> Float[Array, ""]:
    """Log evidence by a Rao-Blackwellized filter whose every particle has its covariance."""
    prior_key, key = jax.random.split(key)
    prior = model.linear_prior()
    x = jax.vmap(model.sample_prior)(jax.random.split(prior_key, num_particles))
    m = jnp.broadcast_to(prior.mean, (num_particles, *prior.mean.shape))
    P = jnp.broadcast_to(prior.covariance, (num_particles, *prior.covariance.shape))

    def one(key: AnyKey, x: Array, m: Array, P: Array) -> tuple[Array, Array, Array]:
        f_n, A_n, Q_n, f_l, A_l, Q_l = model.dynamics(x)
        spread = A_n @ P @ A_n.T + Q_n
        delta = jnp.linalg.cholesky(spread) @ jax.random.normal(key, x.shape, x.dtype)
        gain = A_l @ jnp.linalg.solve(spread, A_n @ P).T
        return f_n + A_n @ m + delta, f_l + A_l @ m + gain @ delta, A_l @ P @ A_l.T + Q_l - gain @ spread @ gain.T

    def step(carry: tuple, inputs: tuple) -> tuple[tuple, Array]:
        x, m, P, log_weights = carry
        key, y = inputs
        resample_key, move_key = jax.random.split(key)
        ancestors = searched(resample_key, log_weights)
        x, m, P = jax.vmap(one)(jax.random.split(move_key, num_particles), x[ancestors], m[ancestors], P[ancestors])
        log_weights = jax.vmap(model.log_likelihood, (0, None))(x, y)
        log_evidence = jax.nn.logsumexp(log_weights) - jnp.log(num_particles)
        return (x, m, P, log_weights), log_evidence

    keys = jax.random.split(key, readings.shape[0])
    carry = (x, m, P, jnp.zeros(num_particles))
    return jax.lax.scan(step, carry, (keys, readings))[1].sum()
