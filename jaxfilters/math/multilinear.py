r"""Tucker decompositions of tensors: unfolding, the N-mode SVD, and the best approximation of low multilinear rank.

`X = core x_1 U_1 ... x_N U_N`, where $(\mathcal X \times_n C)_{i_1..j..i_N} = \sum_{i_n} \mathcal X_{i_1..i_n..i_N}
C_{j i_n}$. A truncated N-mode SVD is not the best approximation of its ranks; alternating least squares (HOOI), which
starts from it, finds a better one (L. De Lathauwer, B. De Moor and J. Vandewalle, "A multilinear singular value
decomposition" and "On the best rank-1 and rank-(R1, ..., RN) approximation of higher-order tensors", SIAM J. Matrix
Anal. Appl. 21(4), 2000). Modes are counted from 0.

Factors are dictionaries from a mode to its matrix, whose columns are orthonormal and have a nonnegative sum; a mode
that is not in the dictionary is not reduced.
"""

from collections.abc import Mapping
from functools import partial
from math import prod
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

Factors = dict[int, Array]


class Tucker(NamedTuple):
    """A Tucker decomposition: the tensor is `compose(core, factors)`."""

    core: Float[Array, "..."]
    """The core tensor."""
    factors: Factors
    """(I_n, R_n) for each reduced mode."""


class Hooi(NamedTuple):
    """An approximation of low multilinear rank, and the course of its computation."""

    core: Float[Array, "..."]
    """The core tensor."""
    factors: Factors
    """(I_n, R_n) for each reduced mode."""
    history: Float[Array, " sweeps"]
    """Energy `|core|^2` of the approximation at the start and after every sweep; after convergence it repeats."""


def unfold(X: Float[Array, "..."], mode: int) -> Float[Array, "rows columns"]:
    """The mode-n unfolding: the tensor as a matrix with the index of one mode along its rows.

    Columns enumerate the other modes in their order, the last one fastest.

    Raises:
        ValueError: If the tensor has no such mode.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear
        >>> print(multilinear.unfold(jnp.arange(8.0).reshape(2, 2, 2), mode=1))
        [[0. 1. 4. 5.]
         [2. 3. 6. 7.]]
    """
    _check_mode(X.ndim, mode)
    return jnp.moveaxis(X, mode, 0).reshape(X.shape[mode], -1)


def fold(Y: Float[Array, "rows columns"], mode: int, shape: tuple[int, ...]) -> Float[Array, "..."]:
    """The tensor of a given shape whose unfolding is `Y`: the inverse of `unfold`.

    Raises:
        ValueError: If the tensor has no such mode, or `Y` does not match the shape.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear
        >>> X = jnp.arange(24.0).reshape(2, 3, 4)
        >>> print(bool((multilinear.fold(multilinear.unfold(X, 1), 1, X.shape) == X).all()))
        True
    """
    _check_mode(len(shape), mode)
    rest = tuple(size for n, size in enumerate(shape) if n != mode)
    if Y.shape != (shape[mode], prod(rest)):
        raise ValueError(f"Y must be {(shape[mode], prod(rest))} to fold into {shape}; got {Y.shape}.")
    return jnp.moveaxis(Y.reshape(shape[mode], *rest), 0, mode)


def mode_product(X: Float[Array, "..."], C: Float[Array, "rows columns"], mode: int) -> Float[Array, "..."]:
    """The n-mode product: the tensor with every fibre of one mode multiplied by `C`.

    Raises:
        ValueError: If the tensor has no such mode, or its size is not the number of columns.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear
        >>> X = jnp.arange(6.0).reshape(2, 3)
        >>> print(multilinear.mode_product(X, jnp.ones((1, 3)), mode=1))
        [[ 3.]
         [12.]]
    """
    _check_mode(X.ndim, mode)
    if C.shape[1] != X.shape[mode]:
        raise ValueError(f"C must have {X.shape[mode]} columns, the size of mode {mode}; got {C.shape}.")
    return jnp.moveaxis(jnp.tensordot(C, X, (1, mode), precision="highest"), 0, mode)


def compose(core: Float[Array, "..."], factors: Factors) -> Float[Array, "..."]:
    """The tensor `core x_n U_n` over all factors.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear
        >>> core = jnp.array([[2.0]])
        >>> print(multilinear.compose(core, {0: jnp.array([[0.6], [0.8]]), 1: jnp.array([[1.0], [0.0]])}))
        [[1.2 0. ]
         [1.6 0. ]]
    """
    for mode, U in factors.items():
        core = mode_product(core, U, mode)
    return core


