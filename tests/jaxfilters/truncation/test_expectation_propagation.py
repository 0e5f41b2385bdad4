"""Expectation propagation against quadrature, scipy's probabilities, batch conditioning and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm, truncnorm

from jaxfilters import kalman
from jaxfilters.gaussian import Gaussian, GaussianRoot
from jaxfilters.truncation import Sites, constraint_distances, cut, linear_constraints, no_sites
from jaxfilters.truncation.expectation_propagation import truncate

FORMS = {"covariance": lambda mean, root: Gaussian(mean, root @ root.T), "root": GaussianRoot}


@pytest.fixture(params=FORMS, ids=str)
def form(request):
    return lambda mean, root: FORMS[request.param](jnp.asarray(mean), jnp.asarray(root))


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def covariance_of(belief):
    return np.asarray(belief.covariance if isinstance(belief, Gaussian) else belief.root @ belief.root.T)


def quadrature(mean, P, normals, lower, upper, points=1501):
    """Mean, covariance and mass of a cut Gaussian in the plane, on a grid of 8 standard deviations each way."""
    L = np.linalg.cholesky(P)
    z = np.linspace(-8, 8, points)
    grid = np.stack([axis.ravel() for axis in np.meshgrid(z, z)])
    x = mean[:, None] + L @ grid
    along = normals @ x
    weight = np.exp(-0.5 * np.sum(grid**2, axis=0)) / (2 * np.pi) * (z[1] - z[0]) ** 2
    weight *= np.all((along >= lower[:, None]) & (along <= upper[:, None]), axis=0)
    mass = weight.sum()
    centre = x @ weight / mass
    return centre, (x - centre[:, None]) * weight @ (x - centre[:, None]).T / mass, mass


def test_one_row_is_met_exactly(x64, rng, form):
    belief = form(rng.normal(size=3), rng.normal(size=(3, 3)))
    normal = rng.normal(size=3)
    level = float(normal @ belief.mean)
    for lower, upper in ((level - 0.3, level + 2), (level + 1, np.inf), (-np.inf, level - 4)):
        truncated, _, info = truncate(belief, linear_constraints(normal[None], lower, upper))
        expected, cut_info = cut.interval(belief, jnp.asarray(normal), lower, upper)
        np.testing.assert_allclose(truncated.mean, expected.mean, atol=1e-10)
        np.testing.assert_allclose(covariance_of(truncated), covariance_of(expected), atol=1e-10)
        np.testing.assert_allclose(info.log_mass, cut_info.log_mass, rtol=1e-10)
        np.testing.assert_allclose(info.distances[0], cut_info.distances)
        assert info.converged
        assert not info.infeasible.any()


def test_independent_rows_are_met_exactly(x64, form):
    deviation = np.array([0.5, 2.0, 1.0])
    belief = form([1.0, -1.0, 0.0], np.diag(deviation))
    lower, upper = np.array([1.2, -np.inf, -np.inf]), np.array([3.0, -2.0, np.inf])
    truncated, sites, info = truncate(belief, linear_constraints(np.eye(3), lower, upper))
    a, b = (lower - [1, -1, 0]) / deviation, (upper - [1, -1, 0]) / deviation
    expected = truncnorm(a, b, [1, -1, 0], deviation)
    np.testing.assert_allclose(truncated.mean, expected.mean(), atol=1e-9)
    np.testing.assert_allclose(covariance_of(truncated), np.diag(expected.var()), atol=1e-9)
    np.testing.assert_allclose(info.log_mass, np.log(norm.cdf(b) - norm.cdf(a)).sum(), rtol=1e-9)
    # A row without bounds has no site.
    np.testing.assert_allclose([sites.precision[2], sites.shift[2], sites.log_scale[2]], 0, atol=1e-12)


def test_two_rows_in_the_plane(x64, form):
    # The example of the specification, section 2.10: mean (-0.137, 0.898), variance (0.081, 0.067).
    P = np.array([[1, 0.8], [0.8, 1]])
    lower, upper = np.array([-np.inf, 0.6]), np.array([0.2, np.inf])
    mean, covariance, mass = quadrature(np.zeros(2), P, np.eye(2), lower, upper)
    np.testing.assert_allclose(mean, [-0.137, 0.898], atol=1e-3)
    truncated, _, info = truncate(form(np.zeros(2), np.linalg.cholesky(P)), linear_constraints(np.eye(2), lower, upper))
    np.testing.assert_allclose(truncated.mean, mean, atol=0.005)
    np.testing.assert_allclose(np.diag(covariance_of(truncated)), np.diag(covariance), atol=0.003)
    np.testing.assert_allclose(info.log_mass, np.log(mass), atol=0.01)


def random_boxes(rng, count, n=5, k=6):
    """Beliefs with 6 constraints, each of them cutting away something but not everything."""
    roots, means = rng.normal(size=(count, n, n)), rng.normal(size=(count, n))
    normals = rng.normal(size=(count, k, n))
    deviation = np.linalg.norm(normals @ roots, axis=-1)
    inside = np.einsum("ckn,cn->ck", normals, means) + deviation * rng.uniform(-1, 1, size=(count, k))
    lower = np.where(rng.uniform(size=(count, k)) < 0.5, -np.inf, inside - 0.7 * deviation)
    return means, roots, normals, lower, inside + 0.7 * deviation


def test_many_random_beliefs_agree_with_samples_and_do_not_depend_on_the_order(x64, rng, form):
    means, roots, normals, lower, upper = random_boxes(rng, 12)
    sequential_errors, errors = [], []
    for m, root, A, a, b in zip(means, roots, normals, lower, upper, strict=True):
        belief, constraints = form(m, root), linear_constraints(A, a, b)
        truncated, _, info = truncate(belief, constraints)
        order = rng.permutation(6)
        again, _, again_info = truncate(belief, linear_constraints(A[order], a[order], b[order]))
        np.testing.assert_allclose(again.mean, truncated.mean, atol=1e-6)
        np.testing.assert_allclose(covariance_of(again), covariance_of(truncated), atol=1e-6)
        np.testing.assert_allclose(again_info.log_mass, info.log_mass, atol=1e-6)

        samples = m + rng.normal(size=(100_000, 5)) @ root.T
        inside = np.all((samples @ A.T >= a) & (samples @ A.T <= b), axis=1)
        kept, share = samples[inside], inside.mean()
        one_by_one = cut.sequential_intervals(belief, constraints)[0]
        off, off_one_by_one = (
            np.linalg.norm(np.linalg.solve(root, np.asarray(got.mean) - kept.mean(axis=0)))
            for got in (truncated, one_by_one)
        )
        errors.append(off)
        sequential_errors.append(off_one_by_one)
        # Four standard errors of the share, and the bias of the method itself.
        assert abs(info.log_mass - np.log(share)) <= 4 * np.sqrt((1 - share) / inside.sum()) + 0.05
    # Whitened errors of the mean, of which 5 / sqrt(samples kept) is noise.
    assert max(errors) <= 0.1
    assert np.median(errors) <= 0.3 * np.median(sequential_errors)


def test_the_mass_agrees_with_the_probability_of_a_box(x64, rng, form):
    root = np.linalg.cholesky([[1.0, 0.5, 0.2], [0.5, 2.0, -0.3], [0.2, -0.3, 0.7]])
    mean, lower, upper = np.array([0.1, -0.4, 0.3]), np.array([-0.5, -np.inf, 0.0]), np.array([1.5, 0.8, 2.0])
    _, _, info = truncate(form(mean, root), linear_constraints(np.eye(3), lower, upper))
    exact = multivariate_normal(mean, root @ root.T).cdf(upper, lower_limit=lower)
    np.testing.assert_allclose(info.log_mass, np.log(exact), atol=0.01)


@pytest.mark.parametrize(("lower", "upper"), [(-np.inf, 0.5), (-1.0, 1.0)])
def test_a_constraint_that_is_applied_again_is_counted_once(x64, form, lower, upper):
    # Without sites N(0, 1) shrinks from -0.51 / 0.70 (x <= 0.5) to -0.80 / 0.38 in 55 frames.
    belief, sites = form([0.0], np.eye(1)), None
    constraints = linear_constraints([[1.0]], lower, upper)
    for frame in range(55):
        belief, sites, info = truncate(belief, constraints, sites)
        assert frame == 0 or abs(info.log_mass) < 1e-9
    np.testing.assert_allclose(belief.mean, truncnorm(lower, upper).mean(), atol=1e-9)
    np.testing.assert_allclose(covariance_of(belief), truncnorm(lower, upper).var(), atol=1e-9)
    if lower == -np.inf:
        np.testing.assert_allclose([belief.mean[0], np.sqrt(covariance_of(belief)[0, 0])], [-0.51, 0.70], atol=0.005)


def observe(belief, y, H, deviation):
    arithmetic, noise = (
        (kalman.joseph, deviation**2) if isinstance(belief, Gaussian) else (kalman.square_root, deviation)
    )
    return arithmetic.update(belief, jnp.atleast_1d(y), jnp.asarray(H)[None], jnp.atleast_2d(noise))


def test_sites_carried_between_measurements_are_as_good_as_all_at_once(x64, rng, form):
    prior = form(rng.normal(size=5), rng.normal(size=(5, 5)))
    _, _, A, a, b = (x[0] for x in random_boxes(rng, 1))
    constraints = linear_constraints(A, a, b)
    ys, Hs = rng.normal(size=4), rng.normal(size=(4, 5))

    belief, sites, log_evidence = prior, None, 0.0
    for y, H in zip(ys, Hs, strict=True):
        belief, observed = observe(belief, y, H, 0.8)
        belief, sites, info = truncate(belief, constraints, sites)
        log_evidence += observed.log_evidence + info.log_mass

    batch, batch_evidence = prior, 0.0
    for y, H in zip(ys, Hs, strict=True):
        batch, observed = observe(batch, y, H, 0.8)
        batch_evidence += observed.log_evidence
    batch, batch_sites, info = truncate(batch, constraints)
    np.testing.assert_allclose(belief.mean, batch.mean, atol=1e-7)
    np.testing.assert_allclose(covariance_of(belief), covariance_of(batch), atol=1e-7)
    np.testing.assert_allclose(log_evidence, batch_evidence + info.log_mass, atol=1e-7)
    for got, expected in zip(jax.tree.leaves(sites), jax.tree.leaves(batch_sites), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_only_the_chosen_sites_persist(x64, rng, form):
    belief = form(rng.normal(size=5), rng.normal(size=(5, 5)))
    _, _, A, a, b = (x[0] for x in random_boxes(rng, 1))
    constraints = linear_constraints(A, a, b)
    _, sites, _ = truncate(belief, constraints)
    kept = sites.only(jnp.arange(6) < 2)
    np.testing.assert_array_equal(kept.shift[:2], sites.shift[:2])
    assert all((leaf[2:] == 0).all() for leaf in jax.tree.leaves(kept))
    from_nothing = truncate(belief, constraints, no_sites(constraints))
    without = truncate(belief, constraints)
    for got, expected in zip(jax.tree.leaves(from_nothing), jax.tree.leaves(without), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_rows_that_cannot_be_met_are_named_and_nothing_is_nan(x64, rng, form):
    root = rng.normal(size=(5, 5))
    root[4] = 0
    mean = rng.normal(size=5)
    normals = np.vstack([np.eye(5)[4], np.eye(5)[4], np.eye(5)[0], -np.eye(5)[0], np.eye(5)[1], np.eye(5)[2]])
    known, first = mean[4], mean[0]
    # Against what is certain; with what is certain; two against each other; far out; a point.
    lower = np.array([known + 1, known - 1, first + 1, -first + 1, mean[1] + 40, mean[2]])
    upper = np.array([known + 2, known, np.inf, np.inf, np.inf, mean[2]])
    for dtype in ("float64", "float32"):
        belief, constraints = jax.tree.map(
            lambda leaf, dtype=dtype: leaf.astype(dtype), (form(mean, root), linear_constraints(normals, lower, upper))
        )
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
        assert np.linalg.eigvalsh(Q).min() > -10 * np.finfo(dtype).eps * np.trace(root @ root.T)
        assert (Q[4] == 0).all()
        np.testing.assert_allclose(truncated.mean[2], mean[2], atol=1e-5)
        np.testing.assert_allclose(info.distances, constraint_distances(belief, constraints))
        gradient = jax.grad(lambda belief, constraints=constraints: jnp.sum(truncate(belief, constraints)[0].mean))(
            belief
        )
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_float32_agrees_with_float64_and_keeps_a_covariance(x64, rng, form):
    # Widths from a thousandth of a standard deviation, parallel rows, and a component that is known.
    means, roots, normals, lower, upper = random_boxes(rng, 40)
    roots[:, 3] = 0
    normals[:, 1], lower[:, 1], upper[:, 1] = -2 * normals[:, 0], -2 * upper[:, 0] - 1, np.inf
    middle = np.einsum("cn,cn->c", normals[:, 2], means)
    lower[:, 2], upper[:, 2] = middle, middle + 10 ** rng.uniform(-3, 1, size=40)
    constraints = linear_constraints(normals[0], lower[0], upper[0])
    run = jax.jit(jax.vmap(lambda m, root, A, a, b: truncate(form(m, root), with_rows(constraints, A, a, b))))
    wide = run(*map(jnp.asarray, (means, roots, normals, lower, upper)))
    slim = run(*(jnp.asarray(x, jnp.float32) for x in (means, roots, normals, lower, upper)))
    assert wide[2].converged.all()
    assert slim[2].converged.all()
    prior = np.linalg.norm(roots, axis=-1)
    error = abs(np.asarray(slim[0].mean, float) - wide[0].mean) / np.where(prior > 0, prior, np.inf)
    # A mean is at best right to some roundings of a standard deviation, times how much rows amplify each other.
    assert np.quantile(error, 0.9) < 1e-4
    assert error.max() < 2e-2
    np.testing.assert_allclose(slim[2].log_mass, wide[2].log_mass, rtol=2e-3)
    Q = np.asarray(slim[0].covariance if isinstance(slim[0], Gaussian) else slim[0].root @ slim[0].root.mT, float)
    assert (np.linalg.eigvalsh(Q).min(axis=-1) > -10 * 1.2e-7 * np.sum(prior**2, axis=-1)).all()


def with_rows(constraints, normals, lower, upper):
    leaves, tree = jax.tree.flatten(constraints)
    assert len(leaves) == 3
    return jax.tree.unflatten(tree, [normals, lower, upper])


def test_gradients_agree_with_differences(x64, rng, form):
    root, mean = rng.normal(size=(3, 3)), rng.normal(size=3)
    A = rng.normal(size=(4, 3))
    level, deviation = A @ mean, np.linalg.norm(A @ root, axis=1)
    constraints = linear_constraints(A, level - 0.5 * deviation, level + deviation)
    weight = jnp.asarray(rng.normal(size=(3, 3)))
    _, sites, _ = truncate(form(mean + 0.1, root), constraints)

    def outcome(x):
        rows = with_rows(constraints, x[12:24].reshape(4, 3), x[24:28], x[28:32])
        given = Sites(*x[32:].reshape(3, 4))
        belief, sites, info = truncate(form(x[:3], x[3:12].reshape(3, 3)), rows, given, max_sweeps=200, tolerance=1e-12)
        covariance = belief.covariance if isinstance(belief, Gaussian) else belief.root @ belief.root.T
        return jnp.sum(weight * covariance) + jnp.sum(belief.mean) + info.log_mass + 0.1 * jnp.sum(sites.precision)

    # Sites that the belief might contain: half of those that it has in the end.
    given = 0.3 * np.concatenate([sites.precision, sites.shift, sites.log_scale])
    x = jnp.concatenate([jnp.asarray(v).ravel() for v in (mean, root, A, constraints.lower, constraints.upper, given)])
    gradient = jax.jit(jax.grad(outcome))(x)
    steps = 1e-5 * jnp.eye(x.size)
    differences = jax.jit(jax.vmap(lambda step: (outcome(x + step) - outcome(x - step)) / 2e-5))(steps)
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-6)


def test_damping_and_patience_change_the_way_and_not_the_result(x64, rng, form):
    _, _, A, a, b = (x[0] for x in random_boxes(rng, 1))
    belief, constraints = form(np.zeros(5), rng.normal(size=(5, 5))), linear_constraints(A, a - 1, b + 1)
    calm, _, calm_info = truncate(belief, constraints)
    bold, _, bold_info = truncate(belief, constraints, damping=1.0)
    np.testing.assert_allclose(bold.mean, calm.mean, atol=1e-6)
    assert bold_info.sweeps < calm_info.sweeps <= 60
    _, _, hasty = truncate(belief, constraints, max_sweeps=2)
    assert (int(hasty.sweeps), bool(hasty.converged)) == (2, False)


def test_beliefs_map_over_any_axis_and_compile_once(rng, form):
    traces = []
    means, roots, normals, lower, upper = (np.float32(x) for x in random_boxes(rng, 4))
    constraints = linear_constraints(normals[0], lower[0] - 2, upper[0] + 2)

    def run(mean, root):
        traces.append(None)
        return truncate(form(mean, root), constraints)

    mapped = jax.jit(jax.vmap(run, -1, -1))
    means, roots = jnp.asarray(means.T), jnp.asarray(np.moveaxis(roots, 0, -1))
    truncated, sites, info = mapped(means, roots)
    mapped(means + 0.1, roots)
    assert len(traces) == 1
    for i in range(4):
        single, single_sites, single_info = truncate(form(means[:, i], roots[..., i]), constraints)
        np.testing.assert_allclose(truncated.mean[:, i], single.mean, atol=1e-4)
        np.testing.assert_allclose(sites.precision[:, i], single_sites.precision, rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(info.log_mass[i], single_info.log_mass, atol=1e-4)
        assert info.sweeps[i] == single_info.sweeps


def test_no_rows_change_nothing(form):
    belief = form(jnp.ones(2), jnp.eye(2))
    truncated, _, info = truncate(belief, linear_constraints(np.zeros((0, 2)), 0, 0))
    np.testing.assert_array_equal(truncated.mean, belief.mean)
    np.testing.assert_array_equal(covariance_of(truncated), covariance_of(belief))
    assert info.log_mass == 0
    assert info.converged
