"""Gaussian filters under linear inequalities: after every update the belief is truncated to the constraints.

Truncating the belief of a Kalman filter is described by D. Simon, D. L. Simon, "Constrained Kalman filtering via
density function truncation for turbofan engine health estimation", International Journal of Systems Science, 2010.
"""

from collections.abc import Callable
from dataclasses import field, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.constraints import expectation_propagation
from jaxfilters.gaussian.constraints.constant_rows import check_constant
from jaxfilters.gaussian.constraints.info import TruncationInfo
from jaxfilters.gaussian.constraints.linear import LinearConstraints, check_rows, check_width
from jaxfilters.gaussian.constraints.resolution import check_resolution
from jaxfilters.gaussian.constraints.sites import Sites, initial_sites
from jaxfilters.typing import AnyKey


@runtime_checkable
class Constrain(Protocol):
    """A rule that truncates beliefs, with a memory that is carried from one step to the next."""

    def start(self) -> PyTree:
        """The memory before the first truncation."""

    def __call__(self, belief: Any, memory: PyTree, /) -> tuple[Any, PyTree, TruncationInfo]:
        """The truncated belief, the new memory, and diagnostics."""


class ConstrainedState(NamedTuple):
    """State of a constrained filter."""

    belief: Any
    """The truncated belief: the `Gaussian` or `GaussianRoot` that is the state of the inner filter."""
    memory: PyTree
    """Memory of the constraints; for `EPConstraints` the `Sites` that the belief contains."""


class ConstrainedInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """Log density of the observation and of the inequalities, given everything before them."""
    inner: PyTree
    """Info of the inner filter."""
    truncation: TruncationInfo
    """Diagnostics of the truncation; its `distances` are those before it."""
    least_distance: Float[Array, ""]
    """The smallest of these distances, in standard deviations; negative outside of the bounds."""


@pytree_dataclass
class TruncateEachStep:
    """Truncates the belief in every step as if it had not been truncated before.

    This is right for constraints on quantities that move between the steps. A constraint on a constant quantity counts
    as often as there are steps, and the belief shrinks with each of them: use `EPConstraints` for such rows.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> rows = jf.constraints.linear_constraints([[1.0, 0.0]], lower=0.0, upper=jnp.inf)
        >>> rule = jf.TruncateEachStep(rows, jf.constraints.cut.sequential_intervals)
    """

    constraints: LinearConstraints
    """The k rows."""
    method: Callable = field(metadata={"static": True})
    """`(belief, constraints) -> (belief, info)`, e.g. `jf.constraints.cut.sequential_intervals`."""

    def start(self) -> tuple:
        """No memory."""
        return ()

    def __call__(self, belief: Any, memory: tuple) -> tuple[Any, tuple, TruncationInfo]:
        """The truncated belief, no memory, and diagnostics."""
        belief, info = self.method(belief, self.constraints)
        return belief, memory, info


@pytree_dataclass
class EPConstraints:
    """Truncates by expectation propagation, and counts rows on constant quantities once.

    The sites of the lasting rows stay in the belief and are replaced in the next step. The sites of the other rows
    start anew in each step.

    A row may be declared lasting only where `normal^T x` is constant in time: no process noise along the normal, and a
    transition f with `normal^T f(x) = normal^T x`. On a quantity that moves, an old site would be divided out of a
    belief that no longer contains it, and the result would be wrong: declare such a row as not lasting.
    `jf.constrained` raises an error where it can verify this, which is for filters made by `jf.kalman`,
    `jf.extended_kalman` and their variants with known matrices. For any other filter it is the caller's duty.

    Examples:
        A position that moves and must stay above 0, and a length between 1 and 2 that is constant:

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> rows = jf.constraints.linear_constraints([[1.0, 0.0], [0.0, 1.0]], [0.0, 1.0], [jnp.inf, 2.0])
        >>> rule = jf.EPConstraints(rows, lasting=jnp.array([False, True]))
    """

    constraints: LinearConstraints
    """The k rows."""
    lasting: Bool[Array, " k"]
    """True for rows whose value `normal^T x` is constant in time."""

    def start(self) -> Sites:
        """Factors of one."""
        return initial_sites(self.constraints)

    def __call__(self, belief: Any, memory: Sites) -> tuple[Any, Sites, TruncationInfo]:
        """The truncated belief, the sites of the lasting rows, and diagnostics."""
        belief, sites, info = expectation_propagation.truncate(belief, self.constraints, memory)
        return belief, sites.select(self.lasting), info


