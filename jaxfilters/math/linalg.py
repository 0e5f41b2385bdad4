"""Linear algebra of small dense matrices that may be singular: triangularisation, Cholesky factors, triangular solves.

Up to 8 rows all functions but `tria` are written as algebra on the elements, which becomes vector arithmetic over an
ensemble and is ten times faster on a CPU than a LAPACK call for each matrix; above that LAPACK is faster.
"""

from collections.abc import Callable
from functools import reduce
from operator import add

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular as lapack_solve_triangular
from jaxtyping import Array, Float

from jaxfilters._xla.materialize import materialized

_UNROLLED = 8


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The square root, with derivative 0 instead of infinity at 0; it is 0 for negative numbers.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> print(linalg.safe_sqrt(jnp.array([4.0, 0.0, -1.0])), jax.grad(linalg.safe_sqrt)(0.0))
        [2. 0. 0.] 0.0
    """
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_norm(x: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    """The Euclidean norm along the last axis, with derivative 0 at 0.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> print(linalg.safe_norm(jnp.array([3.0, 4.0])), jax.grad(linalg.safe_norm)(jnp.zeros(2)))
        5.0 [0. 0.]
    """
    return safe_sqrt(jnp.sum(x * x, axis=-1))


def matmul(a: Float[Array, "n k"], b: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """The matrix product in full precision on every device.

    Raises:
        ValueError: If the inner sizes differ.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> print(linalg.matmul(jnp.array([[1.0, 2.0]]), jnp.array([[3.0], [4.0]])))
        [[11.]]
    """
    if a.shape[1] != b.shape[0]:
        raise ValueError(f"a and b must be (n, k) and (k, m); got {a.shape} and {b.shape}.")
    if max(*a.shape, *b.shape) > _UNROLLED or a.shape[1] == 0:
        return jnp.matmul(a, b, precision="highest")
    return materialized(reduce(add, (a[:, i, None] * b[None, i, :] for i in range(a.shape[1]))))


def cholesky(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower triangular L with `L L^T = S`, from the lower triangle of a positive semidefinite S.

    A variable without variance has a row and a column of zeros, and up to n = 8 so has one that is a linear combination
    of those before it, up to rounding. L has NaN if S is not positive semidefinite.

    Raises:
        ValueError: If S is not square.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> print(linalg.cholesky(jnp.array([[4.0, 0.0, 2.0], [0.0, 0.0, 0.0], [2.0, 0.0, 2.0]])))
        [[2. 0. 0.]
         [0. 0. 0.]
         [1. 0. 1.]]
    """
    if S.shape != S.shape[:1] * 2:
        raise ValueError(f"S must be square; got {S.shape}.")
    n = S.shape[0]
    if n > _UNROLLED:
        fixed = jnp.diagonal(S) == 0
        L = jnp.linalg.cholesky(jnp.where(fixed[:, None] | fixed, jnp.eye(n, dtype=S.dtype), S))
        return jnp.where(fixed[:, None] | fixed, 0.0, L)
    tolerance = n * float(jnp.finfo(S.dtype).eps)
    zero = jnp.zeros((), S.dtype)
    L = [[zero] * n for _ in range(n)]
    for j in range(n):
        variance = S[j, j] - sum(L[j][k] * L[j][k] for k in range(j))
        fixed = abs(variance) <= tolerance * S[j, j]
        L[j][j] = jnp.where(fixed, 0.0, jnp.sqrt(jnp.where(fixed, 1.0, variance)))
        scale = jnp.where(fixed, 0.0, 1 / jnp.where(fixed, 1.0, L[j][j]))
        for i in range(j + 1, n):
            L[i][j] = (S[i, j] - sum(L[i][k] * L[j][k] for k in range(j))) * scale
    return materialized(jnp.stack([jnp.stack(row) for row in L]))


def solve_triangular(
    L: Float[Array, "n n"], b: Float[Array, " n"] | Float[Array, "n m"], *, transpose: bool = False
) -> Float[Array, " n"] | Float[Array, "n m"]:
    """The solution of `L x = b` or `L^T x = b` with lower triangular L; 0 for unknowns whose diagonal element is 0.

    Raises:
        ValueError: If L is not square, or b does not have as many rows.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> L = jnp.array([[2.0, 0.0], [1.0, 4.0]])
        >>> print(linalg.solve_triangular(L, jnp.array([2.0, 9.0])))
        [1. 2.]
        >>> print(linalg.solve_triangular(L, jnp.array([4.0, 8.0]), transpose=True))
        [1. 2.]
    """
    n = L.shape[0]
    if L.shape != (n, n) or b.shape[:1] != (n,):
        raise ValueError(f"L and b must be (n, n) and (n,) or (n, m); got {L.shape} and {b.shape}.")
    if n > _UNROLLED:
        fixed = jnp.diagonal(L) == 0
        rest = jnp.where(fixed.reshape((n,) + (1,) * (b.ndim - 1)), 0.0, b)
        # An unknown that is fixed at zero must not influence the others through its column or row.
        square = jnp.where(fixed[:, None] | fixed, jnp.eye(n, dtype=L.dtype), L)
        return lapack_solve_triangular(square, rest, lower=True, trans=1 if transpose else 0)
    diagonal = jnp.stack([L[i, i] for i in range(n)])
    fixed = diagonal == 0
    scale = jnp.where(fixed, 0.0, 1 / jnp.where(fixed, 1.0, diagonal))
    x = [jnp.zeros(b.shape[1:], b.dtype)] * n
    for i in reversed(range(n)) if transpose else range(n):
        known = range(i + 1, n) if transpose else range(i)
        x[i] = (b[i] - sum((L[k, i] if transpose else L[i, k]) * x[k] for k in known)) * scale[i]
    return materialized(jnp.stack(x))


