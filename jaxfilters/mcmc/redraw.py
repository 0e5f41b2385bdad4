"""How a sweep of conditional sequential Monte Carlo departs from the trajectory that it is given."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.mcmc.conditional_resampling import systematic_at
from jaxfilters.particle import checks, smoothing
from jaxfilters.particle.smoothing import History, LogTransition
from jaxfilters.typing import AnyKey, taking_inputs


@runtime_checkable
class Redraw(Protocol):
    """How a sweep departs from the given trajectory: `ancestral`, `ancestor_sampling` or `backward_sampling`."""

    def parent(
        self, point: Array, log_weights: Array, particles: PyTree, x_next: PyTree, inputs: PyTree, /
    ) -> tuple[Array, Array]:
        """Index of the particle that precedes a state of the given trajectory, and whether none could."""
        ...

    def trace(self, key: AnyKey, history: History, inputs: PyTree, /) -> PyTree:
        """One trajectory through the ensembles of a sweep."""
        ...


class _KeepsPast:
    def parent(
        self, point: Array, log_weights: Array, particles: PyTree, x_next: PyTree, inputs: PyTree
    ) -> tuple[Array, Array]:
        """The given trajectory's own particle."""
        del point, log_weights, particles, x_next, inputs
        return jnp.zeros((), jnp.int32), jnp.zeros((), bool)


class _TracesAncestry:
    def trace(self, key: AnyKey, history: History, inputs: PyTree) -> PyTree:
        """The ancestry of a particle that is drawn by its weight."""
        del inputs
        return ancestry(key, history)


@pytree_dataclass
class Ancestral(_KeepsPast, _TracesAncestry):
    """The given trajectory keeps its past, and the new one is the ancestry of a particle of the last frame."""


@pytree_dataclass
class AncestorSampling(_TracesAncestry):
    """The given trajectory is joined, frame by frame, to a past that is drawn anew."""

    log_transition: LogTransition

    def parent(
        self, point: Array, log_weights: Array, particles: PyTree, x_next: PyTree, inputs: PyTree
    ) -> tuple[Array, Array]:
        """A particle drawn by its weight times the density of the transition to `x_next`.

        A density that is NaN or `+inf` counts as none, and the frame as one without a predecessor.
        """

        def log_density(x: PyTree) -> Array:
            return checks.scalar_log_density("log_transition", self.log_transition(x_next, x, inputs))

        densities = jax.vmap(log_density, in_axes=-1)(particles)
        invalid = jnp.isnan(densities) | jnp.isposinf(densities)
        joined = log_weights + jnp.where(invalid, -jnp.inf, densities)
        impossible = ~jnp.any(joined > -jnp.inf)
        affected = jnp.any(invalid & (log_weights > -jnp.inf))
        return jnp.where(impossible, 0, _draw_index(joined, point)), impossible | affected


@pytree_dataclass
class BackwardSampling(_KeepsPast):
    """The given trajectory keeps its past, and the new one is drawn backwards through all particles."""

    log_transition: LogTransition

    def trace(self, key: AnyKey, history: History, inputs: PyTree) -> PyTree:
        """One draw by backward sampling."""
        # The transition into row t has the inputs of row t; the first row, before which there is none, repeats it.
        inputs = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:1], leaf]), inputs)
        paths = smoothing.backward_sampling(key, history, self.log_transition, inputs, num_paths=1)
        return jax.tree.map(lambda leaf: leaf[..., 0], paths)


def ancestral() -> Ancestral:
    """Trajectories by ancestry: no density of the transition is needed.

    The paths of all particles soon coincide backwards in time, so that early states change in few sweeps only, unless
    there are about as many particles as frames (Andrieu, Doucet and Holenstein 2010).

    Examples:
        >>> import jaxfilters as jf
        >>> jf.mcmc.ancestral()
        Ancestral()
    """
    return Ancestral()


def ancestor_sampling(log_transition: Callable[..., Array]) -> AncestorSampling:
    """Trajectories by ancestor sampling: all states change in most sweeps, with few particles.

    Before every frame the ancestor of the given trajectory is drawn anew (F. Lindsten, M. I. Jordan and T. B. Schon,
    "Particle Gibbs with ancestor sampling", Journal of Machine Learning Research 15, 2014, algorithm 2). It costs n
    densities a frame.

    Args:
        log_transition: `(x_next, x) -> log p(x_next | x)`, a scalar, up to a constant that depends on neither; it may
            take the inputs of the step as one more argument.

    Returns:
        An argument of `conditional_smc`.

    Raises:
        TypeError: If `log_transition` is not callable.

    Examples:
        >>> import jaxfilters as jf
        >>> jf.mcmc.ancestor_sampling(lambda x_next, x: -0.5 * (x_next - x) ** 2).log_transition(3.0, 1.0, None)
        -2.0
    """
    checks.check_callables(log_transition=log_transition)
    return AncestorSampling(taking_inputs("log_transition", log_transition, "x_next", "x"))


def backward_sampling(log_transition: Callable[..., Array]) -> BackwardSampling:
    """Trajectories by backward sampling: as `ancestor_sampling`, in a second pass over stored particles.

    The proposal is N. Whiteley's, in the discussion of Andrieu, Doucet and Holenstein (2010).

    Args:
        log_transition: As for `ancestor_sampling`.

    Returns:
        An argument of `conditional_smc`.

    Raises:
        TypeError: If `log_transition` is not callable.

    Examples:
        >>> import jaxfilters as jf
        >>> jf.mcmc.backward_sampling(lambda x_next, x: -0.5 * (x_next - x) ** 2).log_transition(3.0, 1.0, None)
        -2.0
    """
    checks.check_callables(log_transition=log_transition)
    return BackwardSampling(taking_inputs("log_transition", log_transition, "x_next", "x"))


def ancestry(key: AnyKey, history: History) -> PyTree:
    """The ancestry of a particle of the last frame that is drawn by its weight, leaves `(t + 1, ...)`."""
    last = _draw_index(history.log_weights[-1], jax.random.uniform(key, (), history.log_weights.dtype))

    def parent(index: Array, ancestors: Array) -> tuple[Array, Array]:
        return ancestors[index], index

    _, chosen = jax.lax.scan(parent, last, history.ancestors, reverse=True)
    take = jax.vmap(lambda leaf, index: jnp.take(leaf, index, axis=-1, mode="clip"))
    return jax.tree.map(lambda leaf: take(leaf, chosen), history.particles)


def _draw_index(log_weights: Float[Array, " n"], point: Float[Array, ""]) -> Int32[Array, ""]:
    """The particle in which the fraction `point` of the total weight lies."""
    return systematic_at(point, log_weights, 1)[0]
