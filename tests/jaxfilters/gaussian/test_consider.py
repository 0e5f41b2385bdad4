"""Learning from new views only: nothing is learnt from a repetition, everything from what is new."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters
from jaxfilters import Gaussian, keep_all
from jaxfilters.gaussian.arithmetic import joseph
from jaxfilters.gaussian.consider import consider, schmidt_kalman
from jaxfilters.gaussian.constraints import linear_constraints
from jaxfilters.gaussian.constraints.constrained_filter import EPConstraints, constrained
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.gaussian.linearize import second_order_covariance_only

CONSTANT = np.array([False, False, True, True])


def random_problem(seed, n=4, m=3):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    return (
        rng.normal(size=n),
        root @ root.T,
        rng.normal(size=(m, n)),
        np.diag(rng.uniform(0.1, 1, m)),
        rng.normal(size=m),
    )


@pytest.mark.system
@pytest.mark.parametrize("seed", range(3))
def test_considering_is_schmidts_filter(x64, seed):
    m, P, H, R, y = random_problem(seed)
    before = Gaussian(jnp.asarray(m), jnp.asarray(P))
    after, _ = joseph.update(before, jnp.asarray(y), jnp.asarray(H), jnp.asarray(R))
    considered = consider(before, after, jnp.asarray(CONSTANT))
    # Any gain K gives the covariance (I - K H) P (I - K H)^T + K R K^T; here the optimal one with two rows of zeros.
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    gain[CONSTANT] = 0
    left = np.eye(4) - gain @ H
    np.testing.assert_allclose(considered.mean, m + gain @ (y - H @ m), rtol=1e-9)
    np.testing.assert_allclose(considered.covariance, left @ P @ left.T + gain @ R @ gain.T, rtol=1e-9, atol=1e-12)


def pinhole(x):
    """A stick of length x[1] at the angle x[0] to the image plane: the length of its image."""
    return (x[1] * jnp.cos(x[0]))[None]


def stick(tolerance=0.5, capacity=8, angle_noise=1e-4):
    prior = Gaussian(jnp.array([0.5, 60.0]), jnp.diag(jnp.array([0.2, 10.0]) ** 2))
    inner = extended_kalman(
        prior,
        unmoved,
        jnp.diag(jnp.array([angle_noise, 0.0])),
        pinhole,
        jnp.eye(1) * 0.04,
        linearize=second_order_covariance_only,
    )
    return inner, schmidt_kalman(inner, angle, jnp.array([False, True]), tolerance, capacity=capacity)


def unmoved(x, inputs):
    return x


def angle(x):
    return x[:1]


def test_a_repeated_view_teaches_nothing_about_what_is_constant(x64):
    _, filter = stick()
    y = 50.0 + 0.2 * jax.random.normal(jax.random.key(1), (300, 1))
    _, (states, infos) = jaxfilters.run(filter, jax.random.key(0), y, collect=keep_all)
    variance = np.asarray(states.inner.covariance[:, 1, 1])
    np.testing.assert_array_equal(np.flatnonzero(infos.is_new), [0])
    np.testing.assert_array_equal(variance[1:], variance[0])
    # Without it the deviation falls although nothing was learnt: the paper's open problem.
    naive, _ = stick()
    _, (states, _) = jaxfilters.run(naive, jax.random.key(0), y, collect=keep_all)
    assert np.sqrt(states.covariance[-1, 1, 1] / states.covariance[0, 1, 1]) < 0.99


def test_where_every_view_is_new_it_is_the_inner_filter(x64):
    inner, filter = stick(tolerance=1e-9, capacity=20, angle_noise=0.01)
    y = jnp.asarray(62 * np.cos(np.linspace(0.2, 1.2, 12)))[:, None]
    _, (alone, _) = jaxfilters.run(inner, jax.random.key(0), y, collect=keep_all)
    _, (views, infos) = jaxfilters.run(filter, jax.random.key(0), y, collect=keep_all)
    assert np.all(infos.is_new)
    np.testing.assert_array_equal(infos.num_views, 1 + np.arange(12))
    np.testing.assert_allclose(views.inner.mean, alone.mean, rtol=1e-12)
    np.testing.assert_allclose(views.inner.covariance, alone.covariance, rtol=1e-12)


@pytest.mark.system
def test_memories_of_constraints_stay_with_the_constant_quantities(x64):
    inner, _ = stick()
    rows = linear_constraints(np.array([[0.0, 1.0]]), np.array([-np.inf]), np.array([58.0]))
    cut = constrained(inner, EPConstraints(rows, jnp.array([True])))
    filter = schmidt_kalman(cut, angle, jnp.array([False, True]), 0.5)
    y = jnp.full((20, 1), 50.0)
    _, (states, _) = jaxfilters.run(filter, jax.random.key(0), y, collect=keep_all)
    np.testing.assert_array_equal(states.inner.memory.precision[1:], states.inner.memory.precision[:1].repeat(19, 0))
    assert float(states.inner.memory.precision[0, 0]) > 0
    np.testing.assert_array_equal(states.inner.belief.mean[:, 1], states.inner.belief.mean[0, 1])


def test_the_oldest_view_gives_way(x64):
    _, filter = stick(tolerance=0.05, capacity=1, angle_noise=0.5)
    # There and back: with room for one view the first is forgotten, and new again.
    y = jnp.asarray(60 * np.cos([0.3, 0.9, 0.3, 0.9]))[:, None]
    _, (_, infos) = jaxfilters.run(filter, jax.random.key(0), y, collect=keep_all)
    assert np.all(infos.is_new)


def textbook(H, G, B, P, Q, R, ys):
    """Schmidt's filter with the bias beside the state, in NumPy: the gain of the bias is zero."""
    n, k = len(P), len(B)
    joint, mean = np.block([[P, np.zeros((n, k))], [np.zeros((k, n)), B]]), np.zeros(n + k)
    C, noise = np.hstack([H, G]), np.diag(np.append(np.diag(Q), np.zeros(k)))
    for y in ys:
        joint = joint + noise
        gain = joint @ C.T @ np.linalg.inv(C @ joint @ C.T + R)
        gain[n:] = 0
        left = np.eye(n + k) - gain @ C
        mean, joint = mean + gain @ (y - C @ mean), left @ joint @ left.T + gain @ R @ gain.T
    return mean, joint


