"""Intervals down to 1e-4 prior standard deviations in float32, against closed forms and quadrature in float64.

In all problems but one the constrained quantities are constant, so that all observations can be combined with the prior
before the rows are applied: the evidence is a Gaussian density times the probability of a box under a Gaussian, whose
integral is taken by Gauss-Legendre quadrature. Gradients are those of the same oracle.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf
from jaxfilters.gaussian.constraints import LinearConstraints, expectation_propagation

WIDTHS = (1.0, 0.1, 0.01, 3e-3, 1e-3, 3e-4, 1e-4)
COVARIANCES = {
    1: np.eye(1),
    2: np.array([[1.0, 0.6], [0.6, 1.0]]),
    3: np.array([[1.0, 0.6, 0.3], [0.6, 1.0, -0.2], [0.3, -0.2, 1.0]]),
}
CENTRES = np.array([0.4, -2.5, 0.7])
NOISE = 0.5
GRADIENTS = ("mean", "covariance", "lower", "upper", "noise")
# Off-centre, negative and positive readings; the first frame alone is a sequence of one.
READINGS = np.random.default_rng(3).normal(size=(6, 3)) * 0.7


def single(tree):
    """In float32: what the computation and the oracle both start from."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), tree)


def double(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), tree)


def problem(n, width):
    centres = CENTRES[:n]
    return single(
        {
            "mean": np.linspace(-0.2, 0.3, n),
            "covariance": COVARIANCES[n],
            "lower": centres - width / 2,
            "upper": centres + width / 2,
            "noise": NOISE * np.eye(n),
        }
    )


def filtered_evidence(theta, y, normals, root):
    """Log evidence of observations of the state and of lasting rows, by the filter under test."""
    n, dtype = len(theta["mean"]), theta["mean"].dtype
    prior, noise, options = jf.Gaussian(theta["mean"], theta["covariance"]), theta["noise"], {}
    if root:
        prior = jf.GaussianRoot(theta["mean"], jnp.linalg.cholesky(theta["covariance"]))
        noise, options = jnp.linalg.cholesky(noise), {"arithmetic": jf.arithmetic.square_root}
    I = jnp.eye(n, dtype=dtype)
    inner = jf.kalman(prior, I, 0 * I, I, noise, **options)
    rows = LinearConstraints(normals.astype(dtype), theta["lower"], theta["upper"], tuple("abc"[: len(normals)]))
    filter = jf.constrained(inner, jf.EPConstraints(rows, jnp.ones(len(normals), bool)))
    return jf.log_evidence(filter, jax.random.key(0), y.astype(dtype))


def exact_evidence(theta, y, normals, points=24):
    """The same in closed form, but for the probability of the box: a product rule over its sides."""
    log_evidence, mean, P, R = 0.0, theta["mean"], theta["covariance"], theta["noise"]
    log_density = lambda x, S: -0.5 * (x @ jnp.linalg.solve(S, x) + jnp.linalg.slogdet(2 * jnp.pi * S)[1])
    for reading in y:
        S = P + R
        log_evidence += log_density(reading - mean, S)
        gain = jnp.linalg.solve(S, P).T
        mean, P = mean + gain @ (reading - mean), P - gain @ S @ gain.T
    mean, P = normals @ mean, normals @ P @ normals.T
    nodes, weights = np.polynomial.legendre.leggauss(points)
    half, middle = 0.5 * (theta["upper"] - theta["lower"]), 0.5 * (theta["upper"] + theta["lower"])
    k = len(normals)
    grid = jnp.stack(jnp.meshgrid(*[nodes] * k, indexing="ij"), axis=-1).reshape(-1, k)
    log_weights = jnp.log(jnp.stack(jnp.meshgrid(*[weights] * k, indexing="ij"), axis=-1)).reshape(-1, k).sum(axis=1)
    densities = jax.vmap(lambda t: log_density(middle + half * t - mean, P))(grid)
    return log_evidence + jax.nn.logsumexp(densities + log_weights) + jnp.sum(jnp.log(half))


NORMALS = {
    "3-D": np.eye(3),
    "2-D oblique": np.array([[1.0, 0.5], [-0.3, 1.0]]),
}


CASES = [("3-D", True, 6), ("2-D oblique", False, 6), ("2-D oblique", True, 1)]


@pytest.mark.system
@pytest.mark.parametrize(("name", "root", "frames"), CASES)
def test_evidence_and_gradients_of_narrow_intervals_in_single_precision(x64, name, root, frames):
    normals = jnp.asarray(NORMALS[name], jnp.float32)
    n = normals.shape[1]
    y = single(READINGS[:frames, :n])
    filtered = jax.jit(jax.value_and_grad(partial(filtered_evidence, normals=normals, root=root)))
    exact = jax.jit(jax.value_and_grad(partial(exact_evidence, normals=double(normals))))
    # A covariance in single precision does not represent smaller variances along an oblique normal: section 6 of the
    # derivation.
    narrowest = 3e-3 if name == "2-D oblique" and not root else 0.0
    for width in (width for width in WIDTHS if width >= narrowest):
        theta = problem(n, width)
        value, gradients = filtered(theta, y)
        expected, expected_gradients = exact(double(theta), double(y))
        assert value.dtype == jnp.float32
        # Expectation propagation itself is within 0.01 nat of boxes of these shapes.
        np.testing.assert_allclose(value, expected, atol=0.05, err_msg=f"width {width}")
        for field in GRADIENTS:
            got, wanted = np.asarray(gradients[field], float), np.asarray(expected_gradients[field])
            if field in ("covariance", "noise"):
                # Off the diagonal only the sum of the two equal elements is determined.
                got, wanted = got + got.T, wanted + wanted.T
            # One per cent of the largest element: the others are as exact absolutely. Wide correlated boxes, of which
            # expectation propagation is an approximation, are compared below with double precision.
            if width <= 0.1:
                np.testing.assert_allclose(
                    got, wanted, atol=0.01 * abs(wanted).max(), rtol=0, err_msg=f"{field}, width {width}"
                )


