r"""Smoothing by a particle filter: ancestral trajectories, and backward sampling.

Both start from the ensembles of a whole run, `run(..., collect=keep_history)`. The ancestral trajectories of the last
particles cost next to nothing, but in early frames they coincide in a few particles. Backward sampling draws
trajectories that need not be ancestral, for which it evaluates the density of the transition.
"""

from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters._renamed import takes_inputs
from jaxfilters.particle import checks
from jaxfilters.particle.backward_draws import draw_backward, draw_backward_by_rejection, draw_index, take
from jaxfilters.typing import AnyKey, taking_inputs


class History(NamedTuple):
    """Ensembles of a particle filter, with time as the first axis and the particles along the last one."""

    particles: PyTree
    """Leaves `(t, ..., n)`."""
    log_weights: Float[Array, "t n"]
    ancestors: Int32[Array, "t n"]
    """Index of each particle's parent in the frame before."""


@runtime_checkable
class LogTransition(Protocol):
    r"""Evaluate $\log p(x_t \mid x_{t-1}, u_t)$ up to a constant; `-inf` means impossible."""

    def __call__(self, *arguments: Any, **options: Any) -> Float[Array, ""]: ...


def keep_history(state: PyTree, info: PyTree) -> History:
    """Collect the ensemble of every step; for `run(..., collect=keep_history)`.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> pf = jf.bootstrap(
        ...     lambda key: jnp.zeros(1), lambda e, x: x + e, lambda x, y: -jnp.sum((x - y) ** 2),
        ...     num_particles=100, noise=jf.StandardNormal(1),
        ... )
        >>> _, history = jf.run(pf, jax.random.key(0), jnp.ones((5, 1)), collect=jf.smoothing.keep_history)
        >>> history.particles.shape, history.ancestors.shape
        ((5, 1, 100), (5, 100))
    """
    del info
    return History(state.particles, state.log_weights, state.ancestors)


def trajectories(history: History) -> PyTree:
    """Return the ancestral trajectory of every particle of the last frame.

    With the weights of the last frame the trajectories are a smoothed ensemble (G. Kitagawa, "Monte Carlo filter and
    smoother for non-Gaussian nonlinear state space models", Journal of Computational and Graphical Statistics 5, 1996,
    section 4).

    Args:
        history: Ensembles that `run` collected with `keep_history`.

    Returns:
        Particles along the trajectories, leaves `(t, ..., n)`.

    Raises:
        TypeError: If `history` is not a `History`.
        ValueError: If its leaves do not agree in the numbers of frames and particles.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> pf = jf.bootstrap(
        ...     lambda key: jnp.zeros(1), lambda e, x: x + e, lambda x, y: -jnp.sum((x - y) ** 2),
        ...     num_particles=100, noise=jf.StandardNormal(1),
        ... )
        >>> _, history = jf.run(pf, jax.random.key(0), jnp.ones((5, 1)), collect=jf.smoothing.keep_history)
        >>> jf.smoothing.trajectories(history).shape
        (5, 1, 100)
    """
    checks.check_history(history)
    return _trajectories(history)


@jax.jit
def _trajectories(history: History) -> PyTree:
    indices = jnp.arange(history.ancestors.shape[1], dtype=jnp.int32)

    def parents(indices: Array, ancestors: Array) -> tuple[Array, Array]:
        return ancestors[indices], indices

    _, chosen = jax.lax.scan(parents, indices, history.ancestors, reverse=True)
    return _along(history.particles, chosen)


