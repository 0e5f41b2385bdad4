"""Each view counts once: what is constant in time is learnt from new views only.

A Gaussian filter of a nonlinear observation errs in the same way each time that it sees the same thing. Taken for
fresh noise, the error averages out on paper, and the covariance of constant quantities shrinks without evidence: after
hundreds of like frames the filter is certain of a wrong answer. Here a frame that shows nothing new still corrects
what moves, but the constant quantities are only *considered*: their mean and covariance stay (S. F. Schmidt,
"Application of state-space methods to navigation problems", 1966), and so does what was known of the constraints on
them. Repeating a view therefore teaches nothing, whatever the linearisation does.
"""

from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.constraints.constrained_filter import ConstrainedState
from jaxfilters.typing import AnyKey, as_pytree


class Views(NamedTuple):
    """The views that have been learnt from, in a ring."""

    signatures: Float[Array, "k d"]
    num_views: Int32[Array, ""]
    """How many there have been; the last k of them are held."""


class SchmidtState(NamedTuple):
    """A state of the inner filter, and what it has seen."""

    inner: PyTree
    views: Views


class SchmidtInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    inner: PyTree
    """Info of the inner filter."""
    is_new: Bool[Array, ""]
    """Whether constant quantities were updated."""
    num_views: Int32[Array, ""]
    """So far."""


@pytree_dataclass
class SchmidtKalman:
    """Parameters of a filter that learns from new views only."""

    inner: Filter
    signature: Callable
    constant: Bool[Array, " n"]
    tolerance: Float[Array, ""]
    capacity: int = field(metadata={"static": True})


def schmidt_kalman(
    inner: Filter,
    signature: Callable[[Array], Float[Array, " d"]],
    constant: Bool[Array, " n"],
    tolerance: float | Float[Array, ""],
    *,
    capacity: int = 64,
) -> Filter:
    """The filter `inner` whose constant quantities are updated only by views that it has not learnt from before.

    A view is new where its signature differs from all that are held by more than `tolerance` in some component.

    Args:
        inner: A filter with a `Gaussian` for its state, or `constrained` of one; it updates everything. What it
            remembers of its constraints stays where the constant quantities do.
        signature: `mean -> what is seen` of a state, e.g. noise-free features, less what says nothing about the
            constant quantities, such as the place in the image.
        constant: True for components of the state that never change.
        tolerance: In the unit of the signature; a few standard deviations of the noise.
        capacity: How many views are held; the oldest gives way.

    Raises:
        ValueError: If `capacity < 1` or `tolerance <= 0`.
    """
    if not isinstance(capacity, int) or capacity < 1:
        raise ValueError(f"capacity must be an integer of at least 1; got {capacity!r}.")
    if not isinstance(tolerance, jax.core.Tracer) and not tolerance > 0:
        raise ValueError(f"tolerance must be positive, in the unit of the signature; got {tolerance!r}.")
    params = SchmidtKalman(inner, as_pytree(signature), constant, jnp.asarray(tolerance, dtype=float), capacity)
    return Filter(params, _init, _predict, _update)


def consider(before: Gaussian, after: Gaussian, constant: Bool[Array, " n"]) -> Gaussian:
    """The belief after an update whose gain is made zero for the constant components.

    With P - P' = K S K^T for the optimal gain K, a gain without these rows leaves their own block of the covariance
    as it was, and gives all others the optimal one.
    """
    block = constant[:, None] & constant
    return Gaussian(jnp.where(constant, before.mean, after.mean), jnp.where(block, before.covariance, after.covariance))


def _init(model: SchmidtKalman, key: AnyKey) -> SchmidtState:
    state = model.inner.init(model.inner.params, key)
    shape = jax.eval_shape(model.signature, _belief(state).mean)
    return SchmidtState(state, Views(jnp.zeros((model.capacity, shape.size), shape.dtype), jnp.zeros((), jnp.int32)))


def _predict(model: SchmidtKalman, key: AnyKey, state: SchmidtState, control: PyTree) -> SchmidtState:
    return state._replace(inner=model.inner.predict(model.inner.params, key, state.inner, control))


def _update(
    model: SchmidtKalman, key: AnyKey, state: SchmidtState, observation: PyTree
) -> tuple[SchmidtState, SchmidtInfo]:
    updated, info = model.inner.update(model.inner.params, key, state.inner, observation)
    signature = jax.lax.stop_gradient(model.signature(_belief(updated).mean))
    new = is_new(state.views, signature, model.tolerance)
    considered = consider(_belief(state.inner), _belief(updated), model.constant)
    if isinstance(updated, ConstrainedState):
        considered = state.inner._replace(belief=considered)
    views = remember(state.views, signature)
    learnt, kept = SchmidtState(updated, views), SchmidtState(considered, state.views)
    after = jax.tree.map(lambda yes, no: jnp.where(new, yes, no), learnt, kept)
    return after, SchmidtInfo(info.log_evidence, info, new, after.views.num_views)


def _belief(state: Gaussian | ConstrainedState) -> Gaussian:
    return state.belief if isinstance(state, ConstrainedState) else state


def is_new(views: Views, signature: Float[Array, " d"], tolerance: float | Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a signature differs from all that are held by more than `tolerance` somewhere."""
    held = jnp.arange(views.signatures.shape[0]) < views.num_views
    differs = jnp.max(jnp.abs(views.signatures - signature), axis=1) > tolerance
    return jnp.all(differs | ~held)


def remember(views: Views, signature: Float[Array, " d"]) -> Views:
    """The views with one more, in place of the oldest if need be."""
    place = views.num_views % views.signatures.shape[0]
    return Views(views.signatures.at[place].set(signature), views.num_views + 1)
