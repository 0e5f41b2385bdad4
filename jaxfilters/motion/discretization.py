r"""Transition matrices and noise covariances of linear stochastic differential equations over steps of any length.

$$dx = A x\,dt + L\,dw,\qquad F = e^{A h},\qquad Q = \int_0^h e^{A s} L L^T e^{A^T s} ds.$$

C. F. Van Loan, "Computing integrals involving the matrix exponential", IEEE Transactions on Automatic Control 23(3),
1978, takes both from the exponential of one matrix of twice the size. That matrix holds $e^{-A h}$, which overflows
where a stable system is integrated for long, and Q is a product of large and small numbers. Here, as in the doubling
step of the same paper, F and Q of a short step are summed by their power series, and the step is doubled,
$Q(2h) = Q(h) + F(h) Q(h) F(h)^T$: only positive semidefinite terms are added, whatever the length of the step is.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian import checks

_DOUBLINGS = 32
"""Steps of more than 2^32 times the time in which the fastest part of the system changes give NaN."""
_TERMS = {4: 8, 8: 16}
"""Powers of a matrix of norm 1/2 that matter, by the bytes of a number: 2^-k / k! is then below its rounding."""


class Step(NamedTuple):
    """One step of a linear model, or several, with equal leading axes."""

    F: Float[Array, "..."]
    """Transition matrix, (..., n, n)."""
    Q: Float[Array, "..."]
    """Covariance of the process noise, (..., n, n)."""


def discretize(A: ArrayLike, L: ArrayLike, dt: ArrayLike) -> Step:
    r"""Return F and Q of `dx = A x dt + L dw` over steps of the length `dt`, w a standard Wiener process.

    Both are differentiable in all arguments. A step of zero gives the identity and zero. In single precision, elements
    of Q of different orders of magnitude, such as those of position and velocity after a short step, have each the
    accuracy of single precision. C. F. Van Loan, IEEE Transactions on Automatic Control 23(3), 1978.

    Args:
        A: Drift matrix, (..., n, n), in one over the unit of time.
        L: Root of the spectral density, (..., n, k): `L @ L.T` is the covariance that noise adds per unit of time.
        dt: Lengths of the steps, (...), zero or positive. Leading axes of the three are broadcast.

    Returns:
        `Step(F, Q)` with arrays of shape (..., n, n). They are NaN where `dt` is negative (where its values are traced;
        see below) or longer than 2^32 times the fastest time constant.

    Raises:
        ValueError: If A is not square, L has another number of rows, or a concrete `dt` is negative or not finite.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> A, L = jnp.array([[0.0, 1.0], [0.0, 0.0]]), jnp.array([[0.0], [1.0]])
        >>> F, Q = jf.motion.discretize(A, L, jnp.array([0.0, 2.0]))
        >>> F[1].tolist()
        [[1.0, 2.0], [0.0, 1.0]]
        >>> [[round(q, 3) for q in row] for row in Q[1].tolist()]
        [[2.667, 2.0], [2.0, 2.0]]
    """
    drift, root = _matrix("A", A), _matrix("L", L)
    n = drift.shape[-1]
    if drift.shape[-2] != n:
        raise ValueError(f"A must be square, (..., n, n); got {drift.shape}.")
    if root.shape[-2] != n:
        raise ValueError(f"L must have a row for each of the {n} rows of A, (..., {n}, k); got {root.shape}.")
    dtype = jnp.result_type(drift, root)
    lengths = step_length(dt, dtype)
    return Step(*_steps(drift.astype(dtype), root.astype(dtype), lengths))


@pytree_dataclass
class LinearSDE:
    """A linear stochastic differential equation `dx = A x dt + L dw`, given by its matrices.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> pendulum = jf.motion.LinearSDE(jnp.array([[0.0, 1.0], [-4.0, -0.1]]), jnp.array([[0.0], [0.3]]))
        >>> prior, R = jf.Gaussian(jnp.array([1.0, 0.0]), jnp.eye(2)), 0.01 * jnp.eye(1)
        >>> filter = jf.extended_kalman(prior, pendulum.transition, pendulum.process_noise, lambda x: x[:1], R)
        >>> dt = jnp.array([0.1, 0.5, 0.2])
        >>> last, _ = jf.run(filter, jax.random.key(0), jnp.ones((3, 1)), dt)
        >>> last.mean.shape
        (2,)
    """

    A: Float[Array, "..."]
    """Drift matrix, (n, n)."""
    L: Float[Array, "..."]
    """Root of the spectral density, (n, k)."""

    def discretize(self, dt: ArrayLike) -> Step:
        """F and Q of steps of the length `dt`, as `jf.motion.discretize`."""
        return discretize(self.A, self.L, dt)

    def transition(self, x: Float[Array, " n"], dt: ArrayLike) -> Float[Array, " n"]:
        """The expected state after a step."""
        return jnp.matmul(self.discretize(dt).F, x, precision="highest")

    def process_noise(self, dt: ArrayLike) -> Float[Array, "n n"]:
        """Covariance of the noise of a step."""
        return self.discretize(dt).Q


def step_length(dt: ArrayLike, dtype: jnp.dtype | None = None) -> Float[Array, "..."]:
    """Lengths of steps: an error for concrete ones that are negative or not finite, NaN for such traced ones.

    Raises:
        ValueError: If a concrete length is negative or not finite.
    """
    known = checks.concrete(dt)
    if known is not None and not np.all(np.isfinite(known) & (known >= 0)):
        wrong = known[~(np.isfinite(known) & (known >= 0))].ravel()[0]
        raise ValueError(f"dt must be zero or positive and finite; got {wrong}.")
    dt = jnp.asarray(dt)
    wanted = dtype if dtype is not None else (dt.dtype if jnp.issubdtype(dt.dtype, jnp.floating) else float)
    dt = dt.astype(wanted)
    return jnp.where((dt >= 0) & (dt < jnp.inf), dt, jnp.nan)


def _matrix(name: str, matrix: ArrayLike) -> Array:
    value = jnp.asarray(matrix)
    if value.ndim < 2:
        raise ValueError(f"{name} must be a matrix; got the shape {value.shape}.")
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)


def product(a: Float[Array, "n k"], b: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """The matrix product in full precision."""
    return jnp.matmul(a, b, precision="highest")


@jax.jit
def _steps(A, L, dt):
    return jnp.vectorize(_one_step, signature="(n,n),(n,k),()->(n,n),(n,n)")(A, L, dt)


def _one_step(A: Array, L: Array, dt: Array) -> tuple[Array, Array]:
    n = A.shape[0]
    D = product(L, L.T)
    size = jax.lax.stop_gradient(dt * jnp.max(jnp.sum(jnp.abs(A), axis=0)))
    # A power of two is exact, whatever the type.
    doublings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(size, 2.0**-20))) + 1, 0, _DOUBLINGS).astype(jnp.int32)
    shorter = jnp.asarray(0.5 ** np.arange(_DOUBLINGS + 1), A.dtype)[doublings]
    h = jnp.where(size <= 2.0 ** (_DOUBLINGS - 1), dt * shorter, jnp.nan)

    def add(carry, order):
        F, Q, power, rate = carry
        power = product(power, A) * (h / order)
        F = F + power
        Q = Q + rate
        moved = product(A, rate)
        return (F, Q, power, (moved + moved.T) * (h / (order + 1))), None

    # An element that a chain of n integrations leads to begins with a power of up to 2 n - 2, and its series goes on.
    orders = jnp.arange(1, 2 * (n - 1) + _TERMS[A.dtype.itemsize] + 1, dtype=A.dtype)
    start = (jnp.eye(n, dtype=A.dtype), jnp.zeros_like(A), jnp.eye(n, dtype=A.dtype), h * D)
    (F, Q, _, _), _ = jax.lax.scan(add, start, orders)

    def double(step):
        F, Q = step
        return product(F, F), Q + product(product(F, Q), F.T)

    def maybe(step, index):
        return jax.lax.cond(index < doublings, double, lambda same: same, step), None

    (F, Q), _ = jax.lax.scan(maybe, (F, Q), jnp.arange(_DOUBLINGS))
    return F, 0.5 * (Q + Q.T)
