"""Hand pose from depth: does it pay to carry the velocity of every particle in a Kalman filter?

The plain particle filter on the pose against the Rao-Blackwellized one, without a guide, N = 512, on the paper's data A
(the pose walks at random) and B (its velocity does) with sensor noise: the comparison of Kajihara and Tanaka, figures
6, 7 and 10. Once with the improved set-up, once with the paper's own cost and likelihood (`*_paper_cost`). The full run
adds, on data B, the other two proposals (`rbpf_plug_in`, `rbpf_plug_in_corrected`), a plain filter whose noise is as
wide as what the Rao-Blackwellized one draws (`pf_wide`), the tracker with its guide (`pf_guided`, `rbpf_guided`), and
registration alone from its start (`registration`). Errors are means after the first ten frames; p-values are those of
one-sided paired Wilcoxon signed-rank tests over the seeds. Then the tracker with either filter, and registration alone,
on real hands (`_real_comparison`). A folder given with `--out` receives every run as it finishes, the tables, and
plots; a run that was cut off goes on there after the last recording that it had finished.
"""

import itertools
import sys
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np

from jaxfilters.benchmarks.environment import environment
from jaxfilters.benchmarks.finished import Finished
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _hand_filters as hand
from jaxfilters.benchmarks.scenarios._accuracy import (
    LOST,
    Column,
    Filtering,
    Run,
    Track,
    append_csv,
    as_arrays,
    column,
    from_arrays,
    p_value_better,
    run_all,
)
from jaxfilters.benchmarks.scenarios._pf_vs_rbpf_plots import plot_times, plot_tracks
from jaxfilters.benchmarks.scenarios._real_comparison import real_metrics, registered
from jaxfilters.benchmarks.scenarios._step_time import StepTimes, measure, measure_variants
from jaxfilters.filter import Filter
from jaxfilters.models.hand.skeleton import forward_kinematics, hand_geometry, open_palm
from jaxfilters.models.synthetic.hand import FRAME_INTERVAL, START, kinect_v2
from jaxfilters.particle.proposals import plug_in, plug_in_corrected
from jaxfilters.trackers.hand_depth import tracker as hand_depth
from jaxfilters.trackers.hand_depth.config import HandDepthConfig
from jaxfilters.typing import AnyKey

NUM_PARTICLES = 512
COUNTS, QUICK_COUNTS = (64, 128, 256, 512, 1024, 2048), (64, 512)
ROUNDS, QUICK_ROUNDS = 90, 30
NUM_SEEDS, QUICK_NUM_SEEDS = 20, 7
"""Seven pairs at least: with fewer the exact test cannot fall below 0.01."""
QUICK_NUM_FRAMES = 40
PAPER_COST = "_paper_cost"
WITHOUT_PARTICLES = ("frozen", "registration")
GUIDED_TESTS = {"_guided_better": "pf_guided", "_guided_better_than_registration": "registration"}
"""Of the Rao-Blackwellized tracker on data B, against what."""


def run(
    *,
    quick: bool,
    seed: int,
    out: Path | None,
    num_particles: int = NUM_PARTICLES,
    num_seeds: int | None = None,
    num_frames: int | None = None,
) -> dict[str, Metric]:
    """Measure times, then accuracy; what is not given is as the command line would have it."""
    num_seeds = num_seeds or (QUICK_NUM_SEEDS if quick else NUM_SEEDS)
    num_frames = num_frames or (QUICK_NUM_FRAMES if quick else None)
    _say(out, _preamble(num_particles, num_seeds, num_frames))
    kept = Finished(out, scenario="pf-vs-rbpf", quick=quick, num_particles=num_particles, num_frames=num_frames)
    times = kept.metrics(f"times_{seed}", lambda: time_metrics(_measure_times(quick, seed, out)))
    variants = kept.metrics(f"variants_{seed}", lambda: _measure_variants(num_particles, quick, seed, out))
    seeds = range(seed, seed + num_seeds)
    runs = _measure_accuracy(_filters(num_particles, quick), seeds, num_frames, out, kept)
    _say(out, _accuracy_table(runs))
    return times | variants | accuracy_metrics(runs) | real_metrics(num_particles, quick, kept)


