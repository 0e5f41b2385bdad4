import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math import linalg

SIZES = [1, 2, 5, 8, 9, 12]
# One program for each shape; uncompiled, each of their hundred operations would be one.
cholesky, matmul, tria = map(jax.jit, (linalg.cholesky, linalg.matmul, linalg.tria))
solve_triangular = jax.jit(linalg.solve_triangular, static_argnames="transpose")


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def numeric_tangent(f, x, dx, step=1e-6):
    return (f(x + step * dx) - f(x - step * dx)) / (2 * step)


@pytest.mark.system
@pytest.mark.parametrize("n", SIZES)
def test_cholesky_and_solves_agree_with_numpy(x64, rng, n):
    A = rng.normal(size=(n, n + 2))
    S = jnp.asarray(A @ A.T)
    L = cholesky(S)
    np.testing.assert_allclose(L, np.linalg.cholesky(S), atol=1e-12)
    for b in (jnp.asarray(rng.normal(size=n)), jnp.asarray(rng.normal(size=(n, 3)))):
        np.testing.assert_allclose(L @ solve_triangular(L, b), b, atol=1e-11)
        np.testing.assert_allclose(L.T @ solve_triangular(L, b, transpose=True), b, atol=1e-11)


@pytest.mark.parametrize("n", [4, 10])
def test_a_variable_without_variance_gets_zeros_not_nan(x64, rng, n):
    A = rng.normal(size=(n, n))
    A[1] = 0
    S = jnp.asarray(A @ A.T)
    rest = np.delete(np.arange(n), 1)
    L = cholesky(S)
    np.testing.assert_allclose(L @ L.T, S, atol=1e-12)
    b = jnp.asarray(rng.normal(size=n))
    for transpose in (False, True):
        x = solve_triangular(L, b, transpose=transpose)
        assert x[1] == 0
        square = np.asarray(L)[np.ix_(rest, rest)]
        np.testing.assert_allclose(x[rest], np.linalg.solve(square.T if transpose else square, b[rest]), atol=1e-9)

    def total(S):
        L = cholesky(S)
        return jnp.sum(solve_triangular(L, b) + solve_triangular(L, b, transpose=True))

    assert np.isfinite(jax.jit(jax.grad(total))(S)).all()


def test_dependent_variables_up_to_eight_and_indefinite_matrices():
    v = jnp.array([1.0, 2.0, -0.5])
    L = linalg.cholesky(jnp.outer(v, v))
    np.testing.assert_allclose(L, jnp.outer(v, jnp.array([1.0, 0, 0])), atol=1e-6)
    assert np.isnan(linalg.cholesky(jnp.array([[1.0, 2.0], [2.0, 1.0]]))).any()
    assert np.isnan(linalg.cholesky(-jnp.eye(2))).any()


def test_factors_map_over_the_last_axis(x64, rng):
    A = rng.normal(size=(6, 3, 3))
    S = jnp.asarray(np.moveaxis(A @ A.transpose(0, 2, 1), 0, -1))
    mapped = jax.vmap(linalg.cholesky, -1, -1)(S)
    np.testing.assert_allclose(np.moveaxis(np.asarray(mapped), -1, 0), np.linalg.cholesky(A @ A.transpose(0, 2, 1)))


@pytest.mark.parametrize(("n", "k", "m"), [(2, 3, 4), (8, 8, 8), (9, 2, 1)])
def test_matmul_agrees_with_numpy(x64, rng, n, k, m):
    a, b = rng.normal(size=(n, k)), rng.normal(size=(k, m))
    np.testing.assert_allclose(matmul(jnp.asarray(a), jnp.asarray(b)), a @ b, atol=1e-13)


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (3, 7), (5, 2), (10, 14)])
def test_tria_is_the_lower_root(x64, rng, shape):
    A = jnp.asarray(rng.normal(size=shape))
    L = tria(A)
    np.testing.assert_allclose(L @ L.T, A @ A.T, atol=1e-12)
    np.testing.assert_array_equal(L, np.tril(L))
    assert (np.diagonal(L) >= 0).all()