def test_considered_errors_that_rows_share_are_schmidts_nuisances(x64):
    """Two sensors share one bias and have one each; the biases stay N(0, B), and the errors are those claimed."""
    H, G = np.array([[1.0], [1.0], [1.0]]), np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    B, P, Q, R = np.diag([0.3, 0.1]), np.eye(1), 1e-4 * np.eye(1), 0.04 * np.eye(3)
    rng = np.random.default_rng(0)
    ys = rng.normal(size=(40, 3))
    inner = jaxfilters.kalman(Gaussian(jnp.zeros(1), jnp.asarray(P)), jnp.eye(1), jnp.asarray(Q), H, jnp.asarray(R))
    bias = jaxfilters.GaussMarkov(jnp.array(jnp.inf), jnp.asarray(np.diag(B)))
    filter = schmidt_kalman(
        jaxfilters.correlated_noise(inner, bias, loading=jnp.asarray(G)), None, jnp.array([False, True, True])
    )
    last, (_, infos) = jaxfilters.run(filter, jax.random.key(0), jnp.asarray(ys))
    mean, covariance = textbook(H, G, B, P, Q, R, ys)
    np.testing.assert_allclose(last.inner.mean, mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(last.inner.covariance, covariance, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(last.inner.covariance[1:, 1:], B)
    assert not np.any(infos.is_new)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": None}, "signature and tolerance must both be given, or both be None"),
        ({"capacity": 0}, "capacity must be an integer of at least 1; got 0"),
        ({"tolerance": 0.0}, "tolerance must be positive, in the unit of the signature; got 0.0"),
    ],
)
def test_impossible_settings_are_refused(arguments, message):
    inner, _ = stick()
    with pytest.raises(ValueError, match=message):
        schmidt_kalman(inner, angle, jnp.array([False, True]), **{"tolerance": 1.0} | arguments)
