"""The compiled loop that all search methods share: the history of the loss, termination, and non-finite values."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree


class StepResult(NamedTuple):
    """The result of one step of a method."""

    z: Float[Array, " d"]
    """The coordinates after the step."""
    state: PyTree
    """The state of the method after the step."""
    loss: Float[Array, ""]
    """The loss at the last point that the step evaluated."""
    gradient: Float[Array, " d"]
    """The gradient at that point."""
    last_finite: Float[Array, " d"]
    """The coordinates to keep if the loss or the gradient is not finite."""
    converged: Bool[Array, ""]


@runtime_checkable
class Method(Protocol):
    """A search method. It is hashable, because it is a static argument of compiled functions."""

    @property
    def max_steps(self) -> int: ...

    @property
    def supports_bounds(self) -> bool: ...

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array], /) -> Any:
        """The state before the first step."""
        ...

    def step(self, objective: Any, step: Array, z: Array, state: Any, bounds: tuple[Array, Array], /) -> StepResult:
        """One step from `z`."""
        ...


class SearchState(NamedTuple):
    """A search in progress, or its final state."""

    z: Float[Array, "..."]
    """(d,): coordinates."""
    state: PyTree
    """State of the method."""
    losses: Float[Array, "..."]
    """(max_steps,): minus the log density in every step since the last start; NaN after the last step."""
    step: Int[Array, "..."]
    """Number of steps taken, including those before a restart."""
    first_step: Int[Array, "..."]
    """Number of the step to which `losses[0]` belongs."""
    converged: Bool[Array, "..."]
    failed: Bool[Array, "..."]
    """Whether the last step met a loss or a gradient that is not finite."""
    not_finite: Bool[Array, "..."]
    """(d,): the components of the last gradient that are not finite."""


@runtime_checkable
class Loss(Protocol):
    """`(step, z) -> loss`, to be minimised."""

    def __call__(self, step: Array, z: Array, /) -> Array: ...


def initial_search(method: Method, loss: Any, z: Float[Array, " d"], bounds: tuple[Array, Array]) -> SearchState:
    """A search that starts at `z`."""
    zero = jnp.zeros((), jnp.int32)
    no = jnp.zeros((), bool)
    losses = jnp.full(method.max_steps, jnp.nan, z.dtype)
    return SearchState(z, method.init(loss, z, bounds), losses, zero, zero, no, no, jnp.zeros(z.shape, bool))


def minimize(method: Method, loss: Any, search: SearchState, bounds: tuple[Array, Array]) -> SearchState:
    """The search after up to `method.max_steps` further steps.

    A step whose loss or gradient is not finite ends the search, at the last point where both were finite.
    """
    first_step = search.step
    search = search._replace(
        first_step=first_step, losses=jnp.full_like(search.losses, jnp.nan), converged=jnp.zeros((), bool)
    )

    def unfinished(search: SearchState) -> Bool[Array, ""]:
        return (search.step - first_step < method.max_steps) & ~search.converged & ~search.failed

    def advance(search: SearchState) -> SearchState:
        result = method.step(loss, search.step, search.z, search.state, bounds)
        not_finite = ~jnp.isfinite(result.gradient)
        failed = ~jnp.isfinite(result.loss) | jnp.any(not_finite)
        return search._replace(
            z=jnp.where(failed, result.last_finite, result.z),
            state=jax.tree.map(lambda new, old: jnp.where(failed, old, new), result.state, search.state),
            losses=search.losses.at[search.step - first_step].set(result.loss),
            step=search.step + 1,
            converged=result.converged & ~failed,
            failed=failed,
            not_finite=not_finite,
        )

    return jax.lax.while_loop(unfinished, advance, search)
