"""The thumb test: the paper's score (oracle 10), the posterior beside brute force, and what both make of drift."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxfilters.models.fingertip import thumb
from jaxfilters.models.fingertip.thumb import POSTURE, Posture

T, I = POSTURE.open_thumb, POSTURE.open_forefinger


def covariance(frames, posture, offset_variance):
    """Of the angles of one finger: drift, the person's offset, and noise."""
    apart = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
    drift = posture.drift_sd**2 * posture.correlation**apart
    return drift + offset_variance + posture.measurement_sd**2 * np.eye(frames)


@partial(jax.jit, static_argnames="posture")
def observed(angles, visible, person, posture=POSTURE):
    """Beliefs after each frame of one finger."""

    def step(belief, inputs):
        found = thumb.observe(belief, *inputs, posture)
        return found, found

    return jax.lax.scan(step, thumb.unknown(person, posture), (angles, visible))[1]


@pytest.mark.system
def test_the_papers_score(x64):
    angles = jnp.linspace(I - 1, T + 1, 50)
    values = thumb.increment(angles, T, I)
    assert jnp.all(jnp.diff(values) >= 0)
    np.testing.assert_allclose(thumb.increment(jnp.asarray([I, (I + T) / 2, T]), T, I), [0, 0.5, 1], atol=1e-12)
    assert (float(values[0]), float(values[-1])) == (0, 1)
    np.testing.assert_allclose(thumb.score(jnp.full(7, 0.3)), 0.3)
    np.testing.assert_allclose(thumb.score(jnp.asarray([0.0, 1.0, 1.0])), [0, 1 / 2, 2 / 3])
    with pytest.raises(ValueError, match="thumb must be greater than index"):
        thumb.increment(angles, 1.0, 2.0)


def test_the_evidence_is_that_of_the_whole_sequence(x64):
    """Against two Gaussians over all frames at once; without forgetting the log odds are their log ratio."""
    posture = Posture(exchange=0.0)
    rng = np.random.default_rng(0)
    person = thumb.usual(posture)._replace(offset=jnp.asarray(0.03))
    angles = rng.normal(0.6, 0.2, 12)
    beliefs = observed(jnp.asarray(angles), jnp.ones(12, bool), person, posture)
    for i in range(len(angles)):
        C = covariance(i + 1, posture, posture.person_sd**2)
        as_thumb, as_index = (
            multivariate_normal(np.full(i + 1, mean + 0.03), C).logpdf(angles[: i + 1])
            for mean in (posture.thumb, posture.forefinger)
        )
        np.testing.assert_allclose(beliefs.log_odds[i], as_thumb - as_index, atol=1e-8)


def test_frames_without_an_angle_change_no_odds_and_let_the_drift_go_on(x64):
    angles = jnp.full(30, T)
    visible = jnp.arange(30) < 10
    beliefs = observed(angles.at[10:].set(jnp.nan), visible, thumb.usual())
    log_odds = np.asarray(beliefs.log_odds)
    np.testing.assert_array_equal(log_odds[10:], log_odds[9])
    drift = np.asarray(beliefs.angle.covariance)[:, 0, 0, 0]
    assert np.all(np.diff(drift[10:]) > 0)
    assert drift[-1] < POSTURE.drift_sd**2


@pytest.mark.system
def test_a_track_that_goes_on_as_another_finger_is_found_out(x64):
    """Evidence of 300 frames for a forefinger is forgotten within 10 frames as a thumb; the mean of all never does."""
    angles = jnp.where(jnp.arange(320) < 300, POSTURE.forefinger, POSTURE.thumb)
    beliefs = observed(angles, jnp.ones(320, bool), thumb.usual())
    assert beliefs.log_odds[299] < -5
    assert beliefs.log_odds[310] > 0
    assert thumb.score(thumb.increment(angles, T, I))[-1] < 0.5


def test_a_hand_has_one_thumb():
    log_odds = jnp.asarray([4.0, 1.0, -3.0, 9.0])
    there = jnp.asarray([True, True, True, False])
    found = np.asarray(thumb.probabilities(log_odds, there))
    weights = np.exp([4, 1, -3])
    np.testing.assert_allclose(found, [*weights / (1 + weights.sum()), 0], rtol=1e-5)
    np.testing.assert_array_equal(thumb.probabilities(log_odds, jnp.zeros(4, bool)), 0)


def test_hysteresis_holds_what_was():
    probability = jnp.asarray([0.44, 0.5, 0.56])
    np.testing.assert_array_equal(thumb.decided(jnp.ones(3, bool), probability), [False, True, True])
    np.testing.assert_array_equal(thumb.decided(jnp.zeros(3, bool), probability), [False, False, True])


def test_angles_are_positive_on_the_side_of_the_thumb(x64):
    palm, up = jnp.asarray([100.0, 100.0]), jnp.asarray([0.0, -1.0])
    left = jnp.asarray([90.0, 90.0])
    np.testing.assert_allclose(thumb.base_angle(left, palm, up), math.pi / 4)
    np.testing.assert_allclose(thumb.base_angle(left, palm, up, -1.0), -math.pi / 4)
    assert float(thumb.base_angle(palm, palm, up)) == 0


def test_calibration_is_the_conditional_mean(x64):
    """Of the offset given both fingers' means over frames that drift; against the joint Gaussian of all frames."""
    frames = 40
    rng = np.random.default_rng(1)
    measured = rng.normal(0, 0.05, (2, frames)) + np.array([[T + 0.1], [I + 0.1]])
    found = thumb.calibrated(*measured)
    C = covariance(frames, POSTURE, 0.0)
    ones = np.ones(frames) / frames
    variance = ones @ C @ ones / 2
    share = POSTURE.person_sd**2 / (POSTURE.person_sd**2 + variance)
    np.testing.assert_allclose(found.offset, share * np.mean(measured - np.array([[T], [I]])), rtol=1e-6)
    np.testing.assert_allclose(found.offset_variance, 1 / (1 / POSTURE.person_sd**2 + 1 / variance), rtol=1e-6)
    np.testing.assert_allclose(found.thumb, measured[0].mean(), rtol=1e-6)


def test_calibration_refuses_what_is_no_open_hand():
    with pytest.raises(ValueError, match="at least one; got \\(0,\\)"):
        thumb.calibrated(np.zeros(0), np.zeros(0))
    with pytest.raises(ValueError, match="beyond index"):
        thumb.calibrated(np.full(3, 0.1), np.full(3, 0.9))
