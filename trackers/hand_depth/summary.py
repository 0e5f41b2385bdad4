"""One picture of a whole run: six frames with the skeleton, and its curves over time."""

from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

from jaxfilters.trackers.app.chart import Curve, draw_chart
from jaxfilters.trackers.app.video import caption
from jaxfilters.trackers.hand_depth.drawing import depth_range, draw_frame
from jaxfilters.trackers.hand_depth.recording import DepthSequence
from jaxfilters.trackers.hand_depth.table import TimedHandTrack
from jaxfilters.trackers.io.errors import OutputError

_COLUMNS, _ROWS = 3, 2
_TILE = 320
"""Pixels along one side of a frame in the montage."""
_CHART = (190, _COLUMNS * _TILE)
_AXIS_COLORS = ((70, 70, 215), (60, 150, 60), (205, 110, 40))
_INK = (90, 90, 90)


def joint_errors(sequence: DepthSequence, results: TimedHandTrack) -> np.ndarray | None:
    """(frames,) mean distance in metres between estimated and true joints, NaN for a frame without an estimate.

    None where no truth is known.
    """
    if sequence.joints is None:
        return None
    offsets = results.joints - sequence.joints[: len(results.times_s)]
    return np.linalg.norm(offsets, axis=-1).mean(axis=-1)


def mean_joint_error(sequence: DepthSequence, results: TimedHandTrack) -> float | None:
    """Metres, over the frames that have an estimate; None where there is no such frame or no truth is known."""
    errors = joint_errors(sequence, results)
    return None if errors is None or np.isnan(errors).all() else float(np.nanmean(errors))


def draw_summary(sequence: DepthSequence, results: TimedHandTrack) -> np.ndarray:
    """(rows, cols, 3) uint8: montage above; wrist with 2-sigma bands, ESS and, where known, the joint error below."""
    return np.concatenate([_montage(sequence, results), *_charts(sequence, results)])


def write_summary(path: Path, sequence: DepthSequence, results: TimedHandTrack) -> None:
    """Write `draw_summary` as a PNG image.

    Raises:
        OutputError: the image cannot be written.
    """
    if not cv2.imwrite(str(path), draw_summary(sequence, results)):
        raise OutputError(f"cannot write {path} (is the disk full?).")


def _montage(sequence: DepthSequence, results: TimedHandTrack) -> np.ndarray:
    count = len(results.times_s)
    indices = np.linspace(0, count - 1, _COLUMNS * _ROWS).round().astype(int)
    limits = depth_range(results.joints)
    side = _side(sequence, results)
    tiles = []
    for i in indices:
        tile = _crop(draw_frame(sequence, results, int(i), limits), sequence, results.joints[i], side)
        caption(tile, f"{results.times_s[i] - results.times_s[0]:.2f} s", 0)
        tiles.append(tile)
    rows = [np.concatenate(tiles[r * _COLUMNS : (r + 1) * _COLUMNS], axis=1) for r in range(_ROWS)]
    return np.concatenate(rows)


def _side(sequence: DepthSequence, results: TimedHandTrack) -> float:
    """Camera pixels along a square that holds the hand in nearly every frame."""
    points = np.asarray(sequence.camera.project(jnp.asarray(results.joints)))
    extents = (points.max(axis=1) - points.min(axis=1)).max(axis=-1)
    extents = extents[np.isfinite(extents)]
    widest = float(np.percentile(extents, 90)) * 1.5 if extents.size else np.inf
    return float(np.clip(widest, 32, min(sequence.camera.shape)))


def _crop(image: np.ndarray, sequence: DepthSequence, joints: np.ndarray, side: float) -> np.ndarray:
    scale = image.shape[0] / sequence.camera.shape[0]
    center = np.asarray(sequence.camera.project(jnp.asarray(joints))).mean(axis=0) * scale
    if not np.isfinite(center).all():
        center = np.asarray(image.shape[1::-1]) / 2
    pixels = round(side * scale)
    corner = np.clip(center - pixels / 2, 0, np.asarray(image.shape[1::-1]) - pixels).astype(int)
    square = image[corner[1] : corner[1] + pixels, corner[0] : corner[0] + pixels]
    shrinks = pixels > _TILE
    return cv2.resize(square, (_TILE, _TILE), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def _charts(sequence: DepthSequence, results: TimedHandTrack) -> list[np.ndarray]:
    times_s = results.times_s - results.times_s[0]
    errors = joint_errors(sequence, results)
    ess = Curve("", results.effective_sample_size, _INK)
    x_label = "time (s)"
    charts = [
        draw_chart(_CHART, "wrist from its median, mm, with 2 sigma", times_s, _wrist_curves(results)),
        draw_chart(_CHART, "effective sample size", times_s, [ess], x_label if errors is None else "", from_zero=True),
    ]
    if errors is not None:
        mean = mean_joint_error(sequence, results)
        value = "no estimate" if mean is None else f"{1000 * mean:.1f} mm"
        title = f"mean distance of the 21 joints from the truth: {value}"
        curve = Curve("", 1000 * errors, _AXIS_COLORS[0])
        charts.append(draw_chart(_CHART, title, times_s, [curve], x_label, from_zero=True))
    return charts


def _wrist_curves(results: TimedHandTrack) -> list[Curve]:
    wrist, spread = 1000 * results.pose[:, :3], 1000 * results.pose_std[:, :3]
    observed = wrist[np.isfinite(wrist).all(axis=-1)]
    middle = np.median(observed, axis=0) if len(observed) else np.zeros(3)
    return [
        Curve(f"{axis} from {middle[i]:.0f}", wrist[:, i] - middle[i], _AXIS_COLORS[i], 2 * spread[:, i])
        for i, axis in enumerate("xyz")
    ]
