"""Expectation propagation against quadrature, scipy's probabilities, batch conditioning and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm, truncnorm

from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.constraints import (
    LinearConstraints,
    Sites,
    constraint_distances,
    cut,
    initial_sites,
    linear_constraints,
)
from jaxfilters.gaussian.constraints.expectation_propagation import truncate
from jaxfilters.gaussian.constraints.sites import standardized

FORMS = {"covariance": lambda mean, root: Gaussian(mean, root @ root.T), "root": GaussianRoot}


@pytest.fixture(params=FORMS, ids=str)
def form(request):
    return lambda mean, root: FORMS[request.param](jnp.asarray(mean), jnp.asarray(root))


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def covariance_of(belief):
    if isinstance(belief, Gaussian):
        return np.asarray(belief.covariance)
    return np.asarray(jnp.matmul(belief.root, jnp.swapaxes(belief.root, -1, -2), precision="highest"))


def rows(normals, lower, upper):
    """Constraints on five components, six rows: what is missing has no bounds, so that one program serves all tests."""
    normals = np.asarray(normals, float)
    k, n = normals.shape
    padded, bounds = np.eye(6, 5), np.full((2, 6), [[-np.inf], [np.inf]])
    padded[:k], padded[:k, :n], bounds[0, :k], bounds[1, :k] = 0, normals, lower, upper
    padded[5, 0] += not padded[5].any()
    return linear_constraints(padded, *bounds)


def in_five(form, mean, root):
    """The belief beside components that have nothing to do with it."""
    n = len(mean)
    padded_mean, padded_root = np.zeros(5), np.eye(5)
    padded_mean[:n], padded_root[:n, :n] = mean, root
    return form(padded_mean, padded_root)


def strip(points=400):
    """Exact moments and mass of N(0, [[1, .8], [.8, 1]]) in x <= 0.2, y >= 0.6: x by quadrature, y given x closed."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    x = -9 + (nodes + 1) * (9.2 / 2)
    given = truncnorm((0.6 - 0.8 * x) / 0.6, np.inf, 0.8 * x, 0.6)
    density = weights * (9.2 / 2) * norm.pdf(x) * norm.sf(0.6, 0.8 * x, 0.6)
    mass = density.sum()
    mean = np.array([density @ x, density @ given.mean()]) / mass
    return mean, np.array([density @ x**2, density @ (given.var() + given.mean() ** 2)]) / mass - mean**2, mass


