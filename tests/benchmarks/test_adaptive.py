"""The scenario of adaptive filters: its targets, its numbers on made-up beliefs, and that all filters have theirs."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import adaptive
from jaxfilters.benchmarks.scenarios.adaptive import NOISE, SETTLED, Belief, Sequence


@pytest.mark.system
def test_targets_rest_and_jerk_without_a_jump_of_their_velocity():
    sequence = adaptive.simulate(0, 3, 11)
    truth = np.asarray(sequence.truth)
    assert truth.shape == sequence.observed.shape == (3, adaptive.NUM_FRAMES, 11)
    steps = np.diff(truth[..., :6], axis=1)
    np.testing.assert_array_equal(np.any(steps != 0, axis=-1), sequence.moving[:, 1:])
    assert 0.1 < sequence.moving.mean() < 0.4
    # Of the minimum-jerk way in eight frames or more the velocity changes by 5.8 / 64 of the way a frame at most.
    assert np.max(np.abs(np.diff(steps, axis=1)) / adaptive.JERK) < 5 * 5.8 / 64
    noise = (sequence.observed - truth @ adaptive._observation(11).T) / NOISE
    np.testing.assert_allclose(np.std(noise, axis=(0, 1)), 1, atol=4 / np.sqrt(1800))


def test_metrics_are_root_mean_squares_in_units_of_the_noise():
    moving = np.arange(60) >= 40
    error = np.where(moving, 3.0, 1.0)[:, None] * NOISE * np.array([1, -1] * 5 + [1])
    error[:SETTLED] = 100
    error[-1] *= 2
    sequence = Sequence(jnp.zeros((1, 60, 11)), jnp.zeros((1, 60, 11)), moving[None])
    std = NOISE * np.where(moving, 1.4, 0.6)[:, None]
    belief = Belief(jnp.asarray(error[None]), jnp.asarray(std[None]))
    pose = adaptive.pose_metrics("a", sequence, belief)
    assert pose["error_rest_a"].value == pytest.approx(1)
    assert pose["error_jerk_a"].value == pytest.approx(np.sqrt((19 * 9 + 36) / 20))
    assert pose["worst_error_a"].value == pytest.approx(6)
    face = adaptive.face_metrics("b", sequence, belief)
    assert face["coverage_error_b"].value == pytest.approx(0.954 - 0.5)
    for group in ("pose", "deformation"):
        assert face[f"error_{group}_b"].value == pytest.approx(np.sqrt((20 + 19 * 9 + 36) / 40))


@pytest.mark.system
def test_an_adaptive_diffusion_beats_fixed_ones(tmp_path, monkeypatch):
    """The three share one program; those of the second problem are compared in the tests of their functions."""
    names = ("fixed_small", "fixed_large", "adaptive")
    filters = {name: filter for name, filter in adaptive.pose_filters().items() if name in names}
    monkeypatch.setattr(adaptive, "pose_filters", lambda: filters)
    monkeypatch.setattr(adaptive, "face_filters", dict)
    monkeypatch.setattr(adaptive, "NUM_FRAMES", 120)
    monkeypatch.setattr(adaptive, "QUICK_NUM_SEEDS", 10)
    metrics = adaptive.run(quick=True, seed=0, out=tmp_path)
    value = {name: metric.value for name, metric in metrics.items()}
    assert set(value) == {f"{q}_{n}" for q in ("error_rest", "error_jerk", "worst_error") for n in names}
    assert value["error_rest_adaptive"] < 0.85 * value["error_rest_fixed_large"]
    assert value["error_jerk_adaptive"] < value["error_jerk_fixed_large"]
    assert value["worst_error_adaptive"] < 0.5 * value["worst_error_fixed_small"]
    assert "120 frames" in (tmp_path / "adaptive.txt").read_text()
