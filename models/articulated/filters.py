"""Gaussian filters of an articulated hand: one hypothesis with limits, and a bank of hypotheses about depth.

Three filters of one hypothesis. `recommended` makes the observation linear to the second order, cuts the belief by
expectation propagation with memory, and learns lengths from new views only. `literal` is the paper's: an extended
Kalman filter, half-spaces one after the other in every frame. `unconstrained` is a second-order filter without limits.
"""

import math
from collections.abc import Callable
from dataclasses import field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import gaussian_sum
from jaxfilters.gaussian.arithmetic import KalmanInfo, joseph
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.consider import SchmidtInfo, SchmidtState, schmidt_kalman
from jaxfilters.gaussian.constraints import LinearConstraints, TruncationInfo, cut, linear_constraints
from jaxfilters.gaussian.constraints.constrained_filter import (
    ConstrainedInfo,
    ConstrainedState,
    EPConstraints,
    TruncateEachStep,
    constrained,
)
from jaxfilters.gaussian.extended import Observation, condition
from jaxfilters.gaussian.linearize import (
    Function,
    Linearization,
    Linearize,
    second_order_covariance_only,
    taylor,
)
from jaxfilters.math import linalg
from jaxfilters.models.articulated.ambiguity import (
    depth_mirrors,
    mirror_trigger,
    reversal_trigger,
    reverse_depth,
    separated_points,
)
from jaxfilters.models.articulated.hand import ArticulatedHand
from jaxfilters.models.articulated.limits import LimitRows
from jaxfilters.typing import AnyKey

NEW_VIEW = 20 / 3
"""Standard deviations of a point's noise by which some joint must be visible elsewhere for a view to be new: a fifth of
the hand for keypoints of a network with 3 % of noise, whose errors change with the pose by several of these."""
LASTING = 4.0
"""Frames whose errors of linearisation count as one. A pose hardly changes from frame to frame, so what the linear
approximation leaves out hardly does either, and a filter that takes it for fresh noise averages it away."""
SKIP = 4.0
"""The paper's c_skip: standard deviations beyond which an inequality is not applied."""
REJECT = -3.0
"""c_rej: standard deviations outside of an inequality at which a hypothesis is given up."""
LOG_RATIO = 12.0
BRANCHES = 4


_State = SchmidtState | ConstrainedState | Gaussian


class Inequalities(NamedTuple):
    """Limits as a filter takes them: arrays, with the names static."""

    constraints: LinearConstraints
    lasting: Bool[Array, " k"]
    """True for rows on constant components only."""


def inequalities(rows: LimitRows) -> Inequalities:
    """The rows, checked: see `jaxfilters.constraints.linear_constraints`."""
    return Inequalities(linear_constraints(rows.normals, rows.lower, rows.upper, rows.names), rows.static)


class FeatureObservation(NamedTuple):
    """One frame's features, and where a hypothesis is made linear."""

    y: Float[Array, " rows"]
    """Pixels and radians."""
    mask: Bool[Array, " rows"]
    std: Float[Array, " rows"]
    """Standard deviations of the noise."""
    at: Float[Array, " n"] | None = None
    """Point of linearisation; `None` is the predicted mean."""
    reversed: Bool[Array, ""] | None = None
    """Whether the prediction is to be mirrored in depth first; `None` is no."""


@pytree_dataclass
class HandBelief:
    """Parameters of the innermost filter: predict, and condition on a `FeatureObservation`."""

    hand: ArticulatedHand
    prior: Gaussian
    gate: Float[Array, ""]
    """Standard deviations of its innovation beyond which a row is left out."""
    linearize: Linearize = field(metadata={"static": True})
    corrected: Callable = field(metadata={"static": True})
    """How a correction of the quaternion is taken: `turned` or `added`."""


def recommended(hand: ArticulatedHand, prior: Gaussian, limits: Inequalities, *, gate: float = math.inf) -> Filter:
    """Second-order filter, limits counted once, lengths estimated from new views, of a `FeatureObservation` a frame."""
    inner = constrained(_belief(hand, prior, gate, lasting_curvature, turned), EPConstraints(*limits))
    place, static = jnp.arange(hand.layout.size), hand.layout.static
    constant = (place >= static.start) & (place < static.stop)
    return schmidt_kalman(inner, jax.tree_util.Partial(signature, hand), constant, NEW_VIEW * hand.point_std)


