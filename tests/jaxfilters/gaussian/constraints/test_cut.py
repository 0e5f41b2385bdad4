"""Cuts against the transform of the paper, Monte Carlo and scipy, for covariances and roots alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.constraints import constraint_distances, cut, linear_constraints
from jaxfilters.gaussian.constraints.directions import compiled

halfspace, interval = compiled(cut.halfspace), compiled(cut.interval)
FORMS = {
    "covariance": lambda mean, root: Gaussian(mean, jnp.matmul(root, root.T, precision="highest")),
    "root": GaussianRoot,
}


@pytest.fixture(params=FORMS, ids=str)
def form(request):
    return lambda mean, root: FORMS[request.param](jnp.asarray(mean), jnp.asarray(root))


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def covariance_of(belief):
    if isinstance(belief, Gaussian):
        return np.asarray(belief.covariance)
    return np.asarray(jnp.matmul(belief.root, jnp.swapaxes(belief.root, -1, -2), precision="highest"))


def transformed_cut(m, Q, phi, b):
    """Equations 21 to 29 of Shimada et al. (1997), with its misprints corrected, and scipy's moments."""
    D, T = np.linalg.eigh(Q)
    w = np.sqrt(D) * (T.T @ phi)
    s = np.linalg.norm(w)
    # A reflection takes w / s to the first axis.
    u = w / s - np.eye(len(m))[0]
    O = np.eye(len(m)) - 2 * np.outer(u, u) / (u @ u)
    c = (b - phi @ m) / s
    nu, v = truncnorm(-np.inf, c).stats("mv")
    back = T @ np.diag(np.sqrt(D)) @ O.T
    cut_covariance = np.eye(len(m))
    cut_covariance[0, 0] = v
    return back[:, 0] * nu + m, back @ cut_covariance @ back.T, c


def test_the_rank_one_form_is_the_transform_of_the_paper(x64, rng, form):
    for _ in range(20):
        m, root, phi = rng.normal(size=5), rng.normal(size=(5, 5)), rng.normal(size=5)
        b = phi @ m + rng.uniform(-3, 3) * np.linalg.norm(root.T @ phi)
        expected_mean, expected_covariance, c = transformed_cut(m, root @ root.T, phi, b)
        belief, info = halfspace(form(m, root), jnp.asarray(phi), b)
        np.testing.assert_allclose(belief.mean, expected_mean, atol=1e-12)
        np.testing.assert_allclose(covariance_of(belief), expected_covariance, atol=1e-12)
        np.testing.assert_allclose(info.distances, [np.inf, c], atol=1e-12)
        np.testing.assert_allclose(info.log_mass, norm.logcdf(c), rtol=1e-12)
        assert not info.infeasible


def test_a_cut_agrees_with_a_million_samples(x64, rng, form):
    m, root, phi, b = rng.normal(size=4), rng.normal(size=(4, 4)), rng.normal(size=4), 0.4
    lower, upper = phi @ m - 0.8, phi @ m + b
    count = 1_000_000
    samples = m + rng.normal(size=(count, 4)) @ root.T
    along = samples @ phi
    half, half_info = halfspace(form(m, root), jnp.asarray(phi), upper)
    both, both_info = interval(form(m, root), jnp.asarray(phi), lower, upper)
    for belief, info, kept in (
        (half, half_info, samples[along <= upper]),
        (both, both_info, samples[(along >= lower) & (along <= upper)]),
    ):
        share = len(kept) / count
        assert abs(kept.mean(axis=0) - belief.mean).max() <= 4 * kept.std(axis=0).max() / np.sqrt(len(kept))
        scale = np.sqrt(np.outer(np.diag(covariance_of(belief)), np.diag(covariance_of(belief))))
        assert abs(np.cov(kept.T) - covariance_of(belief)).max() <= 0.01 * scale.max()
        assert abs(np.exp(info.log_mass) - share) <= 4 * np.sqrt(share * (1 - share) / count)


