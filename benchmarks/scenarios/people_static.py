"""People who stand or cross in front of the paper's two cameras: the modern tracker beside the paper's.

Experiments after Kato et al. (1999), made with bodies of six ellipsoids whose
silhouettes have holes, stray pixels and a shadow. Names without a suffix are the modern tracker's, with `_paper` the
paper's, with `_halving` the paper's with finer last steps. In E1 the height is known to 3 cm, as the paper has it;
`_unknown_height` are the same runs without that.
"""

import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _static_people as static
from jaxfilters.benchmarks.scenarios._static_people import APPEARANCES, BODY_M, MODEL_M, Appearance, Estimates, Runs
from jaxfilters.models.calibration import Calibration
from jaxfilters.models.synthetic.standing_person import Flaws
from jaxfilters.trackers.people.state import PeopleConfig
from jaxfilters.trackers.published.people import ACQUIRE, TRACK
from jaxfilters.trackers.published.people_scene import STEP_HALVING, PaperConfig

NUM_SEEDS, QUICK_NUM_SEEDS = 10, 1
NUM_FRAMES = 8
GROUPS = {
    "a": tuple((x, y) for x in (0, -1, -2) for y in (0, 1, 2)),
    "b": tuple((x, 3) for x in (0, -1, -2)),
    "c": tuple((x, -0.5) for x in (-1.5, -1, -0.5)),
    "camera2": tuple((x, y) for x in (0, -1, -2) for y in (0, 1, 2, 3)),
}
"""Floor points of table 1: whole bodies, lower bodies only, upper bodies only; from above."""
KNOWN_HEIGHT_M = (MODEL_M[0], 0.03)
CROSSING_FRAMES = 60
CROSSING_M = (((-1.9, 0.6), (-0.1, 0.6)), ((-0.1, 1.7), (-1.9, 1.7)))
"""First and last places of two people (E3)."""
CROSSING_SIZES_M = ((1.73, 0.48), BODY_M)
GAPS_M, QUICK_GAPS_M = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.5), (0.25, 0.5)
"""Between two people who pass each other (E4)."""
GAP_Y_M = 1.0
"""Of the nearer of them."""
MERGED_M = 0.5
"""Off by more than this at the end, a person was lost to the other."""
HEIGHTS, QUICK_HEIGHTS = (0.90, 0.95, 1.0, 1.05, 1.10), (1.10,)
"""True heights by the model's (E5)."""
MISSING = (0.5, 0.7)
SMALL_FOCAL = 0.45
"""Of the focal length, so that a person has less than 1 percent of the image (E6)."""
OFFSETS_M = (0.15, 0.3, 0.5, 0.7, 0.9)
"""Of starts from the truth, in random directions (E8)."""
FOUND_M = 0.15
"""Off by less than this at the end, a person was found."""
PAPER, HALVING = PaperConfig(capacity=2), PaperConfig(capacity=2, steps_m=STEP_HALVING)
MODERN = PeopleConfig(capacity=4, spread_px=0.0)
"""The silhouettes made here end at their edges, as no camera's do."""

Tracking = Callable[[Runs], Estimates]


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Track everything, print the tables, return their numbers."""
    del out
    seeds = range(seed, seed + (QUICK_NUM_SEEDS if quick else NUM_SEEDS))
    first, second = Rooms(static.camera_1()), Rooms(static.camera_2())
    metrics = accuracy_metrics(seeds, first, second, ("shadow",) if quick else tuple(APPEARANCES))
    metrics |= desk_metrics(seeds, first)
    metrics |= crossing_metrics(seeds, {"": first, "_camera2": second})
    metrics |= gap_metrics(seeds, first, QUICK_GAPS_M if quick else GAPS_M)
    metrics |= height_metrics(seeds, first, QUICK_HEIGHTS if quick else HEIGHTS)
    metrics |= limit_metrics(seeds, first)
    return metrics | basin_metrics(seeds, first)


class Rooms:
    """One camera's room for every tracker; each is compiled once."""

    def __init__(self, calibration: Calibration):
        """The rooms of all trackers."""
        self.calibration = calibration
        self.paper = static.paper_room(calibration, PAPER)
        self.halving = static.paper_room(calibration, HALVING)
        self.modern = static.people_room(calibration, MODERN)

    def trackers(self, *, height_m: tuple[float, float] | None = KNOWN_HEIGHT_M) -> dict[str, Tracking]:
        """By the suffix of their metrics."""
        return {
            "": lambda runs: static.run_people(self.modern, runs, self.calibration, height_m=height_m),
            "_paper": lambda runs: static.run_paper(self.paper, runs),
        }

    def simulate(self, seeds: range, name: str, points, appearance: Appearance, **options) -> Runs:
        """A person at each of the points, for every seed; the numbers drawn depend on the seed and the name."""
        still = np.broadcast_to(np.asarray(points, float)[:, None, None], (len(points), NUM_FRAMES, 1, 2))
        return self.simulate_moving(seeds, name, still, appearance, **options)

    def simulate_moving(self, seeds: range, name: str, truth: np.ndarray, appearance: Appearance, **options) -> Runs:
        """The same of people (runs, frames, people, 2) who move."""
        number = zlib.crc32(name.encode())
        keys = [jax.random.fold_in(jax.random.key(seed), number) for seed in seeds]
        parts = [static.simulate(key, self.calibration, truth, appearance, **options) for key in keys]
        truth, starts, masks = (np.concatenate([part[i] for part in parts]) for i in range(3))
        desks = [part.desks for part in parts if part.desks is not None]
        return Runs(truth, starts, masks, np.concatenate(desks) if desks else None)


