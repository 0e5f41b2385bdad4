"""The normalised Kalman filter of a fingertip beside the textbook's, and section 2.4's numbers (oracles 1-5, 9)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.fingertip import motion

SIGMA_V, SIGMA_W = 1.5, 3.0
Q = (SIGMA_W / SIGMA_V) ** 2


@pytest.fixture
def moves(x64):
    return motion.velocity_driven()


@jax.jit
def steps(moves, belief, measured, observed):
    """Predicted beliefs and innovations of a run; every frame corrects with what is seen and predicts."""

    def step(belief, inputs):
        position, observed = inputs
        corrected, info = motion.correct(belief, position, observed)
        following = motion.predict(moves, corrected, Q)
        return following, (following, info.innovation)

    return jax.lax.scan(step, belief, (measured, observed))[1]


def uncertainties(beliefs):
    return np.asarray(beliefs.covariance)[:, 0, 0]


def textbook(start, measured):
    """Joseph-form filter in pixels; the beliefs after each prediction."""
    F, H = np.eye(4) + np.eye(4, k=2), np.eye(2, 4)
    noise = np.diag([0, 0, SIGMA_W**2, SIGMA_W**2])
    x, P, out = np.asarray(start.mean), SIGMA_V**2 * np.asarray(start.covariance), []
    for y in measured:
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + SIGMA_V**2 * np.eye(2))
        x, left = x + K @ (y - H @ x), np.eye(4) - K @ H
        P = left @ P @ left.T + SIGMA_V**2 * K @ K.T
        x, P = F @ x, F @ P @ F.T + noise
        out.append((x, P))
    return out


@pytest.mark.system
def test_it_is_the_textbooks_filter_in_other_units(moves):
    """Oracle 1: within 1e-10 over 200 steps."""
    measured = np.cumsum(np.random.default_rng(0).normal(size=(200, 2)), axis=0)
    start = motion.new_belief(jnp.asarray(measured[0]))
    beliefs, _ = steps(moves, start, jnp.asarray(measured), jnp.ones(200, bool))
    for i, (mean, covariance) in enumerate(textbook(start, measured)):
        np.testing.assert_allclose(beliefs.mean[i], mean, atol=1e-10)
        np.testing.assert_allclose(SIGMA_V**2 * beliefs.covariance[i], covariance, atol=1e-10)


def test_it_converges_to_the_riccati_equation(moves):
    """Oracles 2 and 5: the covariance does not depend on data, so predictions fed back would never end a track."""
    F, G = np.asarray(moves.F), np.asarray(moves.G)
    expected = solve_discrete_are(F.T, np.eye(4, 2), Q * G @ G.T, np.eye(2))
    start = motion.new_belief(jnp.zeros(2))
    beliefs, _ = steps(moves, start, jnp.zeros((200, 2)), jnp.ones(200, bool))
    np.testing.assert_allclose(beliefs.covariance[-1], expected, atol=1e-9)
    U = uncertainties(beliefs)
    assert abs(U[-1] - 7.352410) < 1e-5
    assert abs(U[-1] / (1 + U[-1]) - 0.880274) < 1e-6
    np.testing.assert_allclose(U[-50:], 7.352, atol=1e-3)


@pytest.mark.system
def test_predictions_ahead_are_predictions_one_after_the_other(moves):
    """Oracle 3: [P10, P11] within 1e-12, in frames of two lengths."""
    L = np.random.default_rng(1).normal(size=(4, 4))
    belief = Gaussian(jnp.asarray(L[0]), jnp.asarray(L @ L.T))
    for chosen in (moves, motion.velocity_driven(0.5)):
        following = belief
        for frames in range(1, 9):
            following = motion.predict(chosen, following, Q)
            found = motion.ahead(chosen, belief, Q, frames)
            np.testing.assert_allclose(found.mean, following.mean, atol=1e-12)
            np.testing.assert_allclose(found.covariance, following.covariance, rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="frames must be at least 1; got 0"):
        motion.ahead(moves, belief, Q, 0)


@pytest.mark.system
def test_uncertainty_grows_and_shrinks_as_the_specification_has_it(moves):
    """Oracle 4: after misses within 0.1, of a new track within 0.02."""
    start = motion.predict(moves, motion.new_belief(jnp.zeros(2)), Q)
    observed = jnp.arange(205) < 200
    U = uncertainties(steps(moves, start, jnp.zeros((205, 2)), observed)[0])
    np.testing.assert_allclose(U[200:], [28.0, 70.8, 143.8, 255.0, 412.4], atol=0.1)
    fresh = [float(motion.uncertainty(start)), *U[:3]]
    np.testing.assert_allclose(fresh, [534.33, 8.98, 7.40, 7.36], atol=0.02)


@pytest.mark.system
def test_a_finger_at_constant_speed_is_followed_exactly(moves):
    """Oracle 9: innovations of 5.83 and 0.033 pixels at first, below 1e-5 at the tenth and 1e-9 at the twentieth."""
    measured = jnp.arange(21.0)[:, None] * jnp.asarray([5.0, 3.0])
    start = motion.predict(moves, motion.new_belief(measured[0]), Q)
    _, innovations = steps(moves, start, measured[1:], jnp.ones(20, bool))
    lengths = np.linalg.norm(innovations, axis=1)
    np.testing.assert_allclose(lengths[:2], [5.83, 0.033], atol=0.005)
    assert lengths[9] < 1e-5
    assert lengths[19] < 1e-9


@pytest.mark.system
def test_a_hint_at_the_velocity_is_a_measurement_of_it(moves):
    belief = motion.new_belief(jnp.zeros(2))
    found = motion.correct_velocity(belief, jnp.asarray([8.0, -4.0]), 10.0, jnp.asarray(True))
    before = float(belief.covariance[2, 2])
    np.testing.assert_allclose(found.mean, [0, 0, *np.array([8, -4]) * before / (before + 10)], atol=1e-12)
    np.testing.assert_allclose(found.covariance[3, 3], 1 / (1 / before + 1 / 10))
    unchanged = motion.correct_velocity(belief, jnp.full(2, jnp.nan), 10.0, jnp.asarray(False))
    np.testing.assert_array_equal(unchanged.mean, belief.mean)


def test_the_distance_of_an_innovation_is_its_nis(moves):
    belief = motion.predict(moves, motion.new_belief(jnp.asarray([3.0, 4.0])), Q)
    measured = jnp.asarray([20.0, -9.0])
    distance = motion.innovation_distance(belief, measured, SIGMA_V)
    np.testing.assert_allclose(distance, motion.correct(belief, measured)[1].nis / SIGMA_V**2)
