"""Proposals of the Rao-Blackwellized filter where the truth is known: one coordinate, all linear and Gaussian.

The table of the specification, section 2.6 (its E5): pose and velocity of one coordinate, the pose observed, 150
frames; `exact`, `plug_in` and `plug_in_corrected` proposals and a plain filter on pose and velocity (`joint_pf`), each
against the joint Kalman filter, averaged over random keys. `rms` is the difference of the posterior means,
`variance_error` how far the ratio of the posterior variances is from 1, `log_evidence_gap` the difference in log
evidence.
"""

import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Key, PyTree

from jaxfilters import weights
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.filter import Filter
from jaxfilters.filter import run as run_filter
from jaxfilters.gaussian.arithmetic import joseph
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import ParticleState, bootstrap
from jaxfilters.particle.proposals import Proposal, exact, plug_in, plug_in_corrected
from jaxfilters.particle.rao_blackwell import MixedDynamics, RaoBlackwellState, rao_blackwell_shared
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.typing import AnyKey

DT, Q_N, Q_L, R = 1 / 30, 0.3, 40.0, 0.02
"""Seconds, and variances of a coordinate without a unit: per second, per second cubed, of one reading."""
PRIOR_POSE, PRIOR_VELOCITY = 0.5, 4.0
"""Variances."""
NUM_FRAMES = 150
NUM_PARTICLES, NUM_SEEDS = 5000, 8
QUICK_NUM_SEEDS = 2
PROPOSALS = (exact, plug_in, plug_in_corrected)


class Belief(NamedTuple):
    """About pose and velocity in every frame; for filters with a leading axis of seeds."""

    mean: Float[Array, "*s t 2"]
    variance: Float[Array, "*s t 2"]
    log_evidence: Float[Array, "*s t"]


