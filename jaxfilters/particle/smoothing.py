r"""States given the whole sequence, from a particle filter: lineages, and backward simulation.

    _, history = run(pf, key, observations, collect=keep_history)
    paths = backward_simulate(key, history, log_transition, num_paths=100)

The lineages cost nothing, but early on all of them go through a few particles, or one. Backward simulation draws
whole paths that need not be lineages, for which it must know the density of the transition.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters.typing import AnyKey


class History(NamedTuple):
    """Ensembles of a particle filter, time first, the particles last."""

    particles: PyTree
    """Leaves `(t, ..., n)`."""
    log_weights: Float[Array, "t n"]
    ancestors: Int32[Array, "t n"]
    """Index of each particle's parent, one frame earlier."""


@runtime_checkable
class LogTransition(Protocol):
    r"""Evaluate $\log p(x_t \mid x_{t-1}, u_t)$, but for a constant; `-inf` means impossible."""

    def __call__(self, x_next: PyTree, x: PyTree, control: PyTree, /) -> Float[Array, ""]: ...


def keep_history(state: PyTree, info: PyTree) -> History:
    """Collect what smoothing needs of every step: `run(..., collect=keep_history)`."""
    del info
    return History(state.particles, state.log_weights, state.ancestors)


@jax.jit
def trajectories(history: History) -> PyTree:
    """Path of every particle of the last frame, leaves `(t, ..., n)`: with its weights, a smoothed ensemble.

    G. Kitagawa, "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models", 1996, section 4.
    """
    indices = jnp.arange(history.ancestors.shape[1], dtype=jnp.int32)

    def parents(indices: Array, ancestors: Array) -> tuple[Array, Array]:
        return ancestors[indices], indices

    _, chosen = jax.lax.scan(parents, indices, history.ancestors, reverse=True)
    return _along(history.particles, chosen)


def backward_sampling(
    key: AnyKey, history: History, log_transition: LogTransition, controls: PyTree = None, *, num_paths: int
) -> PyTree:
    """Paths drawn from the smoothed ensemble, equally weighted, leaves `(t, ..., num_paths)`.

    From the last frame back, a particle is drawn by its weight times the density of the transition to the next one of
    the path (S. Godsill, A. Doucet, M. West, "Monte Carlo smoothing for nonlinear time series", 2004, algorithm 1).
    Every frame costs n densities for every path.

    Args:
        key: Random key.
        history: What `run` collected with `keep_history`.
        log_transition: `(x_next, x, control) -> log p(x_next | x)`. Compared by identity.
        controls: As `run` had them, time first.
        num_paths: How many paths.

    Raises:
        ValueError: If `num_paths < 1`, or `controls` has another length than `history`.
    """
    length = history.log_weights.shape[0]
    lengths = {leaf.shape[0] for leaf in jax.tree.leaves(controls)}
    if num_paths < 1:
        raise ValueError(f"num_paths must be at least 1; got {num_paths}.")
    if not lengths <= {length}:
        raise ValueError(f"controls must be as long as history, {length}; got {sorted(lengths)}.")
    return _simulate(key, history, jax.tree_util.Partial(log_transition), controls, jnp.zeros(num_paths))


@jax.jit
def _simulate(
    key: AnyKey, history: History, log_transition: LogTransition, controls: PyTree, paths: Float[Array, " m"]
) -> PyTree:
    length = history.log_weights.shape[0]
    points = jax.random.uniform(key, (length, paths.size), history.log_weights.dtype)
    last = jax.tree.map(lambda leaf: leaf[-1], history)
    chosen = jax.vmap(_drawn, in_axes=(None, 0))(last.log_weights, points[-1])
    end = _of(last.particles, chosen)

    def step(following: PyTree, inputs: tuple) -> tuple[PyTree, Array]:
        particles, log_weights, control, points = inputs

        def one(x_next: PyTree, point: Array) -> Array:
            moves = jax.vmap(lambda x: log_transition(x_next, x, control), in_axes=-1)(particles)
            return _drawn(log_weights + moves, point)

        chosen = jax.vmap(one, in_axes=(-1, 0))(following, points)
        return _of(particles, chosen), chosen

    earlier = jax.tree.map(lambda leaf: leaf[:-1], (history.particles, history.log_weights))
    following = jax.tree.map(lambda leaf: leaf[1:], controls)
    _, before = jax.lax.scan(step, end, (*earlier, following, points[:-1]), reverse=True)
    return _along(history.particles, jnp.concatenate([before, chosen[None]]))


def _drawn(log_weights: Array, point: Array) -> Array:
    """The index where the running total of the weights passes a share of the whole."""
    totals = jnp.cumsum(weights.relative(log_weights))
    index = jnp.sum(totals <= point * totals[-1], dtype=jnp.int32)
    # Rounding may let the point be the total: the last particle with any weight is meant.
    return jnp.minimum(index, jnp.argmax(totals == totals[-1]).astype(jnp.int32))


def _along(particles: PyTree, chosen: Int32[Array, "t m"]) -> PyTree:
    return jax.vmap(_of)(particles, chosen)


def _of(particles: PyTree, chosen: Int32[Array, " m"]) -> PyTree:
    return jax.tree.map(lambda leaf: jnp.take(leaf, chosen, axis=-1, mode="clip"), particles)
