"""How good a start from five frames is, by how widely the heads in them are turned."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios._mono_runs import DETECTED_PX, camera
from jaxfilters.benchmarks.scenarios._poses import DISPLAY
from jaxfilters.models.face.bundle import Bundle, projected
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Person, Prior
from jaxfilters.models.synthetic.face_motion import MONOCULAR_PLACE_MM
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.start import initialise
from jaxfilters.trackers.head.mono.state import NUM_FRAMES, prior_of

SPREADS = (0.1, 0.5, 1.0, 2.0)
TURNED_DEG = (3.0, 12.0, 7.0)
"""Standard deviations of roll, yaw and pitch at a spread of 1."""
MOVED_MM = (10.0, 10.0, 20.0)


def start_metrics(face: MultilinearFace, seed: int, starts: int) -> dict[str, Metric]:
    """Errors of the pose and of the reprojection over many people whom the model can form, with and without priors."""
    rig, rng = camera(), np.random.default_rng(seed)
    priors = {"": prior_of(MonoConfig()), "_free": Prior(0.0, 0.0)}
    metrics: dict[str, Metric] = {}
    for spread in SPREADS:
        found: dict[str, list] = {suffix: [] for suffix in priors}
        for _ in range(starts):
            true = _random_heads(face, spread, rng)
            points = np.asarray(projected(face, rig, true)) + rng.normal(0, DETECTED_PX, (NUM_FRAMES, 10, 2))
            for suffix, prior in priors.items():
                held = jax.tree.map(jnp.asarray, prior)
                start = initialise(face, rig, jnp.asarray(points, float), held)
                errors = np.abs(np.asarray(start.bundle.poses - true.poses)) * DISPLAY
                found[suffix].append([*errors.mean(axis=0), float(start.adjustment.reprojection_px)])
        for suffix, rows in found.items():
            x, y, z, roll, yaw, pitch, px = np.median(rows, axis=0)
            name = f"start{suffix}_spread_{spread:g}"
            metrics |= {
                f"{name}_z": Metric(float(z), "mm", "lower"),
                f"{name}_pitch": Metric(float(pitch), "deg", "lower"),
                f"{name}_yaw": Metric(float(yaw), "deg", "lower"),
                f"{name}_reprojection": Metric(float(px), "px", "lower"),
            }
            del x, y, roll
    return metrics


def _random_heads(face: MultilinearFace, spread: float, rng: np.random.Generator) -> Bundle:
    within = lambda mean, std, *shape: mean + std * rng.uniform(-1, 1, (*shape, len(mean)))
    turned = np.radians(np.array(TURNED_DEG)) * spread * rng.normal(size=(NUM_FRAMES, 3))
    moved = np.array(MONOCULAR_PLACE_MM) + np.array(MOVED_MM) * rng.normal(size=(NUM_FRAMES, 3))
    expressions = within(np.asarray(face.expression_mean), np.asarray(face.expression_std), NUM_FRAMES)
    identity = within(np.asarray(face.identity_mean), np.asarray(face.identity_std))
    person = Person(jnp.asarray(identity, float), jnp.zeros_like(face.mean))
    return Bundle(jnp.asarray(np.concatenate([moved, turned], axis=1), float), jnp.asarray(expressions, float), person)
