"""Counts of innovations inside their bands, of filters that are right and of filters that are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf
from jaxfilters.trackers.innovations import (
    CONSISTENT_CLAIM,
    TOO_FEW,
    contradiction,
    correction_counts,
    innovation_counts,
    innovation_share,
)

PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
F, Q = jnp.array([[1.0, 0.1], [0.0, 0.95]]), jnp.diag(jnp.array([0.01, 0.1]))
H, R = jnp.array([[1.0, 0.0], [0.5, 1.0]]), jnp.diag(jnp.array([0.2, 0.5]))
FRAMES = 4000


@pytest.fixture(scope="module")
def observations():
    def step(x, key):
        process, noise = jax.random.split(key)
        x = F @ x + jnp.sqrt(jnp.diagonal(Q)) * jax.random.normal(process, (2,))
        return x, H @ x + jnp.sqrt(jnp.diagonal(R)) * jax.random.normal(noise, (2,))

    return jax.lax.scan(step, jnp.zeros(2), jax.random.split(jax.random.key(0), FRAMES))[1]


def counts_of(observations, scale):
    """Of innovations and of corrections, by a Kalman filter whose covariances are those of the data times `scale`."""
    filter = jf.kalman(PRIOR, F, scale * Q, H, scale * R)

    def step(belief, y):
        ahead = jf.predict(filter, jax.random.key(0), belief)
        after, info = jf.update(filter, jax.random.key(0), ahead, y)
        before, variance = (jnp.diagonal(one.covariance) for one in (ahead, after))
        return after, (innovation_counts(info), correction_counts(after.mean - ahead.mean, before, variance))

    return jax.lax.scan(step, PRIOR, observations)[1]


@pytest.mark.parametrize(
    ("scale", "claim"),
    [(1.0, CONSISTENT_CLAIM), (0.25, "overconfident"), (4.0, "conservative")],
)
def test_the_share_says_whether_the_model_is_right(observations, scale, claim):
    """Gains do not depend on the scale, so that innovations are those of the right filter: 95 % if the scale is 1.

    The tolerance is four standard errors of as many independent counts as there are frames (false alarm: 6e-5).
    """
    expected = 2 * float(jax.scipy.stats.norm.cdf(1.959964 * np.sqrt(scale))) - 1
    for counts in counts_of(observations, scale):
        found = innovation_share(np.asarray(counts))
        assert found.number == 2 * FRAMES
        assert found.claim == claim
        assert found.share == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / FRAMES))
        assert found.low <= found.share <= found.high
        assert (contradiction(found.report()) == "") == (claim == CONSISTENT_CLAIM)


def test_what_a_frame_does_not_measure_is_not_counted():
    counts = correction_counts(jnp.array([0.5, 0.0, 3.0]), jnp.array([1.0, 1.0, 1.0]), jnp.array([0.5, 1.0, 0.2]))
    assert counts.tolist() == [2, 1]
    info = jf.update(jf.kalman(PRIOR, F, Q, H, R), jax.random.key(0), PRIOR, jnp.array([0.1, jnp.nan]))[1]
    assert innovation_counts(info).tolist() == [1, 1]
    assert innovation_counts(info, 0.01).tolist() == [1, 0]


def test_errors_that_last_widen_the_interval():
    """Runs of ten equal frames are worth a tenth of as many independent ones: the interval is sqrt(10) as wide."""
    inside = (np.random.default_rng(0).random(400) < 0.95).astype(int)
    single = innovation_share(np.stack([np.ones(400), inside], axis=1))
    lasting = innovation_share(np.repeat(np.stack([np.ones(400), inside], axis=1), 10, axis=0))
    assert lasting.share == single.share
    np.testing.assert_allclose(lasting.high - lasting.low, single.high - single.low, rtol=0.2)


def test_rows_of_a_frame_are_counted_together():
    """Two objects that err alike are no more evidence than one."""
    inside = (np.random.default_rng(1).random(400) < 0.95).astype(int)
    one = np.stack([np.ones(400, int), inside], axis=1)
    alone, both = innovation_share(one), innovation_share(np.repeat(one, 2, axis=0), np.repeat(np.arange(400), 2))
    assert both.number == 800
    np.testing.assert_allclose(both[1:], alone[1:], rtol=1e-12)


def test_few_innovations_are_not_judged():
    none = innovation_share(np.full((30, 2), np.nan)).report()
    assert none == {"count": 0, "share_inside_95": None, "interval": None, "claim": TOO_FEW}
    few = innovation_share(np.array([[3, 0]] * 19)).report()
    assert few == {"count": 57, "share_inside_95": 0.0, "interval": None, "claim": TOO_FEW}
    assert contradiction(few) == ""
