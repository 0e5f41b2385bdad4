"""The model as a filter takes it: features against an independent computation, derivatives, masks, pytree behaviour."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.gaussian.gauss_markov import GaussMarkov
from jaxfilters.models.articulated.features import FULL, KEYPOINTS, PAPER_EXPERIMENT, directed_residual
from jaxfilters.models.articulated.hand import articulated_hand, with_lasting_errors
from jaxfilters.models.articulated.kinematics import pivot_base, pivot_wrist
from jaxfilters.models.articulated.layout import Layout, five_fingers, transition_matrix
from jaxfilters.models.articulated.projection import Perspective
from jaxfilters.models.camera import Pinhole

PIVOTS = {"base": pivot_base, "wrist": pivot_wrist}
observed = jax.jit(lambda hand, x: hand.observe(x))


def camera():
    return Pinhole.from_intrinsics((500.0, 510.0), (320.0, 240.0), (480, 640))


def two_fingers():
    return articulated_hand(Layout(2))


def straight_at_the_camera():
    """A palm that faces the camera, its first finger bent at a right angle: links and palm with and without length."""
    angles = np.deg2rad([0, 90, 0, 0, 0, 0, 90, 0])
    return jnp.asarray(
        np.concatenate([[0, 90, 0.5, -0.5, 0.5, -0.5], angles, np.zeros(14), [62, 42, 35, 60, 40, 33, 60, 80, 20]]),
        dtype=float,
    )


@pytest.mark.system
@pytest.mark.parametrize("pivot", PIVOTS)
@pytest.mark.parametrize("seed", range(2))
def test_features_match_a_computation_from_the_definitions(seed, pivot, random_state, finger_chains_oracle, x64):
    layout = five_fingers()
    x = random_state(np.random.default_rng(seed), layout)
    q, t = x[layout.quaternion], x[layout.position]
    R = np.sum(q**2) * Rotation.from_quat(q, scalar_first=True).as_matrix()
    points = finger_chains_oracle(x, layout, wrist_pivot=pivot == "wrist") @ R[:2].T + t
    delta = np.diff(points, axis=1)
    alpha = np.arctan2(delta[..., 1], delta[..., 0])
    rho = -points[:, 1:, 0] * np.sin(alpha) + points[:, 1:, 1] * np.cos(alpha)
    width, _, thickness = x[layout.palm]
    palm_alpha = np.arctan2(R[1, 0], R[0, 0])
    corners = np.array([(0, a * thickness / 2, b * width / 2) for a in (-1, 1) for b in (-1, 1)]) @ R[:2].T + t
    palm_rho = corners @ (-np.sin(palm_alpha), np.cos(palm_alpha))
    palm = [palm_alpha, palm_rho.min(), palm_rho.max()]
    expected = np.concatenate([t, points[:, 1:].ravel(), alpha.ravel(), rho.ravel(), palm])
    hand = articulated_hand(layout, pivot=PIVOTS[pivot])
    np.testing.assert_allclose(observed(hand, jnp.asarray(x)), expected, atol=1e-10)
    for features in (PAPER_EXPERIMENT, KEYPOINTS):
        part = replace(hand, features=features)
        rows = dict(zip(part.feature_names, np.asarray(observed(part, jnp.asarray(x))), strict=True))
        shared = [name for name in hand.feature_names if name in rows]
        np.testing.assert_allclose([rows[n] for n in shared], expected[np.isin(hand.feature_names, shared)], atol=1e-10)


def test_distances_of_lines_are_measured_from_the_origin(random_state, x64):
    x = jnp.asarray(random_state(np.random.default_rng(0), Layout(2)))
    shift = jnp.array([30.0, -20.0])
    hand = two_fingers()
    moved = observed(replace(hand, origin=shift), x.at[:2].add(shift))
    points = np.array([name.startswith(("wrist", "p_")) for name in hand.feature_names])
    expected = observed(hand, x) + jnp.where(points, jnp.tile(shift, 15)[:29], 0.0)
    np.testing.assert_allclose(moved, expected, atol=1e-11)


@pytest.mark.system
@pytest.mark.parametrize(
    "hand_of", [two_fingers, lambda: articulated_hand(Layout(2, 3), projection=Perspective(camera()))]
)
@pytest.mark.parametrize("seed", range(2))
def test_derivative_of_observe_is_that_of_central_differences(seed, hand_of, random_state, x64):
    hand = hand_of()
    x = jnp.asarray(random_state(np.random.default_rng(seed), hand.layout))
    slope = np.asarray(jax.jit(jax.jacfwd(hand.observe))(x))
    observe = jax.jit(hand.observe)
    step = 1e-6 * np.where(np.arange(x.size) < hand.layout.static.start, 1.0, abs(np.asarray(x)))
    difference = np.stack(
        [(observe(x.at[i].add(h)) - observe(x.at[i].add(-h))) / (2 * h) for i, h in enumerate(step)], axis=1
    )
    # Rounding of a difference: 1e-16 of some hundred pixels, over the step.
    np.testing.assert_allclose(difference / np.abs(slope).max(), slope / np.abs(slope).max(), atol=1e-8)


@pytest.mark.system
@pytest.mark.parametrize("x64_on", [True, False])
def test_values_and_derivatives_are_finite_for_lines_without_length(x64_on):
    with jax.enable_x64(x64_on):
        hand = two_fingers()
        edge_on = straight_at_the_camera().at[2:6].set(jnp.array([1.0, 0.0, -1.0, 0.0]) * np.sqrt(0.5))

        def loss(x):
            return jnp.sum(hand.residual(jnp.zeros(29), hand.observe(x)) ** 2)

        @jax.jit
        def derivatives(x):
            return hand.observe(x), jax.jacfwd(hand.observe)(x), jax.hessian(loss)(x)

        for x in (straight_at_the_camera(), edge_on):
            assert all(np.all(np.isfinite(leaf)) for leaf in derivatives(x))


def test_lines_without_length_are_masked_and_nothing_else():
    hand = two_fingers()
    usable_rows = jax.jit(hand.usable)
    usable = dict(zip(hand.feature_names, np.asarray(usable_rows(straight_at_the_camera())), strict=True))
    # The first finger points at the camera from its base on, the second from its second link on.
    short = {f"{kind}_{link}" for kind in ("alpha", "rho") for link in ("11", "12", "13", "22", "23")}
    assert {name for name, is_usable in usable.items() if not is_usable} == short
    edge_on = straight_at_the_camera().at[2:6].set(jnp.array([1.0, 0.0, -1.0, 0.0]) * np.sqrt(0.5))
    usable = dict(zip(hand.feature_names, np.asarray(usable_rows(edge_on)), strict=True))
    assert not any(usable[f"palm_{row}"] for row in ("alpha", "rho_min", "rho_max"))
    assert all(usable[name] for name in usable if name.startswith(("wrist", "p_")))


def test_float32_observes_what_float64_does(random_state):
    x = random_state(np.random.default_rng(5), Layout(2))
    single = observed(two_fingers(), jnp.asarray(x, jnp.float32))
    assert single.dtype == jnp.float32
    with jax.enable_x64(True):
        hand = two_fingers()
        change = hand.residual(jnp.asarray(np.asarray(single, float)), observed(hand, jnp.asarray(x)))
    # Ten roundings of 6e-8 on some 200 pixels; angles of the shortest lines amplify theirs by 1 / length.
    np.testing.assert_allclose(change, 0, atol=2e-3)


@pytest.mark.system
def test_transition_is_the_matrix_of_constant_velocity(random_state, x64):
    hand = two_fingers()
    x = jnp.asarray(random_state(np.random.default_rng(0), hand.layout))
    for dt, A in ((None, transition_matrix(hand.layout)), (0.25, transition_matrix(hand.layout, 0.25))):
        np.testing.assert_allclose(hand.transition(x, dt), A @ x, atol=1e-13)
        np.testing.assert_allclose(jax.jacfwd(hand.transition)(x, dt), A, atol=1e-14)
    G = hand.process_noise_root(0.25)
    np.testing.assert_allclose(hand.process_noise(0.25), G @ G.T, atol=1e-15)
    assert float(hand.process_noise()[6, 20]) == pytest.approx(np.deg2rad(1.5) ** 2 / 2)


def test_noise_of_the_observation_follows_the_rows():
    hand = articulated_hand(Layout(2), point_std=1.5, alpha_std=0.1, rho_std=2.5)
    std = np.array([1.5] * 14 + [0.1] * 6 + [2.5] * 6 + [0.1, 2.5, 2.5])
    np.testing.assert_allclose(hand.observation_noise(), np.diag(std**2), rtol=1e-6)


@pytest.mark.system
@pytest.mark.parametrize("position_size", [2, 3])
@pytest.mark.parametrize("features", [FULL, PAPER_EXPERIMENT, KEYPOINTS])
def test_five_fingers_have_consistent_shapes(features, position_size, random_state):
    layout = five_fingers(position_size)
    projection = Perspective(camera()) if position_size == 3 else None
    hand = articulated_hand(layout, projection=projection, features=features)
    x = jnp.asarray(random_state(np.random.default_rng(0), layout), jnp.float32)
    rows = features.size(5)
    assert layout.size == 2 * (position_size + 24) + 18
    assert jax.eval_shape(hand.points, x).shape == (5, 4, 3)
    assert jax.eval_shape(hand.image_points, x).shape == (5, 4, 2)
    assert jax.eval_shape(hand.usable, x).shape == (rows,)
    assert jax.eval_shape(jax.jacfwd(hand.observe), x).shape == (rows, layout.size)
    y = observed(hand, x)
    assert np.all(np.isfinite(y))
    np.testing.assert_array_equal(hand.residual(y, y), np.zeros(rows))
    assert hand.observation_std().shape == (rows,)
    assert hand.process_noise().shape == (layout.size, layout.size)
    assert len(hand.feature_names) == rows


@pytest.mark.system
def test_a_hand_is_a_pytree_argument(random_state, x64):
    hand = two_fingers()
    x = jnp.asarray(random_state(np.random.default_rng(0), hand.layout))
    weight = jax.grad(lambda h: jnp.sum(h.observation_noise()))(hand)
    assert float(weight.point_std) == pytest.approx(2 * 14)
    traces = []

    @jax.jit
    def observe(hand, x):
        traces.append(1)
        return hand.observe(x)

    np.testing.assert_allclose(observe(hand, x), hand.observe(x), atol=1e-11)
    observe(replace(two_fingers(), point_std=jnp.array(2.0, dtype=float)), x)
    assert len(traces) == 1
    hands = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf]), hand)
    noise = jax.vmap(lambda h: h.process_noise())(hands)
    np.testing.assert_allclose(noise[1], 4 * noise[0], rtol=1e-12)


@pytest.mark.system
def test_the_comparison_is_the_one_that_was_chosen():
    hand = articulated_hand(Layout(2), compare=directed_residual)
    y = jnp.zeros(29).at[14].set(3.0)
    assert float(hand.residual(y, jnp.zeros(29))[14]) == pytest.approx(3.0)
    assert float(two_fingers().residual(y, jnp.zeros(29))[14]) == pytest.approx(3.0 - np.pi, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(layout=Layout(2, 3)), "position_size must be 2 for WeakPerspective"),
        (dict(point_std=0.0), "point_std must be positive"),
        (dict(alpha_std=float("nan")), "alpha_std must be positive"),
        (dict(rho_std=-1.0), "rho_std must be positive"),
        (dict(origin=(0.0, float("inf"))), "origin must be two finite"),
    ],
)
def test_bad_models_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        articulated_hand(**{"layout": Layout(2), **options})


def test_lasting_errors_stay_as_large_and_as_alike_as_they_are(x64):
    plain = articulated_hand(Layout(1))
    variances = jnp.linspace(0.0, 4.0, plain.observation_std().size)
    hand = with_lasting_errors(plain, GaussMarkov(jnp.asarray(5.0), variances))
    layout, dt = hand.layout, 2.5
    x = jnp.arange(float(layout.size)).at[layout.quaternion].set(jnp.array([1.0, 0, 0, 0]))
    moved = hand.transition(x, dt)
    np.testing.assert_allclose(moved[: layout.body.size], plain.transition(x[: layout.body.size], dt), rtol=1e-12)
    np.testing.assert_allclose(moved[layout.errors], np.exp(-0.5) * x[layout.errors], rtol=1e-12)
    added = np.asarray(hand.process_noise(dt))[layout.errors, layout.errors]
    np.testing.assert_allclose(np.exp(-1.0) * np.diag(variances) + added, np.diag(variances), atol=1e-12)
    np.testing.assert_allclose(hand.observe(x) - plain.observe(x[: layout.body.size]), x[layout.errors], atol=1e-9)
    with pytest.raises(ValueError, match=f"{variances.size} variances"):
        with_lasting_errors(plain, GaussMarkov(jnp.asarray(5.0), variances[:-1]))
