r"""Differentiable resampling: soft resampling, and resampling by optimal transport.

The schemes of `jaxfilters.resampling` choose ancestors, which have no derivative. A particle filter that uses them
keeps the derivative of the weights instead, which makes the gradient of its log evidence a consistent estimate of the
score (A. Ścibior and F. Wood, "Differentiable particle filtering without modifying the forward pass", 2021). This is
the default. The schemes of this module change the forward pass to obtain a gradient with less variance and more bias.
`docs/gradients.md` compares them with measurements.

They are values of the argument `scheme` of a filter. `soft` chooses ancestors and is accepted by every filter.
`transport` averages particles: it is for `bootstrap`, and for `adaptive_diffusion` without partitions. An average of
the Gaussians of several particles is not the Gaussian of a particle, so that Rao-Blackwellized filters reject it, and
an average has no ancestor, so that `fixed_lag` does.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters.particle.resampling import systematic
from jaxfilters.typing import AnyKey, ResamplingScheme

_TOLERANCE = 1e-3
"""Largest error of a transported weight, as a fraction of 1 / n."""
_MOST_ITERATIONS = 200
_COOLING = 0.5
_MOST_SOLVER_ITERATIONS = 100


class Resampled(NamedTuple):
    """An ensemble after resampling."""

    particles: PyTree
    """Leaves `(..., n)`."""
    log_weights: Float[Array, " n"]
    ancestors: Int32[Array, " n"]


@runtime_checkable
class EnsembleScheme(Protocol):
    """A resampling scheme that returns particles and weights as well as ancestors; hashable, because it is static."""

    def resample(self, key: AnyKey, particles: PyTree, log_weights: Float[Array, " n"], /) -> Resampled: ...


@dataclass(frozen=True)
class Soft:
    """Ancestors drawn from a mixture of the weights and equal weights, with an importance correction."""

    share: float
    scheme: ResamplingScheme = systematic

    def resample(self, key: AnyKey, particles: PyTree, log_weights: Float[Array, " n"]) -> Resampled:
        """Return the chosen ancestors, each with the weight `w / (share w + (1 - share) / n) / n` of its parent."""
        log_n = math.log(log_weights.size)
        has_weight = jnp.isfinite(log_weights)
        finite = jnp.where(has_weight, log_weights, 0.0)
        even = math.log1p(-self.share) - log_n
        log_mixture = jnp.where(has_weight, jnp.logaddexp(math.log(self.share) + finite, even), even)
        ancestors = self.scheme(key, jax.lax.stop_gradient(log_mixture))
        corrected = jnp.where(has_weight, finite - log_mixture, -jnp.inf)[ancestors] - log_n
        return Resampled(_chosen(particles, ancestors), corrected, ancestors)


@dataclass(frozen=True)
class Transport:
    """Particles replaced by the averages that an optimal transport plan to equal weights makes of them."""

    regularization: float

    def resample(self, key: AnyKey, particles: PyTree, log_weights: Float[Array, " n"]) -> Resampled:
        """Return the averaged particles with equal weights; the result is deterministic."""
        del key
        x, unravel = _as_columns(particles)
        plan = transport_plan(x, log_weights, self.regularization)
        moved = jnp.matmul(x, plan.T, precision="highest")
        even = jnp.full_like(log_weights, -math.log(log_weights.size))
        return Resampled(unravel(moved), even, jnp.argmax(plan, axis=1).astype(jnp.int32))


def soft(share: float, *, scheme: ResamplingScheme = systematic) -> Soft:
    """Build soft resampling, which keeps part of the weights and of their derivative.

    The method is that of P. Karkus, D. Hsu and W. S. Lee, "Particle filter networks with application to visual
    localization", Conference on Robot Learning, 2018, equation 6. The estimate of the evidence stays unbiased; its
    derivative neglects that the draw depends on the parameters.

    Args:
        share: Fraction of the weights in the mixture with equal weights, in (0, 1). At 1 this would be plain
            resampling, at 0 ancestors would be drawn regardless of weights.
        scheme: Function of `jaxfilters.resampling` that draws the ancestors.

    Returns:
        A value for the argument `scheme` of a filter.

    Raises:
        ValueError: If `share` is out of range.

    Examples:
        The weights 3/4 and 1/4 are drawn from as 5/8 and 3/8, and corrected by 6/5 and 2/3.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> scheme, w = jf.differentiable_resampling.soft(0.5), jnp.array([0.75, 0.25])
        >>> _, log_weights, ancestors = scheme.resample(jax.random.key(0), jnp.array([0.0, 4.0]), jnp.log(w))
        >>> bool(jnp.allclose(2 * jnp.exp(log_weights), jnp.array([6 / 5, 2 / 3])[ancestors], rtol=1e-4))
        True
    """
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1; got {share!r}.")
    return Soft(float(share), scheme)


def transport(regularization: float = 0.5) -> Transport:
    r"""Build resampling by entropy-regularised optimal transport.

    The method is algorithm 3 of A. Corenflos, J. Thornton, G. Deligiannidis and A. Doucet, "Differentiable particle
    filtering via entropy-regularized optimal transport", International Conference on Machine Learning, 2021. Particles
    become averages of each other, so that all leaves of the state must hold floating-point numbers, and their spread
    does not grow. The result is smooth in parameters, but neither unbiased nor consistent unless the regularisation
    decreases as n grows. It stores n^2 numbers and iterates over them some tens of times, which suits up to a few
    hundred particles.

    Args:
        regularization: Weight of the entropy against the cost $|x_i - x_j|^2 / 2$, for states scaled to a largest
            standard deviation of $1 / \sqrt d$. A smaller value means less bias and more iterations.

    Returns:
        A value for the argument `scheme` of a filter.

    Raises:
        ValueError: If `regularization` is not positive.

    Examples:
        The mean of the particles is that of the weighted particles before.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> scheme, w = jf.differentiable_resampling.transport(), jnp.array([0.75, 0.25])
        >>> particles, _, _ = jax.jit(scheme.resample)(jax.random.key(0), jnp.array([0.0, 4.0]), jnp.log(w))
        >>> round(float(jnp.mean(particles)), 2)
        1.0
    """
    if not regularization > 0:
        raise ValueError(f"regularization must be positive; got {regularization!r}.")
    return Transport(float(regularization))


def transport_plan(
    x: Float[Array, "d n"], log_weights: Float[Array, " n"], regularization: float
) -> Float[Array, "n n"]:
    r"""Return the transport plan from weighted particles (columns) to n equal weights (rows, which sum to one).

    It is computed by Sinkhorn iterations on the logarithms of the scalings, with a regularisation that decreases from
    the largest cost, and two Newton steps. The last Newton step is differentiated. Corenflos et al. differentiate one
    more Sinkhorn iteration instead, which can be wrong by orders of magnitude where the regularisation is small.

    Examples:
        The columns sum to n times the weights.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> x, log_weights = jnp.array([[0.0, 4.0]]), jnp.log(jnp.array([0.75, 0.25]))
        >>> plan = jax.jit(lambda x, log_w: jf.differentiable_resampling.transport_plan(x, log_w, 0.5))
        >>> [round(v, 2) for v in jnp.sum(plan(x, log_weights), axis=0).tolist()]
        [1.5, 0.5]
    """
    centred = x - jnp.mean(x, axis=1, keepdims=True)
    variance = jnp.max(jnp.mean(centred**2, axis=1)) * x.shape[0]
    cost = jnp.sum((centred[:, :, None] - centred[:, None, :]) ** 2, axis=0)
    cost = cost * (0.5 / regularization) / jnp.where(variance > 0, variance, 1.0)
    frozen = jax.lax.stop_gradient((cost, log_weights))
    polished = jax.lax.stop_gradient(_newton(*frozen, *_potentials(*frozen)))
    f, g = _newton(cost, log_weights, *polished)
    return jnp.exp(log_weights + f[:, None] + g - cost)


def _newton(cost: Array, log_weights: Array, f: Array, g: Array) -> tuple[Array, Array]:
    """Potentials after a Newton step on the logarithms of the row and column sums of the plan."""
    n = log_weights.size
    rows = f - _towards_rows(cost, log_weights, g)
    columns = g - _towards_columns(cost, f)
    root_w = jnp.exp(0.5 * jax.lax.stop_gradient(log_weights))
    scaled = jnp.exp(jax.lax.stop_gradient(f[:, None] + g - cost)) * jax.lax.rsqrt(jnp.asarray(n, cost.dtype))
    product = lambda a, b: jnp.matmul(a, b, precision="highest")

    # The unknowns of the rows are eliminated first. The remaining system is symmetric and singular, because adding a
    # constant to one potential and subtracting it from the other leaves the plan unchanged. The last term regularises
    # that direction.
    def matrix(b: Array) -> Array:
        return b - root_w * product(scaled.T, product(scaled, root_w * b)) + root_w * jnp.sum(root_w * b)

    def solve(matrix: Callable, b: Array) -> Array:
        return jax.scipy.sparse.linalg.cg(matrix, b, tol=1e-6, maxiter=_MOST_SOLVER_ITERATIONS)[0]

    rest = columns - product(scaled.T, rows) * jax.lax.rsqrt(jnp.asarray(n, cost.dtype))
    found = root_w * jax.lax.custom_linear_solve(matrix, root_w * rest, solve, symmetric=True)
    spread = product(scaled, found)
    return f - rows + spread * n**0.5, g - rest - product(scaled.T, spread)


def _potentials(cost: Array, log_weights: Array) -> tuple[Array, Array]:
    """Logarithms of the scalings that give rows and columns their sums; costs are in units of the regularisation."""
    n = log_weights.size
    target = jnp.exp(log_weights)

    def continues(state: tuple) -> Array:
        _, _, heat, error, i = state
        return ((heat > 1) | (error > _TOLERANCE / n)) & (i < _MOST_ITERATIONS)

    def iterate(state: tuple) -> tuple:
        f, _, heat, _, i = state
        cooler = jnp.maximum(_COOLING * heat, 1.0)
        f, cooled = f * (heat / cooler), cost / cooler
        g = _towards_columns(cooled, f)
        f = _towards_rows(cooled, log_weights, g)
        reached = jnp.mean(jnp.exp(log_weights + f[:, None] + g - cooled), axis=0)
        return f, g, cooler, jnp.max(jnp.abs(reached - target)), i + 1

    zeros = jnp.zeros_like(log_weights)
    hottest = jnp.maximum(jnp.max(cost), 1.0)
    start = (zeros, zeros, hottest, jnp.asarray(jnp.inf, cost.dtype), jnp.zeros((), jnp.int32))
    f, g, *_ = jax.lax.while_loop(continues, iterate, start)
    return f, g


def _towards_columns(cost: Array, f: Array) -> Array:
    return math.log(f.size) - jax.nn.logsumexp(f[:, None] - cost, axis=0)


def _towards_rows(cost: Array, log_weights: Array, g: Array) -> Array:
    return -jax.nn.logsumexp(log_weights + g - cost, axis=1)


def _as_columns(particles: PyTree) -> tuple[Array, Callable]:
    """Every particle as a column of numbers, and the inverse of that mapping."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(particles):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            name = f"particles{jax.tree_util.keystr(path)}"
            raise ValueError(f"{name} must be floating-point numbers to be averaged by transport; got {leaf.dtype}.")
    _, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[..., 0], particles))
    columns = jax.vmap(lambda particle: ravel_pytree(particle)[0], in_axes=-1, out_axes=-1)(particles)
    return columns, jax.vmap(unravel, in_axes=-1, out_axes=-1)


def _chosen(particles: PyTree, ancestors: Int32[Array, " n"]) -> PyTree:
    return jax.tree.map(lambda leaf: jnp.take(leaf, ancestors, axis=-1, mode="clip"), particles)