@pytree_dataclass
class Constrained:
    """Parameters of a filter with inequalities."""

    inner: Filter
    constrain: Constrain


def constrained(inner: Filter, constrain: Constrain) -> Filter:
    """Filter under linear inequalities: the belief of `inner` is truncated after every update.

    The truncated belief is carried on: the next step is predicted from it, and linearised at its mean. The state is a
    `ConstrainedState` and the info a `ConstrainedInfo`, whose `log_evidence` includes the inequalities.

    Args:
        inner: A filter whose state is a `Gaussian` or a `GaussianRoot` and whose info has `log_evidence`.
        constrain: `EPConstraints(constraints, lasting)`, `TruncateEachStep(constraints, method)`, or any callable
            pytree with the methods of `Constrain`.

    Returns:
        The constrained filter. It takes the observations and inputs of `inner`.

    Raises:
        TypeError: `inner` or `constrain` is of the wrong kind, the state of `inner` is not Gaussian, or
            `constrain.lasting` is not Boolean.
        ValueError: The rows do not fit the state, their numbers are not valid, a row that is declared lasting moves in
            time, or one is too narrow for a covariance in float32. Values are checked where they are known, that is,
            not under `jit` or `grad`.

    Examples:
        A random walk that stays above 0:

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> inner = jf.kalman(jf.Gaussian(jnp.ones(1), one), one, 0.1 * one, one, 0.5 * one)
        >>> rows = jf.constraints.linear_constraints([[1.0]], lower=0.0, upper=jnp.inf)
        >>> filter = jf.constrained(inner, jf.EPConstraints(rows, lasting=jnp.array([False])))
        >>> state, (states, infos) = jf.run(filter, jax.random.key(0), jnp.array([[0.3], [-0.4], [-0.2]]))
        >>> bool((states.belief.mean > 0).all())
        True
    """
    if not isinstance(inner, Filter):
        raise TypeError(f"inner: expected a Filter; got {type(inner).__name__}.")
    if not isinstance(constrain, Constrain):
        raise TypeError(
            f"constrain: expected EPConstraints, TruncateEachStep or a Constrain; got {type(constrain).__name__}."
        )
    if isinstance(constrain, EPConstraints | TruncateEachStep):
        constrain = _checked(inner, constrain)
    return Filter(Constrained(inner, constrain), _init, _predict, _update)


def _checked(inner, constrain):
    state = jax.eval_shape(inner.init, inner.params, jax.eval_shape(jax.random.key, 0))
    if not isinstance(state, Gaussian | GaussianRoot):
        raise TypeError(
            f"inner: expected a filter whose state is a Gaussian or a GaussianRoot; its state is a "
            f"{type(state).__name__}."
        )
    check_rows(constrain.constraints)
    check_width(state, constrain.constraints)
    if isinstance(constrain, TruncateEachStep):
        if not callable(constrain.method):
            raise TypeError(f"method: expected a function (belief, constraints) -> (belief, info); got {constrain!r}.")
        return constrain
    lasting, rows = jnp.asarray(constrain.lasting), len(constrain.constraints.names)
    if lasting.dtype != bool:
        raise TypeError(f"lasting: expected Booleans, one for each row; got {lasting.dtype} of shape {lasting.shape}.")
    if lasting.shape != (rows,):
        raise ValueError(f"lasting: expected shape ({rows},), one for each row; got {lasting.shape}.")
    check_constant(inner, constrain.constraints, lasting)
    check_resolution(inner, constrain.constraints, lasting)
    return replace(constrain, lasting=lasting)


def _init(model: Constrained, key: AnyKey) -> ConstrainedState:
    return ConstrainedState(model.inner.init(model.inner.params, key), model.constrain.start())


def _predict(model: Constrained, key: AnyKey, state: ConstrainedState, inputs: PyTree) -> ConstrainedState:
    return state._replace(belief=model.inner.predict(model.inner.params, key, state.belief, inputs))


def _update(
    model: Constrained, key: AnyKey, state: ConstrainedState, observation: PyTree, inputs: PyTree
) -> tuple[ConstrainedState, ConstrainedInfo]:
    belief, info = model.inner.update(model.inner.params, key, state.belief, observation, inputs)
    belief, memory, truncation = model.constrain(belief, state.memory)
    log_evidence = info.log_evidence + truncation.log_mass
    report = ConstrainedInfo(log_evidence, info, truncation, jnp.min(truncation.distances))
    return ConstrainedState(belief, memory), report
