"""An articulated hand from one camera: do loose limits resolve depth, and does the covariance stay honest?

The paper's sequence of 55 frames (Shimada et al., figures 12 to 16) for two hands from the
same start, by three filters: `unconstrained`, `literal` (the paper's) and `recommended`. Then the authors' open
problem, `held_*`: one pose repeated for 500 frames, of which only the first few can teach anything. Where
JAXFILTERS_DATA names the folder of recordings, real hands follow. Errors are over all seeds; `nees` is a mean over
them, to be compared with its band; `drawn_*` are of starts that are samples of the prior, also seed by seed, with the
quantiles and the share within the chi-squared band, and again (`_in_mode`) without the seeds that end in another mode
of the posterior. A folder given with `--out` receives the curves of the held pose.
"""

import os
import sys
from pathlib import Path

import cv2
import jax
import numpy as np
from scipy import stats

from jaxfilters.benchmarks.metrics import WITHIN_TWO_SIGMA, Direction, Metric
from jaxfilters.benchmarks.recordings import VARIABLE
from jaxfilters.benchmarks.scenarios import _articulated_paper as paper
from jaxfilters.benchmarks.timing import interleaved
from jaxfilters.filter import run as run_filter
from jaxfilters.models.synthetic.articulated import SHAPES, simulate_paper
from jaxfilters.trackers.app.chart import Curve, draw_chart

NUM_SEEDS, QUICK_NUM_SEEDS = 50, 6
NUM_HELD_SEEDS, QUICK_NUM_HELD_SEEDS = 20, 2
HELD_FRAMES, QUICK_HELD_FRAMES = 500, 60
ROUNDS, QUICK_ROUNDS = 15, 3
BAND = 0.95
"""Probability of the band of the NEES of one seed."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
RIGHT: dict[str, Direction | float] = {"coverage": WITHIN_TWO_SIGMA, "nees": 6.0}
"""Values of consistent filters, of six lengths."""
COLORS = {"literal": (40, 120, 230), "recommended": (200, 110, 30)}
"""Blue, green, red."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Filter everything, print the tables, return their numbers."""
    seeds = range(seed, seed + (QUICK_NUM_SEEDS if quick else NUM_SEEDS))
    held = range(seed, seed + (QUICK_NUM_HELD_SEEDS if quick else NUM_HELD_SEEDS))
    metrics = paper_metrics(seeds)
    metrics |= drawn_metrics(seeds)
    metrics |= held_metrics(held, QUICK_HELD_FRAMES if quick else HELD_FRAMES, out)
    metrics |= time_metrics(QUICK_ROUNDS if quick else ROUNDS)
    return metrics | _real_metrics(quick)


def paper_metrics(seeds: range) -> dict[str, Metric]:
    """Divergence, errors and consistency of every filter on both hands."""
    metrics: dict[str, Metric] = {}
    final: dict[tuple[str, int], float] = {}
    low, high = paper.band(6, len(seeds))
    _say(f"{len(seeds)} seeds, 55 frames; band of the mean NEES of 6 lengths: {low:.2f} to {high:.2f}")
    for mode in paper.FILTERS:
        for shape in SHAPES:
            runs = paper.run_paper(mode, shape, seeds)
            found = _evaluated(runs)
            final[mode, shape] = found.pop("final_r13_px")
            _say(f"  {mode:14} shape {shape}: " + "  ".join(f"{name} {value:.3g}" for name, value in found.items()))
            for name, value in found.items():
                unit = "px" if name.endswith("_px") else "deg" if name.endswith("_deg") else ""
                better = RIGHT.get(name.partition("_")[0], "lower")
                metrics[f"{name}_{mode}_shape{shape}"] = Metric(value, unit, better)
        difference = abs(final[mode, 2] - final[mode, 1])
        metrics[f"r13_difference_px_{mode}"] = Metric(difference, "px", "higher")
    metrics["nees_lengths_band_low"] = Metric(low, "", 6.0)
    metrics["nees_lengths_band_high"] = Metric(high, "", 6.0)
    return metrics


