"""Noise from recordings: constants that the simulation had, and claims on recordings left out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

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
