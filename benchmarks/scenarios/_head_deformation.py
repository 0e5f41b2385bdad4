"""A face that deforms while the head moves: the registered rigid model beside the one that is estimated."""

import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np

from jaxfilters.benchmarks.metrics import WITHIN_TWO_SIGMA, Metric
from jaxfilters.benchmarks.scenarios._head_runs import (
    AXES,
    AXIS_UNITS,
    BLOCK,
    HeadRun,
    coverage,
    follow,
    lost_share,
    rmse,
)
from jaxfilters.models.synthetic.face_motion import deformation_schedule, motion
from jaxfilters.models.synthetic.face_sequence import face_sequence
from jaxfilters.trackers.app.chart import Curve, Shade, draw_chart
from jaxfilters.trackers.head.common.config import HeadConfig

AMPLITUDE, MILD_AMPLITUDE = 1.8, 1.0
CONTRIBUTION_FRAME = 600
SMOOTHED = 30
"""Frames over which the curves are averaged."""
COLORS = {
    "rigid": (40, 120, 230),
    "deformable": (200, 110, 30),
    "paper_rigid": (160, 200, 245),
    "paper_deformable": (235, 190, 140),
}
"""Blue, green, red."""
DEFORMING_COLOR = (240, 245, 240)


class Schedule(NamedTuple):
    """Frames: the face deforms from the first to the second, of as many as the third."""

    start: int
    stop: int
    num_frames: int

    @property
    def phases(self) -> dict[str, slice]:
        """Rows of a run, which begins with the second frame."""
        return {
            "deforming": slice(self.start - 1, self.stop - 1),
            "afterwards": slice(self.stop - 1, self.num_frames - 1),
        }

    @property
    def trackers(self) -> dict[str, HeadConfig]:
        """By name; deformations are estimated, and not yet used, until the face deforms."""
        return {
            "rigid": HeadConfig(learn=False),
            "deformable": HeadConfig(rigid_frames=self.start),
            "paper_rigid": HeadConfig(variant="published", learn=False),
            "paper_deformable": HeadConfig(variant="published", rigid_frames=self.start),
        }


def deformation_metrics(seeds: range, schedule: Schedule, out: Path | None) -> dict[str, Metric]:
    """Section 5.2; the expressions of the first face also at the amplitude at which they hardly hurt (`mild`)."""
    runs = deforming_runs(seeds, schedule, AMPLITUDE, schedule.trackers)
    metrics = evaluated("", runs, schedule)
    if out is not None:
        plot(out / "deformation.png", runs, schedule)
    modern = {name: schedule.trackers[name] for name in ("rigid", "deformable")}
    return metrics | evaluated("mild_", deforming_runs(seeds[:1], schedule, MILD_AMPLITUDE, modern), schedule)


def deforming_runs(
    seeds: range, schedule: Schedule, amplitude: float, trackers: dict[str, HeadConfig]
) -> dict[str, list[HeadRun]]:
    """Runs of every tracker over all faces."""
    runs: dict[str, list[HeadRun]] = {name: [] for name in trackers}
    expressions = deformation_schedule(schedule.num_frames, amplitude, start=schedule.start, stop=schedule.stop)
    for seed in seeds:
        poses = motion("mix", schedule.num_frames, seed)
        found = follow(face_sequence(jax.random.key(seed), poses, expressions=expressions), trackers)
        for name, one in found.items():
            runs[name].append(one)
            _say(f"  deformation {amplitude} {seed} {name:16} lost {lost_share(one):.3f}")
            for phase, frames in schedule.phases.items():
                _say(
                    f"    {phase:10} rmse {_row(rmse(one, frames))} shape {_mean(one.shape_errors[frames]):.3f} "
                    f"landmarks {_mean(one.landmark_errors[frames]):.3f} coverage {_row(coverage(one, frames))}"
                )
    return runs


