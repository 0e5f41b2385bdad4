"""Bad input: Optimisation and mathematics reject it at trace time or before, and name the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


COST = jnp.ones((2, 3))
PCA = jf.math.incremental_pca.start(3, 2)
TENSOR = jnp.ones((3, 4, 2))
SPLIT = jf.optimize.Split(jnp.zeros(1), jnp.zeros((4, 2)))


def solved(options=None, fn=lambda y, args: y - 3.0):
    solver = jf.optimize.BoxLevenbergMarquardt(rtol=1e-4, atol=1e-4)
    return optimistix.least_squares(fn, solver, jnp.zeros(2), None, options)


def shared(start=SPLIT, data=None, **options):
    data = jnp.zeros((4, 2)) if data is None else data
    return jf.optimize.solve_shared(lambda shared, frame, data: shared + frame - data, start, data, **options)


MATH = [
    Case("least squares, bound of another shape", lambda: solved({"lower": jnp.zeros(3)}), ("lower", "shapes of y")),
    Case("least squares, bound of another tree", lambda: solved({"upper": {"a": 0.0}}), ("upper", "structure")),
    Case("least squares, crossed bounds", lambda: solved({"lower": 2.0, "upper": 1.0}), ("lower", "2.0", "1.0")),
    Case("least squares, NaN bound", lambda: solved({"lower": float("nan")}), ("lower", "nan")),
    Case(
        "bounds, crossed",
        lambda: jf.optimize.bounds_of({"lower": jnp.array([0.0, 2.0]), "upper": 1.0}, jnp.zeros(2)),
        ("lower", "variable 1", "2.0", "1.0"),
    ),
    Case("least squares, no residuals", lambda: solved(fn=lambda y, args: y[:0]), ("fn", "residual", "none")),
    Case("huber, scale", lambda: jf.optimize.huber(jnp.ones(2), 0.0), ("scale", "0.0")),
    Case("cauchy, scale", lambda: jf.optimize.cauchy(jnp.ones(2), -1.0), ("scale", "-1.0")),
    Case("solve_shared, frames of data", lambda: shared(data=jnp.zeros((5, 2))), ("data", "(4, 2)", "(5, 2)")),
    Case("solve_shared, no frames", lambda: shared(jf.optimize.Split(jnp.zeros(1), None)), ("start.frames", "none")),
    Case(
        "solve_shared, crossed bounds",
        lambda: shared(lower=SPLIT._replace(shared=jnp.ones(1)), upper=SPLIT),
        ("lower",),
    ),
    Case("solve_shared, bound of another shape", lambda: shared(lower=SPLIT._replace(shared=jnp.ones(2))), ("lower",)),
    Case("assignment, vector", lambda: jf.math.assignment.match(jnp.ones(3)), ("cost", "(3,)")),
    Case("assignment, NaN", lambda: jf.math.assignment.match(COST.at[0, 1].set(jnp.nan)), ("cost", "NaN", "1 of 6")),
    Case("assignment, mask", lambda: jf.math.assignment.match(COST, jnp.ones(3, bool)), ("rows", "(2,)", "(3,)")),
    Case("assignment, gate", lambda: jf.math.assignment.match_noncrossing_gated(COST, -1.0), ("gate", "-1.0")),
    Case("assignment, columns", lambda: jf.math.assignment.match(jnp.ones((2, 13))), ("cost", "12", "13")),
    Case("pca, components", lambda: jf.math.incremental_pca.start(3, 4), ("num_components", "3", "4")),
    Case("pca, sample", lambda: jf.math.incremental_pca.update(PCA, jnp.ones(2)), ("deviation", "(3,)", "(2,)")),
    Case(
        "pca, sample of moments",
        lambda: jf.math.incremental_pca.update_moments(jf.math.incremental_pca.start_moments(3), jnp.ones(1)),
        ("x", "(3,)", "(1,)"),
    ),
    Case("pca, mean", lambda: jf.math.incremental_pca.running_mean(jnp.ones(3), jnp.ones(1), 2), ("x", "(3,)", "(1,)")),
    Case(
        "pca, basis",
        lambda: jf.math.incremental_pca.change_basis(
            jnp.ones((2, 5)), jnp.zeros(3), jnp.eye(3), jnp.zeros(3), jnp.eye(3)
        ),
        ("coordinates", "(2, 5)", "(3, 3)"),
    ),
    Case("diffusion, scale", lambda: jf.math.diffusion.start(jnp.array([1.0, 0.0])), ("scale", "positive")),
    Case(
        "diffusion, velocity",
        lambda: jf.math.diffusion.update(jf.math.diffusion.start(jnp.ones(2)), jnp.ones(1), jnp.ones(1)),
        ("velocity", "(2,)", "(1,)"),
    ),
    Case("lie, quaternion", lambda: jf.math.lie.quaternion_to_matrix(jnp.ones(3)), ("q", "(3,)")),
    Case("lie, product", lambda: jf.math.lie.quaternion_multiply(jnp.ones(4), jnp.ones(3)), ("q", "(3,)")),
    Case("lie, rotation vector", lambda: jf.math.lie.so3_exp(jnp.ones(4)), ("rotvec", "(4,)")),
    Case("lie, matrix", lambda: jf.math.lie.quaternion_from_matrix(jnp.ones((4, 4))), ("R", "(4, 4)")),
    Case("lie, points", lambda: jf.math.lie.RigidTransform.identity().apply(jnp.ones((5, 2))), ("points", "(5, 2)")),
    Case(
        "linalg, product", lambda: jf.math.linalg.matmul(jnp.ones((2, 3)), jnp.ones((2, 2))), ("a", "(2, 3)", "(2, 2)")
    ),
    Case("linalg, cholesky", lambda: jf.math.linalg.cholesky(jnp.ones((3, 2))), ("S", "(3, 2)")),
    Case(
        "linalg, triangular",
        lambda: jf.math.linalg.solve_triangular(jnp.eye(2), jnp.ones(3)),
        ("L", "b", "(2, 2)", "(3,)"),
    ),
    Case("tensor, rank", lambda: jf.math.multilinear.hosvd(TENSOR, {1: 5}), ("ranks", "mode 1", "5")),
    Case("tensor, mode", lambda: jf.math.multilinear.unfold(TENSOR, 3), ("mode", "3")),
    Case("tensor, NaN", lambda: jf.math.multilinear.hooi(TENSOR * jnp.nan, {0: 1}), ("X", "finite", "24")),
    Case(
        "tensor, product",
        lambda: jf.math.multilinear.mode_product(TENSOR, jnp.ones((2, 2)), 0),
        ("C", "3 columns", "(2, 2)"),
    ),
    Case(
        "tensor, observed",
        lambda: jf.math.tensor_completion.complete(TENSOR, jnp.ones((3, 4), bool), {0: 1}),
        ("observed", "(3, 4, 2)", "(3, 4)"),
    ),
]


@pytest.mark.parametrize("case", MATH, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)