def _evaluated(runs: paper.Runs) -> dict[str, float]:
    lost = paper.diverged(runs)
    r13 = runs.means[:, -1, paper.R13]
    finite = np.where(np.isfinite(r13), r13, 0.0)
    errors, covariances = runs.length_errors[:, -1], runs.length_covariances[:, -1]
    return {
        "diverged_share": float(lost.mean()),
        "r13_error_px": float(abs(finite.mean() - runs.truth[0, -1, paper.R13])),
        "r13_rms_px": float(np.sqrt(np.mean((finite - runs.truth[:, -1, paper.R13]) ** 2))),
        "angle_error_deg": float(np.median(paper.angle_errors(runs))),
        "coverage_2sigma": paper.coverage(errors, covariances),
        "coverage_2sigma_with_palm": paper.coverage(runs.shape_errors[:, -1], runs.shape_covariances[:, -1]),
        "nees_lengths": float(np.mean(paper.nees(errors, covariances))),
        "final_r13_px": float(finite.mean()),
    }


def drawn_metrics(seeds: range) -> dict[str, Metric]:
    """Consistency of the recommended filter's lengths, seed by seed, where starts are samples of what is believed.

    The mean over all seeds is that of the few that end in another mode, so that figures without those stand beside it.
    """
    metrics: dict[str, Metric] = {}
    for shape in SHAPES:
        runs = paper.run_drawn("recommended", shape, seeds)
        found = _drawn(runs)
        _say(f"  drawn starts, shape {shape}: " + "  ".join(f"{name} {found[name].value:.3g}" for name in found))
        nees, other = paper.nees(runs.length_errors[:, -1], runs.length_covariances[:, -1]), paper.in_other_mode(runs)
        each = "  ".join(f"{value:.3g}{'*' * bool(lost)}" for value, lost in zip(nees, other, strict=True))
        _say(f"    NEES of 6 lengths by seed, * in another mode: {each}")
        metrics |= {f"drawn_{name}_recommended_shape{shape}": metric for name, metric in found.items()}
    return metrics


def _drawn(runs: paper.Runs) -> dict[str, Metric]:
    errors, covariances = runs.length_errors[:, -1], runs.length_covariances[:, -1]
    nees, other = paper.nees(errors, covariances), paper.in_other_mode(runs)
    low, high = stats.chi2(6).interval(BAND)
    found = {
        "diverged_share": Metric(float(paper.diverged(runs).mean()), "", "lower"),
        "other_mode_share": Metric(float(other.mean()), "", "lower"),
        "coverage_2sigma": Metric(paper.coverage(errors, covariances), "", WITHIN_TWO_SIGMA),
        "nees_lengths_mean": Metric(float(np.mean(nees)), "", 6.0),
        "nees_lengths_in_band_share": Metric(float(np.mean((nees > low) & (nees < high))), "", BAND),
    }
    for quantile in QUANTILES:
        name = "median" if quantile == 0.5 else f"quantile{100 * quantile:.0f}"
        right = float(stats.chi2(6).ppf(quantile))
        found[f"nees_lengths_{name}"] = Metric(float(np.quantile(nees, quantile)), "", right)
    if not other.all():
        one = nees[~other]
        below, above = paper.band(6, len(one))
        found |= {
            "nees_lengths_mean_in_mode": Metric(float(np.mean(one)), "", 6.0),
            "nees_lengths_mean_in_mode_band_low": Metric(below, "", 6.0),
            "nees_lengths_mean_in_mode_band_high": Metric(above, "", 6.0),
            "nees_lengths_median_in_mode": Metric(float(np.median(one)), "", float(stats.chi2(6).median())),
            "nees_lengths_in_band_share_in_mode": Metric(float(np.mean((one > low) & (one < high))), "", BAND),
            "coverage_2sigma_in_mode": Metric(
                paper.coverage(errors[~other], covariances[~other]), "", WITHIN_TWO_SIGMA
            ),
        }
    return found


