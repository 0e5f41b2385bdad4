"""The type of all filters, and the functions that run them over a sequence.

Time convention: `init` is the belief *before* the first observation. Each step predicts, then updates. A frame without
an observation is a prediction without an update.
"""

from collections.abc import Callable
from dataclasses import field
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters._renamed import takes_inputs
from jaxfilters._struct import pytree_dataclass
from jaxfilters.typing import AnyKey, Collect, Init, Predict, Update


@pytree_dataclass
class Filter:
    """A recursive Bayesian filter: static pure functions and traced parameters.

    It is a pytree, and therefore an argument of `jit`, `vmap` and `grad`: `jax.grad(loss)(filter)` differentiates with
    respect to its parameters. Builders such as `extended_kalman` and `bootstrap` return filters.
    """

    params: PyTree
    """Arrays that the functions need: noise scales, geometry, cameras, the user's own model."""
    init: Init = field(metadata={"static": True})
    """`(params, key) -> state`, the belief before the first observation."""
    predict: Predict = field(metadata={"static": True})
    """`(params, key, state, inputs) -> state`, one step ahead."""
    update: Update = field(metadata={"static": True})
    """`(params, key, state, observation, inputs) -> (state, info)`; `info.log_evidence` is log p(y_t | y_1:t-1)."""


def keep_all(state: PyTree, info: PyTree) -> tuple[PyTree, PyTree]:
    """Collect the state and the info of every step.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> filter = jf.kalman(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), *[jnp.eye(1)] * 4)
        >>> last, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.ones((5, 1)), collect=jf.keep_all)
        >>> beliefs.mean.shape, infos.log_evidence.shape
        ((5, 1), (5,))
    """
    return state, info


def keep_info(state: PyTree, info: PyTree) -> PyTree:
    """Collect the info of every step.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> filter = jf.kalman(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), *[jnp.eye(1)] * 4)
        >>> last, infos = jf.run(filter, jax.random.key(0), jnp.ones((5, 1)), collect=jf.keep_info)
        >>> infos.log_evidence.shape
        (5,)
    """
    del state
    return info


@jax.jit
def init(filter: Filter, key: AnyKey) -> PyTree:
    """State of a filter before the first observation.

    Args:
        filter: The filter.
        key: Random key; deterministic filters ignore it.

    Returns:
        The state.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> filter = jf.kalman(jf.Gaussian(jnp.array([2.0]), one), one, one, one, one)
        >>> jf.init(filter, jax.random.key(0)).mean.tolist()
        [2.0]
    """
    # Weakly typed leaves (from Python numbers) would change type in the first step and compile it twice.
    return jax.tree.map(_strongly_typed, filter.init(filter.params, key))


@jax.jit
@takes_inputs
def predict(filter: Filter, key: AnyKey, state: PyTree, inputs: PyTree = None) -> PyTree:
    """State one time step ahead, before the next observation.

    Args:
        filter: The filter.
        key: Random key; deterministic filters ignore it. The state of a filter that samples may hold the random numbers
            of this prediction already; the key then draws those of the next one, and predictions of one state with
            several keys are the same.
        state: State after the last observation.
        inputs: Known inputs of the step, or `None`.

    Returns:
        The predicted state.

    Examples:
        Process noise of variance 3 adds to the variance 1 of the prior.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior, one = jf.Gaussian(jnp.array([2.0]), jnp.eye(1)), jnp.eye(1)
        >>> filter = jf.kalman(prior, one, 3.0 * one, one, one)
        >>> ahead = jf.predict(filter, jax.random.key(0), prior)
        >>> ahead.mean.tolist(), ahead.covariance.tolist()
        ([2.0], [[4.0]])
    """
    return filter.predict(filter.params, key, state, inputs)


