"""What a filter is, and how it runs.

Time convention: `init` is the belief *before* the first observation. Each step predicts, then updates. A frame that was
not seen is a prediction without an update.
"""

from collections.abc import Callable
from dataclasses import field
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.typing import AnyKey, Collect, Init, Predict, Update


@pytree_dataclass
class Filter:
    """A recursive Bayesian filter: static pure functions and traced parameters.

    It is a pytree, hence a legal argument of `jit`, `vmap` and `grad`: `jax.grad(loss)(filter)` differentiates its
    parameters.
    """

    params: PyTree
    """Whatever the functions need: noise scales, geometry, cameras, the user's own model."""
    init: Init = field(metadata={"static": True})
    """`(params, key) -> state`."""
    predict: Predict = field(metadata={"static": True})
    """`(params, key, state, control) -> state`, one step ahead."""
    update: Update = field(metadata={"static": True})
    """`(params, key, state, observation) -> (state, info)`; `info.log_evidence` is log p(y_t | y_1:t-1)."""


def keep_all(state: PyTree, info: PyTree) -> tuple[PyTree, PyTree]:
    """Collect the state and the info of every step."""
    return state, info


def keep_info(state: PyTree, info: PyTree) -> PyTree:
    """Collect the info of every step."""
    del state
    return info


@jax.jit
def init(filter: Filter, key: AnyKey) -> PyTree:
    """Belief before the first observation."""
    # Weakly typed leaves (from Python numbers) would change type in the first step and compile it twice.
    return jax.tree.map(_strongly_typed, filter.init(filter.params, key))


@jax.jit
def predict(filter: Filter, key: AnyKey, state: PyTree, control: PyTree = None) -> PyTree:
    """One time step ahead."""
    return filter.predict(filter.params, key, state, control)


@jax.jit
def update(filter: Filter, key: AnyKey, state: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
    """Condition on an observation."""
    return filter.update(filter.params, key, state, observation)


@jax.jit
def step(
    filter: Filter, key: AnyKey, state: PyTree, observation: PyTree, control: PyTree = None
) -> tuple[PyTree, PyTree]:
    """Predict, then update: the belief after `observation`, and its diagnostics."""
    predict_key, update_key = jax.random.split(key)
    state = filter.predict(filter.params, predict_key, state, control)
    return filter.update(filter.params, update_key, state, observation)


def run(
    filter: Filter,
    key: AnyKey,
    observations: PyTree,
    controls: PyTree = None,
    *,
    mask: Bool[Array, " t"] | None = None,
    state: PyTree = None,
    collect: Collect = keep_all,
) -> tuple[PyTree, PyTree]:
    """Filter a sequence with one compiled scan.

    Args:
        filter: The filter; its functions are static, its parameters traced: a second call compiles nothing.
        key: Random key; deterministic filters ignore it.
        observations: Pytree whose leaves have time as their first axis.
        controls: Pytree of known inputs, time first; `None` passes `None` to every prediction.
        mask: `False` where a frame was not seen: the filter predicts only, and the info of that frame is all zeros.
            What the observations hold there, NaN included, has no effect on values or gradients.
        state: Belief to start from, e.g. the first result of an earlier `run`; `None` starts from `filter.init`.
        collect: `(state, info) -> what to keep of each step`. Compared by identity: pass a module-level function.

    Returns:
        The last state, and what `collect` kept, stacked along time.

    Raises:
        ValueError: If the leaves of `observations`, `controls` and `mask` do not share one length.
    """
    _check_lengths(observations, controls, mask)
    init_key, scan_key = jax.random.split(key)
    if state is None:
        state = init(filter, init_key)
    return _scan(filter, scan_key, state, observations, controls, mask, collect)


def log_evidence(
    filter: Filter,
    key: AnyKey,
    observations: PyTree,
    controls: PyTree = None,
    *,
    mask: Bool[Array, " t"] | None = None,
) -> Float[Array, ""]:
    """Log evidence log p(y_1:T) of a sequence, differentiable in `filter`.

    For a particle filter this is the logarithm of an unbiased estimate.
    """
    _, log_evidence = run(filter, key, observations, controls, mask=mask, collect=_keep_log_evidence)
    return log_evidence.sum()


def _keep_log_evidence(state: PyTree, info: PyTree) -> Float[Array, ""]:
    del state
    return info.log_evidence


@partial(jax.jit, static_argnames="collect")
def _scan(
    filter: Filter,
    key: AnyKey,
    state: PyTree,
    observations: PyTree,
    controls: PyTree,
    mask: Array | None,
    collect: Collect,
) -> tuple[PyTree, PyTree]:
    def body(state: PyTree, inputs: tuple) -> tuple[PyTree, PyTree]:
        step_key, observation, control, seen = inputs
        predict_key, update_key = jax.random.split(step_key)
        state = filter.predict(filter.params, predict_key, state, control)
        update = partial(filter.update, filter.params, update_key)
        state, info = update(state, observation) if seen is None else _update_if(seen, update, state, observation)
        return state, collect(state, info)

    keys = jax.random.split(key, _length(observations))
    return jax.lax.scan(body, state, (keys, observations, controls, mask))


def _update_if(seen: Bool[Array, ""], update: Callable, state: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
    # An unseen frame often holds NaN; under `vmap` both branches run, and NaN times zero would poison gradients.
    observation = jax.tree.map(lambda y: jnp.where(seen, y, jnp.zeros_like(y)), observation)
    _, info = jax.eval_shape(update, state, observation)

    def skip(state: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
        del observation
        return state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), info)

    return jax.lax.cond(seen, update, skip, state, observation)


def _strongly_typed(leaf: Array) -> Array:
    return jax.lax.convert_element_type(leaf, leaf.dtype) if hasattr(leaf, "dtype") else jnp.asarray(leaf)


def _length(observations: PyTree) -> int:
    return jax.tree.leaves(observations)[0].shape[0]


def _check_lengths(observations: PyTree, controls: PyTree, mask: PyTree) -> None:
    lengths = {
        f"{name}{jax.tree_util.keystr(path)}": jnp.shape(leaf)[:1]
        for name, tree in (("observations", observations), ("controls", controls), ("mask", mask))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
    if not any(name.startswith("observations") for name in lengths):
        raise ValueError("observations must have at least one array leaf with time as its first axis; got none.")
    if len(set(lengths.values())) != 1 or () in lengths.values():
        shown = ", ".join(f"{name}: {shape[0] if shape else 'a scalar'}" for name, shape in lengths.items())
        raise ValueError(f"observations, controls and mask must share one length along their first axis; got {shown}.")
