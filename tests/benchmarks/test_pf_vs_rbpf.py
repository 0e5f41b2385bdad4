"""The comparison of hand filters: its statistics on made-up runs, its filters on what they must have in common."""

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import _accuracy, _step_time, pf_vs_rbpf
from jaxfilters.benchmarks.scenarios import _hand_filters as hand
from jaxfilters.benchmarks.scenarios._accuracy import Run, append_csv, evaluate, p_value_better
from jaxfilters.benchmarks.scenarios._step_time import StepTimes
from jaxfilters.filter import init
from jaxfilters.models.hand.skeleton import forward_kinematics, hand_geometry, open_palm
from jaxfilters.models.synthetic.hand import HandSequence, kinect_v2
from jaxfilters.trackers.tracker import Tracker


def made_up(data, filter, seed, joint_mm):
    return Run(data, filter, seed, joint_mm, 2 * joint_mm, 1.0, 2.0, 3.0, 4.0, 5.0, 100.0)


def made_up_runs(errors):
    """Runs of both filters on both kinds of data, with both costs, from (seeds, 2) errors."""
    names = [("pf", "rbpf"), ("pf_paper_cost", "rbpf_paper_cost")]
    return [
        made_up(data, name, seed, float(error))
        for data, pair in itertools.product("AB", names)
        for seed, row in enumerate(errors)
        for name, error in zip(pair, row, strict=True)
    ]


@pytest.fixture(scope="module")
def still():
    """The truth of a hand that holds still for 30 frames, without images."""
    poses = jnp.tile(open_palm(jnp.array([0.0, 0.09, 0.7])), (30, 1))
    joints = jax.jit(jax.vmap(lambda pose: forward_kinematics(pose, hand_geometry()).joints))(poses)
    return HandSequence(poses, joints, jnp.zeros((30, 1, 1), jnp.uint16))


def exact_signed_rank_p(difference):
    """Share of all sign patterns whose sum of positive ranks is at most the observed one: the test's definition."""
    ranks = np.argsort(np.argsort(np.abs(difference))) + 1
    patterns = np.array(list(itertools.product([0, 1], repeat=len(ranks))))
    return np.mean(patterns @ ranks <= ranks[difference > 0].sum())


def test_p_value_is_the_share_of_sign_patterns_that_are_as_good():
    rng = np.random.default_rng(0)
    for _ in range(5):
        candidate, baseline = rng.normal([[-0.4], [0.4]], 1, (2, 10))
        expected = exact_signed_rank_p(candidate - baseline)
        assert p_value_better(candidate, baseline) == pytest.approx(expected, abs=1e-12)


def test_p_value_is_one_sided_and_one_without_a_difference():
    better, worse = np.arange(8.0), np.arange(8.0) + 1 + np.arange(8.0) / 10
    assert p_value_better(better, worse) == pytest.approx(2.0**-8)
    assert p_value_better(worse, better) == 1.0
    assert p_value_better(better, better) == 1.0


def test_metrics_are_means_over_seeds_and_tests_of_pairs():
    errors = np.stack([np.linspace(10, 50, 8), np.linspace(5, 44, 8)], axis=1)
    runs = made_up_runs(errors)
    metrics = pf_vs_rbpf.accuracy_metrics(runs[::-1])  # pairs are made by seed, not by order
    assert metrics["joint_error_mm_pf_b"].value == pytest.approx(30)
    assert metrics["joint_error_mm_rbpf_b_paper_cost"].value == pytest.approx(24.5)
    assert metrics["tip_error_mm_rbpf_a"].value == pytest.approx(49)
    assert metrics["lost_runs_pf_b"].value == np.sum(errors[:, 0] > 40)
    for cost in ("", "_paper_cost"):
        assert metrics[f"p_value_rbpf_better_b{cost}"].value == pytest.approx(2.0**-8)


def test_the_tracker_is_tested_against_registration_alone_on_data_b():
    errors = {"rbpf_guided": 1.0 + np.arange(8.0), "pf_guided": 2.0 + np.arange(8.0), "registration": np.arange(8.0)}
    made = [made_up("B", name, seed, error) for name, each in errors.items() for seed, error in enumerate(each)]
    metrics = pf_vs_rbpf.accuracy_metrics(made_up_runs(np.ones((8, 2))) + made)
    assert metrics["joint_error_mm_registration_b"].value == pytest.approx(3.5)
    assert metrics["p_value_rbpf_guided_better_b"].value == pytest.approx(2.0**-8)
    assert metrics["p_value_rbpf_guided_better_than_registration_b"].value == pytest.approx(1.0)
    assert "mean_ess_registration_b" not in metrics


