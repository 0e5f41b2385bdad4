"""Lower roots of covariances that may have lost rank, and products that keep no transposed copies."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular as lapack_solve_triangular
from jaxtyping import Array, Bool, Float

from jaxfilters._xla.materialize import materialized
from jaxfilters.math import linalg

UNROLLED = 8
"""Up to this size `linalg.cholesky` is algebra on the elements, which finds dependent variables itself."""


def root(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower L with `L L^T = S`, from the lower half of a positive semidefinite S of any rank.

    A variable that depends on those before it, to rounding, gets a column of zeros, its diagonal element among them.
    NaN where S is not positive semidefinite. Derivatives are those of changes that keep the dependences.
    """
    return linalg.cholesky(S) if S.shape[0] <= UNROLLED else _root(S)


@jax.custom_jvp
def _root(S):
    L, counts = _pivots(S, lambda L, independent: jnp.where(independent, L, 0.0))
    return jnp.where(jnp.any(counts) | jnp.all(S == 0), L, jnp.nan)


@_root.defjvp
def _root_jvp(primals, tangents):
    (S,), (dS,) = primals, tangents
    L = _root(S)
    return L, root_tangent(L, dS)


def independent_root(S: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, " n"], Bool[Array, ""]]:
    """The lower root of S over its independent variables, which they are, and whether S is positive semidefinite.

    The other variables have rows and columns of the identity; where S is not positive semidefinite, all have.
    """
    if S.shape[0] > UNROLLED:
        L, counts = _pivots(S, _without)
        return L, counts, jnp.any(counts) | jnp.all(S == 0)
    L = linalg.cholesky(S)
    definite = ~jnp.any(jnp.isnan(diagonal(L)))
    counts = (diagonal(L) > 0) & definite
    return materialized(_without(L, counts)), counts, definite


def _without(L, counts):
    return jnp.where(counts[:, None] & counts, L, np.eye(L.shape[0], dtype=L.dtype))


def _pivots(S, drop):
    """The root as `drop(L, independent)` leaves it, and which variables are independent of those before them."""
    n, variance = S.shape[0], diagonal(S)
    tolerance = n * float(jnp.finfo(S.dtype).eps)
    # Of the transpose, which lies in memory as LAPACK wants it.
    L = jax.lax.linalg.cholesky(S.T, symmetrize_input=False)

    def loosen(S, L):
        # LAPACK stops at the first pivot that is not positive. A little noise on every variable lets it pass, and
        # leaves dependent ones with a pivot of that size. NaN compares as dependent.
        del L
        noise = tolerance * variance
        L = jax.lax.linalg.cholesky(S + jnp.diag(jnp.where(variance == 0, 1.0, noise)), symmetrize_input=False)
        independent = (diagonal(L) ** 2 > 4 * noise) & (variance != 0)
        return drop(L, independent), independent

    sound = jnp.all(diagonal(L) ** 2 > tolerance * variance)
    return jax.lax.cond(sound, lambda _S, L: (L, jnp.ones(n, bool)), loosen, S, L)


def root_tangent(L: Float[Array, "n n"], dS: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Change of the lower root L for a change of `L L^T`; none in columns that are zero."""
    fixed = diagonal(L) == 0
    # With X = L^-1 dS L^-T, dL = L Y has Y + Y^T = X and Y lower: its diagonal is half of X's.
    complete = L + jnp.diag(fixed.astype(L.dtype))
    X = solve(complete, solve(complete, 0.5 * (dS + dS.T)).T)
    Y = jnp.tril(X) - 0.5 * jnp.diag(diagonal(X))
    return jnp.tril(linalg.matmul(complete, jnp.where(fixed, 0.0, Y)))


def solve(L: Float[Array, "n n"], b: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """`L^-1 b` for a lower L without a zero on its diagonal, which `linalg.solve_triangular` would look for."""
    return linalg.solve_triangular(L, b) if L.shape[0] <= UNROLLED else lapack_solve_triangular(L, b, lower=True)


def diagonal(A: Float[Array, "n n"]) -> Float[Array, " n"]:
    """The diagonal elements; of a small matrix as slices, which stay vector arithmetic over an ensemble."""
    if A.shape[0] <= UNROLLED:
        return jnp.stack([A[i, i] for i in range(A.shape[0])])
    return jnp.diagonal(A)


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
