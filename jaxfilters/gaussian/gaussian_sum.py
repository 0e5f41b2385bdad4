"""Gaussian sums: a bank of filters over hypotheses, which branch, merge and are pruned in a fixed number of slots.

D. L. Alspach and H. W. Sorenson, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE Transactions
on Automatic Control 17(4), 1972.

The hypothesis axis is the *first* axis of every leaf: hypotheses are few and their matrices large, so that they are
batches of whole-matrix operations rather than of scalars. A slot that is not used has the log weight `-inf`.
"""

from dataclasses import field
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.typing import AnyKey, as_pytree, taking_inputs

UNUSED, KEPT, REJECTED, MERGED, PRUNED, CROWDED_OUT, INVALID = range(7)
"""Fates of a candidate: never formed; kept; its margin was negative; merged into one of larger weight; its weight was
too small; all slots were taken by candidates of larger weight; its evidence was not finite."""


@runtime_checkable
class Branch(Protocol):
    """Interpretations of one observation under one hypothesis, e.g. by several points of linearisation.

    Returns them stacked, leaves `(b, ...)`, each an observation for `inner.update`, and which of them are to be tried.
    All of them condition the same predicted hypothesis.
    """

    def __call__(self, state: PyTree, observation: PyTree, inputs: PyTree, /) -> tuple[PyTree, Bool[Array, " b"]]: ...


@runtime_checkable
class Margin(Protocol):
    """How far an updated hypothesis is from being rejected: one with a negative margin is."""

    def __call__(self, state: PyTree, info: PyTree, /) -> Float[Array, ""]: ...


@runtime_checkable
class Same(Protocol):
    """Whether two updated hypotheses, the one of larger weight first, are to be merged."""

    def __call__(self, larger: PyTree, smaller: PyTree, /) -> Bool[Array, ""]: ...


class GaussianSumState(NamedTuple):
    """Weighted hypotheses."""

    components: PyTree
    """States of the inner filter, leaves `(k, ...)`."""
    log_weights: Float[Array, " k"]
    """Normalised, `logsumexp(log_weights) == 0`; in descending order after an update."""


class GaussianSumInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """log p(y_t | y_1:t-1) over all candidates that were not rejected; `-inf` if there was none."""
    components: PyTree
    """Infos of the inner filter, leaves `(k, ...)`, for the hypotheses that were kept."""
    parents: Int32[Array, " k"]
    """Slot before the update from which each hypothesis came."""
    branches: Int32[Array, " k"]
    """Branch of the observation that each hypothesis was updated with; 0 is the first."""
    num_hypotheses: Int32[Array, ""]
    """Number of slots in use."""
    fates: Int32[Array, "k b"]
    """Fate of every candidate, by parent and branch: `UNUSED` ... `INVALID`."""
    all_rejected: Bool[Array, ""]
    """Whether every candidate had a negative margin, and the one with the largest was kept."""


