"""Plots of the comparison: the paper's figures 6, 7 and 10."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.synthetic.hand import FRAME_INTERVAL
from jaxfilters.trackers.app.chart import Curve, draw_chart

COLORS = {"truth": (60, 60, 60), "pf": (40, 120, 230), "rbpf": (200, 110, 30)}
"""Blue, green, red."""
COORDINATES = {
    "A": (("wrist y, mm", 1, 1e3), ("middle finger PIP, degrees", 15, 180 / np.pi)),
    "B": (("wrist y, mm", 1, 1e3), ("wrist x, mm", 0, 1e3), ("wrist z, mm", 2, 1e3)),
}
"""Of the pose, what each figure shows: title, index, factor."""
CHART = (260, 900)


def plot_times(path: Path, milliseconds: dict[int, tuple[float, float]]) -> None:
    """Time per frame of PF and RBPF against the number of particles, figure 10."""
    counts = np.array(list(milliseconds))
    values = np.array(list(milliseconds.values()))
    curves = [Curve(name.upper(), values[:, i], COLORS[name]) for i, name in enumerate(("pf", "rbpf"))]
    chart = draw_chart((360, 640), "time per frame, ms", counts, curves, "particles", from_zero=True)
    _write(path, chart)


def plot_tracks(path: Path, data: str, truth: Float[Array, "t 22"], estimates: dict[str, Float[Array, "t 22"]]) -> None:
    """Some coordinates of the estimated poses against the truth, figures 6 (data A) and 7 (data B)."""
    seconds = FRAME_INTERVAL * np.arange(1, len(truth) + 1)
    charts = []
    for title, index, factor in COORDINATES[data]:
        curves = [
            Curve(name if name == "truth" else name.upper(), factor * np.asarray(poses)[:, index], COLORS[name])
            for name, poses in {"truth": truth, **estimates}.items()
        ]
        charts.append(draw_chart(CHART, title, seconds, curves, "s"))
    _write(path, np.concatenate(charts))


def _write(path: Path, picture: np.ndarray) -> None:
    if not cv2.imwrite(str(path), picture):
        raise OSError(f"Cannot write {path}.")