@pytest.mark.system
def test_one_row_is_met_exactly(x64, rng, form):
    belief = form(rng.normal(size=5), rng.normal(size=(5, 5)))
    normal = rng.normal(size=5)
    level, deviation = float(normal @ belief.mean), np.sqrt(normal @ covariance_of(belief) @ normal)
    for lower, upper in ((level - 0.3, level + 2), (level + 1, np.inf), (-np.inf, level - 8 * deviation)):
        truncated, _, info = truncate(belief, rows(normal[None], lower, upper))
        expected, cut_info = cut.interval(belief, jnp.asarray(normal), lower, upper)
        np.testing.assert_allclose(truncated.mean, expected.mean, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(covariance_of(truncated), covariance_of(expected), rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(info.log_mass, cut_info.log_mass, rtol=1e-8)
        np.testing.assert_allclose(info.distances[0], cut_info.distances)
        assert info.converged
        assert not info.infeasible.any()


def test_independent_rows_are_met_exactly(x64, form):
    mean, deviation = np.array([1.0, -1.0, 0.0]), np.array([0.5, 2.0, 1.0])
    lower, upper = np.array([1.2, -np.inf, -np.inf]), np.array([3.0, -2.0, np.inf])
    truncated, sites, info = truncate(in_five(form, mean, np.diag(deviation)), rows(np.eye(3), lower, upper))
    a, b = (lower - mean) / deviation, (upper - mean) / deviation
    expected = truncnorm(a, b, mean, deviation)
    np.testing.assert_allclose(truncated.mean[:3], expected.mean(), atol=1e-8)
    np.testing.assert_allclose(covariance_of(truncated)[:3, :3], np.diag(expected.var()), atol=1e-8)
    np.testing.assert_allclose(info.log_mass, np.log(norm.cdf(b) - norm.cdf(a)).sum(), rtol=1e-8)
    # A row without bounds has no site.
    np.testing.assert_allclose([sites.precision[2], sites.shift[2], sites.log_scale[2]], 0, atol=1e-12)


def test_two_rows_in_the_plane(x64, form):
    # The quadrature gives mean (-0.137, 0.898) and variance (0.081, 0.067).
    mean, variance, mass = strip()
    np.testing.assert_allclose([*mean, *variance], [-0.137, 0.898, 0.081, 0.067], atol=1.5e-3)
    belief = in_five(form, np.zeros(2), np.linalg.cholesky([[1, 0.8], [0.8, 1]]))
    truncated, _, info = truncate(belief, rows(np.eye(2), [-np.inf, 0.6], [0.2, np.inf]))
    np.testing.assert_allclose(truncated.mean[:2], mean, atol=0.005)
    np.testing.assert_allclose(np.diag(covariance_of(truncated))[:2], variance, atol=0.003)
    np.testing.assert_allclose(info.log_mass, np.log(mass), atol=0.01)


def random_boxes(rng, count, n=5, k=6):
    """Beliefs with 6 constraints, each of them cutting away something but not everything."""
    roots, means = rng.normal(size=(count, n, n)), rng.normal(size=(count, n))
    normals = rng.normal(size=(count, k, n))
    deviation = np.linalg.norm(normals @ roots, axis=-1)
    inside = np.einsum("ckn,cn->ck", normals, means) + deviation * rng.uniform(-1, 1, size=(count, k))
    lower = np.where(rng.uniform(size=(count, k)) < 0.5, -np.inf, inside - 0.7 * deviation)
    return means, roots, normals, lower, inside + 0.7 * deviation


def test_random_beliefs_agree_with_samples_and_do_not_depend_on_the_order(x64, rng, form):
    means, roots, normals, lower, upper = random_boxes(rng, 10)
    sequential_errors, errors = [], []
    for m, root, A, a, b in zip(means, roots, normals, lower, upper, strict=True):
        belief, constraints = form(m, root), linear_constraints(A, a, b)
        truncated, _, info = truncate(belief, constraints)
        order = rng.permutation(6)
        again, _, again_info = truncate(belief, linear_constraints(A[order], a[order], b[order]))
        np.testing.assert_allclose(again.mean, truncated.mean, atol=1e-6)
        np.testing.assert_allclose(covariance_of(again), covariance_of(truncated), atol=1e-6)
        np.testing.assert_allclose(again_info.log_mass, info.log_mass, atol=1e-6)

        samples = m + rng.normal(size=(200_000, 5)) @ root.T
        inside = np.all((samples @ A.T >= a) & (samples @ A.T <= b), axis=1)
        exact, noise = samples[inside].mean(axis=0), np.sqrt(5 / inside.sum())
        one_by_one, _ = cut.sequential_intervals(belief, constraints)
        error, sequential = (np.linalg.norm(np.linalg.solve(root, g.mean - exact)) for g in (truncated, one_by_one))
        errors.append(error)
        sequential_errors.append(sequential)
        # Whitened, four standard errors of the samples beside the bias of the method.
        assert error <= 0.05 + 4 * noise
        assert abs(info.log_mass - np.log(inside.mean())) <= 0.05 + 4 / np.sqrt(inside.sum())
    assert np.median(errors) <= 0.3 * np.median(sequential_errors)


def test_the_mass_agrees_with_the_probability_of_a_box(x64, form):
    root = np.linalg.cholesky([[1.0, 0.5, 0.2], [0.5, 2.0, -0.3], [0.2, -0.3, 0.7]])
    mean, lower, upper = np.array([0.1, -0.4, 0.3]), np.array([-0.5, -np.inf, 0.0]), np.array([1.5, 0.8, 2.0])
    _, _, info = truncate(in_five(form, mean, root), rows(np.eye(3), lower, upper))
    exact = multivariate_normal(mean, root @ root.T).cdf(upper, lower_limit=lower)
    np.testing.assert_allclose(info.log_mass, np.log(exact), atol=0.01)


@pytest.mark.parametrize(("lower", "upper"), [(-np.inf, 0.5), (-1.0, 1.0)])
def test_a_constraint_that_is_applied_again_is_counted_once(x64, form, lower, upper):
    # Without sites N(0, 1) shrinks from -0.51 / 0.70 (x <= 0.5) to -0.80 / 0.38 in 55 frames.
    belief, sites = form(np.zeros(5), np.eye(5)), None
    constraints = rows([[1.0]], lower, upper)
    for frame in range(55):
        belief, sites, info = truncate(belief, constraints, sites)
        assert frame == 0 or abs(info.log_mass) < 1e-7
    mean, deviation = belief.mean[0], np.sqrt(covariance_of(belief)[0, 0])
    expected = truncnorm(lower, upper)
    np.testing.assert_allclose([mean, deviation], [expected.mean(), expected.std()], atol=1e-7)
    if lower == -np.inf:
        np.testing.assert_allclose([mean, deviation], [-0.51, 0.70], atol=0.005)


def observe(belief, y, H, deviation):
    covariance = isinstance(belief, Gaussian)
    arithmetic, noise = (arithmetics.joseph, deviation**2) if covariance else (arithmetics.square_root, deviation)
    return arithmetic.update(belief, jnp.atleast_1d(y), jnp.asarray(H)[None], jnp.atleast_2d(noise))


@pytest.mark.system
def test_sites_carried_between_measurements_are_as_good_as_all_at_once(x64, rng, form):
    prior = form(rng.normal(size=5), rng.normal(size=(5, 5)))
    _, _, A, a, b = (x[0] for x in random_boxes(rng, 1))
    constraints = linear_constraints(A, a, b)
    ys, Hs = rng.normal(size=4), rng.normal(size=(4, 5))

    belief, sites, log_evidence = prior, None, 0.0
    batch, batch_evidence = prior, 0.0
    for y, H in zip(ys, Hs, strict=True):
        belief, observed = observe(belief, y, H, 0.8)
        belief, sites, info = truncate(belief, constraints, sites)
        log_evidence += observed.log_evidence + info.log_mass
        batch, observed = observe(batch, y, H, 0.8)
        batch_evidence += observed.log_evidence
    batch, batch_sites, info = truncate(batch, constraints)
    np.testing.assert_allclose(belief.mean, batch.mean, atol=1e-6)
    np.testing.assert_allclose(covariance_of(belief), covariance_of(batch), atol=1e-6)
    np.testing.assert_allclose(log_evidence, batch_evidence + info.log_mass, atol=1e-6)
    # The same factors, whatever origin they are counted from.
    about_zero = [standardized(found, jnp.zeros(6), jnp.ones(6)) for found in (sites, batch_sites)]
    for got, expected in zip(*map(jax.tree.leaves, about_zero), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_only_the_chosen_sites_persist(x64, rng, form):
    belief = form(rng.normal(size=5), rng.normal(size=(5, 5)))
    _, _, A, a, b = (x[0] for x in random_boxes(rng, 1))
    constraints = linear_constraints(A, a, b)
    _, sites, _ = truncate(belief, constraints)
    kept = sites.select(jnp.arange(6) < 2)
    np.testing.assert_array_equal(kept.shift[:2], sites.shift[:2])
    assert all((leaf[2:] == 0).all() for leaf in jax.tree.leaves(kept))
    from_nothing = truncate(belief, constraints, initial_sites(constraints))
    without = truncate(belief, constraints)
    for got, expected in zip(jax.tree.leaves(from_nothing), jax.tree.leaves(without), strict=True):
        np.testing.assert_array_equal(got, expected)


def contradictory(form, dtype):
    """A known component, and rows against it, with it, against each other, far out, and on a point."""
    mean, deviation = np.array([1.0, 2.0, 3.0, 0.0, 4.0]), np.array([1.0, 0.5, 2.0, 1.0, 0.0])
    normals = np.eye(5)[[4, 4, 0, 0, 1, 2]]
    lower, upper = np.array([5.0, 3.0, 2.0, -np.inf, 22.0, 3.5]), np.array([6.0, 4.0, np.inf, 1.0, np.inf, 3.5])
    belief, constraints = form(mean, np.diag(deviation)), linear_constraints(normals, lower, upper)
    return jax.tree.map(lambda leaf: leaf.astype(dtype), (belief, constraints))


@pytest.mark.system
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_rows_that_cannot_be_met_are_named_and_nothing_is_nan(x64, form, dtype):
    belief, constraints = contradictory(form, dtype)
    truncated, sites, info = truncate(belief, constraints)
    infeasible = np.asarray(info.infeasible)
    assert infeasible[0]
    assert infeasible[2] or infeasible[3]
    assert not infeasible[[1, 4, 5]].any()
    assert info.log_mass == -jnp.inf
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((truncated, sites)))
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(info))
    Q = covariance_of(truncated).astype(float)
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q).min() > -10 * np.finfo(dtype).eps * 4
    np.testing.assert_array_equal(Q[4], 0)
    assert truncated.mean[4] == 4
    # N(2, 0.5^2) above 22, and the point.
    np.testing.assert_allclose(truncated.mean[1], 2 + 0.5 * truncnorm(40, np.inf).mean(), rtol=1e-4)
    np.testing.assert_allclose(truncated.mean[2], 3.5, rtol=1e-6)
    np.testing.assert_allclose(info.distances, constraint_distances(belief, constraints))