def time_metrics(times: dict[int, StepTimes]) -> dict[str, Metric]:
    """Milliseconds a frame and their ratio, for each number of particles."""
    metrics = {}
    for count, measured in times.items():
        metrics[f"frame_ms_pf_n{count}"] = Metric(_median_ms(measured.pf), "ms", "lower")
        metrics[f"frame_ms_rbpf_n{count}"] = Metric(_median_ms(measured.rbpf), "ms", "lower")
        metrics[f"time_ratio_rbpf_over_pf_n{count}"] = Metric(measured.ratio, "", "lower")
        share = float(np.median(measured.rbpf_predict / measured.rbpf))
        metrics[f"predict_share_rbpf_n{count}"] = Metric(share, "", "lower")
    return metrics


def accuracy_metrics(runs: list[Run]) -> dict[str, Metric]:
    """Mean errors, effective sample size and lost runs of every filter on its data, and the paired tests."""
    metrics = {}
    for one in _columns(runs):
        name = _metric_name(one)
        metrics[f"joint_error_mm_{name}"] = Metric(float(one.of("joint_mm").mean()), "mm", "lower")
        if one.filter != "frozen":
            metrics[f"tip_error_mm_{name}"] = Metric(float(one.of("tip_mm").mean()), "mm", "lower")
            if one.filter not in WITHOUT_PARTICLES:
                metrics[f"mean_ess_{name}"] = Metric(float(one.of("ess").mean()), "particles", "higher")
            metrics[f"lost_runs_{name}"] = Metric(float(one.of("lost").sum()), f"of {len(one.runs)}", "lower")
    for cost in ("", PAPER_COST):
        for data in "AB":
            p = _p_value(runs, data, f"rbpf{cost}", f"pf{cost}")
            metrics[f"p_value_rbpf_better_{data.lower()}{cost}"] = Metric(p, "", "lower")
    for test, baseline in GUIDED_TESTS.items():
        if column(runs, "B", baseline).runs:
            metrics[f"p_value_rbpf{test}_b"] = Metric(_p_value(runs, "B", "rbpf_guided", baseline), "", "lower")
    return metrics


def _filters(num_particles: int, quick: bool) -> dict[str, dict[str, Filtering]]:
    both: dict[str, Filtering] = {"frozen": _frozen}
    for cost, setting in (("", hand.improved()), (PAPER_COST, hand.as_published())):
        both[f"pf{cost}"] = _filtering(setting, hand.particle_filter(setting, num_particles))
        both[f"rbpf{cost}"] = _filtering(setting, hand.rao_blackwellized(setting, num_particles))
    if quick:
        return {"A": both, "B": both}
    improved = hand.improved()
    extra = {
        f"rbpf_{proposal.__name__}": _filtering(improved, hand.rao_blackwellized(improved, num_particles, proposal))
        for proposal in (plug_in, plug_in_corrected)
    }
    wide = hand.particle_filter(improved, num_particles, hand.spread_of_increments(improved))
    extra["pf_wide"] = _filtering(improved, wide)
    guided = {f"{name}_guided": _guided(name, num_particles) for name in ("pf", "rbpf")}
    return {"A": both, "B": both | extra | guided | {"registration": _registration}}


def _filtering(setting: hand.Setting, filter: Filter) -> Filtering:
    view = hand.View(kinect_v2(), hand_geometry(), setting.segmented, setting.stride)
    return lambda key, frames: hand.track(filter, key, view, frames)


def _guided(name: str, num_particles: int) -> Filtering:
    """The tracker as users run it, given the size of the hand but not where it starts."""
    config = HandDepthConfig(filter=name, num_particles=num_particles, hand="right", scale=1.0)
    tracker = hand_depth.build(kinect_v2(), config, hand_geometry())

    def filtering(key: AnyKey, frames: jax.Array) -> hand.Estimate:
        state = tracker.init(key, np.asarray(frames[0]))
        _, found = tracker.step(state, np.asarray(frames), FRAME_INTERVAL * np.arange(len(frames), dtype=np.float32))
        return hand.Estimate(*map(jax.numpy.asarray, (found.pose, found.joints, found.effective_sample_size)))

    return filtering


