"""The size of a hand and the noise of a depth camera estimated from stills, by gradient through the renderer.

First on rendered hands of known proportions, then on eight key poses of a real one (E. Remelli et al.,
"Low-dimensionality hand model calibration from monocular depth", ICCV 2017, its user 1). The real hand has no truth:
its proportions are estimated on half of the images, and judged on the other half by the error that remains when only
the poses may adapt, beside that of an average hand.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters import fit
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.cost import count_observed, union_cost
from jaxfilters.models.hand.observation import crop, isolate
from jaxfilters.models.hand.proportions import HandProportions, HandStills, StillsDensity, learn
from jaxfilters.models.hand.skeleton import (
    HandGeometry,
    forward_kinematics,
    hand_center,
    hand_geometry,
    open_palm,
    retract,
)
from jaxfilters.models.hand.start import find_starts
from jaxfilters.models.rendering.comparison import compare_capsules
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.trackers.hand_depth.detect import hand_sightings

TRUE = HandProportions(*(jnp.asarray(factor) for factor in (0.93, [0.95, 0.9, 0.92, 0.93, 1.0], 1.05)))
NOISE = 0.003
NUM_STILLS, NUM_HANDS = 4, 5
WINDOW, STRIDE = (64, 64), 3
SEARCH_WINDOW, SEARCH_STRIDE = (128, 128), 2
MAX_ERROR = 0.03
POSE_SPREAD = np.repeat([0.03, 0.3, 0.4], (3, 3, 15))
FREE = HandStills(HandProportions(fit.positive, fit.positive, fit.positive), fit.positive, fit.free)
POSES_ONLY = FREE._replace(proportions=fit.fixed)
ADAM = fit.adam(0.03, max_steps=400, patience=60)
QUICK_ADAM = fit.adam(0.05, max_steps=100, patience=30)


class Stills(NamedTuple):
    """Windows of depth images of one hand, and roughly where it is in them."""

    cameras: Pinhole
    observed: Float[Array, "f rows cols"]
    starts: Float[Array, "f 22"]

    def part(self, rows: slice) -> "Stills":
        """Some of the images."""
        return jax.tree.map(lambda leaf: leaf[rows], self)


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Learn, print what was estimated, and draw the real hand over its images."""
    method = QUICK_ADAM if quick else ADAM
    found = [learn_size(rendered(np.random.default_rng(seed + i)), method) for i in range(1 if quick else NUM_HANDS)]
    metrics = _errors([each.theta for each in found])
    try:
        folder = recording_folder("hadjust_user1_depth")
    except RecordingError as error:
        sys.stdout.write(f"real hand left out: {error}\n")
        return metrics
    real = recorded(folder / "user1.npz")
    real = real.part(slice(0, None, 4)) if quick else real
    return metrics | real_metrics(real, method, out)


def rendered(rng: np.random.Generator) -> Stills:
    """Rendered hands with the proportions `TRUE` in different poses, and poses some way off."""
    camera = Pinhole.from_intrinsics(287.0, (160.0, 120.0), (240, 320))
    hand = TRUE.of(hand_geometry())
    windows, starts = [], []
    for _ in range(NUM_STILLS):
        bent = np.abs(rng.normal(size=15)) * 0.3 * np.tile([1, 0.2, 1], 5)
        turned = np.concatenate([rng.normal(size=3) * 0.02, rng.normal(size=3) * 0.4, bent])
        pose = retract(open_palm(jnp.array([0.0, 0.05, 0.45])), jnp.asarray(turned, jnp.float32))
        depth = render_capsules(camera, forward_kinematics(pose, hand).capsules)
        noisy = depth + NOISE * jnp.asarray(rng.normal(size=depth.shape), jnp.float32)
        windows.append(crop(camera, noisy, hand_center(pose), WINDOW, STRIDE))
        off = rng.normal(size=21) * np.repeat([0.008, 0.1, 0.1], (3, 3, 15))
        starts.append(retract(pose, jnp.asarray(off, jnp.float32)))
    return _stills(windows, starts)


def recorded(path: Path) -> Stills:
    """The key poses of a recording, each with the pose that an average hand has there."""
    with np.load(path) as held:
        millimetres, is_hand, K = held["depth_mm"], held["mask"] > 0, held["K"]
    camera = Pinhole.from_matrix(K, millimetres.shape[1:])
    windows, starts = [], list[Array]()
    for frame, hand in zip(millimetres, is_hand, strict=True):
        depth = np.where(hand, np.where(frame > 0, frame / 1000, np.nan), np.inf).astype(np.float32)
        sightings = hand_sightings(camera, depth)
        if not sightings:
            raise ValueError(f"{path}: no hand in frame {len(starts)}.")
        center = jnp.asarray(sightings[0].center)
        nearby = crop(camera, jnp.asarray(sightings[0].frame), center, SEARCH_WINDOW, SEARCH_STRIDE)
        found = find_starts(*nearby, sightings[0].center, hand_geometry(), (1.0,), (1.0,))
        starts.append(jnp.asarray(found[0].pose))
        window, observed = crop(camera, jnp.asarray(depth), center, WINDOW, STRIDE)
        windows.append((window, isolate(window, observed, starts[-1])))
    return _stills(windows, starts)