@pytest.mark.system
def test_gradients_are_finite_where_nothing_can_be_met(x64):
    belief, constraints = contradictory(lambda mean, root: Gaussian(jnp.asarray(mean), jnp.asarray(root**2)), "float32")
    total = lambda belief, constraints: sum(
        jnp.sum(leaf) for leaf in jax.tree.leaves(truncate(belief, constraints)[:2])
    )
    gradients = jax.grad(total, (0, 1))(belief, constraints)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


def test_float32_agrees_with_float64_and_keeps_a_covariance(x64, rng, form):
    # Widths from a thousandth of a standard deviation, parallel rows, and a component that is known.
    means, roots, normals, lower, upper = random_boxes(rng, 40)
    roots[:, 3] = 0
    normals[:, 1], lower[:, 1], upper[:, 1] = -2 * normals[:, 0], -2 * upper[:, 0] - 1, np.inf
    lower[:, 2] = np.einsum("cn,cn->c", normals[:, 2], means)
    upper[:, 2] = lower[:, 2] + 10 ** rng.uniform(-3, 1, size=40)
    errors, mass_errors = [], []
    for m, root, A, a, b in zip(means, roots, normals, lower, upper, strict=True):
        belief, constraints = form(m, root), linear_constraints(A, a, b)
        slim, slim_constraints = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (belief, constraints))
        exact, _, exact_info = truncate(belief, constraints)
        truncated, _, info = truncate(slim, slim_constraints)
        assert exact_info.converged
        assert info.converged
        prior = np.delete(np.linalg.norm(root, axis=-1), 3)
        errors.append(np.max(np.delete(abs(truncated.mean - exact.mean), 3) / prior))
        mass_errors.append(abs(info.log_mass - exact_info.log_mass))
        smallest = np.linalg.eigvalsh(covariance_of(truncated).astype(float)).min()
        assert smallest > -10 * np.finfo(np.float32).eps * np.sum(prior**2)
    # A mean is at best right to some roundings of a standard deviation, times how much rows amplify each other.
    assert np.quantile(errors, 0.9) < 1e-4
    assert max(errors) < 1e-2
    assert np.quantile(mass_errors, 0.9) < 2e-3
    assert max(mass_errors) < 0.5


