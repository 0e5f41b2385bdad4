r"""The interacting multiple model filter: a bank of Gaussian filters of a system that switches between models.

$$s_t \sim \Pi_{s_{t-1}, \cdot},\qquad x_t, y_t \sim \text{model } s_t \text{ given } x_{t-1}.$$
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.last_axis import batch_last
from jaxfilters.filter import Filter
from jaxfilters.gaussian import bank as banks
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.bank import Bank
from jaxfilters.gaussian.manifold import Belief, Manifold, dimension, hashable
from jaxfilters.gaussian.mixture import matched
from jaxfilters.gaussian.mode_maps import ModeMaps, check_maps
from jaxfilters.typing import AnyKey


class IMMState(NamedTuple):
    """One belief for each mode, and the probabilities of the modes."""

    beliefs: tuple[Belief, ...]
    """About the state in each mode, given that the system is in it."""
    log_probabilities: Float[Array, " k"]
    """Log probabilities of the modes, normalised."""
    combined: Belief
    """The belief with the moments of the mixture of all modes: in the common state where there are maps."""

    @property
    def probabilities(self) -> Float[Array, "*t k"]:
        """Probabilities of the modes."""
        return jnp.exp(self.log_probabilities)


class IMMInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1) of the mixture; `-inf` if no mode explains the observation, which is then left out."""
    log_likelihoods: Float[Array, " k"]
    """log p(y_t | mode, y_1:t-1) of each mode; `-inf` where that of its filter is not a number."""
    filters: tuple[Any, ...]
    """Infos of the filters."""


@pytree_dataclass
class IMM:
    """Parameters of a filter made by `imm`; its arguments describe them."""

    bank: Bank
    transition: Array | Callable
    initial: Float[Array, " k"]
    manifold: Manifold
    maps: ModeMaps | None


def imm(
    filters: Sequence[Filter],
    transition_matrix: Num[ArrayLike, "..."] | Sequence[Sequence[float]] | Callable[[PyTree], Array],
    initial_probabilities: Num[ArrayLike, "..."] | Sequence[float],
    *,
    maps: ModeMaps | None = None,
) -> Filter:
    """Interacting multiple model (IMM) filter: Gaussian filters of k modes, between which a Markov chain switches.

    Each step mixes the beliefs of all modes into one Gaussian for each mode that may follow, predicts and updates
    these by the filter of the mode, and weighs the modes by their evidence (H. Blom and Y. Bar-Shalom, "The interacting
    multiple model algorithm for systems with Markovian switching coefficients", IEEE Transactions on Automatic Control
    33(8), 1988). It costs k filters a step; the mixing is its only approximation. With one mode it is that filter;
    with the identity as `transition_matrix` it is Bayesian model averaging, without approximation.

    Filters of one builder that differ in numbers only (the same functions, the same shapes) run as one batch. The state
    is an `IMMState`, the info an `IMMInfo`.

    Args:
        filters: One filter for each mode, in the order of the modes: made by `kalman`, `extended_kalman`,
            `unscented_kalman`, `cubature_kalman` or `robust`, all with `Gaussian` or all with `GaussianRoot` beliefs.
            The prior of each is the belief before the first observation given its mode.
        transition_matrix: (k, k), with rows that sum to one: [i, j] is the probability that mode j follows mode i. Or a
            function `inputs -> (k, k)` of the inputs of the step.
        initial_probabilities: (k,), of the modes before the first observation; the first prediction applies the
            transition matrix to them.
        maps: How beliefs about the state of one mode become beliefs about that of another, made by a function of
            `jf.mode_maps`; needed for states of different size.

    Returns:
        The filter, for `jf.run`, `jf.log_evidence` and `jf.step`.

    Raises:
        ValueError: If `filters` is empty, or holds one whose state is not Gaussian, or states of different kinds, sizes
            without `maps`, or manifolds; if `transition_matrix` or `initial_probabilities` have another shape than
            that of k modes, or are no probabilities that sum to one (tested where their values are known); if `maps`
            lead to other shapes than those of the states.
        TypeError: If `filters` is no list of filters, or `maps` is of another kind.

    Examples:
        A point that rests or moves at random; it starts to move in the eleventh frame.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior, one = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> rests, moves = (jf.kalman(prior, one, variance * one, one, 0.1 * one) for variance in (1e-6, 4.0))
        >>> filter = jf.imm([rests, moves], jnp.array([[0.95, 0.05], [0.1, 0.9]]), jnp.array([0.5, 0.5]))
        >>> ys = jnp.concatenate([jnp.zeros((10, 1)), jnp.array([[2.0], [-1.0], [3.0], [1.0]])])
        >>> last, (states, infos) = jf.run(filter, jax.random.key(0), ys)
        >>> (states.probabilities[:, 1] > 0.5).tolist()[8:]
        [False, False, True, True, True, True]
        >>> states.combined.mean.shape
        (14, 1)
    """
    hint = None if maps is not None else ", or maps between them (jf.mode_maps)"
    states = banks.check_filters(filters, one_size=hint)
    if maps is not None:
        check_maps(maps, states)
    manifold = hashable(banks.manifold_of(filters[0]))
    if maps is not None and not manifold.flat:
        raise ValueError("maps must be None for filters of states on a manifold, whose beliefs are mixed there.")
    params = IMM(
        banks.bank_of(filters),
        banks.transition_of(transition_matrix, len(filters)),
        banks.initial_probabilities("initial_probabilities", initial_probabilities, len(filters)),
        manifold,
        maps,
    )
    return Filter(params, _init, _predict, _update)