def test_what_is_uncorrelated_stays_and_nothing_widens(x64, rng, form):
    root = np.zeros((5, 5))
    root[:3, :3], root[3:, 3:] = rng.normal(size=(3, 3)), rng.normal(size=(2, 2))
    phi = np.append(rng.normal(size=3), [0, 0])
    before = form(rng.normal(size=5), root)
    after, _ = interval(before, jnp.asarray(phi), phi @ before.mean + 0.2, phi @ before.mean + 1.0)
    P, Q = covariance_of(before), covariance_of(after)
    np.testing.assert_array_equal(after.mean[3:], before.mean[3:])
    np.testing.assert_array_equal(Q[3:], P[3:])
    np.testing.assert_allclose(Q, Q.T, atol=1e-14)
    assert phi @ Q @ phi < phi @ P @ phi
    assert np.linalg.eigvalsh(Q).min() > 0
    assert np.linalg.eigvalsh(P - Q).min() > -1e-12


def test_half_spaces_in_a_row_depend_on_their_order_and_intervals_do_not(x64, form):
    # Reference values, to the digits printed.
    belief = form([0.3], np.eye(1))
    for normal, mean, variance in ((1.0, 0.0586, 0.1670), (-1.0, -0.0458, 0.1814)):
        constraints = linear_constraints([[normal]], -0.5, 0.5)
        literal, info = cut.sequential_halfspaces(belief, constraints)
        np.testing.assert_allclose(literal.mean, mean, atol=5e-5)
        np.testing.assert_allclose(covariance_of(literal), variance, atol=5e-5)
        assert np.isfinite(info.log_mass)
        exact, info = cut.sequential_intervals(belief, constraints)
        np.testing.assert_allclose(exact.mean, 0.02414, atol=5e-6)
        np.testing.assert_allclose(covariance_of(exact), 0.08025, atol=5e-6)
        np.testing.assert_allclose(info.log_mass, np.log(norm.cdf(0.2) - norm.cdf(-0.8)), rtol=1e-12)


@pytest.mark.system
def test_intervals_in_a_row_in_two_dimensions(x64, form):
    belief = form(np.zeros(2), np.linalg.cholesky([[1, 0.8], [0.8, 1]]))
    normals, lower, upper = np.eye(2), np.array([-np.inf, 0.6]), np.array([0.2, np.inf])
    for order, mean, variance in (
        ([0, 1], (0.111, 0.953), (0.264, 0.096)),
        ([1, 0], (-0.170, 0.773), (0.100, 0.189)),
    ):
        constraints = linear_constraints(normals[order], lower[order], upper[order])
        for method in (cut.sequential_intervals, cut.sequential_halfspaces):
            truncated, info = method(belief, constraints)
            np.testing.assert_allclose(truncated.mean, mean, atol=6e-4)
            np.testing.assert_allclose(np.diag(covariance_of(truncated)), variance, atol=6e-4)
            np.testing.assert_allclose(info.distances, constraint_distances(belief, constraints))
            assert (info.sweeps, info.converged) == (1, True)


@pytest.mark.system
def test_a_known_direction_is_left_alone_or_reported(x64, rng, form):
    root = rng.normal(size=(3, 3))
    root[1] = root[0]
    mean = jnp.array([1.0, 3.0, 0.0])
    belief = form(mean, root)
    difference = jnp.array([-1.0, 1.0, 0.0])
    for bounds, violated in (((1.5, 2.5), False), ((2.0, 2.0), False), ((2.5, 9.0), True), ((-jnp.inf, 1.9), True)):
        after, info = interval(belief, difference, *bounds)
        np.testing.assert_array_equal(after.mean, mean)
        np.testing.assert_array_equal(covariance_of(after), covariance_of(belief))
        assert bool(info.infeasible) == violated
        assert info.log_mass == (-jnp.inf if violated else 0)
    constraints = linear_constraints(np.stack([difference, np.eye(3)[2], -difference]), [2.5, 0.0, -2.1], np.inf)
    for method in (cut.sequential_intervals, cut.sequential_halfspaces):
        after, info = method(belief, constraints)
        np.testing.assert_array_equal(info.infeasible, [True, False, False])
        assert np.isfinite(after.mean).all()
        assert covariance_of(after)[2, 2] < covariance_of(belief)[2, 2]

    def far(leaves):
        after, info = interval(leaves, difference, 1.5, 2.5)
        return jnp.sum(after.mean) + info.log_mass

    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.jit(jax.grad(far))(belief)))


