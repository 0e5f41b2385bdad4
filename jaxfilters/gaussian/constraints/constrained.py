"""Linear inequalities as a hook of any Gaussian filter: after each update, the belief is cut by what must hold."""

from dataclasses import field
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.constraints import LinearConstraints, TruncationInfo, expectation_propagation, initial_sites
from jaxfilters.typing import AnyKey


@runtime_checkable
class Constrain(Protocol):
    """A way to cut beliefs, with a memory from frame to frame."""

    def start(self) -> PyTree:
        """The memory before the first cut."""

    def __call__(self, belief: Any, memory: PyTree, /) -> tuple[Any, PyTree, TruncationInfo]:
        """The belief after the cut, the new memory, and diagnostics."""


class ConstrainedState(NamedTuple):
    """A belief that has been cut."""

    belief: Any
    """`Gaussian` or `GaussianRoot`, the state of the inner filter."""
    memory: PyTree
    """Of the constraints."""


class ConstrainedInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    """Log density of the observation and of the inequalities, given all before them."""
    inner: PyTree
    """Info of the inner filter."""
    truncation: TruncationInfo
    """Its `distances` are those before the cut."""
    least_distance: Float[Array, ""]
    """The smallest of them, in standard deviations; negative outside."""


@pytree_dataclass
class TruncateEachStep:
    """Cuts as if nothing had been cut before; what lasts is then counted as often as there are frames."""

    constraints: LinearConstraints
    method: Any = field(metadata={"static": True})
    """`(belief, constraints) -> (belief, info)`, e.g. `truncation.cut.sequential_halfspaces`."""

    def start(self):
        return ()

    def __call__(self, belief, memory):
        belief, info = self.method(belief, self.constraints)
        return belief, memory, info


@pytree_dataclass
class EPConstraints:
    """Cuts by expectation propagation, and counts rows about things that never change only once.

    The sites of the lasting rows stay in the belief and are replaced the next time; the others have done their
    part when the state moves on, and begin anew.
    """

    constraints: LinearConstraints
    lasting: Bool[Array, " k"]
    """Rows whose value is constant in time."""

    def start(self):
        return initial_sites(self.constraints)

    def __call__(self, belief, memory):
        belief, sites, info = expectation_propagation.truncate(belief, self.constraints, memory)
        return belief, sites.select(self.lasting), info


@pytree_dataclass
class Constrained:
    """Parameters of a filter with inequalities."""

    inner: Filter
    constrain: Constrain


def constrained(inner: Filter, constrain: Constrain) -> Filter:
    """The filter `inner` with its belief cut after every update.

    The cut belief is carried on: it is what the next frame is predicted from and linearised at.

    Args:
        inner: A filter whose state is a `Gaussian` or a `GaussianRoot` and whose info has `log_evidence`.
        constrain: `AfreshEachFrame(constraints, method)` or `Remembering(constraints, lasting)`.
    """
    return Filter(Constrained(inner, constrain), _init, _predict, _update)


def _init(model: Constrained, key: AnyKey) -> ConstrainedState:
    return ConstrainedState(model.inner.init(model.inner.params, key), model.constrain.start())


def _predict(model: Constrained, key: AnyKey, state: ConstrainedState, control: PyTree) -> ConstrainedState:
    return state._replace(belief=model.inner.predict(model.inner.params, key, state.belief, control))


def _update(
    model: Constrained, key: AnyKey, state: ConstrainedState, observation: PyTree
) -> tuple[ConstrainedState, ConstrainedInfo]:
    belief, info = model.inner.update(model.inner.params, key, state.belief, observation)
    belief, memory, cut = model.constrain(belief, state.memory)
    told = ConstrainedInfo(info.log_evidence + cut.log_mass, info, cut, jnp.min(cut.distances))
    return ConstrainedState(belief, memory), told