def accuracy_metrics(seeds: range, first: Rooms, second: Rooms, appearances: tuple[str, ...]) -> dict[str, Metric]:
    """E1: table 1 of the paper, at the end of eight frames."""
    metrics: dict[str, Metric] = {}
    for name, points in GROUPS.items():
        rooms = second if name == "camera2" else first
        unknown = rooms.trackers(height_m=None)[""]
        halving = lambda runs, rooms=rooms: static.run_paper(rooms.halving, runs)
        trackers = {**rooms.trackers(), "_halving": halving, "_unknown_height": unknown}
        for appearance in appearances:
            size = MODEL_M if APPEARANCES[appearance].is_ellipsoid else BODY_M
            runs = rooms.simulate(seeds, f"accuracy {name}", points, APPEARANCES[appearance], sizes_m=(size,))
            for suffix, track in trackers.items():
                found = _errors(f"_{name}{suffix}", runs, track(runs))
                _say(f"  {name:8} {appearance:10} {suffix[1:]:15}", found)
                metrics |= found if appearance == "shadow" else {}
    return metrics


def _errors(suffix: str, runs: Runs, estimates: Estimates) -> dict[str, Metric]:
    off = estimates.xy[:, -1, 0] - runs.truth[:, -1, 0]
    values = {"error_m": np.linalg.norm(off, axis=-1), "error_x_m": np.abs(off[:, 0]), "error_y_m": np.abs(off[:, 1])}
    return {f"{name}{suffix}": Metric(float(value.mean()), "m", "lower") for name, value in values.items()}


def desk_metrics(seeds: range, rooms: Rooms) -> dict[str, Metric]:
    """E2: table 2 of the paper, and whether it is noticed that depth cannot be visible."""
    metrics: dict[str, Metric] = {}
    for name, points, with_desk in (
        ("a", GROUPS["a"], False),
        ("b", GROUPS["b"], False),
        ("c", GROUPS["c"], False),
        ("desk_a", GROUPS["a"], True),
        ("desk_b", GROUPS["b"], True),
    ):
        runs = rooms.simulate(seeds, f"desk {name}", points, APPEARANCES["holes"], with_desk=with_desk)
        for suffix, track in rooms.trackers().items():
            estimates = track(runs)
            found = _errors(f"_{name}{suffix}", runs, estimates) if with_desk else {}
            found[f"flatness_{name}{suffix}"] = Metric(float(estimates.flatness.mean()), "", "higher")
            found[f"least_flatness_{name}{suffix}"] = Metric(float(estimates.flatness.min()), "", "higher")
            found[f"sd_radial_m_{name}{suffix}"] = Metric(float(estimates.sd_radial.mean()), "m", "lower")
            _say(f"  desk {name:8} {suffix[1:]:10}", found)
            metrics |= found
    return metrics


def crossing_metrics(seeds: range, rooms: dict[str, Rooms]) -> dict[str, Metric]:
    """E3: mean errors of two people of whom one passes behind the other, and how often they were exchanged."""
    metrics: dict[str, Metric] = {}
    for camera, room in rooms.items():
        truth = _paths(CROSSING_M)[None]
        runs = room.simulate_moving(seeds, "crossing", truth, APPEARANCES["shadow"], sizes_m=CROSSING_SIZES_M)
        for suffix, track in room.trackers(height_m=None).items():
            estimates = track(runs)
            errors = np.linalg.norm(estimates.xy - runs.truth, axis=-1).mean(axis=(0, 1))
            found = {
                f"crossing_error_m_first{camera}{suffix}": Metric(float(errors[0]), "m", "lower"),
                f"crossing_error_m_second{camera}{suffix}": Metric(float(errors[1]), "m", "lower"),
                f"crossing_exchanged{camera}{suffix}": Metric(float(_confused(runs, estimates).mean()), "", "lower"),
            }
            _say(f"  crossing{camera} {suffix[1:]:10}", found)
            metrics |= found
    return metrics


