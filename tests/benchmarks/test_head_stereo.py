"""The scenario of heads before two cameras: how runs are judged, and what the tables are made of."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _head_deformation as deformation
from jaxfilters.benchmarks.scenarios import _head_runs as runs
from jaxfilters.benchmarks.scenarios import _head_speed as speed
from jaxfilters.benchmarks.scenarios import head_stereo
from jaxfilters.benchmarks.scenarios._head_deformation import Schedule
from jaxfilters.benchmarks.scenarios._head_runs import AXES, HeadRun
from jaxfilters.benchmarks.scenarios._poses import DISPLAY
from jaxfilters.models.face.landmarks import MEAN_SHAPE
from jaxfilters.models.face.rig import nominal
from jaxfilters.models.synthetic.face_sequence import FaceSequence
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.state import RIGID, HeadTrack

K, ASTRAY = 10, 50.0


def fake_run(errors, *, std=1.0, shapes=None, contributions=(0.5,)):
    """A run with the given errors (t, 6) of the pose, millimetres and degrees, about a head that moves.

    An error of `ASTRAY` is a loss: 50 mm are 60 pixels.
    """
    errors = np.asarray(errors, float)
    t = len(errors)
    rng = np.random.default_rng(0)
    poses = np.concatenate([rng.normal(0, 30, (t + 1, 3)), rng.normal(0, 0.2, (t + 1, 3))], axis=-1)
    true_shapes = np.repeat(MEAN_SHAPE[None], t + 1, axis=0)
    poses[:, 2] += 650
    rig = nominal()
    uv = np.asarray(runs._projected(rig, true_shapes, np.asarray(poses, np.float32)), float)
    truth = SimpleNamespace(poses=poses, shapes=true_shapes, uv=uv, rig=rig)
    track = HeadTrack(
        pose=poses[1:] + errors / DISPLAY,
        pose_std=np.broadcast_to(std / DISPLAY, (t, 6)),
        deformation=np.zeros((t, 5)),
        shape=true_shapes[1:] if shapes is None else shapes,
        image_points=uv[1:],
        score=np.ones(t),
        effective_sample_size=np.ones(t),
        innovations=np.zeros((t, 2), int),
        status=np.full(t, RIGID, np.int32),
    )
    return HeadRun(track, truth, np.asarray(contributions))


@pytest.mark.system
def test_errors_are_in_millimetres_and_degrees_and_only_of_frames_with_the_face():
    errors = np.tile([1.0, 2.0, 3.0, 0.1, 0.2, 0.3], (6, 1))
    errors[4:] = ASTRAY
    run = fake_run(errors)
    np.testing.assert_allclose(runs.rmse(run), [1.0, 2.0, 3.0, 0.1, 0.2, 0.3], rtol=1e-6)
    assert runs.lost_share(run) == pytest.approx(2 / 6)
    assert np.all(np.isinf(runs.rmse(run, slice(4, 6))))


@pytest.mark.system
def test_a_pose_that_is_not_known_is_a_loss_and_covers_nothing():
    errors = np.zeros((4, 6))
    errors[3] = np.nan
    run = fake_run(errors)
    assert runs.lost_share(run) == 0.25
    np.testing.assert_allclose(runs.coverage(run), 0.75)
    np.testing.assert_allclose(runs.rmse(run), 0.0, atol=1e-9)


@pytest.mark.system
def test_coverage_is_that_of_a_gaussian():
    errors = np.random.default_rng(1).normal(0, 0.7, (4000, 6))
    # Four standard errors of a share of 0.954 in 4000.
    np.testing.assert_allclose(runs.coverage(fake_run(errors, std=0.7)), 0.9545, atol=4 * np.sqrt(0.0434 / 4000))


def test_shapes_are_compared_after_the_best_rotation():
    rng = np.random.default_rng(2)
    shapes = MEAN_SHAPE + rng.normal(0, 2, (5, K, 3))
    turned = np.stack([Rotation.random(random_state=i).apply(shape) + 7 for i, shape in enumerate(shapes)])
    np.testing.assert_allclose(runs.apart_after_alignment(turned, shapes), 0, atol=1e-6)
    noisy = turned + rng.normal(0, 1, turned.shape)
    expected = []
    for a, b in zip(noisy, shapes, strict=True):
        _, residual = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
        expected.append(residual / np.sqrt(K))
    np.testing.assert_allclose(runs.apart_after_alignment(noisy, shapes), expected, rtol=1e-6)
    mirrored = shapes * np.array([-1.0, 1.0, 1.0])
    assert np.all(runs.apart_after_alignment(mirrored, shapes) > 5)
    noisy[2] = np.nan
    assert np.isnan(runs.apart_after_alignment(noisy, shapes)).tolist() == [False, False, True, False, False]


@pytest.mark.system
def test_landmarks_are_compared_in_the_world():
    errors = np.zeros((3, 6))
    errors[:, 2] = [0.0, 1.0, 2.0]
    np.testing.assert_allclose(fake_run(errors).landmark_errors, [0.0, 1.0, 2.0], atol=1e-4)


@pytest.mark.system
def test_tables_compare_with_the_rows_of_the_paper():
    paper = np.array(head_stereo.PAPER_ADAPTIVE["slow"])
    astray = np.tile(paper, (5, 1))
    astray[3:] = ASTRAY
    table = {
        "": {100: fake_run(np.tile(0.25 * paper, (5, 1))), 101: fake_run(np.tile(0.75 * paper, (5, 1)))},
        "_paper": {100: fake_run(np.tile(0.25 * paper, (5, 1)))},
        "_paper_fixed5": {100: fake_run(astray)},
    }
    metrics = {name: metric.value for name, metric in head_stereo.table_metrics("slow", table).items()}
    for axis in AXES:
        assert metrics[f"ratio_to_paper_adaptive_slow_{axis}"] == pytest.approx(0.5)
        assert metrics[f"worst_ratio_to_paper_adaptive_slow_{axis}"] == pytest.approx(0.75)
        assert metrics[f"adaptive_to_fixed5_slow_{axis}_paper"] == pytest.approx(0.25)
    assert metrics["coverage_2sigma_slow_x"] == 1
    assert metrics["lost_share_slow_paper_fixed5"] == pytest.approx(0.4)
    assert metrics["lost_runs_slow_paper_fixed5"] == 1
    assert metrics["lost_runs_slow"] == 0


@pytest.mark.system
def test_recovery_is_when_the_errors_of_the_next_frames_are_the_usual_ones():
    errors = np.full((599, 6), 0.1)
    errors[200:229] = 2.0  # frames 201 to 229: covered until 230
    errors[229:236, 5] = 2.0  # frames 230 to 236; of 15 frames' errors, one of 2.0 is allowed: 4 / 15 < 0.7^2 < 8 / 15
    errors[310, 2] = 5.0
    evaluated = head_stereo.judge_occlusion(fake_run(errors), np.full(6, 0.1))
    assert evaluated["recovery_frames"] == 6
    assert evaluated["occlusion_peak_x"] == pytest.approx(2)
    assert evaluated["dimming_peak_z"] == pytest.approx(5)
    assert evaluated["dimming_peak_x"] == pytest.approx(0.1)
    assert evaluated["after_occlusion_to_allowed"] == pytest.approx(0.1 / 0.7)
    assert evaluated["occlusion_lost_share"] == 0
    errors[240:] = ASTRAY
    never = head_stereo.judge_occlusion(fake_run(errors), np.full(6, 0.1))
    assert never["recovery_frames"] == np.inf
    assert never["occlusion_lost_share"] == pytest.approx(359 / 599)


@pytest.mark.system
def test_deformation_is_judged_in_the_frames_in_which_it_is():
    schedule = Schedule(40, 120, 200)
    far, near = np.full((199, 6), 0.2), np.full((199, 6), 0.2)
    shapes = MEAN_SHAPE + np.random.default_rng(3).normal(0, 1, (199, K, 3))
    far[39:119, 5], near[39:119, 5] = 4.0, 1.0
    far[119:, 5] = near[119:, 5] = 0.5
    learned = fake_run(near, shapes=shapes, contributions=(0.1, 0.2, 0.9, 0.9, 0.9))
    of = {"rigid": [fake_run(far, shapes=shapes)], "deformable": [learned]}
    metrics = {name: metric.value for name, metric in deformation.evaluated("", of, schedule).items()}
    assert metrics["deforming_rmse_pitch_rigid"] == pytest.approx(4)
    assert metrics["deforming_ratio_to_rigid_rmse_pitch"] == pytest.approx(0.25)
    assert metrics["afterwards_ratio_to_rigid_rmse_pitch"] == pytest.approx(1)
    assert metrics["deforming_ratio_to_rigid_shape"] == pytest.approx(1)
    # Frame 120, the last that counts, is in the third block of 40.
    assert metrics["contribution_deformable"] == metrics["least_contribution_deformable"] == 0.9


def test_the_picture_of_the_deformation_has_four_charts(tmp_path):
    schedule = Schedule(40, 120, 200)
    wave = np.sin(np.arange(199) / 10)[:, None] * np.ones(6)
    of = {
        name: [fake_run(scale * wave, contributions=np.linspace(0, 1, 5))]
        for scale, name in enumerate(deformation.COLORS)
    }
    deformation.plot(tmp_path / "deformation.png", of, schedule)
    image = cv2.imread(str(tmp_path / "deformation.png"))
    assert image.shape == (3 * 260 + 200, 900, 3)
    for color in deformation.COLORS.values():
        assert np.any(np.all(np.abs(image.astype(int) - color) < 12, axis=-1))


SIZES = {
    "": 0.5,
    "_learning": 0.25,
    "_paper": 1.0,
    "_paper_fixed5": 2.0,
    "_paper_fixed1": 1.5,
    "rigid": 1.0,
    "deformable": 0.5,
    "paper_rigid": 2.0,
    "paper_deformable": 1.5,
}
"""Of the errors in millimetres and degrees, by the names of the trackers that stand-ins are for."""


def stand_ins(num_frames, trackers):
    """Runs whose errors change their sign with every frame."""
    signs = np.where(np.arange(num_frames - 1) % 2, 1.0, -1.0)[:, None] * np.ones(6)
    contributions = 0.1 * np.arange(1 + num_frames // deformation.BLOCK)
    return {name: fake_run(SIZES[name] * signs, contributions=contributions) for name in trackers}


@pytest.mark.system
def test_every_table_is_made_of_the_runs_of_its_trackers(monkeypatch, tmp_path):
    """Videos are their numbers of frames, and stand-ins follow them."""
    monkeypatch.setattr(head_stereo, "sequence", lambda key, kind, num_frames, seed, **more: num_frames)
    for module in (head_stereo, deformation):
        monkeypatch.setattr(module, "face_sequence", lambda key, poses, **more: len(poses))
        monkeypatch.setattr(module, "follow", stand_ins)
    speed_of = {"fps_1000_particles": Metric(50.0, "frames/s", "higher")}
    monkeypatch.setattr(head_stereo, "speed_metrics", lambda first, counts, rounds: speed_of)
    metrics = head_stereo.run(quick=True, seed=0, out=tmp_path)
    value = {name: metric.value for name, metric in metrics.items()}
    for kind, paper in head_stereo.PAPER_ADAPTIVE.items():
        for axis, published in zip(AXES, paper, strict=True):
            assert value[f"ratio_to_paper_adaptive_{kind}_{axis}"] == pytest.approx(0.5 / published)
            assert value[f"worst_ratio_to_paper_adaptive_{kind}_{axis}_learning"] == pytest.approx(0.25 / published)
            assert value[f"adaptive_to_fixed5_{kind}_{axis}_paper"] == pytest.approx(0.5)
            assert value[f"coverage_2sigma_{kind}_{axis}"] == 1
        assert value[f"lost_share_{kind}_paper_fixed1"] == 0
    # Of 179 frames: one sign more than of the other.
    assert value["still_std_x_paper_fixed5"] == pytest.approx(2.0 * np.sqrt(1 - 179.0**-2))
    assert value["recovery_frames"] == 0
    assert [value[f"{name}_learning"] for name in ("occlusion_peak_pitch", "dimming_peak_x")] == pytest.approx(
        [0.25] * 2
    )
    assert value["after_occlusion_to_allowed"] == pytest.approx(0.5 / 1.5)
    assert value["deforming_ratio_to_rigid_rmse_pitch"] == pytest.approx(0.5)
    assert value["afterwards_ratio_to_rigid_rmse_x_paper"] == pytest.approx(0.75)
    assert value["mild_deforming_rmse_yaw_rigid"] == pytest.approx(1.0)
    # Frame 200 is the last of five blocks.
    assert value["contribution_deformable"] == pytest.approx(0.4)
    assert value["fps_1000_particles"] == 50
    assert (tmp_path / "deformation.png").stat().st_size > 10_000


class Numbers(FaceSequence):
    """A video whose images are the numbers of its frames."""

    def __init__(self, num_frames):
        for name, value in {"uv": np.zeros((num_frames, 2, K, 2)), "times": np.arange(num_frames) / 30}.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "rig", nominal())

    def frames(self, start, stop):
        return np.arange(start, stop)


def test_a_run_begins_with_the_second_frame_and_has_every_other_one(monkeypatch):
    handed = []

    class Session:
        def __init__(self, rig, options, points):
            self.contribution = 0.0

        def process(self, images, times):
            handed.append(len(images))
            self.contribution += len(images)
            return HeadTrack(*(images[:, None] for _ in HeadTrack._fields))

    monkeypatch.setattr(runs, "HeadSession", Session)
    run = runs.follow(Numbers(91), {"usual": HeadConfig()})["usual"]
    assert handed == [1, 40, 40, 10]
    np.testing.assert_array_equal(run.track.score[:, 0], range(1, 91))
    np.testing.assert_array_equal(run.contributions, [41, 81, 91])


def test_a_frame_is_shared_out_among_its_stages(monkeypatch):
    """Seconds of eight frames, and of one where they come alone."""
    one = speed.Prepared(None, None, None, None, np.zeros((speed.BATCH, 1)), np.zeros(speed.BATCH))
    seconds = {"_250_particles": 0.04, "_1000_particles": 0.08, "_1000_particles_paper": 0.16}
    seconds |= {"_1000_particles_live": 0.012, "stage particles": 0.04, "stage learning": 0.016}
    seconds |= {"stage particles_paper": 0.2}
    monkeypatch.setattr(speed, "recording", lambda seed: None)
    monkeypatch.setattr(speed, "prepared", lambda recorded, options: one)
    monkeypatch.setattr(speed, "modern_stages", lambda one: dict.fromkeys(("particles", "learning")))
    monkeypatch.setattr(speed, "paper_stages", lambda one: dict.fromkeys(("particles",)))
    monkeypatch.setattr(speed, "interleaved", lambda calls, rounds: {name: seconds[name] for name in calls})
    value = {name: metric.value for name, metric in speed.speed_metrics(0, (250, 1000), 3).items()}
    assert value["frame_ms_250_particles"] == pytest.approx(5.0)
    assert value["fps_1000_particles"] == pytest.approx(100.0)
    assert value["frame_ms_1000_particles_live"] == pytest.approx(12.0)
    assert [value[f"stage_share_{name}"] for name in ("particles", "learning", "rest")] == pytest.approx(
        [0.5, 0.2, 0.3]
    )
    # Stages that take longer alone than together leave nothing.
    assert value["stage_share_particles_paper"] == 1
    assert value["stage_ms_rest_paper"] == 0
