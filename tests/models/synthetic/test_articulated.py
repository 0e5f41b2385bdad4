"""Synthetic hands: the facts that the specification states of its sequences, and the statistics of the noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.articulated.ambiguity import depth_mirror
from jaxfilters.models.articulated.limits import limit_rows, table_1
from jaxfilters.models.synthetic.articulated import (
    CRITICAL_FRAME,
    INITIAL_SHAPE,
    LAYOUT,
    SHAPES,
    critical_states,
    held_states,
    initial_belief,
    one_link,
    one_link_length,
    one_link_near_image_plane,
    paper_hand,
    paper_states,
    record,
    simulate_critical,
    simulate_held,
    simulate_paper,
)

STATES = {"shape1": lambda: paper_states(1), "shape2": lambda: paper_states(2), "held": lambda: held_states(2, 3, 20)}


@pytest.mark.system
@pytest.mark.parametrize("name", STATES)
def test_truth_satisfies_table_1_at_every_frame(name):
    rows = limit_rows(LAYOUT, table_1())
    values = np.asarray(STATES[name]()) @ np.asarray(rows.normals).T
    assert np.all((values >= np.asarray(rows.lower)) & (values <= np.asarray(rows.upper)))


def test_truth_of_the_paper_sequence_follows_the_stated_formulas():
    states = np.asarray(paper_states(2))
    assert states.shape == (55, 37)
    n = 17
    turn = Rotation.from_rotvec(
        np.deg2rad(
            [22 * np.sin(2 * np.pi * n / 45), 28 * np.sin(2 * np.pi * n / 33 + 0.4), 15 * np.sin(2 * np.pi * n / 60)]
        )
    )
    rotation = turn * Rotation.from_quat((0.5, -0.5, 0.5, -0.5), scalar_first=True)
    q = states[n, 2:6]
    assert np.sum(q**2) == pytest.approx(1 + 0.12 * np.sin(2 * np.pi * n / 55), abs=1e-5)
    np.testing.assert_allclose(Rotation.from_quat(q, scalar_first=True).as_matrix(), rotation.as_matrix(), atol=1e-5)
    np.testing.assert_allclose(
        states[n, :2], [20 * np.sin(2 * np.pi * n / 50), 90 + 15 * np.sin(2 * np.pi * n / 37)], atol=1e-4
    )
    first = 30 - 25 * np.cos(2 * np.pi * n / 29)
    second = 32 - 24 * np.cos(2 * np.pi * n / 29 - 0.3)
    expected = [
        -10 + 6 * np.sin(2 * np.pi * n / 40),
        35 - 30 * np.cos(2 * np.pi * n / 36),
        first,
        first + 5 * np.sin(2 * np.pi * n / 23),
        10 + 6 * np.sin(2 * np.pi * n / 44),
        38 - 28 * np.cos(2 * np.pi * n / 36 - 0.35),
        second,
        second - 5 * np.sin(2 * np.pi * n / 25),
    ]
    np.testing.assert_allclose(np.rad2deg(states[n, 6:14]), expected, atol=1e-4)
    np.testing.assert_allclose(states[:, 28:], np.broadcast_to(SHAPES[2], (55, 9)))


@pytest.mark.parametrize("states_of", [paper_states, lambda: critical_states()])
def test_rates_are_derivatives_of_the_motion(states_of, x64):
    states = np.asarray(states_of())
    central = 0.5 * (states[2:, :14] - states[:-2, :14])
    # A sixth of the third derivative: 20 pixels and 30 degrees at periods of 23 frames or more, and sums of two such.
    bound = (2 * np.pi / 23) ** 3 / 6 * np.repeat([20, 1, np.deg2rad(60)], [2, 4, 8])
    assert np.all(np.abs(states[1:-1, 14:28] - central) < bound)
    assert np.all(np.abs(states[:, 2:6]).max(axis=0) > 0)


def test_scale_is_one_at_the_first_frame():
    for states in (paper_states(1), critical_states(), held_states(1, 2, 20)):
        assert float(jnp.sum(states[0, 2:6] ** 2)) == pytest.approx(1, abs=1e-6)


def test_critical_pose_has_the_stated_geometry(x64):
    states, hand = critical_states(), paper_hand()
    assert states.shape == (37, 37)
    points = np.asarray(hand.points(states[CRITICAL_FRAME]))
    depth = (points[0, 3] - points[0, 2])[2] / 35
    assert depth == pytest.approx(-0.004, abs=5e-4)
    assert float(depth_mirror(states[CRITICAL_FRAME], hand, 0, 2).amplitude) == pytest.approx(0.993, abs=5e-4)
    # The fingers lead away from the camera.
    assert points[0, 0, 2] > 0
    for frame, violation in ((16, 18), (20, 19)):
        mirrored = LAYOUT.angles_of(depth_mirror(states[frame], hand, 0, 2).x)[0]
        assert np.rad2deg(abs(mirrored[2] - mirrored[3])) - 10 == pytest.approx(violation, abs=0.5)


def test_a_held_pose_is_that_of_its_frame_at_scale_one():
    states, moving = np.asarray(held_states(1, 7, 20)), np.asarray(paper_states(1))[20]
    assert states.shape == (7, 37)
    assert np.all(states == states[0])
    np.testing.assert_array_equal(states[0, 14:28], 0)
    np.testing.assert_allclose(states[0, 6:14], moving[6:14], rtol=1e-6)
    np.testing.assert_allclose(states[0, 2:6], moving[2:6] / np.linalg.norm(moving[2:6]), rtol=1e-5)


@pytest.mark.system
@pytest.mark.parametrize(
    ("simulate", "shape"),
    [
        (lambda key: simulate_paper(key, 2), (55, 29)),
        (lambda key: simulate_held(key, 1, num_frames=20), (20, 29)),
        (simulate_critical, (37, 21)),
    ],
)
def test_a_key_decides_the_sequence(simulate, shape):
    a, b, c = (simulate(jax.random.key(seed)) for seed in (1, 1, 2))
    assert a.features.shape == a.masks.shape == shape
    assert a.noise_std.shape == shape[1:]
    np.testing.assert_array_equal(a.features, b.features)
    np.testing.assert_array_equal(a.initial_mean, b.initial_mean)
    assert not np.allclose(a.features, c.features)
    assert not np.allclose(a.initial_mean, c.initial_mean)
    assert all(np.all(np.isfinite(leaf)) for leaf in a)


@pytest.mark.system
def test_noise_of_the_features_has_the_stated_deviation():
    hand, states = paper_hand(), paper_states(1, 10)
    record_all = jax.jit(jax.vmap(lambda key: record(key, states, hand)))
    features, masks = record_all(jax.random.split(jax.random.key(0), 400))
    noise = np.asarray(features - jax.jit(jax.vmap(hand.observe))(states)) / np.asarray(hand.observation_std())
    count = noise[:, :, 0].size
    np.testing.assert_allclose(noise.mean(axis=(0, 1)), 0, atol=4 / np.sqrt(count))
    np.testing.assert_allclose((noise**2).mean(axis=(0, 1)), 1, atol=4 * np.sqrt(2 / count))
    assert bool(np.all(masks))


@pytest.mark.system
def test_lines_without_length_are_masked():
    # Both fingers of a palm that faces the camera bent by a right angle.
    angles = jnp.deg2rad(jnp.array([0.0, 90, 0, 0, 0, 90, 0, 0]))
    x = critical_states()[0].at[2:6].set(jnp.array([0.5, -0.5, 0.5, -0.5])).at[6:14].set(angles)
    _, masks = record(jax.random.key(0), x[None], paper_hand())
    lines = np.array([name.startswith(("alpha", "rho")) for name in paper_hand().feature_names])
    np.testing.assert_array_equal(masks[0], ~lines)


@pytest.mark.system
@pytest.mark.parametrize("shape", [1, 2])
def test_the_belief_at_the_start_is_that_of_table_2(shape):
    truth = paper_states(shape)[0]
    keys = jax.random.split(jax.random.key(3), 500)
    means, covariances = jax.jit(jax.vmap(lambda key: initial_belief(key, truth, shape=INITIAL_SHAPE)))(keys)
    off = np.asarray(means - truth)
    np.testing.assert_allclose(np.abs(off[:, :2]), 5, atol=1e-4)
    np.testing.assert_allclose(np.abs(np.rad2deg(off[:, 6:14])), 15, atol=1e-3)
    # A mean of 500 random signs.
    np.testing.assert_allclose(np.sign(off[:, [0, 1, *range(6, 14)]]).mean(axis=0), 0, atol=4 / np.sqrt(500))
    np.testing.assert_array_equal(means[:, 14:28], 0)
    np.testing.assert_array_equal(means[:, 28:], np.broadcast_to(INITIAL_SHAPE, (500, 9)))
    q = np.asarray(means[:, 2:6], float)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-6)
    true_rotation = Rotation.from_quat(np.asarray(truth[2:6], float), scalar_first=True)
    errors = (Rotation.from_quat(q, scalar_first=True) * true_rotation.inv()).as_rotvec()
    ratio = np.mean(errors**2, axis=0) / np.deg2rad(8) ** 2
    np.testing.assert_allclose(ratio, 1, atol=4 * np.sqrt(2 / 500))
    P = np.asarray(covariances[0], float)
    variances = np.diag(P)
    np.testing.assert_allclose(variances[:2], 50)
    np.testing.assert_allclose(np.rad2deg(np.sqrt(variances[6:14])), 40, rtol=1e-5)
    np.testing.assert_allclose(variances[28:], [800] * 8 + [100])
    np.testing.assert_allclose(np.sqrt(variances[14:28]), np.repeat([4, 0.03, np.deg2rad(4)], [2, 4, 8]), rtol=1e-5)


def test_the_belief_at_the_start_knows_the_scale_and_doubts_the_rotation(x64):
    mean, P = initial_belief(jax.random.key(0), paper_states()[0], shape=INITIAL_SHAPE)
    q, P_qq = np.asarray(mean[2:6]), np.asarray(P[2:6, 2:6])
    np.testing.assert_allclose(P_qq @ q, 0, atol=1e-15)
    # sigma_q = 0.131 in the three directions across q.
    np.testing.assert_allclose(np.sqrt(np.linalg.eigvalsh(P_qq)[1:]), 0.1309, atol=1e-4)
    np.testing.assert_allclose(P, P.T)
    off_diagonal = np.asarray(P) - np.diag(np.diag(P))
    off_diagonal[2:6, 2:6] = 0
    np.testing.assert_array_equal(off_diagonal, 0)


def test_the_critical_sequence_starts_nearly_right():
    sequence = simulate_critical(jax.random.key(5))
    off = np.abs(np.asarray(sequence.initial_mean - sequence.states[0]))
    np.testing.assert_allclose(np.rad2deg(off[6:14]), 6, atol=1e-3)
    np.testing.assert_allclose(off[28:], 4, atol=1e-4)
    np.testing.assert_allclose(np.diag(sequence.initial_covariance)[28:], 16)


def test_one_link_is_seen_by_the_length_of_its_image():
    case = one_link(70.0)
    assert float(one_link_length(jnp.array([50.0, np.arccos(0.8)]))[0]) == pytest.approx(40, rel=1e-6)
    np.testing.assert_allclose(np.sqrt(np.diag(case.covariance)), [20, np.deg2rad(40)], rtol=1e-6)
    np.testing.assert_allclose(
        [case.mean[0], np.rad2deg(case.mean[1]), case.y[0], case.noise_std[0]], [60, 45, 40, 0.5]
    )
    np.testing.assert_allclose([*case.lower, *case.upper], [-np.inf, 0, 70, np.pi / 2], rtol=1e-6)
    assert float(one_link().upper[0]) == np.inf


def test_one_link_near_the_image_plane_has_two_solutions():
    case = one_link_near_image_plane()
    for degrees in (20, -20):
        observed = one_link_length(jnp.array([35.0, np.deg2rad(degrees)]))
        np.testing.assert_allclose(observed, case.y, rtol=1e-6)
    # Modes of the posterior on a grid, found by the specification at +19.8 and -19.8.
    theta = np.deg2rad(np.linspace(-40, 40, 80001))
    mean, std = float(case.mean[1]), float(np.sqrt(case.covariance[1, 1]))
    deviation = (35 * np.cos(theta) - float(case.y[0])) / float(case.noise_std[0])
    log_posterior = -0.5 * deviation**2 - 0.5 * ((theta - mean) / std) ** 2
    modes = [np.rad2deg(theta[np.argmax(np.where(side, log_posterior, -np.inf))]) for side in (theta > 0, theta < 0)]
    np.testing.assert_allclose(modes, [19.83, -19.80], atol=0.05)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: paper_states(3), "shape must be one of 1, 2"),
        (lambda: paper_states(1, 0), "num_frames must be 1 or more"),
        (lambda: critical_states(0), "num_frames must be 1 or more"),
        (lambda: held_states(1, 5, -1), "frame must be 0 or more"),
        (lambda: held_states(1, 0), "num_frames 1 or more"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