@pytest.mark.parametrize("shape", [(3, 3), (3, 7), (10, 14)])
def test_tria_derivative_at_full_rank_is_that_of_cholesky(x64, rng, shape):
    A, dA = jnp.asarray(rng.normal(size=shape)), jnp.asarray(rng.normal(size=shape))
    weight = jnp.asarray(rng.normal(size=(shape[0], shape[0])))

    @jax.jit
    def derivatives(A, dA):
        expected = jax.jvp(lambda A: jnp.linalg.cholesky(A @ A.T), (A,), (dA,))[1]
        gradient = jax.grad(lambda A: jnp.sum(weight * linalg.tria(A)))(A)
        return expected, jax.jvp(linalg.tria, (A,), (dA,))[1], gradient

    expected, forward, gradient = derivatives(A, dA)
    np.testing.assert_allclose(forward, expected, atol=1e-9)
    np.testing.assert_allclose(jnp.sum(gradient * dA), jnp.sum(weight * expected), atol=1e-9)


def test_tria_derivative_is_right_where_a_change_keeps_the_rank(x64, rng):
    # Rank 3 of 5: the last rows depend on the first, before and after the change.
    mix = np.vstack([np.eye(3), rng.normal(size=(2, 3))])
    base = rng.normal(size=(3, 6))
    A = jnp.asarray(mix @ base)
    dA = jnp.asarray(rng.normal(size=(5, 3)) @ base + mix @ rng.normal(size=(3, 6)))
    follow = lambda t: tria((mix + t * (dA @ np.linalg.pinv(base))) @ base)
    d_mix = jnp.asarray(np.asarray(dA) @ np.linalg.pinv(base))
    along = d_mix @ base
    expected = numeric_tangent(follow, 0.0, 1.0)
    np.testing.assert_allclose(jax.jvp(tria, (A,), (along,))[1], expected, atol=1e-6)


@pytest.mark.parametrize("dead", [0, 1, 3])
def test_tria_derivative_with_a_zero_row_is_that_of_the_other_rows(x64, rng, dead):
    A, dA = rng.normal(size=(4, 5)), rng.normal(size=(4, 5))
    A[dead] = dA[dead] = 0
    rest = np.delete(np.arange(4), dead)
    value, tangent = jax.jvp(lambda A: (lambda L: L @ L.T)(tria(A)), (jnp.asarray(A),), (jnp.asarray(dA),))
    np.testing.assert_allclose(value, A @ A.T, atol=1e-12)
    np.testing.assert_allclose(tangent, A @ dA.T + dA @ A.T, atol=1e-12)
    assert (np.delete(np.asarray(tangent), rest, axis=0) == 0).all()


@pytest.mark.parametrize("A", [np.zeros((3, 3)), np.ones((3, 4)), np.diag([1.0, 0.0, 2.0]), np.zeros((2, 0))])
def test_tria_gradient_is_finite_at_any_rank(A):
    A = jnp.asarray(A, jnp.float32)
    L = tria(A)
    np.testing.assert_allclose(L @ L.T, A @ A.T, atol=1e-5)
    assert np.isfinite(jax.jit(jax.grad(lambda A: jnp.sum(linalg.tria(A))))(A)).all()


def test_safe_root_and_length_have_zero_derivative_at_zero():
    assert linalg.safe_sqrt(jnp.float32(4.0)) == 2
    assert jax.grad(linalg.safe_sqrt)(0.0) == 0
    np.testing.assert_allclose(linalg.safe_norm(jnp.array([[3.0, 4.0], [0.0, 0.0]])), [5, 0])
    np.testing.assert_allclose(jax.grad(linalg.safe_norm)(jnp.array([3.0, 4.0])), [0.6, 0.8])
    np.testing.assert_array_equal(jax.grad(linalg.safe_norm)(jnp.zeros(3)), 0)
