import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.arithmetic import square_root
from jaxfilters.gaussian.belief import GaussianRoot
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
    A = np.asarray(A, np.float32)
    L = np.asarray(tria(A))
    np.testing.assert_allclose(L @ L.T, A @ A.T, atol=1e-5)
    assert np.isfinite(jax.jit(jax.grad(lambda A: jnp.sum(linalg.tria(A))))(A)).all()


@pytest.mark.parametrize("shape", [(3, 5), (9, 11)])
def test_tria_of_a_batch_is_that_of_each(x64, rng, shape):
    many = rng.normal(size=(5, *shape))
    many[1, 1] = 0
    many[2, 2] = many[2, 0] - many[2, 1]
    many[3] = 0
    weight = jnp.asarray(rng.normal(size=(shape[0], shape[0])))
    both = jax.value_and_grad(lambda A: (lambda L: (jnp.sum(weight * L), L))(linalg.tria(A)), has_aux=True)
    found, change = jax.jit(jax.vmap(both))(many)
    for one, L, gradient, independent in zip(many, found[1], change, [True, False, False, False, True], strict=True):
        np.testing.assert_allclose(L @ L.T, one @ one.T, atol=1e-12)
        if independent:
            np.testing.assert_allclose(L, tria(one), atol=1e-12)
            np.testing.assert_allclose(gradient, jax.jit(both)(one)[1], atol=1e-10)
    assert np.isfinite(change).all()


@pytest.mark.parametrize(
    "transform", [lambda f: jax.grad(lambda A: jax.vmap(f)(A).sum()), lambda f: jax.vmap(jax.grad(f))]
)
def test_gradient_of_a_batch_calls_no_lapack(transform):
    """Two such calls at a time wait for each other for ever on a processor with two cores."""
    shapes = [jnp.ones((10, 3, 5)), jnp.ones((10, 3, 3)), jnp.ones((10, 3))]

    def update(root, H, y):
        posterior, info = square_root.update(GaussianRoot(y, root), y, H, jnp.eye(3))
        return info.log_evidence + linalg.tria(posterior.root)[0, 0]

    program = jax.jit(transform(lambda A: update(A, *(x[0] for x in shapes[1:])))).lower(shapes[0]).as_text()
    assert "lapack" not in program


def test_safe_root_and_length_have_zero_derivative_at_zero():
    assert linalg.safe_sqrt(jnp.float32(4.0)) == 2
    assert jax.grad(linalg.safe_sqrt)(0.0) == 0
    np.testing.assert_allclose(linalg.safe_norm(jnp.array([[3.0, 4.0], [0.0, 0.0]])), [5, 0])
    np.testing.assert_allclose(jax.grad(linalg.safe_norm)(jnp.array([3.0, 4.0])), [0.6, 0.8])
    np.testing.assert_array_equal(jax.grad(linalg.safe_norm)(jnp.zeros(3)), 0)