def project(X: Float[Array, "..."], factors: Factors) -> Float[Array, "..."]:
    """The core `X x_n U_n^T` over all factors, which is the optimal one for them.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear
        >>> X = jnp.array([[1.2, 0.0], [1.6, 0.0]])
        >>> print(multilinear.project(X, {0: jnp.array([[0.6], [0.8]])}))
        [[2. 0.]]
    """
    return compose(X, {mode: U.T for mode, U in factors.items()})


def hosvd(X: Float[Array, "..."], ranks: Mapping[int, int] | None = None) -> Tucker:
    """The N-mode singular value decomposition (higher-order SVD), truncated to `ranks`.

    Args:
        X: A tensor of finite numbers.
        ranks: Rank of each mode to reduce; by default all modes keep all of their singular vectors, and the
            decomposition is exact.

    Raises:
        ValueError: If a number is not finite, or a rank is outside of `1..min(I_n, product of the other sizes)`, where
            the size of a reduced mode is its rank.

    Examples:
        A tensor of rank one needs one vector for each mode.

        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear
        >>> X = jnp.einsum("i,j,k->ijk", jnp.array([3.0, 4.0]), jnp.array([1.0, 0.0]), jnp.array([0.0, 2.0]))
        >>> core, factors = multilinear.hosvd(X, {0: 1, 1: 1, 2: 1})
        >>> print(core.round(3), bool(jnp.allclose(multilinear.compose(core, factors), X, atol=1e-5)))
        [[[10.]]] True
    """
    if ranks is None:
        ranks = {n: min(size, X.size // size) for n, size in enumerate(X.shape)}
    else:
        check_ranks(X.shape, ranks)
    check_finite("X", X)
    return _hosvd(X, tuple(sorted(ranks.items())))


def hooi(X: Float[Array, "..."], ranks: Mapping[int, int], *, max_sweeps: int = 200, tolerance: float = 1e-12) -> Hooi:
    """The approximation of given ranks with least squared error, by alternating least squares (HOOI).

    A sweep replaces each reduced mode's factor by the leading left singular vectors of the tensor projected onto the
    factors of the others; the energy of the core never decreases, and `|X - Xhat|^2 = |X|^2 - |core|^2`.

    Args:
        X: A tensor of finite numbers.
        ranks: Rank of each mode to reduce; with `jit`, Python numbers.
        max_sweeps: Upper bound on the number of sweeps.
        tolerance: Relative increase of the energy below which the iteration ends; at least rounding error.

    Raises:
        ValueError: As `hosvd`, or if `max_sweeps` is not positive.

    Examples:
        The energy of the approximation increases from one sweep to the next.

        >>> import jax
        >>> from jaxfilters.math import multilinear
        >>> X = jax.random.normal(jax.random.key(0), (4, 4, 4))
        >>> history = multilinear.hooi(X, {0: 1, 1: 1, 2: 1}).history
        >>> print(bool(history[-1] > history[0]))
        True
    """
    check_ranks(X.shape, ranks)
    check_finite("X", X)
    if max_sweeps < 1:
        raise ValueError(f"max_sweeps must be 1 or more; got {max_sweeps}.")
    return _hooi(X, tuple(sorted(ranks.items())), max_sweeps, tolerance)


def numerical_ranks(X: Float[Array, "..."], tolerance: float | None = None) -> Int[Array, " modes"]:
    """The numerical rank of each unfolding: the number of singular values above a fraction of the largest one.

    Args:
        X: A tensor of finite numbers.
        tolerance: The fraction; by default the larger size of the unfolding times the rounding error of its type, as
            for matrices in numpy. For noisy tensors use the standard deviation of the noise times
            `sqrt(rows) + sqrt(columns)`, divided by the largest singular value.

    Raises:
        ValueError: If a number is not finite, or the tolerance is not in [0, 1).

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear
        >>> print(multilinear.numerical_ranks(jnp.einsum("i,jk->ijk", jnp.array([3.0, 4.0]), jnp.eye(2))))
        [1 2 2]
    """
    check_finite("X", X)
    if tolerance is not None and not 0 <= tolerance < 1:
        raise ValueError(f"tolerance must be in [0, 1); got {tolerance}.")
    found = []
    for mode in range(X.ndim):
        unfolded = unfold(X, mode)
        values = jnp.linalg.svd(unfolded, full_matrices=False, compute_uv=False)  # saves memory
        least = max(unfolded.shape) * float(jnp.finfo(X.dtype).eps) if tolerance is None else tolerance
        found.append(jnp.sum(values > least * values[0]))
    return jnp.stack(found)


def leading_singular_vectors(X: Float[Array, "..."], mode: int, rank: int) -> Float[Array, "rows rank"]:
    """The leading left singular vectors of an unfolding, with signs that make their sums nonnegative.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import multilinear
        >>> print(multilinear.leading_singular_vectors(jnp.diag(jnp.array([1.0, 3.0, 2.0])), mode=0, rank=2).round(3))
        [[0. 0.]
         [1. 0.]
         [0. 1.]]
    """
    U = jnp.linalg.svd(unfold(X, mode), full_matrices=False)[0][:, :rank]
    return U * jnp.where(jnp.sum(U, axis=0) < 0, -1.0, 1.0).astype(U.dtype)


def sweep(X: Float[Array, "..."], factors: Factors) -> Factors:
    """The factors after one sweep of alternating least squares over their modes.

    Examples:
        >>> import jax
        >>> from jaxfilters.math import multilinear
        >>> X = jax.random.normal(jax.random.key(0), (4, 4, 4))
        >>> before = multilinear.hosvd(X, {0: 1, 1: 1, 2: 1}).factors
        >>> after = multilinear.sweep(X, before)
        >>> print(bool(abs(multilinear.project(X, after)) > abs(multilinear.project(X, before))))
        True
    """
    factors = dict(factors)
    for mode, U in factors.items():
        others = {n: V for n, V in factors.items() if n != mode}
        factors[mode] = leading_singular_vectors(project(X, others), mode, U.shape[1])
    return factors


def check_ranks(shape: tuple[int, ...], ranks: Mapping[int, int]) -> None:
    """Reject ranks that no tensor of a shape can have.

    Raises:
        ValueError: If there are none, a mode does not exist, or a rank is outside of
            `1..min(I_n, product of the other sizes)`, where the size of a reduced mode is its rank.
    """
    if not ranks:
        raise ValueError("ranks must reduce one mode or more; got none.")
    for mode in ranks:
        _check_mode(len(shape), mode)
    for mode, rank in ranks.items():
        most = min(shape[mode], prod(ranks.get(n, size) for n, size in enumerate(shape) if n != mode))
        if not 1 <= rank <= most:
            raise ValueError(
                f"ranks must be 1 to {most} for mode {mode} of a tensor {shape} with the other ranks; got {rank}."
            )


def check_finite(name: str, X: Array) -> None:
    """Reject numbers that are not finite; tracers are not checked.

    Raises:
        ValueError: If a number is not finite.
    """
    if not isinstance(X, jax.core.Tracer) and not np.all(np.isfinite(X)):
        raise ValueError(f"{name} must be finite; {int(np.sum(~np.isfinite(X)))} of {X.size} numbers are not.")


@partial(jax.jit, static_argnums=1)
def _hosvd(X, ranks):
    factors = {mode: leading_singular_vectors(X, mode, rank) for mode, rank in ranks}
    return Tucker(project(X, factors), factors)


@partial(jax.jit, static_argnums=(1, 2))
def _hooi(X, ranks, max_sweeps, tolerance):
    # Smaller increases of the energy are rounding errors.
    least = jnp.maximum(tolerance, 4 * float(jnp.finfo(X.dtype).eps))
    start = _hosvd(X, ranks)
    energy = jnp.sum(jnp.square(start.core))
    history = jnp.full(max_sweeps + 1, energy)

    def improve(carry):
        factors, history, count, _ = carry
        factors = sweep(X, factors)
        captured = jnp.sum(jnp.square(project(X, factors)))
        increased = captured - history[count] > least * captured
        # All later entries are set, so that the last value repeats.
        history = jnp.where(jnp.arange(max_sweeps + 1) > count, captured, history)
        return factors, history, count + 1, increased

    unfinished = lambda carry: carry[3] & (carry[2] < max_sweeps)
    initial = (start.factors, history, jnp.zeros((), jnp.int32), jnp.ones((), bool))
    factors, history, *_ = jax.lax.while_loop(unfinished, improve, initial)
    return Hooi(project(X, factors), factors, history)


def _check_mode(ndim: int, mode: int) -> None:
    if not 0 <= mode < ndim:
        raise ValueError(f"mode must be 0 to {ndim - 1} for a tensor with {ndim} modes; got {mode}.")
