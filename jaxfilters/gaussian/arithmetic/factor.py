"""Lower roots of covariances that may have lost rank, and products that keep no transposed copies."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular as lapack_solve_triangular
from jaxtyping import Array, Bool, DTypeLike, Float, Shaped

from jaxfilters._xla.materialize import materialized
from jaxfilters.math import linalg

UNROLLED = 8
"""Up to this size `linalg.cholesky` is algebra on the elements, which finds dependent variables itself."""
_CONSTANT = 128
"""Up to this size identity matrices are written into the program."""


def root(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower L with `L L^T = S`, from the lower half of a positive semidefinite S of any rank.

    A variable that depends on those before it, to rounding, gets a column of zeros, its diagonal element among them.
    NaN where S is not positive semidefinite. Derivatives are those of changes that keep the dependences.
    """
    return linalg.cholesky(S) if S.shape[0] <= UNROLLED else _root(S)


@jax.custom_jvp
def _root(S):
    def sound(_S, L):
        return L, jnp.ones((), bool)

    def loose(S, _L):
        L, counts = _loosened(S)
        return jnp.where(counts, L, 0.0), jnp.any(counts) | jnp.all(S == 0)

    L = plain_root(S)
    L, definite = jax.lax.cond(jnp.min(margins(L, S)) > 0, sound, loose, S, L)
    return jnp.where(definite, L, jnp.nan)


@_root.defjvp
def _root_jvp(primals, tangents):
    (S,), (dS,) = primals, tangents
    L = _root(S)
    return L, root_tangent(L, dS)


def exact_root(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """As `root`, with the full precision of variables that stand beside some without variance.

    `root` adds noise to all where one has none, which costs digits of ill-conditioned covariances.
    """
    if S.shape[0] <= UNROLLED:
        return linalg.cholesky(S)
    certain = diagonal(S) == 0
    apart = certain[:, None] | certain
    return jnp.where(apart, 0.0, _root(jnp.where(apart, identity(len(S), S.dtype), S)))


def independent_root(S: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, " n"], Bool[Array, ""]]:
    """The lower root of a small S over its independent variables, which they are, and whether S is semidefinite.

    The other variables have rows and columns of the identity; where S is not positive semidefinite, all have.
    """
    L = linalg.cholesky(S)
    definite = ~jnp.any(jnp.isnan(diagonal(L)))
    counts = (diagonal(L) > 0) & definite
    return materialized(_without(L, counts)), counts, definite