class Row(NamedTuple):
    """One filter against the Kalman filter; pairs are pose and velocity."""

    rms: tuple[float, float]
    variance_ratio: tuple[float, float]
    log_evidence: float
    """Mean over the seeds."""
    log_evidence_std: float


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Print the table, and return its numbers."""
    observations = simulate(seed)
    truth = kalman_filter(observations)
    keys = jax.random.split(jax.random.key(seed), QUICK_NUM_SEEDS if quick else NUM_SEEDS)
    rows = {name: compare(particles(filter, keys, observations), truth) for name, filter in filters().items()}
    text = _table(rows, float(truth.log_evidence.sum()), len(keys))
    sys.stdout.write(text + "\n")
    if out is not None:
        (out / "linear_gaussian.txt").write_text(text)
    return _metrics(rows, float(truth.log_evidence.sum()))


def simulate(seed: int) -> Float[Array, " t"]:
    """Noisy positions of a point whose velocity walks at random."""
    rng = np.random.default_rng(seed)
    pose, velocity = np.sqrt([PRIOR_POSE, PRIOR_VELOCITY]) * rng.normal(size=2)
    observations = []
    for noise in rng.normal(size=(NUM_FRAMES, 3)):
        pose += DT * velocity + np.sqrt(DT * Q_N) * noise[0]
        velocity += np.sqrt(DT * Q_L) * noise[1]
        observations.append(pose + np.sqrt(R) * noise[2])
    return jnp.asarray(observations, dtype=float)


def kalman_filter(observations: Float[Array, " t"]) -> Belief:
    """The exact posterior."""
    F, H = jnp.array([[1, DT], [0, 1]]), jnp.array([[1.0, 0.0]])
    Q = jnp.diag(jnp.array([DT * Q_N, DT * Q_L]))

    def advance(belief: Gaussian, y: Array) -> tuple[Gaussian, Belief]:
        belief, info = joseph.update(joseph.predict(belief, F, Q), y[None], H, R * jnp.eye(1))
        return belief, Belief(belief.mean, jnp.diagonal(belief.covariance), info.log_evidence)

    prior = Gaussian(jnp.zeros(2), jnp.diag(jnp.array([PRIOR_POSE, PRIOR_VELOCITY])))
    return jax.lax.scan(advance, prior, observations)[1]


def filters(num_particles: int = NUM_PARTICLES) -> dict[str, Filter]:
    """The filters by name."""
    joint = bootstrap(
        _sample_joint_prior,
        _move_joint,
        _log_likelihood,
        num_particles=num_particles,
        noise=StandardNormal(2),
        ess_threshold=1.0,
    )
    return {p.__name__: _rao_blackwellized(p, num_particles) for p in PROPOSALS} | {"joint_pf": joint}


def _rao_blackwellized(proposal: Proposal, num_particles: int) -> Filter:
    return rao_blackwell_shared(
        _sample_pose_prior,
        Gaussian(jnp.zeros(1), PRIOR_VELOCITY * jnp.eye(1)),
        _dynamics,
        _log_likelihood,
        num_particles=num_particles,
        noise_dim=1,
        proposal=proposal,
        ess_threshold=1.0,
    )


def _sample_pose_prior(key: AnyKey) -> Array:
    return _sample_joint_prior(key)[:1]


def _dynamics(pose: Array, inputs: PyTree) -> MixedDynamics:
    del inputs
    one = jnp.ones((1, 1))
    return MixedDynamics(pose, DT * one, DT * Q_N * one, jnp.zeros(1), one, DT * Q_L * one)


def _sample_joint_prior(key: AnyKey) -> Array:
    return jnp.sqrt(jnp.array([PRIOR_POSE, PRIOR_VELOCITY])) * jax.random.normal(key, (2,))


def _move_joint(noise: Array, x: Array, inputs: PyTree) -> Array:
    del inputs
    drift = jnp.array([x[0] + DT * x[1], x[1]])
    return drift + jnp.sqrt(DT * jnp.array([Q_N, Q_L])) * noise


def _log_likelihood(x: Array, y: Array) -> Array:
    return norm.logpdf(y, x[0], np.sqrt(R))


@jax.jit
def particles(filter: Filter, keys: Key[Array, " s"], observations: Float[Array, " t"]) -> Belief:
    """What a filter believes, once for each key."""
    follow = partial(run_filter, collect=_belief)
    return jax.vmap(lambda key: follow(filter, key, observations)[1])(keys)


def _belief(state: RaoBlackwellState | ParticleState, info: ParticleInfo) -> Belief:
    both, within = state.particles, jnp.zeros(2)
    if isinstance(state, RaoBlackwellState):
        both = jnp.concatenate([state.particles, state.linear_mean])
        within = within.at[1].set(state.covariance[0, 0])
    variance = jnp.diagonal(weights.covariance(both, state.log_weights)) + within
    return Belief(weights.mean(both, state.log_weights), variance, info.log_evidence)


def compare(belief: Belief, truth: Belief) -> Row:
    """A filter's runs against the exact posterior."""
    rms = jnp.sqrt(jnp.mean((belief.mean - truth.mean) ** 2, axis=(0, 1)))
    ratio = jnp.mean(belief.variance / truth.variance, axis=(0, 1))
    evidence = np.asarray(belief.log_evidence.sum(-1))
    return Row(
        (float(rms[0]), float(rms[1])),
        (float(ratio[0]), float(ratio[1])),
        float(evidence.mean()),
        float(evidence.std(ddof=1)) if len(evidence) > 1 else float("nan"),
    )


def _metrics(rows: dict[str, Row], true_evidence: float) -> dict[str, Metric]:
    metrics = {}
    for name, row in rows.items():
        metrics[f"pose_rms_{name}"] = Metric(row.rms[0], "", "lower")
        metrics[f"velocity_rms_{name}"] = Metric(row.rms[1], "1/s", "lower")
        metrics[f"pose_variance_error_{name}"] = Metric(abs(row.variance_ratio[0] - 1), "", "lower")
        metrics[f"velocity_variance_error_{name}"] = Metric(abs(row.variance_ratio[1] - 1), "", "lower")
        metrics[f"log_evidence_gap_{name}"] = Metric(abs(row.log_evidence - true_evidence), "", "lower")
    return metrics


def _table(rows: dict[str, Row], true_evidence: float, num_seeds: int) -> str:
    lines = [
        f"N {NUM_PARTICLES}, {num_seeds} seeds, {NUM_FRAMES} frames; log evidence of the Kalman filter "
        f"{true_evidence:.3f}",
        f"{'filter':18}{'rms pose':>10}{'velocity':>10}{'variance ratio pose':>22}{'velocity':>10}{'log evidence':>18}",
    ]
    for name, row in rows.items():
        evidence = f"{row.log_evidence:.2f} +- {row.log_evidence_std:.2f}"
        lines.append(
            f"{name:18}{row.rms[0]:10.4f}{row.rms[1]:10.3f}{row.variance_ratio[0]:22.3f}"
            f"{row.variance_ratio[1]:10.3f}{evidence:>18}"
        )
    return "\n".join(lines) + "\n"