@pytest.mark.system
def test_wide_intervals_in_single_and_in_double_precision_agree(x64):
    normals = jnp.asarray(NORMALS["3-D"], jnp.float32)
    filtered = jax.jit(jax.value_and_grad(partial(filtered_evidence, normals=normals, root=False)))
    for width in (3.0, 1.0, 0.3):
        theta, y = problem(3, width), single(READINGS)
        (value, gradients), (expected, expected_gradients) = filtered(theta, y), filtered(double(theta), double(y))
        np.testing.assert_allclose(value, expected, atol=1e-3)
        for field in GRADIENTS:
            wanted = np.asarray(expected_gradients[field])
            np.testing.assert_allclose(gradients[field], wanted, atol=1e-3 * abs(wanted).max(), rtol=0)


@pytest.mark.parametrize("root", [False, True], ids=["covariance", "root"])
@pytest.mark.parametrize("centre", [0.0, 0.4, -3.0, 8.0])
def test_the_truncated_belief_and_its_mass_in_one_dimension(x64, root, centre):
    cut = jax.jit(lambda belief, rows: expectation_propagation.truncate(belief, rows)[::2])
    for width in WIDTHS:
        lower, upper = single((np.array([centre]), np.array([centre + width])))
        prior = single((jf.GaussianRoot if root else jf.Gaussian)(np.zeros(1), np.eye(1)))
        belief, info = cut(prior, LinearConstraints(jnp.ones((1, 1), jnp.float32), lower, upper, ("a",)))
        nodes, weights = np.polynomial.legendre.leggauss(60)
        x = double(lower) + (nodes + 1) * double(upper - lower) / 2
        density = weights * np.exp(-(x**2) / 2)
        mass = np.sum(density) * float(upper[0] - lower[0]) / 2 / np.sqrt(2 * np.pi)
        assert info.converged
        assert not info.infeasible.any()
        np.testing.assert_allclose(info.log_mass, np.log(mass), atol=1e-3)
        mean = np.average(x, weights=density)
        deviation = np.sqrt(np.average((x - mean) ** 2, weights=density))
        variance = float(belief.root[0] @ belief.root[0]) if root else float(belief.covariance[0, 0])
        np.testing.assert_allclose(np.sqrt(variance), deviation, rtol=5e-3)
        # The mean is a float32 beside the bounds: it is right to their rounding.
        atol = 0.01 * deviation + 4 * np.finfo(np.float32).eps * abs(centre)
        np.testing.assert_allclose(belief.mean[0], mean, atol=atol)


@pytest.mark.parametrize("width", [1e-2, 1e-4])
def test_repeated_truncation_changes_nothing_in_single_precision(width):
    P = jnp.asarray(COVARIANCES[3], jnp.float32)
    rows = LinearConstraints(jnp.eye(3), *(jnp.asarray(CENTRES + s * width / 2, jnp.float32) for s in (-1, 1)), "abc")
    rows = replace(rows, names=tuple("abc"))
    belief, sites, _ = expectation_propagation.truncate(jf.Gaussian(jnp.zeros(3), P), rows)
    first = belief
    for _ in range(20):
        belief, sites, info = expectation_propagation.truncate(belief, rows, sites)
        np.testing.assert_allclose(info.log_mass, 0, atol=1e-3)
    np.testing.assert_allclose(belief.mean, first.mean, atol=0.01 * width)
    np.testing.assert_allclose(jnp.diagonal(belief.covariance), jnp.diagonal(first.covariance), rtol=1e-2)


@pytest.mark.parametrize(("width", "accepted"), [(2e-3, False), (4e-3, True)])
def test_what_a_covariance_in_single_precision_cannot_resolve_is_refused(x64, width, accepted):
    """Where values are known; roots, axis-parallel rows, moving rows and double precision are not concerned."""
    theta, normals = problem(2, width), jnp.asarray(NORMALS["2-D oblique"], jnp.float32)
    rows = LinearConstraints(normals, theta["lower"], theta["upper"], ("a", "b"))
    I = jnp.eye(2, dtype=jnp.float32)

    def build(prior, rows=rows, lasting=True, **options):
        arrays = (I, 0 * I, I, I) if prior.mean.dtype == jnp.float32 else double((I, 0 * I, I, I))
        inner = jf.kalman(prior, *arrays, **options)
        return jf.constrained(inner, jf.EPConstraints(rows, jnp.full(2, lasting)))

    prior = jf.Gaussian(theta["mean"], jnp.eye(2, dtype=jnp.float32))
    if accepted:
        build(prior)
    else:
        # The standard deviation along the second normal, (-0.3, 1), is 1.04, and along the first 1.12.
        with pytest.raises(ValueError, match=r"constraints: a is 0\.0018 prior standard deviations wide.*square_root"):
            build(prior)
    build(jf.GaussianRoot(prior.mean, I), arithmetic=jf.arithmetic.square_root)
    build(prior, replace(rows, normals=I))
    build(prior, lasting=False)
    build(double(prior), double(rows))