def _registration(key: AnyKey, frames: jax.Array) -> hand.Estimate:
    """Registration alone, from the start that the tracker finds and with what it is given."""
    config = HandDepthConfig(num_particles=64, hand="right", scale=1.0, guide=False)  # near the start that is found
    state = hand_depth.build(kinect_v2(), config, hand_geometry()).init(key, np.asarray(frames[0]))
    setup = hand_depth.set_up(kinect_v2(), config, hand_geometry())
    poses, joints = registered(setup, state, frames, jax.numpy.full(len(frames), FRAME_INTERVAL))
    return hand.Estimate(poses, joints, jax.numpy.full(len(frames), jax.numpy.nan))


def _frozen(key: AnyKey, frames: jax.Array) -> hand.Estimate:
    """The pose before the first frame, for ever: the floor."""
    del key
    pose = open_palm(jax.numpy.asarray(START, dtype=float))
    joints = forward_kinematics(pose, hand_geometry()).joints
    still = hand.Estimate(pose, joints, jax.numpy.full((), jax.numpy.nan))
    return jax.tree.map(lambda leaf: jax.numpy.broadcast_to(leaf, (len(frames), *leaf.shape)), still)


def _measure_times(quick: bool, seed: int, out: Path | None) -> dict[int, StepTimes]:
    times: dict[int, StepTimes] = {}
    for count in QUICK_COUNTS if quick else COUNTS:
        times[count] = measure(count, QUICK_ROUNDS if quick else ROUNDS, seed)
        _report(_time_row(count, times[count]))
    _say(out, _time_table(times))
    if out is not None:
        plot_times(out / "time_per_frame.png", {n: (_median_ms(t.pf), _median_ms(t.rbpf)) for n, t in times.items()})
    return times


