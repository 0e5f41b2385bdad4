"""The models on which particle filters are timed, and what they say about simulated readings."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.particle.rao_blackwell import MixedDynamics, rao_blackwell, rao_blackwell_shared
from jaxfilters.priors import from_noise
from jaxfilters.typing import AnyKey

DT = 0.1
POSE = 5


@pytree_dataclass
class Drift:
    """Five coordinates with steady velocities, and the distances of the first three to three beacons."""

    beacons: Float[Array, "..."]
    """(3, 3), metres."""
    spread: Float[Array, "..."]
    """(10,), standard deviations of a step."""
    reading_std: Float[Array, "..."]
    """Metres."""

    def sample_prior(self, key: AnyKey) -> Float[Array, "10"]:
        """A state before the first reading."""
        return self.start(jax.random.normal(key, (2 * POSE,)))

    def start(self, noise: Float[Array, "10"]) -> Float[Array, "10"]:
        """The same from standard normal numbers."""
        return 0.5 * noise

    def move(self, noise: Float[Array, "10"], x: Float[Array, "10"], inputs: None = None) -> Float[Array, "10"]:
        """A tenth of a second later."""
        del inputs
        return jnp.concatenate([x[:POSE] + DT * x[POSE:], x[POSE:]]) + self.spread * noise

    def observe(self, x: Float[Array, "10"]) -> Float[Array, "3"]:
        """Distances without noise."""
        return jnp.sqrt(jnp.sum((self.beacons - x[:3]) ** 2, axis=1))

    def log_likelihood(self, x: Float[Array, "10"], y: Float[Array, "3"]) -> Float[Array, ""]:
        """How likely the distances are."""
        error = (y - self.observe(x)) / self.reading_std
        return -0.5 * jnp.sum(error**2) - 3 * jnp.log(self.reading_std) - 1.5 * jnp.log(2 * jnp.pi)


class DriftProblem(NamedTuple):
    """Readings of a model."""

    model: Drift
    readings: Float[Array, "t 3"]


def drift(seed: int, num_steps: int) -> DriftProblem:
    """Readings simulated with the model."""
    rng = np.random.default_rng(seed)
    beacons = np.array([[30.0, 0.0, 5.0], [0.0, 35.0, 0.0], [-25.0, -15.0, 20.0]])
    spread, reading_std = np.repeat([0.05, 0.1], POSE), 0.3
    x, readings = 0.5 * rng.normal(size=2 * POSE), []
    for _ in range(num_steps):
        x = np.concatenate([x[:POSE] + DT * x[POSE:], x[POSE:]]) + spread * rng.normal(size=2 * POSE)
        readings.append(np.linalg.norm(beacons - x[:3], axis=1) + reading_std * rng.normal(size=3))
    model = Drift(*(jnp.asarray(value, float) for value in (beacons, spread, reading_std)))
    return DriftProblem(model, jnp.asarray(np.array(readings), float))


def plain(model: Drift, num_particles: int) -> Filter:
    """This library's particle filter of the model, resampling in every step; it draws all particles at once."""
    noise = StandardNormal(2 * POSE)
    return bootstrap(
        from_noise(model.start, noise),
        model.move,
        model.log_likelihood,
        num_particles=num_particles,
        noise=noise,
        ess_threshold=1.0,
    )


@pytree_dataclass
class Mixed:
    """A nonlinear state that a linear one drives, seen through an arctangent."""

    A_n: Float[Array, "..."]
    """(n, l)."""
    Q_n: Float[Array, "..."]
    """(n, n)."""
    A_l: Float[Array, "..."]
    """(l, l)."""
    Q_l: Float[Array, "..."]
    """(l, l)."""

    def sample_prior(self, key: AnyKey) -> Float[Array, " n"]:
        """A nonlinear state before the first reading."""
        return 0.5 * jax.random.normal(key, self.Q_n.shape[:1])

    def linear_prior(self) -> Gaussian:
        """What is known of the linear state then."""
        size = self.A_l.shape[0]
        return Gaussian(jnp.zeros(size), jnp.eye(size))

    def dynamics(self, x: Float[Array, " n"], inputs: None = None) -> MixedDynamics:
        """One step."""
        del inputs
        still = jnp.zeros(self.A_l.shape[0], x.dtype)
        return MixedDynamics(0.95 * x + 0.1 * jnp.sin(x), self.A_n, self.Q_n, still, self.A_l, self.Q_l)

    def log_likelihood(self, x: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, ""]:
        """How likely the readings are, whose standard deviation is 0.2."""
        error = (y - jnp.arctan(x)) / 0.2
        return -0.5 * jnp.sum(error**2) - x.size * (np.log(0.2) + 0.5 * np.log(2 * np.pi))


class MixedProblem(NamedTuple):
    """Readings of a mixed model."""

    model: Mixed
    readings: Float[Array, "t n"]


def mixed(seed: int, size: int, linear_size: int, num_steps: int) -> MixedProblem:
    """Readings simulated with the model."""
    rng = np.random.default_rng(seed)
    A_n = 0.3 * rng.normal(size=(size, linear_size))
    A_l = 0.95 * np.linalg.qr(rng.normal(size=(linear_size, linear_size)))[0]
    q_n, q_l = 0.05, 0.1
    x, linear, readings = 0.5 * rng.normal(size=size), rng.normal(size=linear_size), []
    for _ in range(num_steps):
        drift = 0.95 * x + 0.1 * np.sin(x)
        x = drift + A_n @ linear + np.sqrt(q_n) * rng.normal(size=size)
        linear = A_l @ linear + np.sqrt(q_l) * rng.normal(size=linear_size)
        readings.append(np.arctan(x) + 0.2 * rng.normal(size=size))
    matrices = (A_n, q_n * np.eye(size), A_l, q_l * np.eye(linear_size))
    return MixedProblem(Mixed(*(jnp.asarray(M, float) for M in matrices)), jnp.asarray(np.array(readings), float))


def marginalised(model: Mixed, num_particles: int, *, shared: bool) -> Filter:
    """This library's Rao-Blackwellized filter of the model, resampling in every step."""
    build = rao_blackwell_shared if shared else rao_blackwell
    return build(
        model.sample_prior,
        model.linear_prior(),
        model.dynamics,
        model.log_likelihood,
        num_particles=num_particles,
        noise_dim=model.Q_n.shape[0],
        ess_threshold=1.0,
    )
