"""Where adaptive diffusion and halfway partitioned sampling help: targets that rest and jerk, observed through noise.

Two problems with known truth and Gaussian noise. A pose of six coordinates rests for a second, jerks in a third of
one, and rests again. Particle filters with a fixed small and a fixed large diffusion, with `A = I, b = 1` (`adaptive`),
and with the regression updated while tracking (`online`): `error_rest` and `error_jerk` are root mean square errors in
standard deviations of the noise, `worst_error` is the largest such error of any frame.

Then eleven coordinates, the pose and five deformations that the observation confounds with it: one stage against two
(`halfway`, and with the observation counted once, `halfway_once`) at the same number of likelihood evaluations.
`coverage_error` is how far the share of true values within two standard deviations of the particles is from 95.4 %.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxfilters import weights
from jaxfilters.benchmarks.metrics import Metric, table
from jaxfilters.filter import Filter
from jaxfilters.filter import run as run_filter
from jaxfilters.math import diffusion
from jaxfilters.particle.adaptive import AdaptiveDiffusionState, adaptive_diffusion
from jaxfilters.particle.partitioned import Partitions, consecutive, corrected
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.typing import AnyKey

POSE, DEFORMATION = 6, 5
NOISE = np.array([2.0, 2.0, 6.0, 1.0, 3.0, 3.0] + [2.0] * DEFORMATION)
"""Standard deviations in millimetres and degrees."""
JERK = np.array([40.0, 20.0, 50.0, 8.0, 20.0, 13.0])
"""Standard deviations of the way from one rest to the next."""
SMALL, LARGE = 1.0, 5.0
"""Fixed diffusions, millimetres or degrees per frame."""
LOW, HIGH = np.repeat([0.3, 0.1], 3), np.repeat([40.0, 15.0], 3)
STEADY = 1.0
"""Millimetres by which a filter lets each deformation change in a frame."""
NUM_FRAMES = 300
NUM_PARTICLES, NUM_SEEDS = 1000, 40
QUICK_NUM_SEEDS = 20
SETTLED = 20
"""Frames before errors count."""


class Sequence(NamedTuple):
    """Runs of one problem; the first axis is that of the seeds."""

    truth: Float[Array, "s t d"]
    observed: Float[Array, "s t d"]
    moving: np.ndarray
    """(s, t), whether the pose is between two rests."""


class Belief(NamedTuple):
    """What a filter estimates in every frame."""

    estimate: Float[Array, "s t d"]
    std: Float[Array, "s t d"]


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Numbers of every filter; a folder receives them as a table."""
    num_seeds = QUICK_NUM_SEEDS if quick else NUM_SEEDS
    keys = jax.random.split(jax.random.key(seed), num_seeds)
    pose, face = (simulate(seed, num_seeds, size) for size in (POSE, POSE + DEFORMATION))
    metrics: dict[str, Metric] = {}
    for name, filter in pose_filters().items():
        metrics |= pose_metrics(name, pose, follow(filter, keys, pose.observed))
    for name, filter in face_filters().items():
        metrics |= face_metrics(name, face, follow(filter, keys, face.observed))
    if out is not None:
        settings = f"{num_seeds} seeds, {NUM_FRAMES} frames, {NUM_PARTICLES} likelihoods a frame"
        (out / "adaptive.txt").write_text(f"{settings}\n{table(metrics)}\n")
    return metrics


def simulate(seed: int, num_seeds: int, size: int) -> Sequence:
    """Targets of `size` coordinates, the pose first, and noisy observations of them."""
    rng = np.random.default_rng(seed)
    runs = [_journey(rng) for _ in range(num_seeds)]
    pose, moving = (np.stack(parts) for parts in zip(*runs, strict=True))
    phase, rate = rng.uniform(0, 2 * np.pi, (num_seeds, 1, DEFORMATION)), rng.uniform(0.02, 0.08, (1, 1, DEFORMATION))
    deformation = 4 * np.sin(phase + rate * np.arange(NUM_FRAMES)[:, None])
    truth = np.concatenate([pose, deformation], axis=-1)[..., :size]
    observed = truth @ _observation(size).T + NOISE[:size] * rng.normal(size=truth.shape)
    return Sequence(jnp.asarray(truth, dtype=float), jnp.asarray(observed, dtype=float), moving)


