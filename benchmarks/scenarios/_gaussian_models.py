"""The two models on which Gaussian filters are timed, and what they say about simulated readings."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.arithmetic import Arithmetic, square_root
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import extended_kalman


@pytree_dataclass
class Coupled:
    """A state whose components all drive one another, seen through saturating sensors."""

    A: Float[Array, "..."]
    """(n, n)."""
    C: Float[Array, "..."]
    """(m, n)."""

    def move(self, x: Float[Array, " n"], inputs: None = None) -> Float[Array, " n"]:
        """Where a state goes, without noise."""
        del inputs
        return self.A @ x + 0.05 * jnp.sin(x)

    def observe(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """What is read, without noise."""
        linear = self.C @ x
        return linear + 0.1 * jnp.tanh(linear)


@pytree_dataclass
class Ranging:
    """A point in space with a steady velocity, and its distances to three beacons."""

    beacons: Float[Array, "..."]
    """(3, 3), metres."""

    def move(self, x: Float[Array, "6"], inputs: None = None) -> Float[Array, "6"]:
        """A tenth of a second later."""
        del inputs
        return x + 0.1 * jnp.concatenate([x[3:], jnp.zeros(3)])

    def observe(self, x: Float[Array, "6"]) -> Float[Array, "3"]:
        """Metres to the beacons."""
        return jnp.sqrt(jnp.sum((self.beacons - x[:3]) ** 2, axis=1))


class Problem(NamedTuple):
    """A model, how noisy it is, and readings simulated with it."""

    model: Coupled | Ranging
    process_variance: float
    reading_variance: float
    start: Gaussian
    readings: Float[Array, "..."]
    """(t, m), or (t, m, b) for b sequences."""


def coupled(seed: int, num_states: int = 30, num_readings: int = 20, num_steps: int = 500) -> Problem:
    """One long sequence of a large state."""
    rng = np.random.default_rng(seed)
    A = 0.98 * np.linalg.qr(rng.normal(size=(num_states, num_states)))[0]
    C = rng.normal(size=(num_readings, num_states)) / np.sqrt(num_states)
    start = Gaussian(jnp.zeros(num_states), jnp.eye(num_states))
    problem = Problem(Coupled(jnp.asarray(A, float), jnp.asarray(C, float)), 0.1, 0.2, start, jnp.zeros(()))
    return problem._replace(readings=_simulate(rng, problem, num_steps, 1)[..., 0])


def ranging(seed: int, num_sequences: int = 1000, num_steps: int = 100) -> Problem:
    """Many short sequences of a small state, the sequences on the last axis."""
    rng = np.random.default_rng(seed)
    beacons = jnp.array([[30.0, 0.0, 5.0], [0.0, 35.0, 0.0], [-25.0, -15.0, 20.0]])
    problem = Problem(Ranging(beacons), 0.01, 0.04, Gaussian(jnp.zeros(6), 0.25 * jnp.eye(6)), jnp.zeros(()))
    return problem._replace(readings=_simulate(rng, problem, num_steps, num_sequences))


def _simulate(rng, problem, num_steps, num_sequences):
    size = problem.start.mean.size
    x = np.sqrt(np.diagonal(problem.start.covariance))[:, None] * rng.normal(size=(size, num_sequences))
    move, observe = (jax.jit(jax.vmap(f, -1, -1)) for f in (problem.model.move, problem.model.observe))
    readings = []
    for _ in range(num_steps):
        x = np.asarray(move(jnp.asarray(x, float)))
        x = x + np.sqrt(problem.process_variance) * rng.normal(size=x.shape)
        y = np.asarray(observe(jnp.asarray(x, float)))
        readings.append(y + np.sqrt(problem.reading_variance) * rng.normal(size=y.shape))
    return jnp.asarray(np.array(readings), float)


def build(problem: Problem, model: Coupled | Ranging, arithmetic: Arithmetic) -> Filter:
    """This library's extended filter of the problem, with that model."""
    mean, covariance = problem.start.mean, problem.start.covariance
    noises = [
        variance * jnp.eye(size)
        for variance, size in (
            (problem.process_variance, mean.size),
            (problem.reading_variance, problem.readings.shape[1]),
        )
    ]
    if arithmetic is square_root:
        prior = GaussianRoot(mean, jnp.sqrt(covariance))
        roots = [jnp.sqrt(noise) for noise in noises]
        return extended_kalman(prior, model.move, roots[0], model.observe, roots[1], arithmetic=arithmetic)
    return extended_kalman(
        Gaussian(mean, covariance), model.move, noises[0], model.observe, noises[1], arithmetic=arithmetic
    )