def test_registration_alone_starts_where_the_tracker_does(monkeypatch):
    """A stand-in returns what it is given: the first frame as the state, the frames as poses, the times as joints."""
    tracker = Tracker(lambda key, frame: frame, lambda state, frames, times: None)
    monkeypatch.setattr(pf_vs_rbpf.hand_depth, "build", lambda *arguments: tracker)
    monkeypatch.setattr(pf_vs_rbpf, "registered", lambda setup, state, frames, dt: (frames - state, dt))
    frames = jnp.arange(3.0)[:, None, None] + jnp.ones((1, 2, 2))
    found = pf_vs_rbpf._registration(jax.random.key(0), frames)
    np.testing.assert_array_equal(found.pose, np.arange(3.0)[:, None, None] * np.ones((1, 2, 2)))
    np.testing.assert_allclose(found.joints, 3 * [1 / 30], rtol=1e-6)
    assert np.isnan(found.ess).all()


def test_a_run_without_estimates_is_lost():
    assert made_up("B", "rbpf", 0, float("nan")).lost
    assert made_up("B", "rbpf", 0, 40.1).lost
    assert not made_up("B", "rbpf", 0, 39.9).lost


def test_time_metrics_take_the_median_of_the_ratios():
    pf, rbpf = np.array([1.0, 2.0, 10.0]) * 1e-3, np.array([1.1, 1.0, 40.0]) * 1e-3
    metrics = pf_vs_rbpf.time_metrics({512: StepTimes(pf, rbpf, 0.1 * rbpf)})
    assert metrics["time_ratio_rbpf_over_pf_n512"].value == pytest.approx(1.1)
    assert metrics["frame_ms_pf_n512"].value == pytest.approx(2.0)
    assert metrics["frame_ms_rbpf_n512"].value == pytest.approx(1.1)
    assert metrics["predict_share_rbpf_n512"].value == pytest.approx(0.1)


@pytest.mark.system
def test_errors_are_those_of_a_known_shift(still):
    shift = jnp.array([0.003, 0.0, 0.004]) * (jnp.arange(30) >= 10)[:, None]
    found = hand.Estimate(still.poses.at[:, :3].add(shift), still.joints + shift[:, None], jnp.full(30, 7.0))
    run = evaluate("A", "pf", 3, found, still)
    # Positions near 0.7 m hold float32 to 3e-5 mm.
    assert run.joint_mm == pytest.approx(5, abs=1e-3)
    assert run.tip_mm == pytest.approx(5, abs=1e-3)
    assert (run.wrist_x_mm, run.wrist_y_mm, run.wrist_z_mm) == pytest.approx((3, 0, 4), abs=1e-3)
    assert (run.rotation_deg, run.angle_deg, run.ess) == pytest.approx((0, 0, 7), abs=1e-3)


def test_finished_runs_are_on_disk_at_once(tmp_path):
    path = tmp_path / "runs.csv"
    append_csv(path, [made_up("A", "pf", 0, 1.5)])
    append_csv(path, [made_up("A", "rbpf", 0, 2.5)])
    header, first, second = path.read_text().splitlines()
    assert header.split(",") == [field.name for field in dataclasses.fields(Run)]
    assert first.startswith("A,pf,0,1.5,")
    assert second.startswith("A,rbpf,0,2.5,")


@pytest.mark.system
def test_both_filters_start_from_the_same_particles_and_share_their_noise():
    setting = hand.improved()
    pf, rbpf = (build(setting, 16) for build in (hand.particle_filter, hand.rao_blackwellized))
    key = jax.random.key(0)
    plain, marginal = (init(filter, key) for filter in (pf, rbpf))
    np.testing.assert_array_equal(plain.particles, marginal.particles)
    np.testing.assert_array_equal(plain.noise, marginal.noise)


def test_the_wide_filter_spreads_like_the_rao_blackwellized_one():
    # Steady state of one undamped coordinate, specification 2.5: N = dt^2 P + dt q_n.
    setting = hand.improved()
    motion, dt = setting.motion, 1 / 30
    q_n, q_l = float(motion.pose_variance_rate[0]), float(motion.velocity_variance_rate[0])
    settled = 0.5 * (dt * q_l + np.sqrt((dt * q_l) ** 2 + 4 * q_l * q_n))
    np.testing.assert_allclose(hand.spread_of_increments(setting)[0], dt * settled + q_n, rtol=1e-3)


