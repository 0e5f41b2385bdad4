"""The Schmidt-Kalman filter with a novelty gate: constant quantities are updated by new views only.

A Gaussian filter of a nonlinear observation makes the same linearisation error each time that it observes the same
scene. Treated as independent noise, the error seems to average out, and the covariance of constant quantities shrinks
without evidence: after hundreds of similar frames the filter is certain of a wrong value. Here a frame that shows
nothing new still corrects what moves, but the constant quantities are only *considered*: their mean and covariance
stay (S. F. Schmidt, "Application of state-space methods to navigation problems", in "Advances in Control Systems" 3,
1966), and so does the memory of constraints on them. A repeated view therefore adds no information about them,
whatever the linearisation.

Without a description of views the quantities are considered in every frame: nuisances, such as the error of a
calibration or the common misplacement of a detector, widen the belief about everything else for good.
"""

from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.constraints.constrained_filter import ConstrainedState
from jaxfilters.gaussian.manifold import Manifold, euclidean
from jaxfilters.typing import AnyKey, as_pytree


class ViewMemory(NamedTuple):
    """Signatures of the views that have updated the constant quantities, in a ring buffer."""

    signatures: Float[Array, "k d"]
    num_views: Int32[Array, ""]
    """Number of such views; the last k of them are in the buffer."""


class SchmidtState(NamedTuple):
    """State of the inner filter, and the views that have updated it."""

    inner: PyTree
    views: ViewMemory


class SchmidtInfo(NamedTuple):
    """Diagnostics of one update."""

    log_evidence: Float[Array, ""]
    inner: PyTree
    """Info of the inner filter."""
    is_new: Bool[Array, ""]
    """Whether constant quantities were updated."""
    num_views: Int32[Array, ""]
    """Number of views so far that updated them."""


@pytree_dataclass
class SchmidtKalman:
    """Parameters of a filter made by `schmidt_kalman`; its arguments describe them."""

    inner: Filter
    signature: Callable | None
    constant: Bool[Array, " n"]
    tolerance: Float[Array, ""]
    capacity: int = field(metadata={"static": True})


def schmidt_kalman(
    inner: Filter,
    signature: Callable[[Array], Float[Array, " d"]] | None,
    constant: Bool[Array, " n"],
    tolerance: float | Float[Array, ""] | None = None,
    *,
    capacity: int = 64,
) -> Filter:
    """Schmidt-Kalman filter: `inner`, with constant quantities that only new views update.

    A view is new if its signature differs from all in the memory by more than `tolerance` in some component. The state
    is a `SchmidtState`, the info a `SchmidtInfo`. Without a `signature` no view is new: the chosen components are never
    updated. They are then the considered nuisances of S. F. Schmidt, whose covariance stays that of the prior or, for
    the lasting errors of `correlated_noise`, of their process. Errors that rows or sensors share have one component,
    and enter the rows through `loading`.

    Args:
        inner: Filter with a `Gaussian` for its state, or `constrained` of one; it updates everything. Where the
            constant quantities stay, so does its memory of constraints.
        signature: `mean -> signature`, (n,) to (d,): a description of what the state looks like, e.g. noise-free
            features without what says nothing about the constant quantities, such as the place in the image. `None` if
            no view may update them.
        constant: True for components of the state that never change, (n,), or that are considered. On a manifold, for
            components of increments; they must belong to vectors in it.
        tolerance: Least difference of a new view, in the unit of the signature; a few standard deviations of the noise.
            `None` without a signature, and only there.
        capacity: Number of views in the memory, at least 1; a new one replaces the oldest.

    Returns:
        The filter.

    Raises:
        ValueError: If `capacity < 1` or `tolerance <= 0`; when the filter is traced, if `constant` has another length
            than the mean of the state, or `signature` returns no array of one axis.
        TypeError: If `inner` is no filter, `constant` no boolean array, or, when the filter is traced, if the state of
            `inner` is not a `Gaussian`.

    Examples:
        A bar of unknown length that turns: its projection tells the length only while the angle changes.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.array([0.5, 60.0]), jnp.diag(jnp.array([0.04, 100.0])))
        >>> observe = lambda x: x[1:] * jnp.cos(x[:1])
        >>> Q, R = jnp.diag(jnp.array([1e-4, 0.0])), 0.04 * jnp.eye(1)
        >>> inner = jf.extended_kalman(prior, lambda x: x, Q, observe, R)
        >>> filter = jf.schmidt_kalman(inner, lambda mean: mean[:1], jnp.array([False, True]), tolerance=0.5)
        >>> _, (states, infos) = jf.run(filter, jax.random.key(0), jnp.full((5, 1), 50.0))
        >>> infos.is_new.tolist()
        [True, False, False, False, False]

        A bias of the readings, of 0.5 to one standard deviation, that no number of readings tells from the place.

        >>> inner = jf.kalman(jf.Gaussian(jnp.zeros(1), 9.0 * jnp.eye(1)), jnp.eye(1), 0.0 * Q[:1, :1], jnp.eye(1), R)
        >>> biased = jf.correlated_noise(inner, jf.GaussMarkov(jnp.array(jnp.inf), jnp.array([0.25])))
        >>> filter = jf.schmidt_kalman(biased, None, jnp.array([False, True]))
        >>> last, _ = jf.run(filter, jax.random.key(0), jnp.ones((1000, 1)))
        >>> [round(float(variance) ** 0.5, 2) for variance in jnp.diagonal(last.inner.covariance)]
        [0.5, 0.5]
    """
    checks.is_filter("inner", inner)
    if signature is not None:
        checks.function("signature", signature)
    if (signature is None) != (tolerance is None):
        raise ValueError(
            "signature and tolerance must both be given, or both be None; "
            f"got {'no' if signature is None else 'a'} signature and the tolerance {tolerance}."
        )
    if jnp.ndim(constant) != 1:
        raise ValueError(f"constant must have the shape (n,), that of the mean; got {jnp.shape(constant)}.")
    checks.boolean("constant", constant, jnp.shape(constant))
    if not isinstance(capacity, int) or capacity < 1:
        raise ValueError(f"capacity must be an integer of at least 1; got {capacity!r}.")
    if tolerance is not None and not isinstance(tolerance, jax.core.Tracer) and not tolerance > 0:
        raise ValueError(f"tolerance must be positive, in the unit of the signature; got {tolerance!r}.")
    if signature is not None:
        signature = as_pytree(signature)
    tolerance = jnp.asarray(0.0 if tolerance is None else tolerance, dtype=float)
    params = SchmidtKalman(inner, signature, constant, tolerance, capacity)
    return Filter(params, _init, _predict, _update)


