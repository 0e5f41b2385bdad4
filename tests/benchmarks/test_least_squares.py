"""The scenario on bounded least squares, with few problems."""

import jax
import numpy as np

from jaxfilters.benchmarks.scenarios import least_squares


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


def test_shared_variables_are_solved_alike(x64):
    metrics = least_squares.shared_metrics(0, (4, 8), 1)
    assert metrics["shared_apart_from_dense"].value < 1e-7
    assert metrics["shared_ms_schur_8_frames"].value > 0


def test_the_peers_own_derivatives_are_right():
    """SciPy is given a Jacobian that is written out."""
    A, b, c, lower, upper, start = (a[5] for a in least_squares.random_problems(1, 12))
    with jax.enable_x64(True):
        found = least_squares.scipy_solve(A, b, c, lower, upper, start)
        expected = jax.jacfwd(least_squares.residuals)(np.asarray(found.x), (A, b, c))
        np.testing.assert_allclose(found.jac, expected, rtol=1e-10)