@jax.jit
def update(
    filter: Filter, key: AnyKey, state: PyTree, observation: PyTree, inputs: PyTree = None
) -> tuple[PyTree, PyTree]:
    """State given one more observation, and the diagnostics of the update.

    Args:
        filter: The filter.
        key: Random key; deterministic filters ignore it.
        state: Predicted state.
        observation: One observation, without a time axis.
        inputs: Known inputs of the step, those that the prediction had, or `None`.

    Returns:
        The state, and the info of the filter, whose `log_evidence` is log p(y_t | y_1:t-1).

    Examples:
        An observation that is as uncertain as the belief moves its mean halfway, and halves its variance.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior, one = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> filter = jf.kalman(prior, one, one, one, one)
        >>> belief, info = jf.update(filter, jax.random.key(0), prior, jnp.array([4.0]))
        >>> round(float(belief.mean[0]), 3), round(float(belief.covariance[0, 0]), 3)
        (2.0, 0.5)
    """
    return filter.update(filter.params, key, state, observation, inputs)


@jax.jit
@takes_inputs
def step(
    filter: Filter, key: AnyKey, state: PyTree, observation: PyTree, inputs: PyTree = None
) -> tuple[PyTree, PyTree]:
    """State after one prediction and one update, and the diagnostics: for observations that arrive one by one.

    Args:
        filter: The filter.
        key: Random key, a new one for every step; deterministic filters ignore it.
        state: State after the last observation; `init` gives the first.
        observation: One observation, without a time axis.
        inputs: Known inputs of the step, or `None`.

    Returns:
        The state, and the info of the filter.

    Examples:
        The prediction has the variance 1 + 1, and the observation noise the same: the mean moves halfway.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> filter = jf.kalman(jf.Gaussian(jnp.zeros(1), one), one, one, one, 2.0 * one)
        >>> state = jf.init(filter, jax.random.key(0))
        >>> state, info = jf.step(filter, jax.random.key(1), state, jnp.array([4.0]))
        >>> round(float(state.mean[0]), 3), round(float(state.covariance[0, 0]), 3)
        (2.0, 1.0)
    """
    predict_key, update_key = jax.random.split(key)
    state = filter.predict(filter.params, predict_key, state, inputs)
    return filter.update(filter.params, update_key, state, observation, inputs)