def _init(model: IMM, key: AnyKey) -> IMMState:
    beliefs = model.bank.apply(lambda filter: filter.init(filter.params, key))
    possible = model.initial > 0
    log_initial = jnp.where(possible, jnp.log(jnp.where(possible, model.initial, 1.0)), -jnp.inf)
    return _state(model, beliefs, log_initial.astype(beliefs[0].mean.dtype))


def _predict(model: IMM, key: AnyKey, state: IMMState, inputs: PyTree) -> IMMState:
    transition = banks.transition_at(model.transition, inputs, model.bank.count).astype(state.log_probabilities.dtype)
    log_predicted, origins = interaction(transition, state.log_probabilities)
    mixed = _mixed(model, state.beliefs, origins)
    ahead = model.bank.apply(lambda filter, belief: filter.predict(filter.params, key, belief, inputs), mixed)
    return _state(model, ahead, log_predicted)


def _update(model: IMM, key: AnyKey, state: IMMState, observation: PyTree, inputs: PyTree) -> tuple[IMMState, IMMInfo]:
    found = model.bank.apply(
        lambda filter, belief: filter.update(filter.params, key, belief, observation, inputs), state.beliefs
    )
    log_likelihoods = jnp.stack([info.log_evidence for _, info in found])
    usable = jnp.where(log_likelihoods < jnp.inf, log_likelihoods, -jnp.inf)
    log_probabilities, log_evidence = weights.normalize(state.log_probabilities + usable)
    # Where no mode explains the observation, the prediction is all that is known.
    after = (tuple(belief for belief, _ in found), log_probabilities)
    dead = log_evidence == -jnp.inf
    after = jax.tree.map(lambda new, old: jnp.where(dead, old, new), after, (state.beliefs, state.log_probabilities))
    return _state(model, *after), IMMInfo(log_evidence, usable, tuple(info for _, info in found))


def interaction(
    transition: Float[Array, "k k"], log_probabilities: Float[Array, " k"]
) -> tuple[Float[Array, " k"], Float[Array, "k k"]]:
    """Log probabilities of the next modes, and the probabilities [i, j] that mode i came before mode j.

    A mode that cannot be reached has itself as its origin.
    """
    possible = transition > 0
    reached = jnp.where(possible, log_probabilities[:, None], -jnp.inf)
    peak = jax.lax.stop_gradient(jnp.max(reached, axis=0))
    alive = peak > -jnp.inf
    joint = jnp.where(possible, transition, 0.0) * jnp.exp(reached - jnp.where(alive, peak, 0.0))
    total = jnp.where(alive, jnp.sum(joint, axis=0), 1.0)
    log_predicted = jnp.where(alive, jnp.log(total) + peak, -jnp.inf)
    return log_predicted, jnp.where(alive, joint / total, jnp.eye(len(total), dtype=joint.dtype))


def _mixed(model: IMM, beliefs: tuple[Belief, ...], origins: Float[Array, "k k"]) -> tuple[Belief, ...]:
    """For each mode one belief about the state before it, with the moments of the mixture of all origins."""
    maps, count = model.maps, model.bank.count
    if count == 1:
        return beliefs
    if maps is not None:
        return tuple(
            _matched(model, [maps.convert(i, j, belief) for i, belief in enumerate(beliefs)], origins[:, j])
            for j in range(count)
        )
    mixed = jax.vmap(lambda of: _matched(model, beliefs, of), -1, -1)(origins)
    return tuple(jax.tree.map(lambda leaf, j=j: leaf[..., j], mixed) for j in range(count))


def _matched(model: IMM, beliefs: Sequence[Belief], probabilities: Float[Array, " k"]) -> Belief:
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1), *beliefs)
    small = max(dimension(beliefs[0]), len(beliefs)) <= factor.UNROLLED
    return (batch_last(matched) if small else matched)(model.manifold, stacked, probabilities)


def _state(model: IMM, beliefs: tuple[Belief, ...], log_probabilities: Float[Array, " k"]) -> IMMState:
    shown = beliefs
    if model.maps is not None:
        shown = tuple(model.maps.to_common(i, belief) for i, belief in enumerate(beliefs))
    combined = shown[0] if len(shown) == 1 else _matched(model, shown, weights.linear(log_probabilities))
    return IMMState(beliefs, log_probabilities, combined)
