"""A bank of one filter over hypotheses: branch, reject, weigh, merge and prune in a fixed number of slots.

The hypothesis axis is the *first* axis of every leaf: hypotheses are few and their matrices large, so that they are
batches of whole-matrix operations rather than of scalars. A slot that is not used has the log weight `-inf`.
"""

from dataclasses import field
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.typing import AnyKey, as_pytree

UNUSED, KEPT, REJECTED, MERGED, PRUNED, CROWDED_OUT, INVALID = range(7)
"""What became of a candidate: never formed; kept; its margin was negative; it equals a heavier one; its weight was too
small; all slots were taken by heavier ones; its evidence was not finite."""


@runtime_checkable
class Branch(Protocol):
    """Ways to look at one observation from one hypothesis, e.g. at several points of linearisation.

    Returns them stacked, leaves `(b, ...)`, each what `inner.update` takes as an observation, and which of them are
    to be tried. All of them condition the same predicted hypothesis.
    """

    def __call__(self, state: PyTree, observation: PyTree, /) -> tuple[PyTree, Bool[Array, " b"]]: ...


@runtime_checkable
class Margin(Protocol):
    """How far an updated hypothesis is from being rejected; a negative one is."""

    def __call__(self, state: PyTree, info: PyTree, /) -> Float[Array, ""]: ...


@runtime_checkable
class Same(Protocol):
    """Whether two updated hypotheses say the same."""

    def __call__(self, heavier: PyTree, lighter: PyTree, /) -> Bool[Array, ""]: ...


class GaussianSumState(NamedTuple):
    """Weighted hypotheses."""

    components: PyTree
    """States of the inner filter, leaves `(k, ...)`."""
    log_weights: Float[Array, " k"]
    """`logsumexp(log_weights) == 0`; after an update in falling order."""


class GaussianSumInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1) over all candidates that were not rejected; `-inf` if there was none."""
    components: PyTree
    """Infos of the inner filter, leaves `(k, ...)`, for the hypotheses that were kept."""
    parents: Int32[Array, " k"]
    """Slot before the update from which each hypothesis came."""
    branches: Int32[Array, " k"]
    """Which way of looking at the observation made it: 0 is the first."""
    num_hypotheses: Int32[Array, ""]
    """Slots in use."""
    fates: Int32[Array, "k b"]
    """Of every candidate, by parent and branch: `UNUSED` ... `INVALID`."""
    all_rejected: Bool[Array, ""]
    """Whether every candidate had a negative margin, and the one with the largest was kept."""


@pytree_dataclass
class GaussianSum:
    """Parameters of a bank of filters."""

    inner: Filter
    start: GaussianSumState | None
    branch: Branch
    margin: Margin
    same: Same
    log_ratio: float
    capacity: int = field(metadata={"static": True})


def gaussian_sum(
    inner: Filter,
    *,
    capacity: int,
    start: GaussianSumState | None = None,
    branch: Branch | None = None,
    margin: Margin | None = None,
    same: Same | None = None,
    log_ratio: float = 12.0,
) -> Filter:
    """A filter over hypotheses, each of them a state of `inner`, in `capacity` slots.

    An update tries every branch of every hypothesis, drops those with a negative margin (unless all have one: then
    the best stays, and the info says so), weighs them by the `log_evidence` of the inner update, lets the heaviest
    of those that are the same stand for them, and keeps the heaviest `capacity` of them. Merged hypotheses of
    different parents add their weights. Two branches of one parent that arrive at the same place have found one mode
    of its posterior twice, and count once.

    Args:
        inner: Filter of one hypothesis; its info needs `log_evidence`.
        capacity: Number of slots.
        start: Hypotheses before the first observation, at most `capacity`; `None` starts with the one of `inner`.
        branch: Ways to look at an observation; `None` is the observation itself.
        margin: Rejects where negative; `None` rejects nothing.
        same: Merges where true; `None` merges nothing.
        log_ratio: Hypotheses whose log weight is this much below the heaviest one's are dropped.

    Raises:
        ValueError: If `capacity < 1`, `log_ratio <= 0`, or `start` has more hypotheses than `capacity`.
    """
    if not isinstance(capacity, int) or capacity < 1:
        raise ValueError(f"capacity must be an integer of at least 1; got {capacity!r}.")
    if not log_ratio > 0:
        raise ValueError(f"log_ratio must be positive; got {log_ratio!r}.")
    if start is not None and start.log_weights.shape[0] > capacity:
        raise ValueError(f"start must have at most capacity = {capacity} hypotheses; got {start.log_weights.shape[0]}.")
    params = GaussianSum(
        inner,
        start,
        as_pytree(branch or _as_it_is),
        as_pytree(margin or _never_rejected),
        as_pytree(same or _never_the_same),
        float(log_ratio),
        capacity,
    )
    return Filter(params, _init, _predict, _update)


def map_component(state: GaussianSumState) -> PyTree:
    """The inner state of the hypothesis with the largest weight."""
    best = jnp.argmax(state.log_weights)
    return jax.tree.map(lambda leaf: leaf[best], state.components)


def _as_it_is(state, observation):
    del state
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], observation), jnp.ones(1, bool)


def _never_rejected(state, info):
    del state
    return jnp.full_like(info.log_evidence, jnp.inf)


def _never_the_same(heavier, lighter):
    del heavier, lighter
    return jnp.zeros((), bool)


def _init(model: GaussianSum, key: AnyKey) -> GaussianSumState:
    start = model.start
    if start is None:
        only = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], model.inner.init(model.inner.params, key))
        start = GaussianSumState(only, jnp.zeros(1, dtype=float))
    spare = model.capacity - start.log_weights.shape[0]
    # Unused slots hold copies: real numbers, so that what is computed for them stays finite.
    components = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[:1], spare, axis=0)]), start.components
    )
    log_weights = jnp.pad(start.log_weights, (0, spare), constant_values=-jnp.inf)
    return GaussianSumState(components, weights.normalize(log_weights)[0])


def _predict(model: GaussianSum, key: AnyKey, state: GaussianSumState, control: PyTree) -> GaussianSumState:
    keys = jax.random.split(key, model.capacity)
    predict = partial(model.inner.predict, model.inner.params)
    components = jax.vmap(lambda key, component: predict(key, component, control))(keys, state.components)
    return state._replace(components=components)


class _Candidates(NamedTuple):
    """Every branch of every hypothesis, in one row."""

    states: PyTree
    infos: PyTree
    log_weights: Float[Array, " m"]
    """Not normalised."""
    margins: Float[Array, " m"]
    fates: Int32[Array, " m"]
    parents: Int32[Array, " m"]
    branches: Int32[Array, " m"]


def _update(
    model: GaussianSum, key: AnyKey, state: GaussianSumState, observation: PyTree
) -> tuple[GaussianSumState, GaussianSumInfo]:
    candidates, all_rejected = _rejected(_form(model, key, state, observation))
    order = jnp.argsort(-_usable(candidates))
    candidates = jax.tree.map(lambda leaf: leaf[order], candidates)
    candidates = _merged(model.same, candidates)
    log_evidence = weights.normalize(_usable(candidates))[1]
    candidates = _pruned(candidates, model.log_ratio, model.capacity)

    order_kept = jnp.argsort(-_usable(candidates))[: model.capacity]
    kept = jax.tree.map(lambda leaf: leaf[order_kept], candidates)
    dead = log_evidence == -jnp.inf
    normalized, _ = weights.normalize(_usable(kept))
    num_branches = candidates.fates.shape[0] // model.capacity
    info = GaussianSumInfo(
        log_evidence=log_evidence,
        components=kept.infos,
        parents=kept.parents,
        branches=kept.branches,
        num_hypotheses=jnp.sum(kept.fates == KEPT, dtype=jnp.int32),
        fates=jnp.zeros_like(candidates.fates).at[order].set(candidates.fates).reshape(model.capacity, num_branches),
        all_rejected=all_rejected,
    )
    # Where nothing has any weight, the prediction is all that is known.
    after = GaussianSumState(kept.states, normalized)
    return jax.tree.map(lambda new, old: jnp.where(dead, old, new), after, state), info


def _usable(candidates: _Candidates) -> Float[Array, " m"]:
    return jnp.where(candidates.fates == KEPT, candidates.log_weights, -jnp.inf)


def _form(model: GaussianSum, key: AnyKey, state: GaussianSumState, observation: PyTree) -> _Candidates:
    """Update every hypothesis with every branch of the observation that is to be tried."""
    views, tried = jax.vmap(model.branch, (0, None))(state.components, observation)
    tried = tried & (state.log_weights > -jnp.inf)[:, None]
    parents, branches = jnp.indices(tried.shape, dtype=jnp.int32)

    def look(key: AnyKey, component: PyTree, view: PyTree) -> tuple[Any, ...]:
        after, info = model.inner.update(model.inner.params, key, component, view)
        return after, info, model.margin(after, info)

    def pass_over(key: AnyKey, component: PyTree, view: PyTree) -> tuple[Any, ...]:
        _, info, margin = jax.eval_shape(look, key, component, view)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), (info, margin))
        return component, *nothing

    def candidate(inputs: tuple) -> tuple[Any, ...]:
        is_tried, parent, branch = inputs
        component = jax.tree.map(lambda leaf: leaf[parent], state.components)
        view = jax.tree.map(lambda leaf: leaf[parent, branch], views)
        return jax.lax.cond(is_tried, look, pass_over, keys[parent], component, view)

    # One after the other: few are tried in most frames, the others then cost nothing, and the factorisations of
    # large matrices in a batch stand still in jaxlib 0.10 where two of them meet on a machine with two cores.
    keys = jax.random.split(key, model.capacity)
    places = (tried.ravel(), parents.ravel(), branches.ravel())
    states, infos, margins = jax.lax.map(candidate, places)
    gain = infos.log_evidence
    invalid = ~jnp.isfinite(gain) | jnp.isnan(margins)
    fates = jnp.where(places[0], jnp.where(invalid, INVALID, KEPT), UNUSED).astype(jnp.int32)
    log_weights = state.log_weights[places[1]] + gain
    return _Candidates(states, infos, log_weights, margins, fates, places[1], places[2])


def _rejected(candidates: _Candidates) -> tuple[_Candidates, Bool[Array, ""]]:
    """Drop negative margins; where there are no others, all but the largest."""
    alive = candidates.fates == KEPT
    margins = jnp.where(alive, candidates.margins, -jnp.inf)
    all_rejected = jnp.any(alive) & jnp.all(margins < 0)
    best = jnp.arange(len(margins)) == jnp.argmax(margins)
    stays = jnp.where(all_rejected, best, margins >= 0)
    return candidates._replace(fates=jnp.where(alive & ~stays, REJECTED, candidates.fates)), all_rejected


def _merged(same: Same, candidates: _Candidates) -> _Candidates:
    """Let the heaviest stand for all that are the same; candidates come in falling order of weight."""
    alike = jax.vmap(jax.vmap(same, (None, 0)), (0, None))(candidates.states, candidates.states)
    siblings = candidates.parents[:, None] == candidates.parents
    index = jnp.arange(len(candidates.fates))

    def absorb(carry: tuple, j: Array) -> tuple[tuple, None]:
        fates, log_weights = carry
        heavier = (fates == KEPT) & alike[:, j] & (index < j)
        first = jnp.argmax(heavier)
        merges = jnp.any(heavier) & (fates[j] == KEPT)
        adds = merges & ~siblings[first, j]
        gained = jnp.logaddexp(log_weights[first], jnp.where(adds, log_weights[j], -jnp.inf))
        log_weights = log_weights.at[first].set(jnp.where(adds, gained, log_weights[first]))
        return (fates.at[j].set(jnp.where(merges, MERGED, fates[j])), log_weights), None

    (fates, log_weights), _ = jax.lax.scan(absorb, (candidates.fates, candidates.log_weights), index)
    return candidates._replace(fates=fates, log_weights=log_weights)


def _pruned(candidates: _Candidates, log_ratio: float | Array, capacity: int) -> _Candidates:
    usable = _usable(candidates)
    light = (candidates.fates == KEPT) & (usable < jnp.max(usable) - log_ratio)
    fates = jnp.where(light, PRUNED, candidates.fates)
    usable = jnp.where(light, -jnp.inf, usable)
    rank = jnp.argsort(jnp.argsort(-usable))
    return candidates._replace(fates=jnp.where((fates == KEPT) & (rank >= capacity), CROWDED_OUT, fates))