@takes_inputs
def run(
    filter: Filter,
    key: AnyKey,
    observations: PyTree,
    inputs: PyTree = None,
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
        inputs: Pytree of known inputs, time first: those of a step belong to the transition to it and to its
            observation. The model's functions get them where they ask for them, see `jf.typing`. `None` passes `None`.
        mask: Booleans (t,), `False` for frames without an observation: there the filter only predicts, and the info is
            all zeros. The observations of such a frame, NaN included, have no effect on values or gradients.
        state: State to start from, e.g. the first result of an earlier `run`; `None` starts from `filter.init`.
        collect: `(state, info) -> pytree` to keep of each step, such as `keep_all` and `keep_info`. It is compared by
            identity: pass a module-level function, or each call compiles anew.

    Returns:
        The last state, and the results of `collect`, stacked along time: `(states, infos)` by default.

    Raises:
        ValueError: If the leaves of `observations`, `inputs` and `mask` do not share one length, or `mask` is not of
            shape (t,).
        TypeError: If `filter` is no `Filter`, or `mask` no boolean array.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> filter = jf.extended_kalman(prior, lambda x, inputs: x, 0.1 * jnp.eye(1), lambda x: x, jnp.eye(1))
        >>> last, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.ones((5, 1)))
        >>> beliefs.mean.shape
        (5, 1)
    """
    _check_run(filter, mask)
    _check_lengths(observations, inputs, mask)
    init_key, scan_key = jax.random.split(key)
    if state is None:
        state = init(filter, init_key)
    return _scan(filter, scan_key, state, observations, inputs, mask, collect)


@takes_inputs
def log_evidence(
    filter: Filter,
    key: AnyKey,
    observations: PyTree,
    inputs: PyTree = None,
    *,
    mask: Bool[Array, " t"] | None = None,
) -> Float[Array, ""]:
    """Marginal log-likelihood log p(y_1:T) of a sequence (its log evidence), differentiable in `filter`.

    For a particle filter this is the logarithm of an unbiased estimate.

    Args:
        filter: The filter.
        key: Random key; deterministic filters ignore it.
        observations: Pytree whose leaves have time as their first axis.
        inputs: Pytree of known inputs, time first, as for `run`, or `None`.
        mask: Booleans (t,), `False` for frames without an observation; these add nothing.

    Returns:
        The sum of the log evidences of all frames, in nats.

    Raises:
        ValueError: As for `run`.
        TypeError: As for `run`.

    Examples:
        One observation at its predicted value, whose variance is 1 + 1 + 2.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> filter = jf.kalman(jf.Gaussian(jnp.zeros(1), one), one, one, one, 2.0 * one)
        >>> round(float(jf.log_evidence(filter, jax.random.key(0), jnp.zeros((1, 1)))), 3)
        -1.612
        >>> round(float(-0.5 * jnp.log(2 * jnp.pi * 4.0)), 3)
        -1.612
    """
    _, log_evidence = run(filter, key, observations, inputs, mask=mask, collect=_keep_log_evidence)
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
    inputs: PyTree,
    mask: Array | None,
    collect: Collect,
) -> tuple[PyTree, PyTree]:
    def body(state: PyTree, frame: tuple) -> tuple[PyTree, PyTree]:
        (predict_key, update_key), observation, inputs, is_observed = frame
        state = filter.predict(filter.params, predict_key, state, inputs)

        def update(state: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
            return filter.update(filter.params, update_key, state, observation, inputs)

        if is_observed is None:
            state, info = update(state, observation)
        else:
            state, info = _update_if(is_observed, update, state, observation)
        return state, collect(state, info)

    # The keys that `step` would make of one for each step, all at once.
    keys = jax.vmap(jax.random.split, out_axes=1)(jax.random.split(key, _length(observations)))
    return jax.lax.scan(body, state, ((keys[0], keys[1]), observations, inputs, mask))


def _update_if(
    is_observed: Bool[Array, ""], update: Callable, state: PyTree, observation: PyTree
) -> tuple[PyTree, PyTree]:
    # A frame without an observation often holds NaN; under `vmap` both branches run, and NaN times zero would poison
    # gradients.
    observation = jax.tree.map(lambda y: jnp.where(is_observed, y, jnp.zeros_like(y)), observation)
    _, info = jax.eval_shape(update, state, observation)

    def skip(state: PyTree, observation: PyTree) -> tuple[PyTree, PyTree]:
        del observation
        return state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), info)

    return jax.lax.cond(is_observed, update, skip, state, observation)


def _strongly_typed(leaf: Array) -> Array:
    return jax.lax.convert_element_type(leaf, leaf.dtype) if hasattr(leaf, "dtype") else jnp.asarray(leaf)


def _length(observations: PyTree) -> int:
    return jax.tree.leaves(observations)[0].shape[0]


def _check_run(filter: Filter, mask: PyTree) -> None:
    if not isinstance(filter, Filter):
        raise TypeError(f"filter must be a Filter, as the builders return; got a {type(filter).__name__}.")
    if mask is None:
        return
    if not jnp.issubdtype(getattr(mask, "dtype", float), jnp.bool_):
        raise TypeError(f"mask must be a boolean array; got {getattr(mask, 'dtype', type(mask).__name__)}.")
    if mask.ndim != 1:
        raise ValueError(
            f"mask must have the shape (t,), one boolean a frame; got {mask.shape}. "
            "Components of Gaussian observations are masked by Observation(y, mask)."
        )


def _check_lengths(observations: PyTree, inputs: PyTree, mask: PyTree) -> None:
    lengths = {
        f"{name}{jax.tree_util.keystr(path)}": jnp.shape(leaf)[:1]
        for name, tree in (("observations", observations), ("inputs", inputs), ("mask", mask))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
    if not any(name.startswith("observations") for name in lengths):
        raise ValueError("observations must have at least one array leaf with time as its first axis; got none.")
    if len(set(lengths.values())) != 1 or () in lengths.values():
        shown = ", ".join(f"{name}: {shape[0] if shape else 'a scalar'}" for name, shape in lengths.items())
        raise ValueError(f"observations, inputs and mask must share one length along their first axis; got {shown}.")
