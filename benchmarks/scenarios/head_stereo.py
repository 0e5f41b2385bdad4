"""Heads before two cameras, rendered with known truth: the published errors, deformation, occlusion, speed.

Tables 3 and 4 of Oka, Sato et al. (2006) and section 3.4 of Sugano's thesis (2007). Faces are registered by the
tracker's own stereo matching from the true landmarks of the first left image. Names without a suffix are the modern
tracker's with a rigid model, adaptive diffusion `A = I, b = 1`, and 1000 particles; `_learning` may deform and
`_online_diffusion` goes on estimating `A` and `b`; `_50_particles`, `_fixed1` and `_fixed5` have fewer of them and
fixed diffusions. `_paper` is the paper's tracker, `_paper_fixed1` and `_paper_fixed5` are that with fixed diffusions. A
tracker has lost the face in frames in which it says so, or in which its pose would put the landmarks half a template
away. Not compared are trackers without a part that no option turns off: recalculation, its start, the score gate, the
removal of rigid motion, the amnesic parameter, and sampling in one stage. A folder given with `--out` receives the
curves of the deformation.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from jaxfilters.benchmarks.metrics import WITHIN_TWO_SIGMA, Metric
from jaxfilters.benchmarks.scenarios._head_deformation import Schedule, deformation_metrics
from jaxfilters.benchmarks.scenarios._head_runs import AXES, AXIS_UNITS, HeadRun, coverage, follow, lost_share, rmse
from jaxfilters.benchmarks.scenarios._head_speed import speed_metrics
from jaxfilters.models.synthetic.face_motion import DIMMING_FRAMES, OCCLUSION_FRAMES, motion
from jaxfilters.models.synthetic.face_sequence import face_sequence, sequence
from jaxfilters.trackers.head.common.config import HeadConfig

FIRST_SEED = 100
"""The tracker was made with smaller ones."""
PAPER_ADAPTIVE = {"slow": (1.25, 1.91, 2.71, 0.25, 1.55, 1.70), "fast": (3.42, 3.34, 4.92, 0.87, 2.86, 2.34)}
"""Root mean square errors of tables 3 and 4 in millimetres and degrees."""
ALWAYS = {"": HeadConfig(learn=False), "_learning": HeadConfig()}
_PAPER = HeadConfig(variant="published", learn=False)
PAPER = {
    "_paper": _PAPER,
    "_paper_fixed5": HeadConfig(variant="published", learn=False, diffusion="fixed", fixed_diffusion=5.0),
    "_paper_fixed1": HeadConfig(variant="published", learn=False, diffusion="fixed", fixed_diffusion=1.0),
}
TABLED = ("", "_learning", "_paper")
"""With their ratios to the paper's errors, and their coverage."""
ABLATIONS = {
    "_online_diffusion": HeadConfig(learn=False, diffusion="online"),
    "_50_particles": HeadConfig(learn=False, num_particles=50),
    "_fixed5": HeadConfig(learn=False, diffusion="fixed", fixed_diffusion=5.0),
    "_fixed1": HeadConfig(learn=False, diffusion="fixed", fixed_diffusion=1.0),
}
NUM_SEEDS, NUM_PAPER_SEEDS, NUM_FRAMES = 10, 3, 600
QUICK_NUM_SEEDS, QUICK_NUM_FRAMES = 2, 120
NUM_OCCLUSIONS, NUM_STILL, STILL_FRAMES, SETTLED = 5, 2, 200, 20
QUICK_OCCLUSION_FRAMES = 360
RECOVERY_FRAMES = 15
"""By which a tracker should have recovered from an occlusion, and over which that is judged."""
NUM_IDENTITIES, QUICK_NUM_IDENTITIES = 3, 1
SCHEDULE, QUICK_SCHEDULE = Schedule(120, 1200, 1800), Schedule(30, 200, 280)
COUNTS, QUICK_COUNTS = (250, 500, 1000, 2000, 4000), (250, 1000)
ROUNDS, QUICK_ROUNDS = 25, 3