def _journey(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(t, 6) positions, and when they change: rests, and ways of least jerk between them (Flash and Hogan 1985)."""
    path: list[np.ndarray] = []
    moving: list[bool] = []
    place = np.zeros(POSE)
    while len(path) < NUM_FRAMES:
        rest, length = rng.integers(20, 50), rng.integers(8, 14)
        s = np.arange(1, length + 1)[:, None] / length
        way = place + (10 * s**3 - 15 * s**4 + 6 * s**5) * JERK * rng.normal(size=POSE)
        path += [place] * rest + list(way)
        moving += [False] * rest + [True] * length
        place = way[-1]
    return np.array(path[:NUM_FRAMES]), np.array(moving[:NUM_FRAMES])


def _observation(size: int) -> np.ndarray:
    """(d, d): each deformation also shows half in one coordinate of the pose."""
    H = np.eye(size)
    deformations = np.arange(POSE, size)
    H[deformations - POSE, deformations] = 0.5
    return H


def pose_filters(num_particles: int = NUM_PARTICLES) -> dict[str, Filter]:
    """The filters of the first problem by name."""
    ones, keep = jnp.ones(POSE), diffusion.fixed
    build = partial(_filter, num_particles=num_particles)
    return {
        "fixed_small": build(diffusion.start(SMALL * ones, slope=0.0), update_fit=keep),
        "fixed_large": build(diffusion.start(LARGE * ones, slope=0.0), update_fit=keep),
        "adaptive": build(diffusion.start(ones), update_fit=keep),
        "online": build(diffusion.start(ones)),
    }


def face_filters(num_particles: int = NUM_PARTICLES) -> dict[str, Filter]:
    """The filters of the second problem by name; two stages have half of the particles."""
    build = partial(_filter, diffusion.start(jnp.ones(POSE)), size=POSE + DEFORMATION)
    groups = consecutive(POSE, DEFORMATION)
    return {
        "one_stage": build(num_particles=num_particles),
        "halfway": build(num_particles=num_particles // 2, partitions=Partitions(groups)),
        "halfway_once": build(num_particles=num_particles // 2, partitions=Partitions(groups, stage_weights=corrected)),
    }


def _filter(fit: diffusion.DiffusionFit, *, size: int = POSE, **options: Any) -> Filter:
    return adaptive_diffusion(
        _sample_pose if size == POSE else _sample_face,
        _log_likelihood,
        fit,
        mode_scale=jnp.concatenate([jnp.full(POSE, 5.0), jnp.full(size - POSE, 2 * STEADY)]),
        steady_std=jnp.full(size - POSE, STEADY),
        low=jnp.asarray(LOW, dtype=float),
        high=jnp.asarray(HIGH, dtype=float),
        **options,
    )


def _sample_pose(key: AnyKey) -> Array:
    return 2 * jax.random.normal(key, (POSE,))


def _sample_face(key: AnyKey) -> Array:
    return 2 * jax.random.normal(key, (POSE + DEFORMATION,))


def _log_likelihood(particles: Array, y: Array) -> Array:
    size = particles.shape[0]
    predicted = jnp.matmul(_observation(size), particles, precision="highest")
    error = (y[:, None] - predicted) / NOISE[:size, None]
    return -0.5 * jnp.sum(jnp.square(error), axis=0)


@jax.jit
def follow(filter: Filter, keys: Key[Array, " s"], observed: Float[Array, "s t d"]) -> Belief:
    """What a filter believes in every run."""
    return jax.vmap(lambda key, ys: run_filter(filter, key, ys, collect=_belief)[1])(keys, observed)


def _belief(state: AdaptiveDiffusionState, info: ParticleInfo) -> Belief:
    del info
    spread = jnp.diagonal(weights.covariance(state.particles, state.log_weights))
    return Belief(state.estimate, jnp.sqrt(jnp.maximum(spread, 0)))


def pose_metrics(name: str, sequence: Sequence, belief: Belief) -> dict[str, Metric]:
    """Errors at rest, in motion and at worst of one filter."""
    square = np.square(_scaled_error(sequence, belief))[:, SETTLED:].mean(-1)
    moving = sequence.moving[:, SETTLED:]
    return {
        f"error_rest_{name}": Metric(_root_mean(square[~moving]), "noise std", "lower"),
        f"error_jerk_{name}": Metric(_root_mean(square[moving]), "noise std", "lower"),
        f"worst_error_{name}": Metric(float(np.sqrt(square.max())), "noise std", "lower"),
    }


def face_metrics(name: str, sequence: Sequence, belief: Belief) -> dict[str, Metric]:
    """Errors of pose and deformation of one filter, and how wrong its spread is."""
    error = _scaled_error(sequence, belief)
    within = np.abs(error) * NOISE[: error.shape[-1]] <= 2 * np.asarray(belief.std)
    square, coverage = np.square(error[:, SETTLED:]), float(within[:, SETTLED:].mean())
    return {
        f"error_pose_{name}": Metric(_root_mean(square[..., :POSE]), "noise std", "lower"),
        f"error_deformation_{name}": Metric(_root_mean(square[..., POSE:]), "noise std", "lower"),
        f"coverage_error_{name}": Metric(abs(coverage - 0.954), "", "lower"),
    }


def _scaled_error(sequence: Sequence, belief: Belief) -> np.ndarray:
    error = np.asarray(belief.estimate) - np.asarray(sequence.truth)
    return error / NOISE[: error.shape[-1]]


def _root_mean(square: np.ndarray) -> float:
    return float(np.sqrt(square.mean()))