def literal(hand: ArticulatedHand, prior: Gaussian, limits: Inequalities, *, gate: float = math.inf) -> Filter:
    """The paper's filter: first-order, half-spaces one by one in every frame (Shimada et al., sections 3 to 5)."""
    return constrained(_belief(hand, prior, gate, taylor, added), TruncateEachStep(limits.constraints, one_by_one))


def unconstrained(hand: ArticulatedHand, prior: Gaussian, limits: Inequalities, *, gate: float = math.inf) -> Filter:
    """Second-order filter that knows of no limits."""
    del limits
    return _belief(hand, prior, gate, second_order_covariance_only, turned)


def lasting_curvature(f: Function, belief: Gaussian | GaussianRoot) -> Linearization:
    """`second_order_covariance_only` with an error of linearisation that is the same for `LASTING` frames.

    An error that n updates have in common leaves n times the variance that independent errors of its size would.
    """
    found = second_order_covariance_only(f, belief)
    return found._replace(residual_root=math.sqrt(LASTING) * found.residual_root)


def signature(hand: ArticulatedHand, x: Float[Array, " n"]) -> Float[Array, " d"]:
    """What is visible of a hand wherever it is in the image: its joints from the wrist, pixels."""
    points = hand.points(x)
    return (hand.projection.image_points(points) - hand.projection.image_points(hand.wrist(x))).ravel()


def standard_deviations(points: Callable[[Array], Float[Array, "*shape"]], belief: Gaussian) -> Float[Array, "*shape"]:
    """Of points of a hand in its state: `points` is made linear at the mean of the belief about the state."""
    shape = jax.eval_shape(points, belief.mean).shape
    F = taylor(lambda x: points(x).ravel(), belief).F
    return linalg.safe_sqrt(jnp.sum(dot(F, belief.covariance) * F, axis=1)).reshape(shape)


def one_by_one(belief: Any, constraints: LinearConstraints) -> tuple[Any, TruncationInfo]:
    """The paper's truncation with its skip rule."""
    return cut.sequential_halfspaces(belief, constraints, skip=SKIP)


def belief_of(state: _State) -> Gaussian:
    """The belief in the state of any of the filters above."""
    state = state.inner if isinstance(state, SchmidtState) else state
    return state.belief if isinstance(state, ConstrainedState) else state


class Report(NamedTuple):
    """What any of the filters above tells of an update."""

    kalman: KalmanInfo
    least_distance: Float[Array, ""]
    """Standard deviations to the nearest limit before the cut, negative outside; infinite without limits."""
    is_new_view: Bool[Array, ""]
    """Whether lengths were estimated."""


def report_of(info: SchmidtInfo | ConstrainedInfo | KalmanInfo) -> Report:
    """The same diagnostics of every filter, whatever it is wrapped in."""
    if isinstance(info, SchmidtInfo):
        return report_of(info.inner)._replace(is_new_view=info.is_new)
    if isinstance(info, ConstrainedInfo):
        return report_of(info.inner)._replace(least_distance=info.least_distance)
    return Report(info, jnp.full_like(info.log_evidence, jnp.inf), jnp.ones((), bool))


def hypotheses(
    inner: Filter, hand: ArticulatedHand, *, capacity: int, start: gaussian_sum.GaussianSumState | None
) -> Filter:
    """A bank over the depth ambiguities of a hand (Shimada et al., section 6); observations are `FeatureObservation`s.

    Every hypothesis is made linear at its mean; where the image of a link hardly depends on its angle, at both poses of
    the link that is most in doubt instead [30]; and where all fingers may be straight, also with the hand mirrored.
    Those that leave a limit by more than three standard deviations are given up. Arguments as in
    `jaxfilters.gaussian_sum`.
    """
    return gaussian_sum.gaussian_sum(
        inner,
        capacity=capacity,
        start=start,
        branch=jax.tree_util.Partial(_branches, hand),
        margin=_margin,
        same=jax.tree_util.Partial(_same, hand),
        log_ratio=LOG_RATIO,
    )


