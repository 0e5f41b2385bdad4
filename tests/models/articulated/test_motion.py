"""Motions against the solution of their stochastic differential equations, and what they come to in the long run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import expm

from jaxfilters.models.articulated.anatomy import flexion_correlation, relaxed_angles
from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.models.articulated.motion import ANGLE_SPREAD, MOVEMENT_TIME, AboutEase, about_ease, lean_axes

SPEED_STD, TIME = (0.01, 0.02, 0.03), (5.0, 8.0, 12.0)
"""Of position, quaternion and angles."""


def uneven(layout):
    """A motion in which every kind of entry has its own time."""
    ease = np.linspace(-0.2, 0.5, 8)
    return AboutEase(jnp.asarray(ease), layout.per_moving(*SPEED_STD), layout.per_moving(*TIME)), ease


def exact(speed_std, time, dt, *, is_angle):
    """Van Loan: transition and covariance of (p, p') over `dt`."""
    a = 1 / time
    A = np.array([[0.0, 1.0], [-(a**2), -2 * a]]) if is_angle else np.array([[0.0, 1.0], [0.0, -a]])
    q = (4 if is_angle else 2) * a * speed_std**2
    block = np.block([[-A, np.diag([0.0, q])], [np.zeros((2, 2)), A.T]]) * dt
    solved = expm(block)
    F = solved[2:, 2:].T
    return F, F @ solved[:2, 2:]


@pytest.mark.system
@pytest.mark.parametrize("dt", [0.3, 1.0, 6.0, 60.0])
def test_a_hand_about_its_ease_solves_its_equation(dt, x64, random_state):
    layout = Layout(2)
    motion, ease = uneven(layout)
    x = random_state(np.random.default_rng(0), layout)
    after = np.asarray(motion.advance(jnp.asarray(x), layout, dt))
    root = np.asarray(motion.noise_root(layout, dt))
    noise = root @ root.T
    kinds = np.repeat([0, 1, 2], [layout.position_size, 4, 8])
    rest = np.zeros(layout.num_moving)
    rest[layout.angles] = ease
    for i, kind in enumerate(kinds):
        F, Q = exact(SPEED_STD[kind], TIME[kind], dt, is_angle=kind == 2)
        pair = [i, layout.num_moving + i]
        np.testing.assert_allclose(after[pair], F @ (x[pair] - [rest[i], 0]) + [rest[i], 0], rtol=1e-12, atol=1e-12)
        # The error of the quadrature.
        np.testing.assert_allclose(noise[np.ix_(pair, pair)], Q, atol=(1e-5 if dt < 10 else 0.02) * np.abs(Q).max())
        noise[np.ix_(pair, pair)] = 0
    np.testing.assert_array_equal(noise, 0)
    np.testing.assert_array_equal(after[layout.static], x[layout.static])


@pytest.mark.system
def test_angles_that_nobody_sees_come_to_the_spread_of_hands():
    layout = five_fingers()
    ease = relaxed_angles(layout).ravel()
    alike = flexion_correlation(layout)
    motion = about_ease(layout, ease, correlation=alike)
    F = jax.jacfwd(lambda x: motion.advance(x, layout, 1.0))(jnp.zeros(layout.size))
    G = motion.noise_root(layout, 1.0)

    def step(P, _):
        return F @ P @ F.T + G @ G.T, None

    P, _ = jax.lax.scan(step, jnp.zeros((layout.size, layout.size)), None, length=int(20 * MOVEMENT_TIME))
    np.testing.assert_allclose(P[layout.angles, layout.angles], ANGLE_SPREAD**2 * alike, atol=2e-3 * ANGLE_SPREAD**2)
    np.testing.assert_allclose(np.sqrt(np.diagonal(P)[layout.rates]), motion.speed_std, rtol=1e-3)


@pytest.mark.system
def test_no_time_changes_nothing():
    layout = Layout(2)
    motion, _ = uneven(layout)
    x = jnp.arange(layout.size, dtype=float)
    np.testing.assert_allclose(motion.advance(x, layout, 0.0), x, rtol=1e-6)
    np.testing.assert_array_equal(motion.noise_root(layout, 0.0), 0)


@pytest.mark.system
@pytest.mark.parametrize("position_size", [2, 3])
def test_a_hand_of_which_nothing_is_known_has_its_long_axis_near_the_image_plane(position_size, x64):
    """Many hands after many frames, against Watson's density exp(-s^2 / 2 lean_std^2) of the sine s of the lean."""
    lean_std, hands, step = 0.4, 2000, 0.1
    layout = Layout(1, position_size)
    motion = about_ease(layout, np.zeros(4), lean_std=lean_std, speed_std=(0.0, 0.15, 0.0), time=0.2)
    root = motion.noise_root(layout, step)

    def move(states, key):
        noise = jax.random.normal(key, (hands, root.shape[1])) @ root.T
        states = jax.vmap(lambda x: motion.advance(x, layout, step))(states) + noise
        q = states[:, layout.quaternion]
        states = states.at[:, layout.quaternion].set(q / jnp.linalg.norm(q, axis=1, keepdims=True))
        return states, None

    # All begin with the long axis along the line of sight but for a little.
    first = (
        jnp.zeros((hands, layout.size)).at[:, layout.position.stop].set(0.7).at[:, layout.position.stop + 2].set(0.7)
    )
    first = first.at[:, : layout.position.stop].set(jnp.arange(1.0, 1 + position_size))
    states, _ = jax.lax.scan(move, first, jax.random.split(jax.random.key(0), 600))
    sines = np.array(jax.vmap(lambda x: jnp.sum(jnp.prod(jnp.stack(lean_axes(x, layout)), axis=0)))(states))
    grid = np.linspace(-1, 1, 2001)
    density = np.cumsum(np.exp(-0.5 * (grid / lean_std) ** 2))
    assert stats.kstest(sines, lambda s: np.interp(s, grid, density / density[-1])).pvalue > 1e-3


def test_a_lean_of_any_size_is_turned_flat_about_the_axis_across_it(x64, random_state):
    """The axis turns in its plane with the line of sight, by rate times sin cos of the lean to first order."""
    layout = Layout(2, 3)
    motion = about_ease(layout, np.zeros(8), lean_std=0.3, speed_std=(0.0, 0.02, 0.0))
    x = jnp.asarray(random_state(np.random.default_rng(1), layout)).at[layout.rates].set(0.0)
    dt = 1e-3
    before, sight = (np.asarray(axis) for axis in lean_axes(x, layout))
    after, _ = (np.asarray(axis) for axis in lean_axes(motion.advance(x, layout, dt), layout))
    lean = np.arcsin(before @ sight)
    rate = (2 * 0.02) ** 2 * MOVEMENT_TIME / 0.3**2
    assert np.arcsin(after @ sight) - lean == pytest.approx(-rate * dt * np.sin(lean) * np.cos(lean), rel=1e-3)
    assert np.linalg.det(np.stack([before, after, sight])) == pytest.approx(0, abs=1e-12)


def test_speeds_in_an_image_are_those_in_space_times_its_scale():
    layout = Layout(2)
    speed = about_ease(layout, np.zeros(8), per_metre=500.0, speed_std=(0.01, 0.02, 0.03)).speed_std
    np.testing.assert_allclose(speed, [5.0] * 2 + [0.02] * 4 + [0.03] * 8, rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(ease=np.zeros(7)), "ease must be 8 finite angles"),
        (dict(ease=np.full(8, np.nan)), "ease must be 8 finite angles"),
        (dict(speed_std=(1.0, -0.1, 0.1)), "speed_std must be three numbers"),
        (dict(time=0.0), "time must be positive; got 0.0"),
        (dict(lean_std=0.0), "lean_std must be positive; got 0.0"),
        (dict(per_metre=float("inf")), "per_metre must be positive; got inf"),
        (dict(correlation=np.eye(7)), r"correlation must be symmetric \(8, 8\) with ones on its diagonal"),
        (dict(correlation=2 * np.eye(8)), "with ones on its diagonal"),
        (dict(correlation=np.ones((8, 8)) - 2 * np.eye(8, k=1) - 2 * np.eye(8, k=-1)), "must be positive definite"),
    ],
)
def test_bad_motions_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        about_ease(**{"layout": Layout(2), "ease": np.zeros(8), **options})
