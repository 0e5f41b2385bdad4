r"""Resampling that passes derivatives in other ways: soft, and by optimal transport.

The schemes of `jaxfilters.resampling` choose ancestors, which have no derivative; a particle filter that uses them
keeps the derivative of the weights instead, which makes that of its log evidence a consistent estimate of the score
(A. Ścibior and F. Wood, "Differentiable particle filtering without modifying the forward pass", 2021). It is the
default. What is here changes the forward pass for a derivative with less noise and more bias. `docs/gradients.md` has
measured numbers and says when to use which.

Pass it as the `scheme` of a filter. `soft` chooses ancestors and goes wherever a scheme goes. `transport` makes
averages of particles: for `bootstrap`, and `adaptive_diffusion` without partitions, whose particles are vectors. The
average of several particles' Gaussians is no particle's Gaussian, hence not for Rao-Blackwellized filters; and an
average has no ancestor, hence not within `fixed_lag`.
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
"""Largest error of a transported weight, as a share of 1 / n."""
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
    """Resampling that changes particles or weights beyond choosing ancestors; hashable, for it is static."""

    def resample(self, key: AnyKey, particles: PyTree, log_weights: Float[Array, " n"], /) -> Resampled: ...


@dataclass(frozen=True)
class Soft:
    """Ancestors drawn from a mixture of the weights and equal ones, the weights corrected."""

    share: float
    scheme: ResamplingScheme = systematic

    def resample(self, key: AnyKey, particles: PyTree, log_weights: Float[Array, " n"]) -> Resampled:
        """The ensemble with weights `w / (share w + (1 - share) / n)`, of mean one, over n."""
        log_n = math.log(log_weights.size)
        alive = jnp.isfinite(log_weights)
        finite = jnp.where(alive, log_weights, 0.0)
        even = math.log1p(-self.share) - log_n
        log_mixture = jnp.where(alive, jnp.logaddexp(math.log(self.share) + finite, even), even)
        ancestors = self.scheme(key, jax.lax.stop_gradient(log_mixture))
        corrected = jnp.where(alive, finite - log_mixture, -jnp.inf)[ancestors] - log_n
        return Resampled(_chosen(particles, ancestors), corrected, ancestors)


@dataclass(frozen=True)
class Transport:
    """Particles moved to the means of what optimal transport brings to each of n equal places."""

    regularization: float

    def resample(self, key: AnyKey, particles: PyTree, log_weights: Float[Array, " n"]) -> Resampled:
        """The ensemble with equal weights; nothing is random."""
        del key
        x, unravel = _as_columns(particles)
        plan = transport_plan(x, log_weights, self.regularization)
        moved = jnp.matmul(x, plan.T, precision="highest")
        even = jnp.full_like(log_weights, -math.log(log_weights.size))
        return Resampled(unravel(moved), even, jnp.argmax(plan, axis=1).astype(jnp.int32))


def soft(share: float, *, scheme: ResamplingScheme = systematic) -> Soft:
    """Soft resampling: some of the weights, and with them of their derivative, is kept.

    P. Karkus, D. Hsu, W. S. Lee, "Particle filter networks with application to visual localization", 2018, equation 6.
    The log evidence stays that of an unbiased estimate of the evidence; its derivative leaves out that the draw
    depends on the parameters.

    Args:
        share: Of the weights in the mixture, in (0, 1): 1 would be plain resampling, 0 none at all.
        scheme: How ancestors are drawn.

    Raises:
        ValueError: If `share` is out of range.
    """
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1; got {share!r}.")
    return Soft(float(share), scheme)


def transport(regularization: float = 0.5) -> Transport:
    r"""Resampling by entropy-regularised optimal transport.

    A. Corenflos, J. Thornton, G. Deligiannidis, A. Doucet, "Differentiable particle filtering via entropy-regularized
    optimal transport", 2021, algorithm 3. Particles become averages of each other: only for states that are vectors of
    floating-point numbers, and never more spread than before. Smooth in parameters, but neither unbiased nor consistent
    unless the regularisation falls as n grows. Costs n^2 numbers and some tens of passes over them; for up to a few
    hundred particles.

    Args:
        regularization: Of the cost $|x_i - x_j|^2 / 2$, for states scaled to a largest standard deviation of
            $1 / \sqrt d$. Less is less bias, and more iterations.

    Raises:
        ValueError: If `regularization` is not positive.
    """
    if not regularization > 0:
        raise ValueError(f"regularization must be positive; got {regularization!r}.")
    return Transport(float(regularization))


def transport_plan(
    x: Float[Array, "d n"], log_weights: Float[Array, " n"], regularization: float
) -> Float[Array, "n n"]:
    r"""What share of each of n equal places (rows, which sum to one) comes from each weighted particle (columns).

    Sinkhorn's iterations on the logarithms of the scalings, the regularisation cooled from the largest cost; then two
    Newton steps, of which the last is what is differentiated. The source differentiates one more iteration instead,
    which can be wrong by orders of magnitude where the regularisation is small.
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
    """Potentials after a Newton step from constant ones, on the logarithms of the plan's sums."""
    n = log_weights.size
    rows = f - _towards_rows(cost, log_weights, g)
    columns = g - _towards_columns(cost, f)
    root_w = jnp.exp(0.5 * jax.lax.stop_gradient(log_weights))
    scaled = jnp.exp(jax.lax.stop_gradient(f[:, None] + g - cost)) * jax.lax.rsqrt(jnp.asarray(n, cost.dtype))
    product = lambda a, b: jnp.matmul(a, b, precision="highest")

    # Of the unknowns the rows' go first. What is left is symmetric, and singular: one potential may rise by what the
    # other falls. The last term lifts that direction, of which the plan knows nothing.
    def matrix(b: Array) -> Array:
        return b - root_w * product(scaled.T, product(scaled, root_w * b)) + root_w * jnp.sum(root_w * b)

    def solve(matrix: Callable, b: Array) -> Array:
        return jax.scipy.sparse.linalg.cg(matrix, b, tol=1e-6, maxiter=_MOST_SOLVER_ITERATIONS)[0]

    rest = columns - product(scaled.T, rows) * jax.lax.rsqrt(jnp.asarray(n, cost.dtype))
    found = root_w * jax.lax.custom_linear_solve(matrix, root_w * rest, solve, symmetric=True)
    spread = product(scaled, found)
    return f - rows + spread * n**0.5, g - rest - product(scaled.T, spread)