@pytree_dataclass
class GaussianSum:
    """Parameters of a filter made by `gaussian_sum`; its arguments describe them."""

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
    """Gaussian sum filter: a weighted bank of hypotheses, each a state of the filter `inner`, in `capacity` slots.

    An update tries every branch of every hypothesis; rejects those with a negative margin (unless all have one: then
    the one with the largest stays, and the info reports it); weighs them by the `log_evidence` of the inner update;
    merges those that are the same into the one of largest weight; and keeps the `capacity` largest. Merged hypotheses
    of different parents add their weights. Two branches of one parent that arrive at the same state have found one
    mode of its posterior twice, and count once. The state is a `GaussianSumState`, the info a `GaussianSumInfo`.

    Args:
        inner: Filter of one hypothesis; its info needs `log_evidence`.
        capacity: Number of slots, at least 1.
        start: Hypotheses before the first observation, at most `capacity`; `None` starts with the one of `inner`.
        branch: `(state, observation)`, maybe with the inputs of the step after them, to interpretations of the
            observation, see `Branch`; `None` is the observation itself.
        margin: `(state, info) -> margin`; a negative one rejects. `None` rejects nothing.
        same: `(state, state) -> bool`; merges where true. `None` merges nothing.
        log_ratio: Hypotheses whose log weight is this much below the largest are dropped; positive.

    Returns:
        The filter.

    Raises:
        ValueError: If `capacity < 1`, `log_ratio <= 0`, or `start` has more hypotheses than `capacity`, another shape
            than states of `inner`, or log weights that are not numbers.
        TypeError: If `inner` is no filter, `start` no `GaussianSumState`, or `branch`, `margin` or `same` no function.

    Examples:
        Two hypotheses about where a robot starts; the second observation tells them apart.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> inner = jf.extended_kalman(prior, lambda x: x, 0.1 * jnp.eye(1), lambda x: x, 0.1 * jnp.eye(1))
        >>> places = jf.Gaussian(jnp.array([[-5.0], [5.0]]), jnp.ones((2, 1, 1)))
        >>> start = jf.GaussianSumState(places, jnp.log(jnp.array([0.5, 0.5])))
        >>> filter = jf.gaussian_sum(inner, capacity=4, start=start)
        >>> last, _ = jf.run(filter, jax.random.key(0), jnp.array([[4.0], [4.5]]))
        >>> bool(jf.map_component(last).mean[0] > 0)
        True
    """
    checks.is_filter("inner", inner)
    if not isinstance(capacity, int) or capacity < 1:
        raise ValueError(f"capacity must be an integer of at least 1; got {capacity!r}.")
    if not log_ratio > 0:
        raise ValueError(f"log_ratio must be positive; got {log_ratio!r}.")
    for name, value in (("branch", branch), ("margin", margin), ("same", same)):
        if value is not None:
            checks.function(name, value)
    if start is not None:
        _check_start(inner, start, capacity)
    params = GaussianSum(
        inner,
        start,
        taking_inputs("branch", branch or _unchanged, "state", "observation"),
        as_pytree(margin or _never_rejected),
        as_pytree(same or _never_the_same),
        float(log_ratio),
        capacity,
    )
    return Filter(params, _init, _predict, _update)


def _check_start(inner, start, capacity):
    if not isinstance(start, GaussianSumState):
        raise TypeError(f"start must be a GaussianSumState; got a {type(start).__name__}.")
    checks.floating("start.log_weights", start.log_weights)
    count = start.log_weights.shape
    if len(count) != 1 or count[0] < 1:
        raise ValueError(f"start.log_weights must have the shape (k,), k at least 1; got {count}.")
    if count[0] > capacity:
        raise ValueError(f"start must have at most capacity = {capacity} hypotheses; got {count[0]}.")
    log_weights = checks.concrete(start.log_weights)
    if log_weights is not None and not np.isfinite(np.max(log_weights)):
        raise ValueError(f"start.log_weights must have a finite maximum; got {np.max(log_weights)}.")
    one = jax.eval_shape(inner.init, inner.params, jax.eval_shape(jax.random.key, 0))
    # As text: structures compare as equal where two classes have the same number of fields.
    wanted, got = str(jax.tree.structure(one)), str(jax.tree.structure(start.components))
    if wanted != got:
        raise ValueError(f"start.components must be states of inner, {wanted}, stacked; got {got}.")
    leaves = zip(jax.tree_util.tree_leaves_with_path(start.components), jax.tree.leaves(one), strict=True)
    for (path, leaf), single in leaves:
        if jnp.shape(leaf) != (*count, *single.shape):
            raise ValueError(
                f"start.components{jax.tree_util.keystr(path)} must have the shape {(*count, *single.shape)}, one "
                f"state of inner for each of the log weights; got {jnp.shape(leaf)}."
            )


def map_component(state: GaussianSumState) -> PyTree:
    """State of `inner` in the hypothesis with the largest weight.

    Args:
        state: State of a `gaussian_sum` filter; for states with time first, use `jax.vmap(map_component)`.

    Returns:
        The state, e.g. a `Gaussian`.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> places = jf.Gaussian(jnp.array([[-5.0], [5.0]]), jnp.ones((2, 1, 1)))
        >>> state = jf.GaussianSumState(places, jnp.log(jnp.array([0.2, 0.8])))
        >>> jf.map_component(state).mean.tolist()
        [5.0]
    """
    best = jnp.argmax(state.log_weights)
    return jax.tree.map(lambda leaf: leaf[best], state.components)


def _unchanged(state, observation):
    del state
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], observation), jnp.ones(1, bool)


def _never_rejected(state, info):
    del state
    return jnp.full_like(info.log_evidence, jnp.inf)


def _never_the_same(larger, smaller):
    del larger, smaller
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