def _measure_variants(num_particles: int, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """The two dearer frames: rendered from the mesh, and with registration before the draw."""
    seconds = measure_variants(num_particles, QUICK_ROUNDS if quick else ROUNDS, seed)
    _say(out, "".join(f"{name:>20} {_median_ms(times):8.2f} ms\n" for name, times in seconds.items()))
    return {
        f"frame_ms_{name}_n{num_particles}": Metric(_median_ms(times), "ms", "lower") for name, times in seconds.items()
    }


def _measure_accuracy(
    filters: dict[str, dict[str, Filtering]], seeds: range, num_frames: int | None, out: Path | None, kept: Finished
) -> list[Run]:
    runs: list[Run] = []
    begin = time.monotonic()
    for seed, (data, chosen) in itertools.product(seeds, filters.items()):
        folder_of_plots = out if seed == seeds.start else None
        measure = partial(_measure_recording, chosen, data, seed, num_frames, out, folder_of_plots)
        new = from_arrays(kept.arrays(f"data_{data}_{seed}", measure))
        runs += new
        errors = "  ".join(f"{one.filter} {one.joint_mm:.1f}" for one in new)
        _report(f"[{time.monotonic() - begin:5.0f} s] seed {seed} data {data}, mm: {errors}")
    return runs


def _measure_recording(
    filters: dict[str, Filtering],
    data: str,
    seed: int,
    num_frames: int | None,
    out: Path | None,
    folder_of_plots: Path | None,
) -> dict[str, np.ndarray]:
    runs, track = run_all(filters, data, seed, num_frames)
    if out is not None:
        append_csv(out / "runs.csv", runs)
    if folder_of_plots is not None:
        _plot(folder_of_plots, data, track)
    return as_arrays(runs)


def _plot(out: Path, data: str, track: Track) -> None:
    for cost in ("", PAPER_COST):
        estimates = {name: track.estimates[f"{name}{cost}"].pose for name in ("pf", "rbpf")}
        plot_tracks(out / f"data_{data.lower()}{cost}.png", data, track.truth.poses, estimates)


def _columns(runs: list[Run]) -> list[Column]:
    pairs = dict.fromkeys((run.data, run.filter) for run in runs)
    return [column(runs, *pair) for pair in sorted(pairs, key=lambda pair: pair[0])]


def _metric_name(one: Column) -> str:
    filter, cost, _ = one.filter.partition(PAPER_COST)
    return f"{filter}_{one.data.lower()}{cost}"


def _p_value(runs: list[Run], data: str, candidate: str, baseline: str) -> float:
    return p_value_better(*(column(runs, data, name).of("joint_mm") for name in (candidate, baseline)))


def _median_ms(seconds: np.ndarray) -> float:
    return float(1e3 * np.median(seconds))


def _preamble(num_particles: int, num_seeds: int, num_frames: int | None) -> str:
    machine = "  ".join(f"{name} {value}" for name, value in environment().items())
    return (
        f"{machine}\n"
        f"N {num_particles}, {num_seeds} seeds, {num_frames or 150} frames, window {hand.WINDOW}, "
        f"c_max {1e3 * hand.MAX_ERROR:g} mm\n"
        f"improved:   union cost, exp(-D/sigma), sigma {1e3 * hand.SIGMA:g} mm tempered to ESS "
        f"{hand.TEMPERED_SHARE:g} N, soft joint limits, angular velocities damped over {hand.DAMPING_TIME:g} s\n"
        f"paper cost: rendered pixels, exp(-D^2/2 sigma^2), sigma {1e3 * hand.PAPER_SIGMA:g} mm, nothing else\n"
    )


def _time_table(times: dict[int, StepTimes]) -> str:
    header = f"{'N':>5} {'PF ms':>8} {'RBPF ms':>8} {'RBPF/PF':>8} {'its predict ms':>15}"
    return "\n".join([header, *(_time_row(*row) for row in times.items())]) + "\n"


def _time_row(count: int, times: StepTimes) -> str:
    pf, rbpf, predict = map(_median_ms, (times.pf, times.rbpf, times.rbpf_predict))
    return f"{count:5} {pf:8.2f} {rbpf:8.2f} {times.ratio:8.3f} {predict:15.2f}"


_QUANTITIES = ("joint_mm", "tip_mm", "wrist_x_mm", "wrist_y_mm", "wrist_z_mm", "rotation_deg", "angle_deg", "ess")


def _accuracy_table(runs: list[Run]) -> str:
    """One line a filter: means over the seeds, runs above `LOST` mm, p-value of being better than the plain filter."""
    titles = ("joint", "+-se", "tip", "x", "y", "z", "rot.", "angle", "ess", "lost", "p(<pf)")
    lines = [
        f"Mean 3-D errors of joints and tips in mm; RMSE of the wrist in mm, of rotation and angles in degrees; "
        f"runs above {LOST:g} mm",
        f"data  {'filter':22}" + "".join(f"{title:>9}" for title in titles),
    ]
    for one in _columns(runs):
        values = [one.of(quantity).mean() for quantity in _QUANTITIES]
        error = one.of("joint_mm")
        spread = error.std(ddof=1) / np.sqrt(len(error)) if len(error) > 1 else np.nan
        baseline = "pf" + (PAPER_COST if PAPER_COST in one.filter else "_guided" if "guided" in one.filter else "")
        tested = one.filter not in (*WITHOUT_PARTICLES, baseline)
        p = f"{_p_value(runs, one.data, one.filter, baseline):.2g}" if tested else ""
        cells = [f"{values[0]:.2f}", f"{spread:.2f}", *(f"{value:.2f}" for value in values[1:-1]), f"{values[-1]:.0f}"]
        cells += [f"{int(one.of('lost').sum())}/{len(one.runs)}", p]
        lines.append(f"{one.data:5} {one.filter:22}" + "".join(f"{cell:>9}" for cell in cells))
    return "\n".join(lines) + "\n"


def _say(out: Path | None, text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
    if out is not None:
        with (out / "report.txt").open("a", encoding="utf-8") as file:
            file.write(text + "\n")


def _report(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