def _belief(hand: ArticulatedHand, prior: Gaussian, gate: float, linearize: Linearize, corrected: Callable) -> Filter:
    model = HandBelief(hand, prior, jnp.asarray(gate, dtype=float), linearize, corrected)
    return Filter(model, _init, _predict, _update)


def _init(model: HandBelief, key: AnyKey) -> Gaussian:
    del key
    return model.prior


def _predict(model: HandBelief, key: AnyKey, belief: Gaussian, inputs: Array) -> Gaussian:
    del key
    F = jax.jacfwd(model.hand.transition)(belief.mean, inputs)
    ahead = joseph.predict(belief, F, model.hand.process_noise(inputs))
    return Gaussian(model.hand.transition(belief.mean, inputs), ahead.covariance)


def _update(
    model: HandBelief, key: AnyKey, belief: Gaussian, look: FeatureObservation, inputs: PyTree
) -> tuple[Gaussian, KalmanInfo]:
    del key, inputs
    hand = model.hand
    if look.reversed is not None:
        mirror = jax.jacfwd(partial(reverse_depth, hand=hand))(belief.mean)
        covariance = linalg.matmul(linalg.matmul(mirror, belief.covariance), mirror.T)
        mirrored = Gaussian(reverse_depth(belief.mean, hand), covariance)
        chosen = partial(jnp.where, look.reversed)
        belief = jax.tree.map(chosen, mirrored, belief)
    at = belief.mean if look.at is None else look.at
    H = jax.jacfwd(hand.observe)(at)
    noise = jnp.diag(look.std**2)
    measured = Observation(look.y, look.mask & _within_gate(model, belief, look, H, at), noise)
    posterior, info = condition(
        belief,
        measured,
        hand.observe,
        noise,
        at=at,
        linearize=partial(_linearized, model.linearize, hand),
        residual=hand.residual,
    )
    posterior = model.corrected(hand, belief.mean, posterior)
    # An innovation's likelihood cannot be compared between points of linearisation; the height of the mode can.
    log_evidence = laplace_log_evidence(hand, belief, posterior, info, H, look)
    return posterior, replace(info, log_evidence=log_evidence)


def _linearized(linearize: Linearize, hand: ArticulatedHand, observe: Function, belief: Gaussian) -> Linearization:
    """The linear approximation of the image, which says nothing of rates and in which errors are added.

    Only what bends the image is handed on: second derivatives of the rest are zero and need not be computed.
    """
    layout = hand.layout
    bends = np.r_[layout.moving, layout.static]

    def image(part: Array) -> Array:
        return observe(belief.mean.at[bends].set(part))

    found = linearize(image, Gaussian(belief.mean[bends], belief.covariance[jnp.ix_(bends, bends)]))
    F = jnp.zeros((found.value.size, layout.size), found.F.dtype).at[:, bends].set(found.F)
    errors = jnp.eye(found.value.size, layout.num_errors, dtype=F.dtype)
    return found._replace(F=F.at[:, layout.errors].set(errors))


def added(hand: ArticulatedHand, before: Float[Array, " n"], after: Gaussian) -> Gaussian:
    """The belief as it is: the quaternion is corrected like any other number, as in the paper."""
    del hand, before
    return after


def turned(hand: ArticulatedHand, before: Float[Array, " n"], after: Gaussian) -> Gaussian:
    """The belief with the quaternion's correction taken as a turn, which leaves the scale alone, and a stretch.

    Added, a turn by an angle a would stretch the quaternion by 1 / cos(a / 2): 20 degrees are 3 % of the hand's size.
    The covariance turns along, so that a scale that is known stays known.
    """
    block = hand.layout.quaternion
    q = before[block]
    length = linalg.safe_norm(q)
    axis = q / length
    moved = after.mean[block]
    stretch = jnp.sum(moved * axis)
    new_axis = moved / linalg.safe_norm(moved)
    mean = after.mean.at[block].set(stretch * new_axis)
    # The rotation in the plane of the two axes that takes one to the other.
    middle = axis + new_axis
    scale = 1 + dot(axis, new_axis)
    turn = jnp.eye(4, dtype=q.dtype) - jnp.outer(middle, middle) / scale + 2 * jnp.outer(new_axis, axis)
    whole = jnp.eye(after.mean.size, dtype=q.dtype).at[block, block].set(turn)
    return Gaussian(mean, linalg.matmul(linalg.matmul(whole, after.covariance), whole.T))