def _predict(model: GaussianSum, key: AnyKey, state: GaussianSumState, inputs: PyTree) -> GaussianSumState:
    keys = jax.random.split(key, model.capacity)
    predict = partial(model.inner.predict, model.inner.params)
    components = jax.vmap(lambda key, component: predict(key, component, inputs))(keys, state.components)
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
    model: GaussianSum, key: AnyKey, state: GaussianSumState, observation: PyTree, inputs: PyTree
) -> tuple[GaussianSumState, GaussianSumInfo]:
    candidates, all_rejected = _rejected(_form(model, key, state, observation, inputs))
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


def _form(model: GaussianSum, key: AnyKey, state: GaussianSumState, observation: PyTree, inputs: PyTree) -> _Candidates:
    """Update every hypothesis with every branch of the observation that is to be tried."""
    readings, tried = jax.vmap(model.branch, (0, None, None))(state.components, observation, inputs)
    tried = tried & (state.log_weights > -jnp.inf)[:, None]
    parents, branches = jnp.indices(tried.shape, dtype=jnp.int32)

    def update(key: AnyKey, component: PyTree, reading: PyTree) -> tuple[Any, ...]:
        after, info = model.inner.update(model.inner.params, key, component, reading, inputs)
        margin = model.margin(after, info)
        if jnp.shape(margin) != ():
            raise ValueError(f"margin must return one number; got the shape {jnp.shape(margin)}.")
        return after, info, margin

    def skip(key: AnyKey, component: PyTree, reading: PyTree) -> tuple[Any, ...]:
        _, info, margin = jax.eval_shape(update, key, component, reading)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), (info, margin))
        return component, *nothing

    def candidate(place: tuple) -> tuple[Any, ...]:
        is_tried, parent, branch = place
        component = jax.tree.map(lambda leaf: leaf[parent], state.components)
        reading = jax.tree.map(lambda leaf: leaf[parent, branch], readings)
        return jax.lax.cond(is_tried, update, skip, keys[parent], component, reading)

    # One after the other: few are tried in most frames, and the others then cost nothing. In a batch, factorisations
    # of large matrices can deadlock in jaxlib 0.10 where two of them meet on a machine with two cores.
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
    """Merge all that are the same into the one of largest weight; candidates come in descending order of weight."""
    found = jax.eval_shape(same, *[jax.tree.map(lambda leaf: leaf[0], candidates.states)] * 2)
    if getattr(found, "shape", None) != ():
        raise ValueError(f"same must return one boolean; got the shape {getattr(found, 'shape', None)}.")
    alike = jax.vmap(jax.vmap(same, (None, 0)), (0, None))(candidates.states, candidates.states)
    index = jnp.arange(len(candidates.fates))
    # Which parents' weights each candidate has: branches of one parent that merge count once.
    has = candidates.parents[:, None] == index

    def absorb(carry: tuple, j: Array) -> tuple[tuple, None]:
        fates, log_weights, has = carry
        larger = (fates == KEPT) & alike[:, j] & (index < j)
        first = jnp.argmax(larger)
        merges = jnp.any(larger) & (fates[j] == KEPT)
        parent = candidates.parents[j]
        adds = merges & ~has[first, parent]
        gained = jnp.logaddexp(log_weights[first], jnp.where(adds, log_weights[j], -jnp.inf))
        log_weights = log_weights.at[first].set(jnp.where(adds, gained, log_weights[first]))
        has = has.at[first, parent].set(has[first, parent] | merges)
        return (fates.at[j].set(jnp.where(merges, MERGED, fates[j])), log_weights, has), None

    (fates, log_weights, _), _ = jax.lax.scan(absorb, (candidates.fates, candidates.log_weights, has), index)
    return candidates._replace(fates=fates, log_weights=log_weights)


def _pruned(candidates: _Candidates, log_ratio: float | Array, capacity: int) -> _Candidates:
    usable = _usable(candidates)
    light = (candidates.fates == KEPT) & (usable < jnp.max(usable) - log_ratio)
    fates = jnp.where(light, PRUNED, candidates.fates)
    usable = jnp.where(light, -jnp.inf, usable)
    rank = jnp.argsort(jnp.argsort(-usable))
    return candidates._replace(fates=jnp.where((fates == KEPT) & (rank >= capacity), CROWDED_OUT, fates))