Runs = dict[str, dict[int, HeadRun]]
"""By suffix and seed."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Track everything, print the tables, return their numbers."""
    first = FIRST_SEED + seed
    num_seeds = QUICK_NUM_SEEDS if quick else NUM_SEEDS
    few = {**PAPER, **({} if quick else ABLATIONS)}
    num_frames = QUICK_NUM_FRAMES if quick else NUM_FRAMES
    metrics: dict[str, Metric] = {}
    tables: dict[str, Runs] = {}
    for kind in PAPER_ADAPTIVE:
        tables[kind] = moving_runs(kind, range(first, first + num_seeds), num_frames, few)
        metrics |= table_metrics(kind, tables[kind])
    metrics |= still_metrics(range(first, first + (1 if quick else NUM_STILL)))
    covered = range(first, first + (1 if quick else NUM_OCCLUSIONS))
    metrics |= occlusion_metrics(covered, QUICK_OCCLUSION_FRAMES if quick else NUM_FRAMES, tables["slow"])
    rounds, counts = (QUICK_ROUNDS, QUICK_COUNTS) if quick else (ROUNDS, COUNTS)
    speed = speed_metrics(first, counts, rounds)
    _say("  speed: " + "  ".join(f"{name} {metric.value:.3g}" for name, metric in speed.items()))
    people = range(first, first + (QUICK_NUM_IDENTITIES if quick else NUM_IDENTITIES))
    return metrics | speed | deformation_metrics(people, QUICK_SCHEDULE if quick else SCHEDULE, out)


def moving_runs(kind: str, seeds: range, num_frames: int, few: Mapping[str, HeadConfig]) -> Runs:
    """Runs over one table's sequences; trackers in `few` see the first of them only."""
    runs: Runs = {}
    for seed in seeds:
        trackers = {**ALWAYS, **(few if seed < seeds.start + NUM_PAPER_SEEDS else {})}
        found = follow(sequence(jax.random.key(seed), kind, num_frames, seed), trackers)
        for suffix, one in found.items():
            runs.setdefault(suffix, {})[seed] = one
            _say(f"  {kind} {seed} {suffix[1:]:16} rmse {_row(rmse(one))} lost {lost_share(one):.3f}")
    return runs


def table_metrics(kind: str, runs: Runs) -> dict[str, Metric]:
    """Table 3 (`slow`) or 4 (`fast`)."""
    metrics: dict[str, Metric] = {}
    paper = np.array(PAPER_ADAPTIVE[kind])
    means = {suffix: np.mean([rmse(one) for one in of_one.values()], axis=0) for suffix, of_one in runs.items()}
    for suffix, of_one in runs.items():
        ratios = np.stack([rmse(one) for one in of_one.values()]) / paper
        covered = np.mean([coverage(one) for one in of_one.values()], axis=0)
        lost = np.array([lost_share(one) for one in of_one.values()])
        _say(f"  {kind} {suffix[1:]:16} mean {_row(means[suffix])} / paper {_row(ratios.mean(axis=0))}")
        metrics |= _by_axis(f"rmse_{kind}", suffix, means[suffix], AXIS_UNITS)
        if suffix in TABLED:
            metrics |= _by_axis(f"ratio_to_paper_adaptive_{kind}", suffix, ratios.mean(axis=0))
            metrics |= _by_axis(f"worst_ratio_to_paper_adaptive_{kind}", suffix, ratios.max(axis=0))
            metrics |= _by_axis(f"coverage_2sigma_{kind}", suffix, covered, better=WITHIN_TWO_SIGMA)
        metrics[f"lost_share_{kind}{suffix}"] = Metric(float(lost.mean()), "", "lower")
        metrics[f"lost_runs_{kind}{suffix}"] = Metric(float((lost > 0).mean()), "", "lower")
    return metrics | _by_axis(f"adaptive_to_fixed5_{kind}", "_paper", means["_paper"] / means["_paper_fixed5"])


