"""Fixed-lag smoothing: beliefs about the state some frames ago, given all observations until now, as frames arrive.

Both smoothers wrap a filter and are filters, with the infos of the inner one. In the first frames, when the state of
so many frames ago does not exist, the belief is about the state before the first observation.
"""

from dataclasses import field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from jaxfilters._renamed import takes_inputs
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.manifold import Belief, increments, retract_belief, to_tangent
from jaxfilters.gaussian.model import model_of
from jaxfilters.particle.differentiable_resampling import Transport
from jaxfilters.typing import AnyKey


class LineageState(NamedTuple):
    """State of a particle filter, and the trajectories of its particles over the last frames."""

    inner: Any
    window: PyTree
    """Ancestors of the particles, leaves `(lag + 1, ..., n)`, the oldest frame first."""

    @property
    def delayed(self) -> PyTree:
        """Particles `lag` frames ago, leaves `(..., n)`; their weights are those of the current particles."""
        return jax.tree.map(lambda leaf: leaf[0], self.window)


class GaussianLagState(NamedTuple):
    """Belief of a Gaussian filter, those of the last frames, and the smoothed one."""

    belief: Belief
    window: Belief
    """Filtered beliefs of the last `lag + 1` frames, the oldest first."""
    inputs: PyTree
    """Controls of the same frames."""
    frames: Int[Array, ""]
    """Number of frames so far."""
    delayed: Belief
    """Belief about the state `lag` frames ago, given all observations until now."""


@pytree_dataclass
class FixedLag:
    """Parameters of a filter made by `fixed_lag` or `fixed_lag_rts`; their arguments describe them."""

    inner: Filter
    inputs: PyTree
    lag: int = field(metadata={"static": True})


def fixed_lag(inner: Filter, lag: int) -> Filter:
    """Fixed-lag smoother of a particle filter, by the ancestors of its particles.

    The smaller the lag, the more distinct ancestors are left; five to fifty frames are usual (G. Kitagawa, "Monte Carlo
    filter and smoother for non-Gaussian nonlinear state space models", Journal of Computational and Graphical
    Statistics 5(1), 1996, section 4). The state is a `LineageState`.

    Args:
        inner: Particle filter whose state, or its field `ensemble`, has `particles`, `log_weights` and `ancestors`,
            like those of `bootstrap`, `rao_blackwell`, `adaptive_diffusion` and `guided_rao_blackwell`.
        lag: Number of frames that the smoothed belief is behind, at least 1.

    Returns:
        The filter.

    Raises:
        ValueError: If `lag < 1`; if `inner` resamples by transport, whose particles are averages and have no ancestors;
            or, when it is traced, if the state of `inner` is another one.
        TypeError: If `inner` is no filter.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> pf = jf.bootstrap(
        ...     lambda key: jnp.zeros(1), lambda e, x: x + e, lambda x, y: -jnp.sum((x - y) ** 2),
        ...     num_particles=100, noise=jf.StandardNormal(1),
        ... )
        >>> last, _ = jf.run(jf.smoothing.fixed_lag(pf, lag=3), jax.random.key(0), jnp.ones((5, 1)))
        >>> last.window.shape, last.delayed.shape
        ((4, 1, 100), (1, 100))
    """
    checks.is_filter("inner", inner)
    _check(lag)
    if any(isinstance(leaf, Transport) for leaf in _schemes(inner.params)):
        raise ValueError("inner must choose ancestors when it resamples; particles moved by transport have none.")
    return Filter(FixedLag(inner, None, lag), _begin_lineages, _predict_lineages, _update_lineages)


@takes_inputs
def fixed_lag_rts(inner: Filter, lag: int, *, inputs: PyTree = None) -> Filter:
    """Fixed-lag Rauch-Tung-Striebel smoother of a Gaussian filter; the state is a `GaussianLagState`.

    Args:
        inner: Filter made by `extended_kalman`, `unscented_kalman`, `cubature_kalman` or `kalman`.
        lag: Number of frames that the smoothed belief is behind, at least 1; each frame costs that many steps back.
        inputs: Any inputs of a step, where steps have them: their shapes are needed before the first ones arrive.

    Returns:
        The filter.

    Raises:
        ValueError: If `inner` is another kind of filter, or `lag < 1`.
        TypeError: If `inner` is no filter.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> inner = jf.extended_kalman(prior, lambda x: x, 0.1 * jnp.eye(1), lambda x: x, jnp.eye(1))
        >>> filter = jf.smoothing.fixed_lag_rts(inner, lag=3)
        >>> _, (states, infos) = jf.run(filter, jax.random.key(0), jnp.ones((10, 1)))
        >>> bool(states.delayed.covariance[-1, 0, 0] < states.belief.covariance[-1, 0, 0])
        True
    """
    checks.is_filter("inner", inner)
    _check(lag)
    model_of(inner, "inner")
    return Filter(FixedLag(inner, inputs, lag), _begin_beliefs, _predict_beliefs, _update_beliefs)


def _check(lag: int) -> None:
    if not isinstance(lag, int) or lag < 1:
        raise ValueError(f"lag must be an integer of at least 1; got {lag!r}.")