def plain_root(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower root of a positive definite S by LAPACK; NaN where it is not."""
    # Of the transpose, which lies in memory as LAPACK wants it.
    return lower_part(jax.lax.linalg.cholesky_p.bind(S.T))


def margins(L: Float[Array, "n n"], S: Float[Array, "n n"]) -> Float[Array, " n"]:
    """How far each variable of S is from depending on those before it, to rounding: positive where it does not.

    L is the `plain_root` of S, or NaN, and so are the margins then.
    """
    pivots = diagonal(L)
    return pivots * pivots - _tolerance(L) * diagonal(S)


def loosened_root(S: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, " n"]]:
    """As `plain_root`, over the variables that do not depend on those before them, and which these are.

    The other variables have rows and columns of the identity.
    """
    L, counts = _loosened(S)
    return _without(L, counts), counts


def _loosened(S):
    # LAPACK stops at the first pivot that is not positive. A little noise on every variable lets it pass, and leaves
    # dependent ones with a pivot of that size. NaN compares as dependent.
    variance = diagonal(S)
    noise = _tolerance(S) * variance
    L = plain_root(S + diagonal_matrix(jnp.where(variance == 0, 1.0, noise)))
    return L, (diagonal(L) ** 2 > 4 * noise) & (variance != 0)


def _tolerance(S):
    return S.shape[0] * float(jnp.finfo(S.dtype).eps)


def _without(root, counts):
    return jnp.where(counts[:, None] & counts, root, identity(root.shape[0], root.dtype))


def inverse(L: Float[Array, "n n"], counts: Bool[Array, " n"]) -> Float[Array, "n n"]:
    """Inverse of a lower root, with rows and columns of zeros for variables that do not count.

    In `L` they have rows and columns of the identity.
    """
    right = diagonal_matrix(counts.astype(L.dtype))
    if len(L) <= UNROLLED:
        return linalg.solve_triangular(L, right)
    # LAPACK reads and writes by columns: the transposes of what is stored by rows, without a copy.
    return jax.lax.linalg.triangular_solve(L.T, right, left_side=False, lower=False).T


def identity(n: int, dtype: DTypeLike) -> Shaped[Array | np.ndarray, "n n"]:
    """The identity matrix. A small one is a constant of the program: no code is compiled that makes it."""
    return np.eye(n, dtype=dtype) if n <= _CONSTANT else jnp.eye(n, dtype=dtype)


def diagonal_matrix(elements: Float[Array, " n"]) -> Float[Array, "n n"]:
    """The matrix with these elements on its diagonal, and zeros elsewhere."""
    return jnp.where(_on_diagonal(elements.size), elements, jnp.zeros((), elements.dtype))


def _on_diagonal(n):
    # Compiled into the loop that reads it: a constant would have to be copied where LAPACK wants columns.
    rows, columns = (jax.lax.broadcasted_iota(jnp.int32, (n, n), axis) for axis in (0, 1))
    return rows == columns


def lower_part(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The elements on the diagonal and below it, zeros elsewhere, whatever is there."""
    return jnp.where(np.tri(A.shape[0], A.shape[1]) > 0, A, 0.0) if len(A) <= _CONSTANT else jnp.tril(A)


def root_tangent(L: Float[Array, "n n"], dS: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Change of the lower root L for a change of `L L^T`; none in columns that are zero."""
    fixed = diagonal(L) == 0
    # With X = L^-1 dS L^-T, dL = L Y has Y + Y^T = X and Y lower: its diagonal is half of X's.
    complete = L + diagonal_matrix(fixed.astype(L.dtype))
    X = solve(complete, solve(complete, 0.5 * (dS + dS.T)).T)
    Y = lower_part(X) - 0.5 * diagonal_matrix(diagonal(X))
    return lower_part(linalg.matmul(complete, jnp.where(fixed, 0.0, Y)))


def solve(L: Float[Array, "n n"], b: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """`L^-1 b` for a lower L without a zero on its diagonal, which `linalg.solve_triangular` would look for."""
    return linalg.solve_triangular(L, b) if L.shape[0] <= UNROLLED else lapack_solve_triangular(L, b, lower=True)


def diagonal(A: Float[Array, "n n"]) -> Float[Array, " n"]:
    """The diagonal elements; of a small matrix as slices, which stay vector arithmetic over an ensemble."""
    n = A.shape[0]
    if n <= UNROLLED:
        return jnp.stack([A[i, i] for i in range(n)])
    return jax.lax.slice(A.reshape(n * n), (0,), (n * n,), (n + 1,))


def apply(A: Float[Array, "n m"], x: Float[Array, " m"]) -> Float[Array, " n"]:
    """`A x` in full precision; over an ensemble, as vector arithmetic where A is small."""
    if max(A.shape) <= UNROLLED:
        return linalg.matmul(A, x[:, None])[:, 0]
    return jnp.matmul(A, x, precision="highest")


def outer(A: Float[Array, "n k"], B: Float[Array, "m k"]) -> Float[Array, "n m"]:
    """`A B^T` in full precision; a transposed copy of B would be kept for the backward pass."""
    if max(*A.shape, *B.shape) <= UNROLLED:
        return linalg.matmul(A, B.T)
    return jax.lax.dot_general(A, B, (((1,), (1,)), ((), ())), precision="highest")


def inner(A: Float[Array, "k n"], B: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """`A^T B` in full precision; a transposed copy of A would be kept for the backward pass."""
    if max(*A.shape, *B.shape) <= UNROLLED:
        return linalg.matmul(A.T, B)
    return jax.lax.dot_general(A, B, (((0,), (0,)), ((), ())), precision="highest")


@jax.custom_jvp
def turned(F: Float[Array, "k n"], P: Float[Array, "n n"]) -> Float[Array, "k k"]:
    """`F P F^T` for a symmetric P."""
    return outer(linalg.matmul(F, P), F)


@turned.defjvp
def _turned_jvp(primals, tangents):
    (F, P), (dF, dP) = primals, tangents
    FP = linalg.matmul(F, P)
    half = outer(dF, FP)
    return outer(FP, F), turned(F, dP) + half + half.T
