"""Gradients of a particle filter's log evidence where the true one is known: bias, noise and cost of each way.

A point in one dimension with damped velocity, its position observed, 50 frames; the parameters are the damping rate,
and the logarithms of the noise of the motion and of the observation. Every way to pass derivatives through resampling
is run with many random keys, resampling below half of the effective sample size, and its gradients are compared with
that of the Kalman filter. `bias` and `spread` are lengths of vectors relative to the true gradient's: of the mean
difference, and of the standard deviations. `time` is one log evidence with its gradient.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.timing import interleaved
from jaxfilters.filter import Filter, log_evidence
from jaxfilters.gaussian.arithmetic import joseph
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Resampled, soft, transport
from jaxfilters.particle.resampling import systematic
from jaxfilters.typing import AnyKey, ResamplingScheme

DT, NUM_FRAMES = 0.1, 50
TRUTH = (0.5, 0.0, -1.5)
"""Damping rate per second, log of the root of the motion's power, log of the standard deviation of a reading."""
AT = (0.8, -0.3, -1.2)
"""Where gradients are taken: away from the truth, as on the way to it."""
SIZES = {25: 400, 100: 400, 400: 200}
"""Runs by number of particles."""
QUICK_SIZES = {25: 8}
MOST_TRANSPORTED, TRANSPORTED_SHARE = 100, 0.25
"""Particles and share of the runs of transport, which otherwise takes minutes."""
CHUNK = 20
"""Runs at once."""


@dataclass(frozen=True)
class Cut:
    """Plain resampling that drops the derivative of the weights: what is often written, and wrong."""

    def resample(self, key: AnyKey, particles: PyTree, log_weights: Float[Array, " n"]) -> Resampled:
        """The chosen particles with equal weights."""
        ancestors = systematic(key, jax.lax.stop_gradient(log_weights))
        chosen = jax.tree.map(lambda leaf: leaf[..., ancestors], particles)
        return Resampled(chosen, jnp.full_like(log_weights, -np.log(log_weights.size)), ancestors)


WAYS: dict[str, ResamplingScheme | EnsembleScheme] = {
    "cut": Cut(),
    "stop_gradient": systematic,
    "soft_0.9": soft(0.9),
    "soft_0.5": soft(0.5),
    "transport_0.5": transport(0.5),
    "transport_0.1": transport(0.1),
    "transport_0.02": transport(0.02),
}


@pytree_dataclass
class Damped:
    """The model: parameters as one vector, so that its gradient is one."""

    theta: Float[Array, "3"]

    def transition(self, x: Float[Array, "2"]) -> Float[Array, "2"]:
        """Where position and velocity go without noise."""
        return jnp.stack([x[0] + DT * x[1], (1 - DT * self.theta[0]) * x[1]])

    def spread(self) -> Float[Array, "2"]:
        """Standard deviations of the noise of one step."""
        return jnp.exp(self.theta[1]) * jnp.array([0.1, 1.0]) * np.sqrt(DT)

    def move(self, noise: Float[Array, "2"], x: Float[Array, "2"], inputs: PyTree) -> Float[Array, "2"]:
        """One step with noise."""
        del inputs
        return self.transition(x) + self.spread() * noise

    def log_likelihood(self, x: Float[Array, "2"], y: Float[Array, ""]) -> Float[Array, ""]:
        """Of a reading of the position."""
        return norm.logpdf(y, x[0], jnp.exp(self.theta[2]))