def test_bounds_far_inside_are_skipped(x64, form):
    belief = form(np.zeros(1), np.eye(1))
    constraints = linear_constraints([[1.0]], -2.5, 0.5)
    skipped, _ = cut.sequential_halfspaces(belief, constraints, skip=2.0)
    upper_only, _ = halfspace(belief, jnp.ones(1), 0.5)
    np.testing.assert_array_equal(skipped.mean, upper_only.mean)
    np.testing.assert_array_equal(covariance_of(skipped), covariance_of(upper_only))
    untouched, info = halfspace(belief, jnp.ones(1), 0.5, skip=0.4)
    assert (untouched.mean[0], info.log_mass) == (0, 0)


def test_distances_are_in_standard_deviations(x64, form):
    belief = form([1.0, 2.0, 5.0], np.diag([2.0, 3.0, 0.0]))
    constraints = linear_constraints(
        [[1, 0, 0], [1, -1, 0], [0, 0, 1], [0, 0, -2]], [0, -np.inf, 5, -9], [2, 1, np.inf, np.inf]
    )
    s = np.sqrt(13)
    expected = [[0.5, 0.5], [np.inf, 2 / s], [np.inf, np.inf], [-np.inf, np.inf]]
    np.testing.assert_allclose(constraint_distances(belief, constraints), expected)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_hundreds_of_cuts_leave_a_covariance(x64, rng, form, dtype):
    # Slab after slab through the mean of a belief in ten dimensions, three of them spanned by the others.
    mix = np.vstack([np.eye(7), rng.normal(size=(3, 7))])
    belief = form((mix @ rng.normal(size=7)).astype(dtype), (mix @ rng.normal(size=(7, 7))).astype(dtype))
    normals = rng.normal(size=(200, 10))
    middle = normals @ np.asarray(belief.mean, float)
    constraints = linear_constraints(normals, middle - 1, middle + 1)
    constraints = jax.tree.map(lambda leaf: leaf.astype(dtype), constraints)
    before = covariance_of(belief).astype(float)
    after, info = cut.sequential_intervals(belief, constraints)
    Q = covariance_of(after).astype(float)
    assert np.isfinite(after.mean).all()
    assert np.isfinite(info.log_mass)
    np.testing.assert_array_equal(Q, Q.T)
    # One rounding of each of 200 steps at most, adding up to their square root.
    assert np.linalg.eigvalsh(Q).min() >= -15 * np.finfo(dtype).eps * np.trace(before)
    assert np.trace(Q) < 0.1 * np.trace(before)


@pytest.mark.system
def test_gradients_agree_with_differences(x64, rng, form):
    root, phi = rng.normal(size=(3, 3)), jnp.asarray(rng.normal(size=3))
    mean = rng.normal(size=3)
    weight = jnp.asarray(rng.normal(size=(3, 3)))

    def outcome(x):
        belief, info = interval(form(x[:3], x[3:12].reshape(3, 3)), phi, x[12], x[13])
        covariance = belief.covariance if isinstance(belief, Gaussian) else belief.root @ belief.root.T
        return jnp.sum(weight * covariance) + jnp.sum(belief.mean) + info.log_mass

    x = jnp.asarray([*mean, *root.ravel(), phi @ mean - 0.3, phi @ mean + 1.1])
    gradient = jax.jit(jax.grad(outcome))(x)
    steps = 1e-6 * jnp.eye(x.size)
    differences = jax.jit(jax.vmap(lambda step: (outcome(x + step) - outcome(x - step)) / 2e-6))(steps)
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-7)


def test_cuts_map_over_the_last_axis_and_compile_once(rng, form):
    traces = []
    constraints = linear_constraints(rng.normal(size=(4, 3)), -0.5, 0.7)

    def truncate(belief):
        traces.append(None)
        return cut.sequential_intervals(belief, constraints)

    roots, means = rng.normal(size=(3, 3, 6)).astype(np.float32), rng.normal(size=(3, 6)).astype(np.float32)
    beliefs = jax.vmap(form, -1, -1)(jnp.asarray(means), jnp.asarray(roots))
    mapped = jax.jit(jax.vmap(truncate, -1, -1))
    truncated, info = mapped(beliefs)
    mapped(jax.tree.map(lambda leaf: leaf + 0.1, beliefs))
    assert len(traces) == 1
    for i in range(6):
        single, single_info = cut.sequential_intervals(
            jax.tree.map(lambda leaf, i=i: leaf[..., i], beliefs), constraints
        )
        np.testing.assert_allclose(truncated.mean[:, i], single.mean, atol=1e-5)
        np.testing.assert_allclose(info.log_mass[i], single_info.log_mass, rtol=1e-5)