def _potentials(cost: Array, log_weights: Array) -> tuple[Array, Array]:
    """Scalings that make the rows and the columns sum to what they should; costs are in units of the regularisation."""
    n = log_weights.size
    target = jnp.exp(log_weights)

    def goes_on(state: tuple) -> Array:
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
    f, g, *_ = jax.lax.while_loop(goes_on, iterate, start)
    return f, g


def _towards_columns(cost: Array, f: Array) -> Array:
    return math.log(f.size) - jax.nn.logsumexp(f[:, None] - cost, axis=0)


def _towards_rows(cost: Array, log_weights: Array, g: Array) -> Array:
    return -jax.nn.logsumexp(log_weights + g - cost, axis=1)


def _as_columns(particles: PyTree) -> tuple[Array, Callable]:
    """Every particle as a column of numbers, and the way back."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(particles):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            name = f"particles{jax.tree_util.keystr(path)}"
            raise ValueError(f"{name} must be floating-point numbers to be averaged by transport; got {leaf.dtype}.")
    _, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[..., 0], particles))
    columns = jax.vmap(lambda particle: ravel_pytree(particle)[0], in_axes=-1, out_axes=-1)(particles)
    return columns, jax.vmap(unravel, in_axes=-1, out_axes=-1)


def _chosen(particles: PyTree, ancestors: Int32[Array, " n"]) -> PyTree:
    return jax.tree.map(lambda leaf: jnp.take(leaf, ancestors, axis=-1, mode="clip"), particles)