def gap_metrics(seeds: range, rooms: Rooms, gaps: tuple[float, ...]) -> dict[str, Metric]:
    """E4: the smallest gap at which, and above which, two people who pass each other are never exchanged."""
    confused: dict[str, list[float]] = {}
    for gap in gaps:
        near, far = GAP_Y_M, GAP_Y_M + gap
        truth = _paths((((-1.9, near), (-0.1, near)), ((-0.1, far), (-1.9, far))))[None]
        runs = rooms.simulate_moving(seeds, f"gap {gap}", truth, APPEARANCES["holes"], sizes_m=CROSSING_SIZES_M)
        for suffix, track in rooms.trackers(height_m=None).items():
            confused.setdefault(suffix, []).append(float(_confused(runs, track(runs)).mean()))
    metrics = {}
    for suffix, shares in confused.items():
        worst = max((gap for gap, share in zip(gaps, shares, strict=True) if share > 0), default=0.0)
        safe = min((gap for gap in gaps if gap > worst), default=float("inf"))
        metrics[f"exchange_gap_m{suffix}"] = Metric(safe, "m", "lower")
        _say(f"  gaps {gaps} {suffix[1:]:10} exchanged or merged: {shares}", {})
    return metrics


def _paths(ends) -> np.ndarray:
    """(frames, people, 2) of people who walk straight from a place to another."""
    share = np.linspace(0, 1, CROSSING_FRAMES)[:, None, None]
    first, last = np.moveaxis(np.asarray(ends), 1, 0)
    return first + share * (last - first)


def _confused(runs: Runs, estimates: Estimates) -> np.ndarray:
    """(runs,) whether anybody ended as another person, or nowhere."""
    apart = np.linalg.norm(estimates.xy[:, -1, :, None] - runs.truth[:, -1, None], axis=-1)
    own = np.diagonal(apart, axis1=1, axis2=2)
    return np.any((own > apart.min(axis=-1)) | (own > MERGED_M), axis=-1)


def height_metrics(seeds: range, rooms: Rooms, heights: tuple[float, ...]) -> dict[str, Metric]:
    """E5: people who are not as tall as believed."""
    metrics: dict[str, Metric] = {}
    for factor in heights:
        size = (MODEL_M[0] * factor, BODY_M[1])
        runs = rooms.simulate(seeds, "heights", GROUPS["a"], APPEARANCES["holes"], sizes_m=(size,))
        for suffix, track in rooms.trackers(height_m=None).items():
            metrics[f"height_error_m_{100 * factor:.0f}{suffix}"] = _error(runs, track(runs))
    _say("  heights", metrics)
    return metrics


def limit_metrics(seeds: range, rooms: Rooms) -> dict[str, Metric]:
    """E6: silhouettes of which much is missing, and small ones, alone and with one that is nobody's."""
    calibration = rooms.calibration
    K = calibration.K * np.array([[SMALL_FOCAL], [SMALL_FOCAL], [1.0]])
    K[:2, 2] = calibration.K[:2, 2]
    small = Rooms(calibration._replace(K=K))
    metrics: dict[str, Metric] = {}
    cases = [(f"missing_{100 * share:.0f}", rooms, Appearance(flaws=Flaws(share))) for share in MISSING]
    cases += [
        ("small", small, Appearance(flaws=Flaws())),
        ("small_with_blob", small, Appearance(flaws=Flaws(), with_blob=True)),
    ]
    for name, room, appearance in cases:
        runs = room.simulate(seeds, name, GROUPS["a"], appearance)
        for suffix, track in room.trackers().items():
            metrics[f"{name}_error_m{suffix}"] = _error(runs, track(runs))
    _say("  limits", metrics)
    return metrics


def basin_metrics(seeds: range, rooms: Rooms) -> dict[str, Metric]:
    """E8: from how far away people are found, by how much the start is off."""
    metrics: dict[str, Metric] = {}
    trackers = {
        "": rooms.trackers()[""],
        "_paper_acquire": lambda runs: static.run_paper(rooms.paper, runs, mode=ACQUIRE),
        "_paper_track": lambda runs: static.run_paper(rooms.paper, runs, mode=TRACK),
    }
    for offset in OFFSETS_M:
        runs = rooms.simulate(seeds, "basin", GROUPS["a"], APPEARANCES["body"], start_offset_m=_circle(offset))
        for suffix, track in trackers.items():
            off = np.linalg.norm(track(runs).xy[:, -1, 0] - runs.truth[:, -1, 0], axis=-1)
            share = Metric(float((off < FOUND_M).mean()), "", "higher")
            metrics[f"found_from_{100 * offset:.0f}cm{suffix}"] = share
    _say("  basin", metrics)
    return metrics


def _circle(radius: float) -> Callable:
    def offsets(key, shape):
        angle = jax.random.uniform(key, shape[:-1], maxval=2 * np.pi)
        return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    return offsets


def _error(runs: Runs, estimates: Estimates) -> Metric:
    return Metric(float(np.linalg.norm(estimates.xy[:, -1, 0] - runs.truth[:, -1, 0], axis=-1).mean()), "m", "lower")


def _say(text: str, metrics: dict[str, Metric]) -> None:
    numbers = "  ".join(f"{name} {metric.value:.3f}" for name, metric in metrics.items())
    sys.stderr.write(f"{text} {numbers}\n")
