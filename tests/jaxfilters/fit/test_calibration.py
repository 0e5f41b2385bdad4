"""Noise from recordings: constants that the simulation had, and claims on recordings left out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf
from jaxfilters.fit.score_errors import with_score_errors

DT, TAU, SCALE, STEP = 0.1, 1.0, 0.5, 0.3
START = {"tau": 0.4, "B": 0.6}


def filter_of(theta):
    prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
    inner = jf.kalman(prior, jnp.eye(1), STEP**2 * jnp.eye(1), jnp.ones((3, 1)), 0.01 * jnp.eye(3))
    return jf.correlated_noise(inner, jf.GaussMarkov(theta["tau"], theta["B"] * jnp.ones(3)), dt=DT)


def believed(state):
    return state.marginal([0])


def recordings_of(seed, lengths, with_truth=True):
    """A random walk behind three readings, each with an error of its own that lasts for ten frames."""
    rng, made = np.random.default_rng(seed), []
    phi = np.exp(-DT / TAU)
    for length in lengths:
        x, b, rows, truth = rng.normal(), SCALE * rng.normal(size=3), [], []
        for _ in range(length):
            x = x + STEP * rng.normal()
            b = phi * b + SCALE * np.sqrt(1 - phi**2) * rng.normal(size=3)
            rows.append(x + b + 0.1 * rng.normal(size=3))
            truth.append([x])
        both = (jnp.asarray(np.asarray(values), jnp.float32) for values in (rows, truth))
        observations, truth = both
        made.append(jf.fit.Recording(observations, None, truth if with_truth else None))
    return made


@pytest.mark.system
def test_constants_are_those_of_the_simulation_and_claims_hold_on_recordings_left_out():
    """Constants within four standard errors; a wrong alarm has a probability of 1e-4 each for the other claims."""
    recordings = recordings_of(0, [120, 100, 150, 110, 130, 90])
    found = jf.fit.calibrate(jax.random.key(0), filter_of, recordings, START, jf.fit.positive, believed=believed)
    theta, errors = found.fit.theta, found.fit.standard_errors
    assert abs(theta["tau"] - TAU) < 4 * errors["tau"]
    assert abs(theta["B"] - SCALE**2) < 4 * errors["B"]
    assert errors["tau"] < 0.5 * TAU
    assert found.whiteness.min() > 1e-4
    band = found.nis_band
    assert band.low - 0.1 < found.nis < band.high + 0.1
    low, high = found.coverage.interval
    assert float(low[0]) < 0.954 < float(high[0]) + 0.02
    assert 0.9 < float(found.coverage.share[0]) < 0.99
    assert found.num_draws > 30
    assert "effective draws" in str(found)

    message = r"too short to tell .* hold [\d.]+ draws .* 6 recordings of [\d.]+ each"
    with pytest.raises(ValueError, match=message) as raised:
        jf.fit.calibrate(
            jax.random.key(0), filter_of, recordings, theta, jf.fit.positive, believed=believed, min_draws=1e3
        )
    assert "1000 recordings of any length" in str(raised.value)


@pytest.mark.system
@pytest.mark.parametrize("by_score", [False, True])
def test_a_scale_is_found_within_standard_errors_that_are_the_spread_over_sets_of_recordings(by_score):
    """Sixteen sets of six recordings; the scale multiplies the variance of the lasting errors, and 1 is right.

    The spread of 16 estimates has an error of 18 percent; four of them are 0.5 to 2 times. The curvature of the score
    alone, which takes frames for independent, claims 0.3 times the spread. A set within four stated errors has a wrong
    alarm of 6e-5 if these are right; six are left to those of scores, which are a fifth too small with six recordings.
    """
    of_scale = lambda theta: filter_of({"tau": TAU, "B": SCALE**2 * theta["scale"]})
    logs, claims = [], []
    for seed in range(16):
        found = jf.fit.calibrate(
            jax.random.key(seed),
            of_scale,
            recordings_of(100 + seed, [80] * 6),
            {"scale": 2.0},
            jf.fit.positive,
            believed=believed,
            by_score=by_score,
        )
        assert found.fit.converged
        logs.append(np.log(float(found.fit.theta["scale"])))
        claims.append(float(found.fit.standard_errors["scale"] / found.fit.theta["scale"]))
    logs, claims = np.array(logs), np.array(claims)
    assert abs(logs.mean()) < 4 * logs.std(ddof=1) / 4
    assert np.all(np.abs(logs) < (6 if by_score else 4) * claims)
    assert 0.5 < np.sqrt(np.mean(claims**2)) / logs.std(ddof=1) < 2


def fit_of(scores, mask):
    """A fit of one number whose log density has the curvature of independent scores."""
    information = float(jnp.sum(jnp.where(mask[..., None], scores, 0.0) ** 2))
    fit = jf.fit.maximize(lambda x: -0.5 * information * x**2, jnp.zeros(()))
    return with_score_errors(fit, scores, mask)


def test_errors_by_score_are_of_independent_recordings():
    """Scores that are equal within each of eight recordings count once each; those that add to zero, and NaN, not.

    With eight sums of ten each, J = 80 and K = 800 / (1 - 1 / 8): the sums are of scores whose total is zero.
    """
    signs = jnp.where(jnp.arange(8) % 2 == 0, 1.0, -1.0)
    scores = jnp.broadcast_to(signs[:, None], (10, 8, 1))
    whole = jnp.ones((10, 8), bool)
    found = fit_of(scores, whole)
    np.testing.assert_allclose(found.standard_errors, np.sqrt(800 / (7 / 8)) / 80, rtol=1e-4)
    # Padding of shorter recordings does not count, whatever it holds.
    padded = jnp.concatenate([scores, jnp.full((5, 8, 1), jnp.nan)])
    mask = jnp.concatenate([whole, jnp.zeros((5, 8), bool)])
    np.testing.assert_allclose(fit_of(padded, mask).standard_errors, found.standard_errors, rtol=1e-5)
    # Three recordings that are each one draw say nothing of how these spread.
    few = fit_of(scores[:, :3], whole[:, :3])
    assert np.isnan(few.standard_errors)
    assert few.missing_errors == {"theta": "not computed"}
    # Independent frames have the errors of the curvature; the spread of 4000 squares has an error of two percent.
    white = jax.random.normal(jax.random.key(0), (500, 8, 1))
    expected = 1 / np.sqrt(float(jnp.sum(white**2)))
    np.testing.assert_allclose(fit_of(white, jnp.ones((500, 8), bool)).standard_errors, expected, rtol=0.15)


@pytest.mark.parametrize(
    ("recordings", "options", "message"),
    [
        (recordings_of(0, [5]), {"believed": believed}, "recordings must be at least two"),
        (recordings_of(0, [5, 5]), {}, "believed and the truth of recordings must both be given"),
        (recordings_of(0, [5, 5], False), {"by_score": True}, "by_score needs recordings with truth"),
        ([*recordings_of(0, [5]), *recordings_of(0, [5], False)], {}, "recordings must have one structure"),
        (
            [jf.fit.Recording(jnp.zeros((5, 3)), jnp.zeros(4))] * 2,
            {},
            r"recordings\[0\] must have arrays of one length",
        ),
    ],
)
def test_bad_input_is_named(recordings, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        jf.fit.calibrate(jax.random.key(0), filter_of, recordings, START, jf.fit.positive, **options)


@pytest.mark.system
def test_frames_without_truth_do_not_count_in_the_log_score():
    """The score of all frames is the mean of those of every second frame and of the others."""
    recordings = recordings_of(1, [20, 20])
    every_second = np.arange(20)[:, None] % 2 == 0

    def score(known):
        rows = [recording._replace(truth=jnp.where(known, recording.truth, jnp.nan)) for recording in recordings]
        options = {"believed": believed, "min_draws": 1.0}
        return jf.fit.calibrate(
            jax.random.key(0), filter_of, rows, START, jf.fit.positive, **options
        ).coverage.log_score

    halves = [score(every_second), score(~every_second)]
    np.testing.assert_allclose(np.mean(halves), score(np.ones((20, 1), bool)), rtol=1e-4)