class Row(NamedTuple):
    """One way with one number of particles."""

    bias: float
    spread: float
    milliseconds: float


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Print the table, and return its numbers."""
    ys, theta = simulate(seed), jnp.asarray(AT)
    exact = np.asarray(jax.jit(jax.grad(exact_log_evidence))(theta, ys))
    rows = {}
    for num_particles, num_runs in (QUICK_SIZES if quick else SIZES).items():
        for name, scheme in WAYS.items():
            transports = name.startswith("transport")
            if transports and num_particles > MOST_TRANSPORTED:
                continue
            count = max(2, int(num_runs * TRANSPORTED_SHARE)) if transports else num_runs
            rows[name, num_particles] = measure(scheme, theta, ys, num_particles, count, exact, seed)
    text = _table(rows, exact)
    sys.stdout.write(text)
    if out is not None:
        (out / "particle_gradients.txt").write_text(text)
    return _metrics(rows)


def simulate(seed: int) -> Float[Array, " t"]:
    """Readings of the position."""
    rng = np.random.default_rng(seed)
    model = Damped(jnp.asarray(TRUTH))
    spread, x, ys = np.asarray(model.spread()), rng.normal(size=2), []
    for _ in range(NUM_FRAMES):
        x = np.array([x[0] + DT * x[1], (1 - DT * TRUTH[0]) * x[1]]) + spread * rng.normal(size=2)
        ys.append(x[0] + np.exp(TRUTH[2]) * rng.normal())
    return jnp.asarray(ys, dtype=float)


def exact_log_evidence(theta: Float[Array, "3"], ys: Float[Array, " t"]) -> Float[Array, ""]:
    """Of the Kalman filter."""
    model = Damped(theta)
    F, Q = jax.jacfwd(model.transition)(jnp.zeros(2)), jnp.diag(model.spread() ** 2)
    R = jnp.exp(2 * theta[2]) * jnp.eye(1)

    def advance(belief: Gaussian, y: Array) -> tuple[Gaussian, Array]:
        belief, info = joseph.update(joseph.predict(belief, F, Q), y[None], jnp.array([[1.0, 0.0]]), R)
        return belief, info.log_evidence

    return jnp.sum(jax.lax.scan(advance, Gaussian(jnp.zeros(2), jnp.eye(2)), ys)[1])


def filter_of(theta: Float[Array, "3"], num_particles: int, scheme: ResamplingScheme | EnsembleScheme) -> Filter:
    """A bootstrap filter of the model."""
    model = Damped(theta)
    noise = StandardNormal(2)
    return bootstrap(
        _sample_prior, model.move, model.log_likelihood, num_particles=num_particles, noise=noise, scheme=scheme
    )


def _sample_prior(key: AnyKey) -> Array:
    return jax.random.normal(key, (2,))


def gradients(
    scheme: ResamplingScheme | EnsembleScheme, num_particles: int
) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
    """`(theta, ys, keys) -> (log evidences, gradients)`, compiled."""

    def of_parameters(key: AnyKey, theta: Array, ys: Array) -> Array:
        return log_evidence(filter_of(theta, num_particles, scheme), key, ys)

    @jax.jit
    def evaluate(theta: Array, ys: Array, keys: Array) -> tuple[Array, Array]:
        both = jax.value_and_grad(of_parameters, 1)
        return jax.lax.map(lambda key: both(key, theta, ys), keys, batch_size=CHUNK)

    return evaluate


def measure(
    scheme: ResamplingScheme | EnsembleScheme,
    theta: Float[Array, "3"],
    ys: Float[Array, " t"],
    num_particles: int,
    num_runs: int,
    exact: np.ndarray,
    seed: int,
) -> Row:
    """Bias and spread over many keys, and the time of one."""
    evaluate = gradients(scheme, num_particles)
    keys = jax.random.split(jax.random.key(seed), num_runs)
    found = np.asarray(evaluate(theta, ys, keys)[1], dtype=np.float64)
    seconds = interleaved({"one": lambda: evaluate(theta, ys, keys[:1])}, 5)["one"]
    return row(found, exact, 1e3 * seconds)


def row(found: np.ndarray, exact: np.ndarray, milliseconds: float) -> Row:
    """Of gradients `(runs, d)` against the exact one."""
    scale = np.linalg.norm(exact)
    bias, spread = found.mean(axis=0) - exact, found.std(axis=0, ddof=1)
    return Row(float(np.linalg.norm(bias) / scale), float(np.linalg.norm(spread) / scale), float(milliseconds))


def _metrics(rows: dict[tuple[str, int], Row]) -> dict[str, Metric]:
    metrics = {}
    for (name, size), found in rows.items():
        metrics[f"bias_{name}_n{size}"] = Metric(found.bias, "", "lower")
        metrics[f"spread_{name}_n{size}"] = Metric(found.spread, "", "lower")
        metrics[f"time_{name}_n{size}"] = Metric(found.milliseconds, "ms", "lower")
    return metrics


def _table(rows: dict[tuple[str, int], Row], exact: np.ndarray) -> str:
    lines = [
        f"exact gradient {np.array2string(exact, precision=3)}",
        f"{'way':16}{'N':>6}{'bias':>10}{'spread':>10}{'ms':>10}",
    ]
    lines += [
        f"{name:16}{size:6}{found.bias:10.3f}{found.spread:10.3f}{found.milliseconds:10.2f}"
        for (name, size), found in rows.items()
    ]
    return "\n".join(lines) + "\n"
