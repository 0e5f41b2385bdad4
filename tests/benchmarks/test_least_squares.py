"""The scenario on bounded least squares, with few problems."""

import jax
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import _least_squares_peers as peers
from jaxfilters.benchmarks.scenarios import least_squares


@pytest.mark.system
def test_few_problems_are_solved_and_compared(x64):
    problems = least_squares.random_problems(0, 12)
    metrics = least_squares.answer_metrics(problems)
    assert metrics["infeasible"].value == 0
    assert metrics["projected_gradient_worst"].value < 1e-5
    assert metrics["worse_than_scipy"].value == 0
    timed = least_squares.batch_metrics(problems, 1)
    assert timed["batch_solved_box"].value == 100
    assert timed["batch_solved_scipy"].value > 90
    assert timed["ratio_batch_to_scipy"].value > 0


@pytest.mark.system
def test_shared_variables_are_solved_alike(x64):
    metrics = least_squares.shared_metrics(0, (4, 8), 1)
    assert metrics["shared_apart_from_dense"].value < 1e-7
    assert metrics["shared_ms_schur_8_frames"].value > 0
    assert np.isfinite([metrics[f"shared_exponent_{kind}"].value for kind in ("schur", "dense")]).all()


@pytest.mark.parametrize("name", ["pyceres", "nlopt"])
def test_peers_that_are_not_of_python_solve_the_same_problems(name):
    """Where no bound is near. Within near ones they stay too, though Ceres, which only clips its steps, may stall."""
    pytest.importorskip(name)
    solve = getattr(peers, name)
    for one in zip(*least_squares.random_problems(2, 9), strict=True):
        near = least_squares.written(*one)
        y = solve(near, 1e-6, 400)
        assert np.all((y >= near.lower) & (y <= near.upper))
        assert np.sum(near.value(y) ** 2) <= np.sum(near.value(near.start) ** 2)
    far = near._replace(lower=np.full(4, -50.0), upper=np.full(4, 50.0))
    y = solve(far, 1e-6, 400)
    assert np.abs(far.jacobian(y).T @ far.value(y)).max() < 1e-3


@pytest.mark.system
def test_the_peers_own_derivatives_are_right():
    """SciPy is given a Jacobian that is written out."""
    A, b, c, lower, upper, start = (a[5] for a in least_squares.random_problems(1, 12))
    with jax.enable_x64(True):
        found = least_squares.scipy_solve(A, b, c, lower, upper, start)
        expected = jax.jacfwd(least_squares.residuals)(np.asarray(found.x), (A, b, c))
        np.testing.assert_allclose(found.jac, expected, rtol=1e-10)