def evaluated(prefix: str, runs: dict[str, list[HeadRun]], schedule: Schedule) -> dict[str, Metric]:
    """Errors of every tracker in both phases, and those of deformable models over those of rigid ones."""
    metrics: dict[str, Metric] = {}
    for phase, frames in schedule.phases.items():
        of_tracker = {name: np.mean([errors(one, frames) for one in each], axis=0) for name, each in runs.items()}
        for name, values in of_tracker.items():
            for what, value, unit in zip(_WHAT, values, _UNITS, strict=True):
                metrics[f"{prefix}{phase}_{what}_{name}"] = Metric(float(value), unit, "lower")
            covered = np.mean([coverage(one, frames) for one in runs[name]], axis=0)
            for axis, value in zip(AXES, covered, strict=True):
                metrics[f"{prefix}{phase}_coverage_2sigma_{axis}_{name}"] = Metric(float(value), "", WITHIN_TWO_SIGMA)
        for paper in ("", "paper_"):
            if f"{paper}deformable" in of_tracker:
                ratios = of_tracker[f"{paper}deformable"] / of_tracker[f"{paper}rigid"]
                for what, value in zip(_WHAT, ratios, strict=True):
                    name = f"{prefix}{phase}_ratio_to_rigid_{what}{'_paper' if paper else ''}"
                    metrics[name] = Metric(float(value), "", "lower")
    for name, each in runs.items():
        metrics[f"{prefix}lost_share_{name}"] = Metric(float(np.mean([lost_share(one) for one in each])), "", "lower")
        if name.endswith("deformable"):
            at = min(CONTRIBUTION_FRAME, schedule.stop) // BLOCK - 1
            shares = [one.contributions[at] for one in each]
            metrics[f"{prefix}contribution_{name}"] = Metric(float(np.mean(shares)), "", "higher")
            metrics[f"{prefix}least_contribution_{name}"] = Metric(float(np.min(shares)), "", "higher")
    return metrics


_WHAT = (*(f"rmse_{axis}" for axis in AXES), "shape", "landmark")
_UNITS = (*AXIS_UNITS, "mm", "mm")


def errors(one: HeadRun, frames: slice) -> np.ndarray:
    """(8,) of a run: pose, shape after alignment, and landmarks in the world."""
    return np.array([*rmse(one, frames), _mean(one.shape_errors[frames]), _mean(one.landmark_errors[frames])])


def plot(path: Path, runs: dict[str, list[HeadRun]], schedule: Schedule) -> None:
    """Errors over time, of all faces together."""
    frames = np.arange(1, schedule.num_frames)
    shades = [Shade(float(schedule.start), float(schedule.stop), DEFORMING_COLOR)]
    curves = {
        "pitch, deg": lambda one: one.errors[:, AXES.index("pitch")],
        "shape after alignment, mm": lambda one: one.shape_errors,
        "landmarks in the world, mm": lambda one: one.landmark_errors,
    }
    charts = []
    for title, values in curves.items():
        lines = [
            Curve(name.replace("_", ", "), _running([values(one) for one in each]), COLORS[name])
            for name, each in runs.items()
        ]
        charts.append(draw_chart((260, 900), title, frames, lines, from_zero=True, shades=shades))
    shares = [
        Curve(name.replace("_", ", "), np.mean([one.contributions for one in each], axis=0), COLORS[name])
        for name, each in runs.items()
        if name.endswith("deformable")
    ]
    at = np.minimum(BLOCK * (1 + np.arange(len(shares[0].values))), schedule.num_frames - 1)
    charts.append(
        draw_chart((200, 900), "share of the deformation in five modes", at, shares, "frames", from_zero=True)
    )
    if not cv2.imwrite(str(path), np.concatenate(charts)):
        raise OSError(f"Cannot write {path}.")


def _running(errors: list[np.ndarray]) -> np.ndarray:
    """Root mean square over faces and over the frames around; gaps where nobody is tracked."""
    square = np.square(np.stack(errors))
    known = np.isfinite(square)
    window = np.ones(SMOOTHED)
    total = np.convolve(np.where(known, square, 0.0).sum(axis=0), window, mode="same")
    count = np.convolve(known.sum(axis=0), window, mode="same")
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _mean(errors: np.ndarray) -> float:
    return float(np.nanmean(errors)) if np.any(np.isfinite(errors)) else float("inf")


def _row(values) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
