"""Linear algebra of small dense matrices that may be singular: triangularisation, Cholesky factors, triangular solves.

Up to 8 rows all functions but `tria` are written as algebra on the elements, which becomes vector arithmetic over an
ensemble and is ten times faster on a CPU than a LAPACK call for each matrix; above that LAPACK is faster.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular as lapack_solve_triangular
from jaxtyping import Array, Float

from jaxfilters._xla.last_axis import batch_last
from jaxfilters._xla.materialize import materialized
from jaxfilters._xla.one_or_many import one_or_many
from jaxfilters._xla.product import LARGEST, small_product

LARGEST_WIDTH = 24
"""Number of columns up to which algebra on the elements of a matrix with few rows is faster than LAPACK."""


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
    n, k, m = len(a), len(b), b.shape[1]
    if min(n, k, m) == 0 or n > LARGEST or max(k, m) > LARGEST_WIDTH:
        return jnp.matmul(a, b, precision="highest")
    kind = jnp.result_type(a, b)
    return materialized(small_product(a.astype(kind), b.astype(kind)))


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
    if n > LARGEST:
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


def log_det_triangular(L: Float[Array, "n n"]) -> Float[Array, ""]:
    """Logarithm of the determinant of a triangular matrix with a positive diagonal: half of that of `L L^T`.

    Raises:
        ValueError: If L is not square.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> print(linalg.log_det_triangular(jnp.array([[2.0, 0.0], [5.0, 0.5]])))
        0.0
    """
    if L.shape != L.shape[:1] * 2:
        raise ValueError(f"L must be square; got {L.shape}.")
    return jnp.log(jnp.diagonal(L)).sum()


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
    if n > LARGEST:
        fixed = jnp.diagonal(L) == 0
        rest = jnp.where(fixed.reshape((n,) + (1,) * (b.ndim - 1)), 0.0, b)
        # An unknown that is fixed at zero must not influence the others through its column or row.
        square = jnp.where(fixed[:, None] | fixed, jnp.eye(n, dtype=L.dtype), L)
        return lapack_solve_triangular(square, rest, lower=True, trans=1 if transpose else 0)
    return materialized(_substituted(transpose, L, b))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _substituted(transpose, L, b):
    n = L.shape[0]
    diagonal = jnp.stack([L[i, i] for i in range(n)])
    fixed = diagonal == 0
    scale = jnp.where(fixed, 0.0, 1 / jnp.where(fixed, 1.0, diagonal))
    x = [jnp.zeros(b.shape[1:], b.dtype)] * n
    for i in reversed(range(n)) if transpose else range(n):
        known = range(i + 1, n) if transpose else range(i)
        x[i] = (b[i] - sum((L[k, i] if transpose else L[i, k]) * x[k] for k in known)) * scale[i]
    return jnp.stack(x)


@_substituted.defjvp
def _substituted_jvp(transpose, primals, tangents):
    # The derivative of L x = b; as products of matrices it is transposed to products.
    (L, b), (dL, db) = primals, tangents
    x = _substituted(transpose, L, b)
    changed = matmul(jnp.tril(dL).T if transpose else jnp.tril(dL), x.reshape(len(b), -1)).reshape(b.shape)
    return x, _substituted(transpose, L, db - changed)


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
    """As `tria`, without the order in which it takes rows, for many matrices at once under `vmap`.

    A row of zeros leads to a row of zeros; its column need not be zero. Derivatives are those of `tria`.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> many = jnp.array([[[3.0, 4.0]], [[6.0, 8.0]]])
        >>> print(jax.vmap(linalg.tria_of_many)(many).ravel())
        [ 5. 10.]
    """
    return _wide_tria(A)


def reflected(count: int, A: Float[Array, "n m"], *others: Float[Array, "_ m"]) -> tuple[Float[Array, "_ m"], ...]:
    """`A` and the other matrices times the reflections that make the first `count` rows of `A` lower triangular.

    These are Householder's, written as algebra on the elements, for many matrices under `vmap`. Elements on the
    diagonal may be negative. A row that is a linear combination of those before it has a zero there.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> L, Q = linalg.reflected(1, jnp.array([[3.0, 4.0]]), jnp.eye(2))
        >>> print(L.round(3), Q.round(3))
        [[-5.  0.]] [[-0.6 -0.8]
         [-0.8  0.6]]
    """
    # Sums of squares must neither overflow nor vanish.
    largest = jnp.max(jnp.abs(A))
    scale = jnp.where(largest > 0, largest, 1.0)
    rest, done = [A / scale, *others], []
    for i in range(count):
        if rest[0].shape[1] > 1:
            normal = _normal(rest[0][i : i + 1])
            square = small_product(normal, normal.T)
            twice = jnp.where(square > 0, 2 / jnp.where(square > 0, square, 1.0), 0.0)
            rest = [materialized(x - small_product(small_product(x, normal.T) * twice, normal)) for x in rest]
        # Later reflections do not change this column.
        done.append([x[:, :1] for x in rest])
        rest = [x[:, 1:] for x in rest]
    first, *last = (jnp.hstack(columns) for columns in zip(*done, rest, strict=True))
    return first * scale, *last


def _normal(row):
    """Of the mirror that takes a row (1, m) to its first axis."""
    first = row[:, :1]
    length = jnp.sqrt(small_product(row, row.T))
    return jnp.hstack([first + jnp.where(first < 0, -length, length), row[:, 1:]])


def with_positive_diagonal(L: Float[Array, "n n"], *others: Float[Array, "_ n"]) -> tuple[Float[Array, "_ n"], ...]:
    """A lower triangular matrix and others, with the sign of those columns changed where its diagonal is negative.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import linalg
        >>> L, Q = linalg.with_positive_diagonal(jnp.array([[-5.0]]), jnp.array([[-0.6], [-0.8]]))
        >>> print(L, Q.ravel())
        [[5.]] [0.6 0.8]
    """
    sign = jnp.where(jnp.diagonal(L) < 0, -1.0, 1.0).astype(L.dtype)
    return jnp.tril(L * sign), *(x * sign for x in others)


def _lower_of_one(A):
    return with_positive_diagonal(jnp.linalg.qr(A.T, mode="r").T)[0]


def _lower_of_few_rows(A):
    n = len(A)
    return with_positive_diagonal(reflected(n, A)[0][:, :n])[0]


def _factors_of_one(A):
    Q, R = jnp.linalg.qr(A.T)
    return with_positive_diagonal(R.T, Q)


def _factors_of_few_rows(A):
    n, m = A.shape
    L, Q = reflected(n, A, jnp.eye(m, dtype=A.dtype))
    return with_positive_diagonal(L[:, :n], Q[:, :n])


def is_small(rows: int, columns: int) -> bool:
    """Whether a batch of matrices of this size is factored by `reflected`, and one after the other by LAPACK if not.

    >>> from jaxfilters.math import linalg
    >>> linalg.is_small(4, 8), linalg.is_small(100, 200)
    (True, False)
    """
    return rows <= LARGEST and columns <= LARGEST_WIDTH


def _of_many(of_few_rows, of_one):
    def of_many(A):
        return jax.vmap(batch_last(of_few_rows))(A) if is_small(*A.shape[1:]) else jax.lax.map(of_one(), A)

    return of_many


_lower: Callable[[Array], Array] = one_or_many(_lower_of_one, _of_many(_lower_of_few_rows, lambda: _lower))
_factors: Callable[[Array], tuple[Array, Array]] = one_or_many(
    _factors_of_one, _of_many(_factors_of_few_rows, lambda: _factors)
)
"""L and Q of A = L Q^T with a nonnegative diagonal of L, for A with no fewer columns than rows; L alone before."""


@jax.custom_jvp
def _tria(A):
    return _lower(A)


@_tria.defjvp
def _tria_jvp(primals, tangents):
    # A = L Q^T. For every skew-symmetric W, dL = dA Q + L W satisfies d(L L^T) = d(A A^T), at any rank. The W for which
    # dL is lower triangular follows from the upper triangle of L^-1 dA Q, which needs independent rows only.
    (A,), (dA,) = primals, tangents
    L, Q = _factors(A)
    turned = matmul(dA, Q)
    dependent = jnp.diagonal(L) <= 4 * jnp.finfo(L.dtype).eps * safe_norm(L)
    independent = jnp.where(dependent[:, None], jnp.eye(len(L), dtype=L.dtype), L)
    upper = jnp.triu(solve_triangular(independent, jnp.where(dependent[:, None], 0.0, turned)), 1)
    return L, jnp.tril(turned + matmul(L, upper.T - upper))