def held_metrics(seeds: range, num_frames: int, out: Path | None) -> dict[str, Metric]:
    """What becomes of lengths and of their covariance while nothing new is visible."""
    metrics: dict[str, Metric] = {}
    curves: dict[str, paper.Runs] = {}
    for mode in ("literal", "recommended"):
        runs = curves[mode] = paper.run_held(mode, 1, seeds, num_frames)
        early = min(20, num_frames // 3)
        deviations = np.sqrt(np.diagonal(runs.length_covariances, axis1=-2, axis2=-1)).mean(axis=(0, 2))
        metrics[f"held_nees_lengths_{mode}"] = Metric(
            float(np.mean(paper.nees(runs.length_errors[:, -1], runs.length_covariances[:, -1]))), "", 6.0
        )
        metrics[f"held_coverage_2sigma_{mode}"] = Metric(
            paper.coverage(runs.length_errors[:, -1], runs.length_covariances[:, -1]), "", WITHIN_TWO_SIGMA
        )
        metrics[f"held_std_kept_{mode}"] = Metric(float(deviations[-1] / deviations[early]), "", "higher")
        _say(
            f"  held pose, {mode:12} frames {early}, {num_frames}: deviation {deviations[early]:.2f}, "
            f"{deviations[-1]:.2f} px; NEES of 6 lengths {metrics[f'held_nees_lengths_{mode}'].value:.3g}"
        )
    if out is not None:
        _plot_held(out / "held_pose.png", curves)
    return metrics


def _plot_held(path: Path, runs: dict[str, paper.Runs]) -> None:
    frames = np.arange(next(iter(runs.values())).means.shape[1])
    deviations, values = [], []
    for mode, of_mode in runs.items():
        spread = np.sqrt(np.diagonal(of_mode.length_covariances, axis1=-2, axis2=-1)).mean(axis=(0, 2))
        error = np.sqrt((of_mode.length_errors**2).mean(axis=(0, 2)))
        blue, green, red = (int(0.5 * (255 + part)) for part in COLORS[mode])
        deviations += [
            Curve(f"{mode}: deviation", spread, COLORS[mode]),
            Curve(f"{mode}: true error", error, (blue, green, red)),
        ]
        nees = np.mean(paper.nees(of_mode.length_errors, of_mode.length_covariances), axis=0) / 6
        values.append(Curve(mode, np.log10(nees), COLORS[mode]))
    charts = [
        draw_chart((300, 900), "lengths, px", frames, deviations, from_zero=True),
        draw_chart((300, 900), "log10 of NEES / 6, 0 where consistent", frames, values, "frames of the same pose"),
    ]
    if not cv2.imwrite(str(path), np.concatenate(charts)):
        raise OSError(f"Cannot write {path}.")


def time_metrics(rounds: int) -> dict[str, Metric]:
    """Microseconds of one frame of one hypothesis: predict, update, truncate."""
    sequence = simulate_paper(jax.random.key(0), 1)
    looks, inputs = paper.looks_of(sequence)
    calls = {}
    for mode, make in paper.FILTERS.items():
        filter = paper.filter_of(make, paper.paper_model(), sequence)
        calls[mode] = lambda filter=filter: run_filter(filter, jax.random.key(0), looks, inputs)
    seconds = interleaved(calls, rounds)
    per_frame = {mode: 1e6 * value / len(sequence.features) for mode, value in seconds.items()}
    metrics = {f"step_us_{mode}": Metric(value, "us", "lower") for mode, value in per_frame.items()}
    return metrics | {"step_us": metrics["step_us_recommended"]}


def _real_metrics(quick: bool) -> dict[str, Metric]:
    folder = os.environ.get(VARIABLE)
    if not folder:
        _say(f"{VARIABLE} is not set: no real hands")
        return {}
    from jaxfilters.benchmarks.scenarios._real_motion import real_motion_metrics

    return real_motion_metrics(Path(folder), quick)


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
