"""Process and sensor noise of a keypoint tracker estimated from what networks say, without truth, on real hands.

NYU hand poses (J. Tompson et al., "Real-time continuous pose recovery of human hands", 2014) as eight networks saw
them. Noises are estimated on the first half of the frames; the other half is filtered and smoothed with them, and
compared with the truth. `jitter_ratio` is the estimated sensor noise over that part of a network's error that changes
from frame to frame: 1 where the noises are separated well. Most of a network's error is the same in neighbouring
frames, which no filter without a model of hands can remove.
"""

import sys
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import recording_folder
from jaxfilters.models.moving_points import PointNoise, Tracks, learn, positions, tracks_of
from jaxfilters.trackers.app.chart import Curve, draw_chart

NOMINAL = PointNoise(jnp.float32(10.0), jnp.float32(100.0))
"""A centimetre, and a decimetre a second after a second: round numbers of millimetres."""
FPS = 30
QUICK_NETWORKS = 2
_COLORS = {"true": (60, 60, 60), "network": (40, 120, 230), "smoothed": (200, 110, 30)}


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Learn the noises of each network, filter with them, print and draw."""
    del seed  # Nothing is drawn.
    with np.load(recording_folder("handpose_tracks") / "nyu_person1.npz") as held:
        K, truth = held["K"], _points(held["gt_uvd"], held["K"])
        observed = {name: _points(held[name], K) for name in sorted(held) if name not in ("K", "gt_uvd")}
    names = list(observed)[: QUICK_NETWORKS if quick else None]
    rows = np.array([_row(name, observed[name], truth, out if i == 0 else None) for i, name in enumerate(names)])
    raw, filtered, smoothed, nominal, jitter = rows.mean(axis=0)
    return {
        "networks": Metric(float(len(names)), "", "higher"),
        "error_raw_mm": Metric(float(raw), "mm", "lower"),
        "error_filtered_mm": Metric(float(filtered), "mm", "lower"),
        "error_smoothed_mm": Metric(float(smoothed), "mm", "lower"),
        "error_filtered_nominal_mm": Metric(float(nominal), "mm", "lower"),
        "reduction_smoothed_percent": Metric(float(100 * (1 - smoothed / raw)), "%", "higher"),
        "jitter_ratio": Metric(float(jitter), "", 1.0),
    }


def _points(uvd: np.ndarray, K: np.ndarray) -> np.ndarray:
    """(frames, joints, 3) millimetres."""
    u, v, depth = np.moveaxis(uvd.astype(float), -1, 0)
    return np.stack([(u - K[0, 2]) * depth / K[0, 0], (v - K[1, 2]) * depth / K[1, 1], depth], axis=-1)


def _row(name: str, observed: np.ndarray, truth: np.ndarray, out: Path | None) -> list[float]:
    """Errors of a network, filtered, smoothed, and filtered with round numbers, mm; ratio of the jitters."""
    half = len(observed) // 2
    times = np.arange(len(observed)) / FPS
    noise = learn(tracks_of(observed[:half], times[:half])[0]).theta
    tracks, means = tracks_of(observed[half:], times[half:])
    found, round_numbers = positions(tracks, noise), positions(tracks, NOMINAL)
    raw, filtered, smoothed, nominal = (
        _error(places, means, truth[half:])
        for places in (_places(tracks), found.filtered, found.smoothed, round_numbers.filtered)
    )
    error = np.diff((observed - truth)[:half], axis=0)
    # Of independent errors the difference has twice the variance.
    true_jitter = np.sqrt(np.mean(error**2) / 2)
    ratio = float(noise.sensor) / true_jitter
    sys.stdout.write(
        f"{name:26} sensor {float(noise.sensor):.2f} mm, drive {float(noise.drive):.0f} mm/s after 1 s; "
        f"error {raw:.2f} -> {filtered:.2f} filtered, {smoothed:.2f} smoothed, {nominal:.2f} with round numbers\n"
    )
    if out is not None:
        _draw(out / "fit_noise.png", observed[half:], truth[half:], np.asarray(found.smoothed) + means)
    return [raw, filtered, smoothed, nominal, ratio]


def _places(tracks: Tracks) -> np.ndarray:
    return np.asarray(tracks.y)[:, 0]


def _error(places: np.ndarray, means: np.ndarray, truth: np.ndarray) -> float:
    points = (np.asarray(places) + means).reshape(truth.shape)
    return float(np.linalg.norm(points - truth, axis=-1).mean())


def _draw(path: Path, observed: np.ndarray, truth: np.ndarray, smoothed: np.ndarray) -> None:
    """One coordinate of a fingertip over five seconds."""
    shown = slice(0, 5 * FPS)
    tip = smoothed.reshape(truth.shape)
    curves = [
        Curve(name, points[shown, 0, 0], _COLORS[name])
        for name, points in (("true", truth), ("network", observed), ("smoothed", tip))
    ]
    seconds = np.arange(5 * FPS) / FPS
    chart = draw_chart((320, 900), "tip of the little finger, x in mm", seconds, curves, "s")
    if not cv2.imwrite(str(path), chart):
        raise OSError(f"Cannot write {path}.")