def consider(
    before: Gaussian, after: Gaussian, constant: Bool[Array, " n"], manifold: Manifold = euclidean
) -> Gaussian:
    """Belief after an update whose gain is set to zero for the constant components.

    With P - P' = K S K^T for the optimal gain K, a gain with zeros in these rows leaves their own block of the
    covariance as it was, and gives all others the optimal one.
    """
    block = constant[:, None] & constant
    covariance = jnp.where(block, before.covariance, after.covariance)
    if manifold.flat:
        return Gaussian(jnp.where(constant, before.mean, after.mean), covariance)
    moved = jnp.where(constant, 0.0, manifold.local(before.mean, after.mean))
    return Gaussian(manifold.retract(before.mean, moved), covariance)


def _init(model: SchmidtKalman, key: AnyKey) -> SchmidtState:
    state = model.inner.init(model.inner.params, key)
    belief = _belief(state)
    checks.belief("the state of inner", belief, Gaussian)
    checks.boolean("constant", model.constant, belief.covariance.shape[:1], ", that of the mean of the state")
    if model.signature is None:
        return SchmidtState(state, ViewMemory(jnp.zeros((0, 0), belief.mean.dtype), jnp.zeros((), jnp.int32)))
    shape = jax.eval_shape(model.signature, belief.mean)
    checks.floating("the result of signature", shape)
    if shape.ndim != 1:
        raise ValueError(f"signature must return an array of the shape (d,); got {shape.shape}.")
    memory = ViewMemory(jnp.zeros((model.capacity, shape.size), shape.dtype), jnp.zeros((), jnp.int32))
    return SchmidtState(state, memory)


def _predict(model: SchmidtKalman, key: AnyKey, state: SchmidtState, inputs: PyTree) -> SchmidtState:
    return state._replace(inner=model.inner.predict(model.inner.params, key, state.inner, inputs))


def _update(
    model: SchmidtKalman, key: AnyKey, state: SchmidtState, observation: PyTree, inputs: PyTree
) -> tuple[SchmidtState, SchmidtInfo]:
    updated, info = model.inner.update(model.inner.params, key, state.inner, observation, inputs)
    manifold = getattr(model.inner.params, "manifold", euclidean)
    considered = consider(_belief(state.inner), _belief(updated), model.constant, manifold)
    if isinstance(updated, ConstrainedState):
        considered = state.inner._replace(belief=considered)
    if model.signature is None:
        none = jnp.zeros((), bool)
        return state._replace(inner=considered), SchmidtInfo(info.log_evidence, info, none, state.views.num_views)
    signature = jax.lax.stop_gradient(model.signature(_belief(updated).mean))
    new = is_new(state.views, signature, model.tolerance)
    views = with_view(state.views, signature)
    if_new, if_known = SchmidtState(updated, views), SchmidtState(considered, state.views)
    after = jax.tree.map(lambda yes, no: jnp.where(new, yes, no), if_new, if_known)
    return after, SchmidtInfo(info.log_evidence, info, new, after.views.num_views)


def _belief(state: Gaussian | ConstrainedState) -> Gaussian:
    return state.belief if isinstance(state, ConstrainedState) else state


def is_new(views: ViewMemory, signature: Float[Array, " d"], tolerance: float | Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a signature differs from all in the memory by more than `tolerance` in some component."""
    filled = jnp.arange(views.signatures.shape[0]) < views.num_views
    differs = jnp.max(jnp.abs(views.signatures - signature), axis=1) > tolerance
    return jnp.all(differs | ~filled)


def with_view(views: ViewMemory, signature: Float[Array, " d"]) -> ViewMemory:
    """The memory with one more view, which replaces the oldest once the memory is full."""
    place = views.num_views % views.signatures.shape[0]
    return ViewMemory(views.signatures.at[place].set(signature), views.num_views + 1)