def learn_size(stills: Stills, method: object) -> fit.Fit:
    """Proportions, noise and poses."""
    average = HandProportions(jnp.float32(1), jnp.ones(5), jnp.float32(1))
    theta = HandStills(average, jnp.float32(0.01), jnp.zeros((len(stills.starts), 21)))
    return learn(_density(stills), theta, FREE, method=method)


def pose_costs(stills: Stills, proportions: HandProportions, method: object) -> tuple[fit.Fit, Float[np.ndarray, " f"]]:
    """Poses of a hand whose proportions are known, and the depth error that remains in each image, metres."""
    theta = HandStills(proportions, jnp.float32(0.01), jnp.zeros((len(stills.starts), 21)))
    found = learn(_density(stills), theta, POSES_ONLY, method=method)
    poses = _poses(stills, found.theta)
    return found, np.asarray(_costs(stills, proportions.of(hand_geometry()), poses))


def real_metrics(stills: Stills, method: object, out: Path | None) -> dict[str, Metric]:
    """What the real hand's images say, and how well what one half says serves the other."""
    half = len(stills.starts) // 2
    found = learn_size(stills.part(slice(half)), method)
    average = HandProportions(jnp.float32(1), jnp.ones(5), jnp.float32(1))
    others = stills.part(slice(half, None))
    before = pose_costs(others, average, method)[1]
    fitted, after = pose_costs(others, found.theta.proportions, method)
    learned = found.theta
    sys.stdout.write(
        f"real hand: palm {learned.proportions.palm:.3f}, digits {np.round(learned.proportions.digits, 3)}, "
        f"thickness {learned.proportions.thickness:.3f} of an average hand; noise {1000 * learned.noise:.1f} mm\n"
        f"depth error in the other images, mm: average hand {np.round(1000 * before, 2)}, "
        f"this hand {np.round(1000 * after, 2)}\n"
    )
    if out is not None:
        _draw(out / "fit_hand.png", others, fitted.theta)
    return {
        "real_error_average_mm": Metric(1000 * float(before.mean()), "mm", "lower"),
        "real_error_fitted_mm": Metric(1000 * float(after.mean()), "mm", "lower"),
        "real_reduction_percent": Metric(100 * (1 - float(after.mean() / before.mean())), "%", "higher"),
        "real_noise_mm": Metric(1000 * float(learned.noise), "mm", "lower"),
    }


def _stills(windows: list, starts: list) -> Stills:
    cameras, observed = zip(*windows, strict=True)
    return Stills(jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras), jnp.stack(observed), jnp.stack(starts))


def _density(stills: Stills) -> StillsDensity:
    spread = jnp.asarray(POSE_SPREAD, jnp.float32)
    return StillsDensity(hand_geometry(), stills.cameras, stills.observed, stills.starts, spread)


def _poses(stills: Stills, theta: HandStills) -> Float[Array, "f 22"]:
    return jax.vmap(retract)(stills.starts, jnp.asarray(POSE_SPREAD, jnp.float32) * theta.steps)


@jax.jit
def _costs(stills: Stills, hand: HandGeometry, poses: Float[Array, "f 22"]) -> Float[Array, " f"]:
    """Mean depth error over rendered or observed pixels, metres, at most `MAX_ERROR` each."""

    def cost(inputs):
        camera, observed, pose = inputs
        terms = compare_capsules(camera, forward_kinematics(pose, hand).capsules, observed, MAX_ERROR)
        return union_cost(terms, count_observed(observed), MAX_ERROR)

    return jax.lax.map(cost, (stills.cameras, stills.observed, poses))


def _errors(found: list[HandStills]) -> dict[str, Metric]:
    """Of the proportions that are known, rms over hands."""

    def percent(name: str) -> Metric:
        ratios = [np.asarray(getattr(each.proportions, name)) / getattr(TRUE, name) - 1 for each in found]
        return Metric(100 * float(np.sqrt(np.mean(np.square(ratios)))), "%", "lower")

    noise = np.array([float(each.noise) for each in found])
    metrics = {f"rendered_{name}_error_percent": percent(name) for name in HandProportions._fields}
    return metrics | {
        "rendered_noise_error_percent": Metric(100 * float(np.abs(noise / NOISE - 1).mean()), "%", "lower")
    }


def _draw(path: Path, stills: Stills, theta: HandStills) -> None:
    """Observed depth above, the estimated hand as rendered below."""
    poses = _poses(stills, theta)
    hand = theta.proportions.of(hand_geometry())
    rendered_rows = []
    for i in range(len(poses)):
        camera = jax.tree.map(lambda leaf, i=i: leaf[i], stills.cameras)
        rendered_rows.append(np.asarray(render_capsules(camera, forward_kinematics(poses[i], hand).capsules)))
    visible = np.asarray(stills.observed)
    nearest = float(np.nanmin(visible))
    shades = np.concatenate([np.concatenate(list(row), axis=1) for row in (visible, np.stack(rendered_rows))])
    bright = np.where(np.isfinite(shades), np.clip(255 - 1000 * (shades - nearest), 60, 255), 0)
    picture = cv2.resize(bright.astype(np.uint8), None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    if not cv2.imwrite(str(path), picture):
        raise OSError(f"Cannot write {path}.")