def tria(A: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """The lower triangular L with `L L^T = A A^T` and a nonnegative diagonal, for A of any width.

    A row of zeros leads to a row and a column of zeros. L is differentiable where the rows of A are independent. A row
    that is zero, or a linear combination of earlier rows up to rounding, has a zero on the diagonal, at which L is not
    differentiable, as |x| at 0: the derivative there is finite, correct for changes that keep the row in the span, and
    ignores the part of other changes to the right of the diagonal.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> print(linalg.tria(jnp.array([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0]])))
        [[5. 0.]
         [0. 2.]]
    """
    return _with_rows_of_zeros(_wide_tria, A)


def _with_rows_of_zeros(triangular: Callable[[Array], Array], A: Float[Array, "n m"]) -> Float[Array, "n n"]:
    # Rows of zeros are moved to the end, so that the factorisation assigns no direction of the row space to them.
    zero = jnp.all(A == 0, axis=1)
    place = jnp.where(zero, jnp.sum(~zero) + jnp.cumsum(zero), jnp.cumsum(~zero)) - 1
    ordered = (place == jnp.arange(A.shape[0])[:, None]).astype(A.dtype)
    return matmul(matmul(ordered.T, triangular(matmul(ordered, A))), ordered)


def _wide_tria(A: Float[Array, "n m"]) -> Float[Array, "n n"]:
    n, m = A.shape
    return _tria(jnp.pad(A, ((0, 0), (0, max(0, n - m)))))


def tria_of_many_with_zeros(A: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """As `tria_of_many`, and a row of zeros leads to a column of zeros, too, as in `tria`.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> print(linalg.tria_of_many_with_zeros(jnp.array([[0.0, 0.0], [3.0, 4.0]])))
        [[0. 0.]
         [0. 5.]]
    """
    return _with_rows_of_zeros(tria_of_many, A)


def tria_of_many(A: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """As `tria`, for many matrices at once under `vmap`: up to 8 rows by Householder reflections written as algebra.

    A row of zeros leads to a row of zeros; its column need not be zero. Derivatives are those of `tria`.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> many = jnp.array([[[3.0, 4.0]], [[6.0, 8.0]]])
        >>> print(jax.vmap(linalg.tria_of_many)(many).ravel())
        [ 5. 10.]
    """
    n, m = A.shape
    A = jnp.pad(A, ((0, 0), (0, max(0, n - m))))
    return _reflected(A) if n <= _UNROLLED else _tria(A)


@jax.custom_jvp
def _reflected(A):
    n, m = A.shape
    # Sums of squares must neither overflow nor vanish.
    largest = jnp.max(jnp.abs(A))
    scale = jnp.where(largest > 0, largest, 1.0)
    A = A / scale
    for i in range(min(n, m - 1)):
        row = jnp.where(jnp.arange(m) >= i, A[i], 0.0)
        length = jnp.sqrt(jnp.sum(row * row))
        normal = row + jnp.where(jnp.arange(m) == i, jnp.where(row[i] < 0, -length, length), 0.0)
        square = jnp.sum(normal * normal)
        along = jnp.sum(A * normal, axis=1) * jnp.where(square > 0, 2 / jnp.where(square > 0, square, 1.0), 0.0)
        A = materialized(A - along[:, None] * normal)
    L = A[:, :n]
    return jnp.tril(L * jnp.where(jnp.diagonal(L) < 0, -scale, scale))


def _factors(A):
    Q, R = jnp.linalg.qr(A.T)
    sign = jnp.where(jnp.diagonal(R) < 0, -1.0, 1.0).astype(A.dtype)
    return jnp.tril(R.T * sign), Q * sign


@jax.custom_jvp
def _tria(A):
    return _factors(A)[0]


@_reflected.defjvp
@_tria.defjvp
def _tria_jvp(primals, tangents):
    # A = L Q^T. For every skew-symmetric W, dL = dA Q + L W satisfies d(L L^T) = d(A A^T), at any rank. The W for which
    # dL is lower triangular follows from the upper triangle of L^-1 dA Q, which needs independent rows only.
    (A,), (dA,) = primals, tangents
    L, Q = _factors(A)
    turned = jnp.matmul(dA, Q, precision="highest")
    dependent = jnp.diagonal(L) <= 4 * jnp.finfo(L.dtype).eps * jnp.linalg.norm(L, axis=1)
    independent = jnp.where(dependent[:, None], jnp.eye(len(L), dtype=L.dtype), L)
    upper = jnp.triu(lapack_solve_triangular(independent, jnp.where(dependent[:, None], 0.0, turned), lower=True), 1)
    return L, jnp.tril(turned + jnp.matmul(L, upper.T - upper, precision="highest"))