SHIFTS_MM = {"frozen": 50.0, "pf": 20.0, "rbpf": 10.0, "pf_paper_cost": 30.0, "rbpf_paper_cost": 45.0}


@pytest.mark.system
def test_every_filter_is_judged_on_every_recording(still, tmp_path, monkeypatch):
    """Stand-ins say of a hand that holds still that it is a known way aside."""

    def stand_in(millimetres):
        shift = jnp.array([1e-3 * millimetres, 0.0, 0.0])
        found = hand.Estimate(still.poses.at[:, :3].add(shift), still.joints + shift, jnp.full(30, 7.0))
        return lambda key, frames: found

    chosen = {name: stand_in(millimetres) for name, millimetres in SHIFTS_MM.items()}
    assert list(pf_vs_rbpf._filters(16, quick=True)["A"]) == list(chosen)
    seconds = np.array([0.001, 0.002])
    monkeypatch.setattr(pf_vs_rbpf, "_filters", lambda num_particles, quick: {"A": chosen, "B": chosen})
    monkeypatch.setattr(pf_vs_rbpf, "measure", lambda *arguments: StepTimes(seconds, 2 * seconds, seconds))
    variants = {"rbpf_mesh_stride2": 4 * seconds, "rbpf_guided": 8 * seconds}
    monkeypatch.setattr(pf_vs_rbpf, "measure_variants", lambda *arguments: variants)
    filtered = []
    monkeypatch.setattr(_accuracy, "simulate_sequence", lambda key, data, num_frames: filtered.append(data) or still)
    monkeypatch.setattr(pf_vs_rbpf, "real_metrics", lambda num_particles, quick, kept: {})
    run = partial(pf_vs_rbpf.run, quick=True, seed=0, out=tmp_path, num_particles=16)
    run(num_seeds=1)
    metrics = run(num_seeds=2)
    assert filtered == ["A", "B"] * 2  # the second run takes the first seed from the folder
    value = {name: metric.value for name, metric in metrics.items()}
    for data, (name, millimetres) in itertools.product("ab", SHIFTS_MM.items()):
        name, cost, _ = name.partition("_paper_cost")
        assert value[f"joint_error_mm_{name}_{data}{cost}"] == pytest.approx(millimetres, abs=1e-3)
    assert [value[f"lost_runs_rbpf_b{cost}"] for cost in ("", "_paper_cost")] == [0, 2]
    # Two pairs that both fall the same way: one of four patterns of signs.
    assert [value[f"p_value_rbpf_better_b{cost}"] for cost in ("", "_paper_cost")] == pytest.approx([0.25, 1.0])
    assert value["time_ratio_rbpf_over_pf_n64"] == pytest.approx(2.0)
    assert value["frame_ms_rbpf_mesh_stride2_n16"] == pytest.approx(6.0)
    assert value["frame_ms_rbpf_guided_n16"] == pytest.approx(12.0)
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 1 + 2 * 2 * len(SHIFTS_MM)
    assert {path.name for path in tmp_path.glob("*.png")} == {
        "time_per_frame.png",
        *(f"data_{data}{cost}.png" for data in "ab" for cost in ("", "_paper_cost")),
    }


def test_a_filter_that_is_timed_starts_anew_after_the_last_frame(monkeypatch):
    monkeypatch.setattr(_step_time, "init", lambda filter, key: 0)
    advance = lambda filter, key, view, state, frame: (state + 1, (state, int(frame[0, 0])))
    monkeypatch.setattr(_step_time, "advance", advance)
    setting = hand.improved()
    view = hand.View(kinect_v2(), hand_geometry(), setting.segmented, setting.stride)
    frames = jnp.zeros((3, 1, 1)) + jnp.arange(3)[:, None, None]
    follower = _step_time._Follower(hand.particle_filter(setting, 16), jax.random.key(0), view, frames)
    assert [follower() for _ in range(5)] == [(0, 0), (1, 1), (2, 2), (0, 0), (1, 1)]


def test_rounds_that_are_timed_come_after_those_that_warm_up(monkeypatch):
    monkeypatch.setattr(_step_time, "NUM_FRAMES", 2)
    calls = []
    seconds = _step_time.rounds_of({name: lambda name=name: calls.append(name) for name in "ab"}, 3)
    assert "".join(calls) == "ab" + "ba" + "ab" + "ba" + "ab"
    assert [len(times) for times in seconds.values()] == [3, 3]