@pytest.mark.system
def test_gradients_agree_with_differences(x64, rng, form):
    m, root, A, a, b = (x[0] for x in random_boxes(rng, 1))
    a = np.maximum(a, -20)
    # A belief that has been truncated before, by narrower bounds.
    before, sites, _ = truncate(form(m, root), linear_constraints(A, a + 0.1, b - 0.1))
    m, root, given = before.mean, np.linalg.cholesky(covariance_of(before)), jnp.stack(jax.tree.leaves(sites))
    constraints = linear_constraints(A, a, b)
    weight = jnp.asarray(rng.normal(size=(5, 5)))

    def outcome(m, root, A, a, b, given):
        rows = LinearConstraints(A, a, b, constraints.names)
        belief, sites, info = truncate(form(m, root), rows, Sites(*given), max_sweeps=300, tolerance=1e-12)
        covariance = belief.covariance if isinstance(belief, Gaussian) else belief.root @ belief.root.T
        return jnp.sum(weight * covariance) + jnp.sum(belief.mean) + info.log_mass + 0.1 * jnp.sum(sites.precision)

    x = [jnp.asarray(value) for value in (m, root, A, constraints.lower, constraints.upper, given)]
    gradients = jax.grad(outcome, range(6))(*x)
    for i, gradient in enumerate(gradients):
        for direction in rng.normal(size=(3, *x[i].shape)):
            moved = lambda t, i=i, direction=direction: outcome(*x[:i], x[i] + t * direction, *x[i + 1 :])
            difference = (moved(1e-5) - moved(-1e-5)) / 2e-5
            np.testing.assert_allclose(jnp.sum(gradient * direction), difference, rtol=1e-5, atol=1e-6)