@takes_inputs
def backward_sampling(
    key: AnyKey,
    history: History,
    log_transition: LogTransition,
    inputs: PyTree = None,
    *,
    num_paths: int,
    log_bound: float | Float[Array, ""] | None = None,
    max_candidates: int = 32,
) -> PyTree:
    """Draw equally weighted trajectories from the smoothing distribution.

    From the last frame to the first, a particle is drawn with probability proportional to its weight times the density
    of the transition to the next state of the trajectory (S. Godsill, A. Doucet and M. West, "Monte Carlo smoothing for
    nonlinear time series", Journal of the American Statistical Association 99, 2004, algorithm 1). Every frame costs n
    densities for every trajectory; with `log_bound` it costs a few, whatever n is, by rejection (R. Douc, A. Garivier,
    E. Moulines and J. Olsson, "Sequential Monte Carlo smoothing for general state space hidden Markov models", Annals
    of Applied Probability 21(6), 2011, section 4), for samples of the same distribution.

    Args:
        key: Random key.
        history: Ensembles that `run` collected with `keep_history`.
        log_transition: `(x_next, x) -> log p(x_next | x)`, a scalar, or with the inputs of the step after them.
            Compared by identity.
        inputs: The inputs of `run`, with time as the first axis.
        num_paths: Number of trajectories.
        log_bound: An upper bound of `log_transition` over all states, for rejection. A trajectory on which a density
            is found above it is NaN.
        max_candidates: Candidates of the rejection sampler before a draw takes n densities. It changes the time alone.

    Returns:
        States along the trajectories, leaves `(t, ..., num_paths)`.

    Raises:
        TypeError: If `history` is not a `History` or `log_transition` is not callable.
        ValueError: If `num_paths < 1` or `max_candidates < 1`, `log_bound` is not finite, `inputs` has another
            length than `history`, or `log_transition` does not return a scalar.

    Examples:
        Two frames of two particles of a state that hardly moves: no trajectory changes sides.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> particles, ancestors = jnp.array([[-1.0, 1.0], [-1.0, 1.0]]), jnp.array([[0, 1], [0, 1]])
        >>> history = jf.smoothing.History(particles, jnp.log(jnp.full((2, 2), 0.5)), ancestors)
        >>> log_transition = lambda x_next, x: -1000.0 * (x_next - x) ** 2
        >>> paths = jf.smoothing.backward_sampling(jax.random.key(0), history, log_transition, num_paths=10)
        >>> paths.shape, bool((paths[0] == paths[1]).all())
        ((2, 10), True)
    """
    checks.check_history(history)
    checks.check_callables(log_transition=log_transition)
    checks.check_num_particles(num_paths, name="num_paths")
    checks.check_num_particles(max_candidates, name="max_candidates")
    if log_bound is not None:
        checks.check_scalar("log_bound", log_bound, "finite", np.isfinite)
    for path, leaf in jax.tree_util.tree_leaves_with_path(inputs):
        if jnp.shape(leaf)[:1] != history.log_weights.shape[:1]:
            raise ValueError(
                f"inputs{jax.tree_util.keystr(path)} must have as many frames as history, "
                f"{history.log_weights.shape[0]}; got the shape {jnp.shape(leaf)}."
            )
    transition = taking_inputs("log_transition", log_transition, "x_next", "x")
    if log_bound is None:
        return _simulate(key, history, transition, inputs, jnp.zeros(num_paths))
    return _simulate_by_rejection(key, history, transition, inputs, log_bound, num_paths, max_candidates)


@jax.jit
def _simulate(
    key: AnyKey, history: History, log_transition: LogTransition, inputs: PyTree, paths: Float[Array, " m"]
) -> PyTree:
    length = history.log_weights.shape[0]
    points = jax.random.uniform(key, (length, paths.size), history.log_weights.dtype)
    last = jax.tree.map(lambda leaf: leaf[-1], history)
    chosen = jax.vmap(draw_index, in_axes=(None, 0))(last.log_weights, points[-1])
    end = take(last.particles, chosen)

    def step(following: PyTree, frame: tuple) -> tuple[PyTree, Array]:
        particles, log_weights, inputs, points = frame

        density = lambda x_next, x: log_transition(x_next, x, inputs)
        chosen = draw_backward(density, following, particles, log_weights, points)
        return take(particles, chosen), chosen

    earlier = jax.tree.map(lambda leaf: leaf[:-1], (history.particles, history.log_weights))
    following = jax.tree.map(lambda leaf: leaf[1:], inputs)
    _, before = jax.lax.scan(step, end, (*earlier, following, points[:-1]), reverse=True)
    return _along(history.particles, jnp.concatenate([before, chosen[None]]))


@partial(jax.jit, static_argnames=("num_paths", "max_candidates"))
def _simulate_by_rejection(
    key: AnyKey,
    history: History,
    log_transition: LogTransition,
    inputs: PyTree,
    log_bound: Array | float,
    num_paths: int,
    max_candidates: int,
) -> PyTree:
    end_key, key = jax.random.split(key)
    last = jax.tree.map(lambda leaf: leaf[-1], history)
    points = jax.random.uniform(end_key, (num_paths,), last.log_weights.dtype)
    chosen = jax.vmap(draw_index, in_axes=(None, 0))(last.log_weights, points)

    def step(state: tuple, frame: tuple) -> tuple[tuple, Array]:
        following, bounded = state
        key, particles, log_weights, inputs = frame
        density = lambda x_next, x: log_transition(x_next, x, inputs)
        chosen, below = draw_backward_by_rejection(
            key, density, log_bound, following, particles, log_weights, max_candidates
        )
        return (take(particles, chosen), bounded & below), chosen

    earlier = jax.tree.map(lambda leaf: leaf[:-1], (history.particles, history.log_weights))
    keys = jax.random.split(key, len(history.log_weights) - 1)
    start = take(last.particles, chosen), jnp.ones(num_paths, bool)
    inputs = (keys, *earlier, jax.tree.map(lambda leaf: leaf[1:], inputs))
    (_, bounded), before = jax.lax.scan(step, start, inputs, reverse=True)
    paths = _along(history.particles, jnp.concatenate([before, chosen[None]]))
    return jax.tree.map(lambda leaf: jnp.where(bounded, leaf, jnp.nan) if is_float(leaf) else leaf, paths)


def is_float(leaf: Array) -> bool:
    """Whether an array holds floating-point numbers."""
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _along(particles: PyTree, chosen: Int32[Array, "t m"]) -> PyTree:
    return jax.vmap(take)(particles, chosen)
