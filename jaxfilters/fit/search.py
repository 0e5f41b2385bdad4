"""One compiled loop for every way to search: the losses on the way, when it ends, and what is kept if it fails."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree


class Move(NamedTuple):
    """One step of a method."""

    z: Float[Array, " d"]
    state: PyTree
    loss: Float[Array, ""]
    gradient: Float[Array, " d"]
    """At the newest point that was looked at; where it is not finite, `good` is what is kept."""
    good: Float[Array, " d"]
    done: Bool[Array, ""]


@runtime_checkable
class Method(Protocol):
    """How to search. Hashable: it is static."""

    @property
    def max_steps(self) -> int: ...

    @property
    def knows_bounds(self) -> bool: ...

    def init(self, objective: Any, z: Array, bounds: tuple[Array, Array], /) -> Any: ...

    def step(self, objective: Any, step: Array, z: Array, state: Any, bounds: tuple[Array, Array], /) -> Move: ...


class Search(NamedTuple):
    """A search under way, or its end."""

    z: Float[Array, "..."]
    """(d,): coordinates."""
    state: PyTree
    losses: Float[Array, "..."]
    """(max_steps,): NaN after the last step."""
    step: Int[Array, "..."]
    """How many steps were taken, those before a restart among them."""
    first: Int[Array, "..."]
    """The number of the first step of these losses."""
    done: Bool[Array, "..."]
    failed: Bool[Array, "..."]
    """Whether the last step met a loss or a gradient that is not finite."""
    not_finite: Bool[Array, "..."]
    """(d,): in which coordinates the gradient is not."""


@runtime_checkable
class Loss(Protocol):
    """`(step, z) -> loss`, to be minimised."""

    def __call__(self, step: Array, z: Array, /) -> Array: ...


def begin(method: Method, loss: Any, z: Float[Array, " d"], bounds: tuple[Array, Array]) -> Search:
    """A search that starts at z."""
    zero = jnp.zeros((), jnp.int32)
    no = jnp.zeros((), bool)
    losses = jnp.full(method.max_steps, jnp.nan, z.dtype)
    return Search(z, method.init(loss, z, bounds), losses, zero, zero, no, no, jnp.zeros(z.shape, bool))


def descend(method: Method, loss: Any, search: Search, bounds: tuple[Array, Array]) -> Search:
    """The search after up to `method.max_steps` more steps.

    A step whose loss or gradient is not finite is the last one; the search then stands where both were finite.
    """
    first = search.step
    search = search._replace(first=first, losses=jnp.full_like(search.losses, jnp.nan), done=jnp.zeros((), bool))

    def goes_on(search: Search) -> Bool[Array, ""]:
        return (search.step - first < method.max_steps) & ~search.done & ~search.failed

    def walk(search: Search) -> Search:
        move = method.step(loss, search.step, search.z, search.state, bounds)
        not_finite = ~jnp.isfinite(move.gradient)
        failed = ~jnp.isfinite(move.loss) | jnp.any(not_finite)
        return search._replace(
            z=jnp.where(failed, move.good, move.z),
            state=jax.tree.map(lambda new, old: jnp.where(failed, old, new), move.state, search.state),
            losses=search.losses.at[search.step - first].set(move.loss),
            step=search.step + 1,
            done=move.done & ~failed,
            failed=failed,
            not_finite=not_finite,
        )

    return jax.lax.while_loop(goes_on, walk, search)