def _begin_lineages(model: FixedLag, key: AnyKey) -> LineageState:
    inner = model.inner.init(model.inner.params, key)
    return LineageState(inner, _repeated(_ensemble(inner).particles, model.lag + 1))


def _predict_lineages(model: FixedLag, key: AnyKey, state: LineageState, inputs: PyTree) -> LineageState:
    inner = model.inner.predict(model.inner.params, key, state.inner, inputs)
    ensemble = _ensemble(inner)
    return LineageState(inner, _pushed(_followed(state.window, ensemble.ancestors), ensemble.particles))


def _update_lineages(
    model: FixedLag, key: AnyKey, state: LineageState, observation: PyTree, inputs: PyTree
) -> tuple[LineageState, PyTree]:
    before = _ensemble(state.inner).ancestors
    inner, info = model.inner.update(model.inner.params, key, state.inner, observation, inputs)
    ensemble = _ensemble(inner)

    def children_of_the_same() -> PyTree:
        # Partitioned filters resample in their update, too: any sibling has the same ancestors.
        child = jnp.zeros_like(before).at[before].set(jnp.arange(before.size, dtype=before.dtype))
        return _followed(state.window, child[ensemble.ancestors])

    stayed = jnp.all(ensemble.ancestors == before)
    window = jax.lax.cond(stayed, lambda: state.window, children_of_the_same)
    return LineageState(inner, _renewed(window, ensemble.particles)), info


def _ensemble(state: Any) -> Any:
    """The part of a filter's state that holds the particles."""
    ensemble = getattr(state, "ensemble", state)
    if not all(hasattr(ensemble, name) for name in ("particles", "log_weights", "ancestors")):
        raise ValueError(f"inner must have particles, log_weights and ancestors in its state; got {type(state)}.")
    return ensemble


def _schemes(params: Any) -> list:
    """Resampling schemes of a filter and of the one inside it."""
    return [getattr(part, "scheme", None) for part in (params, getattr(params, "inner", None))]


def _followed(window: PyTree, ancestors: Int[Array, " n"]) -> PyTree:
    return jax.tree.map(lambda leaf: jnp.take(leaf, ancestors, axis=-1, mode="clip"), window)


def _begin_beliefs(model: FixedLag, key: AnyKey) -> GaussianLagState:
    belief = model.inner.init(model.inner.params, key)
    window = _repeated(belief, model.lag + 1)
    inputs = _repeated(jax.tree.map(jnp.asarray, model.inputs), model.lag + 1)
    return GaussianLagState(belief, window, inputs, jnp.zeros((), jnp.int32), belief)


def _predict_beliefs(model: FixedLag, key: AnyKey, state: GaussianLagState, inputs: PyTree) -> GaussianLagState:
    got, wanted = (str(jax.tree.structure(tree)) for tree in (model.inputs, inputs))
    if got != wanted:
        raise ValueError(f"inputs of fixed_lag_rts must have the structure of those of a step, {wanted}; got {got}.")
    belief = model.inner.predict(model.inner.params, key, state.belief, inputs)
    window, past = _pushed(state.window, belief), _pushed(state.inputs, inputs)
    return _smoothed(model, GaussianLagState(belief, window, past, state.frames + 1, state.delayed))


def _update_beliefs(
    model: FixedLag, key: AnyKey, state: GaussianLagState, observation: PyTree, inputs: PyTree
) -> tuple[GaussianLagState, PyTree]:
    belief, info = model.inner.update(model.inner.params, key, state.belief, observation, inputs)
    return _smoothed(model, state._replace(belief=belief, window=_renewed(state.window, belief))), info


def _smoothed(model: FixedLag, state: GaussianLagState) -> GaussianLagState:
    linear = model.inner.params
    # Before the first frame there are only copies of the prior, with no transition between them.
    exists = jnp.arange(model.lag) >= model.lag - state.frames

    def step(following: Belief, frame: tuple[Belief, PyTree, Bool[Array, ""]]) -> tuple[Belief, None]:
        belief, inputs, exists = frame
        origin, ahead = linear.linear_transition(belief, inputs)
        next_belief = to_tangent(linear.manifold, origin, following)
        noise = linear.process_noise_of(belief, inputs)
        delta = linear.arithmetic.rts(increments(belief), next_belief, ahead.F, noise, ahead.value, ahead.residual_root)
        smoothed = retract_belief(linear.manifold, belief.mean, delta)
        return jax.tree.map(lambda new, old: jnp.where(exists, new, old), smoothed, following), None

    earlier = jax.tree.map(lambda leaf: leaf[:-1], state.window)
    inputs = jax.tree.map(lambda leaf: leaf[1:], state.inputs)
    delayed, _ = jax.lax.scan(step, state.belief, (earlier, inputs, exists), reverse=True)
    return state._replace(delayed=delayed)


def _repeated(tree: PyTree, count: int) -> PyTree:
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), tree)


def _pushed(window: PyTree, newest: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf, new: jnp.concatenate([leaf[1:], new[None]]), window, newest)


def _renewed(window: PyTree, newest: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf, new: leaf.at[-1].set(new), window, newest)