def still_metrics(seeds: range) -> dict[str, Metric]:
    """Oracle 12: how much the estimates of a head at rest move."""
    trackers = {**ALWAYS, **{name: PAPER[name] for name in ("_paper", "_paper_fixed5")}}
    found: dict[str, list[np.ndarray]] = {suffix: [] for suffix in trackers}
    for seed in seeds:
        poses = np.repeat(motion("slow", 1, seed), STILL_FRAMES, axis=0)
        for suffix, one in follow(face_sequence(jax.random.key(seed), poses), trackers).items():
            found[suffix].append(np.std(one.errors[SETTLED:], axis=0))
    metrics: dict[str, Metric] = {}
    for suffix, stds in found.items():
        _say(f"  still {suffix[1:]:16} std {_row(np.mean(stds, axis=0))}")
        metrics |= _by_axis("still_std", suffix, np.mean(stds, axis=0), AXIS_UNITS)
    return metrics


def occlusion_metrics(seeds: range, num_frames: int, clean: Runs) -> dict[str, Metric]:
    """Something before mouth and nostrils for 30 frames, and light that goes down to 70 % (end of section 5.1)."""
    trackers = {**ALWAYS, "_paper": PAPER["_paper"]}
    found: dict[str, list[dict[str, float]]] = {suffix: [] for suffix in trackers}
    for seed in seeds:
        truth = sequence(jax.random.key(seed), "slow", num_frames, seed, occlusion=True)
        for suffix, one in follow(truth, trackers).items():
            usual = clean[suffix].get(seed)
            level = np.mean([rmse(other) for other in clean[suffix].values()], axis=0) if usual is None else rmse(usual)
            found[suffix].append(judge_occlusion(one, level))
    metrics: dict[str, Metric] = {}
    units = {**dict(zip(AXES, AXIS_UNITS, strict=True)), "frames": "frames"}
    for suffix, evaluated in found.items():
        worst = {name: max(one[name] for one in evaluated) for name in evaluated[0]}
        for name, value in worst.items():
            metrics[f"{name}{suffix}"] = Metric(value, units.get(name.rpartition("_")[2], ""), "lower")
        _say(f"  occlusion {suffix[1:]:12} " + "  ".join(f"{name} {value:.3g}" for name, value in worst.items()))
    return metrics


def judge_occlusion(one: HeadRun, clean: np.ndarray) -> dict[str, float]:
    """Peak errors while the face is covered and while it gets dark, and how long the first is felt.

    A tracker has recovered once the root mean square errors of the next frames, `RECOVERY_FRAMES` of them, are within
    twice the usual ones and half a unit.

    Args:
        one: The run.
        clean: (6,) root mean square errors without occlusion, millimetres and degrees.
    """
    frames = np.arange(1, 1 + len(one.errors))
    errors = np.where(one.is_tracked[:, None], np.abs(one.errors), np.inf)
    covered = (frames >= OCCLUSION_FRAMES[0]) & (frames < OCCLUSION_FRAMES[1] + RECOVERY_FRAMES)
    dark = frames >= DIMMING_FRAMES[0]
    allowed = 2 * clean + 0.5
    free = errors[(frames >= OCCLUSION_FRAMES[1]) & ~dark]
    windows = np.lib.stride_tricks.sliding_window_view(free, RECOVERY_FRAMES, axis=0)
    recovered = np.all(np.sqrt(np.mean(windows**2, axis=-1)) <= allowed, axis=-1)
    after = np.sqrt(np.mean(free[RECOVERY_FRAMES:] ** 2, axis=0))
    peaks = {
        f"{name}_peak_{axis}": float(errors[when, i].max())
        for name, when in (("occlusion", covered), ("dimming", dark))
        for i, axis in enumerate(AXES)
    }
    return {
        "occlusion_lost_share": lost_share(one),
        "recovery_frames": float(np.argmax(recovered)) if recovered.any() else float("inf"),
        "after_occlusion_to_allowed": float(np.max(after / allowed)),
        **peaks,
    }


def _by_axis(name, suffix, values, units="", better="lower") -> dict[str, Metric]:
    units = units or ("",) * len(AXES)
    return {
        f"{name}_{axis}{suffix}": Metric(float(value), unit, better)
        for axis, value, unit in zip(AXES, values, units, strict=True)
    }


def _row(values) -> str:
    return " ".join(f"{value:.3f}" for value in values)


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
