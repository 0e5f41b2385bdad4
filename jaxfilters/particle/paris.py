r"""Online smoothing of additive functionals by particles, with the PaRIS algorithm.

$S_t = h_0(x_0) + \sum_{s \le t} h(x_{s-1}, x_s)$ given $y_{1:t}$: every particle carries an estimate of $E[S_t]$ given
that it is the state, which a few draws from the backward kernel update. Nothing is stored of earlier frames, and the
estimate does not degenerate as that by ancestral trajectories does.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.checks import is_filter
from jaxfilters.particle import checks
from jaxfilters.particle.backward_draws import draw_backward_by_rejection, take
from jaxfilters.particle.bootstrap import Bootstrap
from jaxfilters.particle.differentiable_resampling import Transport
from jaxfilters.particle.smoothing import LogTransition
from jaxfilters.typing import AnyKey, as_pytree, taking_inputs


class ParisState(NamedTuple):
    """State of a particle filter, and each particle's estimate of the functional."""

    inner: Any
    statistics: PyTree
    """E[S_t] given the state, leaves (..., n)."""
    is_bounded: Bool[Array, ""]
    """Whether no density of a transition was above its bound so far; if one was, the estimates are NaN."""

    @property
    def estimate(self) -> PyTree:
        """E[S_t | y_1:t], leaves (...)."""
        return weights.mean(self.statistics, self.inner.log_weights)


@pytree_dataclass
class Paris:
    """Parameters of a filter made by `paris`; its arguments describe them."""

    inner: Filter
    initial: Callable
    increment: Callable
    log_transition: Callable
    log_bound: Float[Array, ""]
    num_draws: int = field(metadata={"static": True})
    max_candidates: int = field(metadata={"static": True})


def paris(
    inner: Filter,
    initial: Callable[[PyTree], PyTree],
    increment: Callable[[PyTree, PyTree, PyTree], PyTree],
    log_transition: LogTransition,
    log_bound: float | Float[Array, ""],
    *,
    num_draws: int = 2,
    max_candidates: int = 32,
) -> Filter:
    """Online smoother of an additive functional of the states: sums over time of functions of neighbouring states.

    J. Olsson and J. Westerborn, "Efficient particle-based online smoothing in general hidden Markov models: the PaRIS
    algorithm", Bernoulli 23(3), 2017, algorithm 2. Sufficient statistics of maximum likelihood are such functionals.
    The state is a `ParisState`, whose `estimate` is the expectation given all observations so far; the info is that of
    `inner`.

    Args:
        inner: Filter made by `bootstrap` without tempering, resampling by choice of ancestors.
        initial: `x -> h_0` of the state before the first observation: floating-point numbers and arrays.
        increment: `(x, x_next) -> h`, a pytree like that of `initial`; or with the inputs of the step after them.
        log_transition: `(x_next, x) -> log p(x_next | x)`, a scalar; or with the inputs of the step after them.
        log_bound: An upper bound of `log_transition` over all states. If a density is found above it, the estimates
            are NaN from then on.
        num_draws: Draws from the backward kernel for each particle; 2 or more keep the variance from growing with the
            square of time.
        max_candidates: Candidates of the rejection sampler before a draw costs as much as there are particles.

    Returns:
        The filter.

    Raises:
        TypeError: If `inner` is no filter, or a function is not callable.
        ValueError: If `inner` is another kind of filter, `num_draws < 1`, `max_candidates < 1`, or `log_bound` is not
            finite; when it is traced, if `increment` and `initial` return different structures, shapes or types.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> pf = jf.bootstrap(
        ...     lambda key: jnp.zeros(1), lambda e, x: 0.9 * x + e, lambda x, y: -jnp.sum((x - y) ** 2),
        ...     num_particles=100, noise=jf.StandardNormal(1),
        ... )
        >>> log_transition = lambda x_next, x: jax.scipy.stats.norm.logpdf(x_next - 0.9 * x).sum()
        >>> product = lambda x, x_next: x[0] * x_next[0]
        >>> smoother = jf.smoothing.paris(pf, lambda x: 0.0, product, log_transition, log_bound=-0.918)
        >>> last, infos = jf.run(smoother, jax.random.key(0), jnp.ones((5, 1)), collect=jf.keep_info)
        >>> last.estimate.shape
        ()
    """
    is_filter("inner", inner)
    checks.check_callables(increment=increment, log_transition=log_transition, initial=initial)
    checks.check_scalar("log_bound", log_bound, "finite", np.isfinite)
    checks.check_num_particles(num_draws, name="num_draws")
    checks.check_num_particles(max_candidates, name="max_candidates")
    if not isinstance(inner.params, Bootstrap) or isinstance(inner.params.scheme, Transport):
        raise ValueError("inner must be made by bootstrap with a scheme of jf.resampling, which chooses ancestors.")
    increment = taking_inputs("increment", increment, "x", "x_next")
    density = taking_inputs("log_transition", log_transition, "x_next", "x")
    params = Paris(
        inner, as_pytree(initial), increment, density, jnp.asarray(log_bound, float), num_draws, max_candidates
    )
    return Filter(params, _init, _predict, _update)


def _init(model: Paris, key: AnyKey) -> ParisState:
    inner = model.inner.init(model.inner.params, key)
    statistics = jax.vmap(model.initial, in_axes=-1, out_axes=-1)(inner.particles)
    statistics = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), statistics)
    return ParisState(inner, statistics, jnp.ones((), bool))


def _predict(model: Paris, key: AnyKey, state: ParisState, inputs: PyTree) -> ParisState:
    inner_key, draw_key = jax.random.split(key)
    before = state.inner
    inner = model.inner.predict(model.inner.params, inner_key, before, inputs)

    def draw(key: AnyKey) -> tuple[PyTree, Array]:
        chosen, below = draw_backward_by_rejection(
            key,
            lambda x_next, x: model.log_transition(x_next, x, inputs),
            model.log_bound,
            inner.particles,
            before.particles,
            before.log_weights,
            model.max_candidates,
        )
        step = jax.vmap(lambda x, x_next: model.increment(x, x_next, inputs), in_axes=-1, out_axes=-1)
        added = step(take(before.particles, chosen), inner.particles)
        added = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), added)
        checks.like("the result of increment", added, state.statistics, "what initial returns, for all particles")
        return jax.tree.map(jnp.add, take(state.statistics, chosen), added), jnp.all(below)

    draws, below = jax.vmap(draw)(jax.random.split(draw_key, model.num_draws))
    is_bounded = state.is_bounded & jnp.all(below)
    statistics = jax.tree.map(lambda leaf: jnp.where(is_bounded, leaf.mean(axis=0), jnp.nan), draws)
    return ParisState(inner, statistics, is_bounded)


def _update(
    model: Paris, key: AnyKey, state: ParisState, observation: PyTree, inputs: PyTree
) -> tuple[ParisState, PyTree]:
    inner, info = model.inner.update(model.inner.params, key, state.inner, observation, inputs)
    return state._replace(inner=inner), info