def test_damping_and_patience_change_the_way_and_not_the_result(x64, rng, form):
    m, root, A, a, b = (x[0] for x in random_boxes(rng, 1))
    belief, constraints = form(m, root), linear_constraints(A, a, b)
    calm, _, calm_info = truncate(belief, constraints)
    bold, _, bold_info = truncate(belief, constraints, damping=1.0)
    np.testing.assert_allclose(bold.mean, calm.mean, atol=1e-6)
    assert bold_info.sweeps < calm_info.sweeps <= 60
    _, _, hasty = truncate(belief, constraints, max_sweeps=2)
    assert (int(hasty.sweeps), bool(hasty.converged)) == (2, False)


@pytest.mark.system
def test_beliefs_map_over_any_axis_and_compile_once(rng, form):
    traces = []
    means, roots, normals, lower, upper = random_boxes(rng, 4)
    constraints = linear_constraints(normals[0], lower[0] - 2, upper[0] + 2)

    def run(mean, root):
        traces.append(None)
        return truncate(form(mean, root), constraints)

    mapped = jax.jit(jax.vmap(run, -1, -1))
    means, roots = jnp.asarray(means.T, jnp.float32), jnp.asarray(np.moveaxis(roots, 0, -1), jnp.float32)
    truncated, sites, info = mapped(means, roots)
    mapped(means + 0.1, roots)
    assert len(traces) == 1
    for i in range(4):
        single, single_sites, single_info = truncate(form(means[:, i], roots[..., i]), constraints)
        np.testing.assert_allclose(truncated.mean[:, i], single.mean, atol=1e-4)
        np.testing.assert_allclose(sites.precision[:, i], single_sites.precision, rtol=1e-2, atol=1e-4)
        np.testing.assert_allclose(info.log_mass[i], single_info.log_mass, atol=1e-3)
        assert abs(info.sweeps[i] - single_info.sweeps) <= 1