def _within_gate(model, belief, look, H, at):
    predicted = jnp.sum(linalg.matmul(H, belief.covariance) * H, axis=1) + look.std**2
    innovation = model.hand.residual(look.y, model.hand.observe(at)) + dot(H, at - belief.mean)
    return innovation**2 <= model.gate**2 * predicted


def laplace_log_evidence(
    hand: ArticulatedHand,
    prior: Gaussian,
    posterior: Gaussian,
    info: KalmanInfo,
    H: Float[Array, "rows n"],
    look: FeatureObservation,
) -> Float[Array, ""]:
    r"""Log evidence by Laplace's method at the posterior mean; for a linear observation, that of the innovation.

    $-\frac12(\epsilon^T W^{-1} \epsilon + d^T \tilde P^+ d + \log |2 \pi S|)$ with the nonlinear residual
    $\epsilon$ and $d$ the correction. As $d = \tilde P H^T S^{-1} \nu$, nothing is inverted that may be singular.
    """
    root = info.innovation_root
    counts = jnp.diagonal(root) > 0
    missed = jnp.where(counts, hand.residual(look.y, hand.observe(posterior.mean)) / look.std, 0.0)
    pull = linalg.solve_triangular(root, linalg.solve_triangular(root, info.innovation), transpose=True)
    correction = jnp.sum(jnp.where(counts, pull * dot(H, posterior.mean - prior.mean), 0.0))
    scale = jnp.log(jnp.where(counts, jnp.diagonal(root), 1.0)) + 0.5 * math.log(2 * math.pi)
    log_scale = jnp.sum(jnp.where(counts, scale, 0.0))
    value = -0.5 * (jnp.sum(missed**2) + correction) - log_scale
    return jnp.where(jnp.isneginf(info.log_evidence), -jnp.inf, value)


def _branches(
    hand: ArticulatedHand, state: _State, look: FeatureObservation
) -> tuple[FeatureObservation, Bool[Array, " b"]]:
    belief = belief_of(state)
    std = jnp.sqrt(jnp.maximum(jnp.diagonal(belief.covariance), 0.0))
    doubtful = mirror_trigger(belief.mean, std, hand)
    # Of the links in doubt the one whose two poses lie closest together, in standard deviations.
    sigma = hand.layout.angles_of(std)[:, 1:]
    distance = jnp.abs(depth_mirrors(belief.mean, hand).change) / jnp.where(sigma > 0, sigma, 1.0)
    finger, link = jnp.divmod(jnp.argmin(jnp.where(doubtful, distance, jnp.inf)), doubtful.shape[1])
    both = separated_points(belief.mean, std, hand, finger, link)
    reversed_mean = reverse_depth(belief.mean, hand)
    at = jnp.stack([belief.mean, both[0], both[1], reversed_mean])
    mirrored = jnp.array([False, False, False, True])
    any_doubt = jnp.any(doubtful)
    tried = jnp.stack([~any_doubt, any_doubt, any_doubt, reversal_trigger(belief.mean, std, hand.layout)])
    spread = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (BRANCHES, *leaf.shape)), FeatureObservation(*look[:3]))
    return spread._replace(at=at, reversed=mirrored), tried


def _margin(state: _State, info) -> Float[Array, ""]:
    del state
    return report_of(info).least_distance - REJECT


def _same(hand: ArticulatedHand, heavier: _State, lighter: _State) -> Bool[Array, ""]:
    """Whether all joint angles agree within half their deviations and half a degree, and palms within 10 degrees."""
    a, b = belief_of(heavier), belief_of(lighter)
    layout = hand.layout
    spread = sum(jnp.sqrt(jnp.maximum(jnp.diagonal(belief.covariance)[layout.angles], 0.0)) for belief in (a, b))
    apart = jnp.abs(a.mean[layout.angles] - b.mean[layout.angles]) > 0.5 * spread + math.radians(0.5)
    p, q = a.mean[layout.quaternion], b.mean[layout.quaternion]
    aligned = jnp.abs(dot(p, q)) / (linalg.safe_norm(p) * linalg.safe_norm(q)) > math.cos(math.radians(5.0))
    return ~jnp.any(apart) & aligned
