"""Iterated smoothers against the least squares of whole trajectories by SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import jaxfilters as jf

KEY = jax.random.key(0)
T, DT = 10, 1.0
SENSORS = np.array([[-1.5, 0.5], [1.0, 1.0]])
MEAN = np.array([0.0, 0.0, 1.0, 0.0, 0.0])
P = np.diag([0.1, 0.1, 0.5, 0.5, 0.5])
Q = np.diag([0.01, 0.01, 0.05, 0.05, 0.02])
R = np.diag([0.05, 0.05]) ** 2


def move(x, inputs=None, *, xp=jnp):
    """Coordinated turn: position, velocity and turn rate."""
    del inputs
    w = x[4]
    # sin(w) / w and (1 - cos(w)) / w, with their limits at 0.
    s, c = xp.sinc(w * DT / np.pi) * DT, xp.sinc(w * DT / 2 / np.pi) ** 2 * w * DT**2 / 2
    cos, sin = xp.cos(w * DT), xp.sin(w * DT)
    return xp.stack(
        [
            x[0] + s * x[2] - c * x[3],
            x[1] + c * x[2] + s * x[3],
            cos * x[2] - sin * x[3],
            sin * x[2] + cos * x[3],
            w,
        ]
    )


def bearings(x, *, xp=jnp):
    return xp.arctan2(x[1] - SENSORS[:, 1], x[0] - SENSORS[:, 0])


def wrapped(y, y_hat, *, xp=jnp):
    return xp.mod(y - y_hat + np.pi, 2 * np.pi) - np.pi


def simulated(seed):
    rng = np.random.default_rng(seed)
    x, ys = rng.multivariate_normal(MEAN, P), []
    for _ in range(T):
        x = move(x, xp=np) + rng.multivariate_normal(np.zeros(5), Q)
        ys.append(wrapped(bearings(x, xp=np) + rng.multivariate_normal(np.zeros(2), R), 0.0, xp=np))
    return np.array(ys)


def most_probable(ys, start):
    """Means of the states from the first observation on, and half the sum of squares."""
    roots = [np.linalg.inv(np.linalg.cholesky(C)) for C in (P, Q, R)]

    def residuals(flat):
        xs = flat.reshape(T + 1, 5)
        steps = [roots[1] @ (xs[t + 1] - move(xs[t], xp=np)) for t in range(T)]
        readings = [roots[2] @ wrapped(ys[t], bearings(xs[t + 1], xp=np), xp=np) for t in range(T)]
        return np.concatenate([roots[0] @ (xs[0] - MEAN), *steps, *readings])

    found = least_squares(residuals, start.ravel(), x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-10)
    return found.x.reshape(T + 1, 5)[1:], found.cost


def build(kind=jf.extended_kalman, arithmetic=jf.arithmetic.joseph, **options):
    arrays = [jnp.asarray(each) for each in (MEAN, P, Q, R)]
    if arithmetic is jf.arithmetic.square_root:
        arrays[1:] = [jnp.linalg.cholesky(each) for each in arrays[1:]]
        prior = jf.GaussianRoot(*arrays[:2])
    else:
        prior = jf.Gaussian(*arrays[:2])
    return kind(prior, move, arrays[2], bearings, arrays[3], arithmetic=arithmetic, residual=wrapped, **options)


@pytest.mark.system
def test_the_iterated_extended_smoother_finds_the_most_probable_trajectory(x64):
    ys = simulated(0)
    filter = build(arithmetic=jf.arithmetic.square_root)
    smoothed, info = jf.smoothing.iterated(filter, KEY, jnp.asarray(ys), iterations=25)
    means, cost = most_probable(ys, np.vstack([MEAN, np.asarray(smoothed.mean)]))
    np.testing.assert_allclose(info.reached[-1], cost, rtol=1e-8)
    np.testing.assert_allclose(smoothed.mean, means, atol=1e-4)


@pytest.mark.system
@pytest.mark.parametrize("kind", ["extended_kalman", "cubature_kalman"])
def test_no_iteration_raises_the_cost_from_any_start(x64, kind):
    filter = build(getattr(jf, kind))
    rng = np.random.default_rng(1)
    starts = jf.Gaussian(jnp.asarray(rng.normal(0, 5, (8, T, 5))), jnp.broadcast_to(jnp.asarray(P), (8, T, 5, 5)))
    ys = jnp.asarray(simulated(2))
    run = lambda start: jf.smoothing.iterated(filter, KEY, ys, start=start, iterations=30)
    smoothed, info = jax.jit(jax.vmap(run))(starts)
    assert np.isfinite(np.asarray(smoothed.mean)).all()
    assert (np.asarray(info.reached) <= np.asarray(info.cost)).all()
    # Three orders of magnitude are left of the cost at the start.
    assert (np.asarray(info.reached)[:, -1] < 1e-3 * np.asarray(info.cost)[:, 0]).all()


@pytest.mark.system
def test_in_parallel_it_finds_the_same(x64):
    # Few frames: every round of the scan is compiled.
    filter, ys = build(jf.cubature_kalman), simulated(3)[:3]
    ys[2, 0], mask = np.nan, np.arange(3) != 1
    run = lambda smoother: jf.smoothing.iterated(
        filter, KEY, jnp.asarray(ys), mask=jnp.asarray(mask), iterations=2, smoother=smoother
    )
    expected, found = run(jf.smoothing.sequential), run(jf.smoothing.parallel)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-8), found, expected)


@pytest.mark.system
@pytest.mark.parametrize("root", [False, True], ids=["covariance", "root"])
@pytest.mark.parametrize("kind", ["extended_kalman", "cubature_kalman"])
def test_what_is_exact_holds_from_any_start(x64, kind, root):
    """Exact observations and positions, noise on the velocity alone: against the conditional of the joint Gaussian."""
    A, Q, H, mean = (
        np.array([[1.0, 1.0], [0.0, 1.0]]),
        np.diag([0.0, 0.2]),
        np.array([[1.0, 0.0]]),
        np.array([1.0, 0.5]),
    )
    ys, frames = np.array([0.3, 1.1, 0.7, 2.0]), 4
    spread = [jnp.asarray(np.sqrt(C) if root else C) for C in (np.diag([4.0, 1.0]), Q, np.zeros((1, 1)))]
    form = jf.GaussianRoot if root else jf.Gaussian
    arithmetic = jf.arithmetic.square_root if root else jf.arithmetic.joseph
    filter = getattr(jf, kind)(
        form(jnp.asarray(mean), spread[0]),
        lambda x: A @ x,
        spread[1],
        lambda x: H @ x,
        spread[2],
        arithmetic=arithmetic,
    )
    start = form(jnp.zeros((frames, 2)), jnp.tile(jnp.eye(2), (frames, 1, 1)))
    found, info = jf.smoothing.iterated(filter, KEY, jnp.asarray(ys)[:, None], iterations=3, start=start)
    # States are a linear function of the first one and of the noises.
    L = np.zeros((frames, 2, 2 + 2 * frames))
    part = np.eye(2, 2 + 2 * frames)
    for t in range(frames):
        part = A @ part
        part[:, 2 + 2 * t : 4 + 2 * t] += np.eye(2)
        L[t] = part
    joint = (
        L.reshape(2 * frames, -1)
        * np.concatenate([[4.0, 1.0], np.tile(np.diag(Q), frames)])
        @ L.reshape(2 * frames, -1).T
    )
    means = np.concatenate([np.linalg.matrix_power(A, t + 1) @ mean for t in range(frames)])
    gain = joint[:, ::2] @ np.linalg.inv(joint[::2, ::2])
    np.testing.assert_allclose(found.mean.ravel(), means + gain @ (ys - means[::2]), atol=1e-7)
    assert info.step[0] == 1
    P = found.root @ found.root.transpose(0, 2, 1) if root else found.covariance
    expected = joint - gain @ joint[::2]
    np.testing.assert_allclose(P, [expected[i : i + 2, i : i + 2] for i in range(0, 2 * frames, 2)], atol=1e-6)
