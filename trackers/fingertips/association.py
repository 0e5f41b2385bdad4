"""Which detected tip is which finger."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math import assignment
from jaxfilters.models.fingertip import motion
from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.models.fingertip.thumb import base_angle
from jaxfilters.trackers.fingertips.state import CONFIRMED, FREE, TENTATIVE, FingertipConfig, HandState

LEAST_DOUBT = 4.0
"""Cost by which a matching in order has to be dearer than one in any order, for the order to be in doubt."""
_PRICE = 60.0
"""Of a finger and a tip that stay alone, above that of any pair which the gates let through."""


def angular_order(
    points: Float[Array, "n 2"], there: Bool[Array, " n"], palm: Float[Array, "2"], axis: Float[Array, "2"]
) -> Int32[Array, " n"]:
    """Indices of points in the order of their angle about the palm, cut at the wrist; last those that are not there."""
    angles = jax.vmap(base_angle, in_axes=(0, None, None))(points, palm, axis)
    return jnp.argsort(jnp.where(there, angles, jnp.inf)).astype(jnp.int32)


def nearest_in_order(
    config: FingertipConfig, state: HandState, beliefs: Gaussian, observed: HandObservation
) -> tuple[Int32[Array, " slots"], Bool[Array, ""]]:
    """The paper's: as many pairs as possible in order, the least sum of squared distances; far ones then dropped."""
    there = state.tracks.mode != FREE
    distance = _squared_distances(beliefs, observed)
    tips = _in_order(state, beliefs, observed, distance, there, observed.is_tip, assignment.match_noncrossing)[0]
    reach = jnp.where(state.tracks.mode == CONFIRMED, config.gate, config.tentative_gate)
    own = jnp.take_along_axis(distance, jnp.maximum(tips, 0)[:, None], axis=1)[:, 0]
    return jnp.where((tips >= 0) & (own <= jnp.square(reach)), tips, -1), jnp.asarray(False)


def likeliest(
    config: FingertipConfig, state: HandState, beliefs: Gaussian, observed: HandObservation
) -> tuple[Int32[Array, " slots"], Bool[Array, ""]]:
    """The likeliest pairs in order within the gates of every finger's own uncertainty, confirmed tracks first.

    A pair costs twice its negative log likelihood. Where the order is contradicted for some frames, as when fingers
    cross, any order will do until it is not.
    """
    mode = state.tracks.mode
    cost = _surprise(config, mode, beliefs, observed)

    def gated(cost: Array, rows: Array, columns: Array) -> assignment.Matching:
        return assignment.match_noncrossing_gated(cost, 2 * _PRICE, rows, columns)

    certain = mode == CONFIRMED
    tips, spent = _in_order(state, beliefs, observed, cost, certain, observed.is_tip, gated)
    free = assignment.match_gated(cost, 2 * _PRICE, certain, observed.is_tip)
    doubt = spent > config.disorder * free.cost + LEAST_DOUBT
    tips = jnp.where(doubt & (state.disordered >= config.disordered_frames - 1), free.column, tips)
    taken = jnp.any(tips[:, None] == jnp.arange(len(observed.is_tip)), axis=0)
    tentative, _ = _in_order(state, beliefs, observed, cost, mode == TENTATIVE, observed.is_tip & ~taken, gated)
    return jnp.where(certain, tips, tentative), doubt


def _in_order(state, beliefs, observed, cost, rows, columns, match):
    """`(tip of every slot or -1, cost)` by a matching that takes both in the order of their angles."""
    by_angle = angular_order(beliefs.mean[:, :2], rows, state.palm, state.axis)
    tip_by_angle = angular_order(observed.tips, columns, state.palm, state.axis)
    found = match(cost[by_angle][:, tip_by_angle], rows[by_angle], columns[tip_by_angle])
    tips = jnp.where(found.column >= 0, tip_by_angle[jnp.maximum(found.column, 0)], -1)
    return jnp.zeros_like(tips).at[by_angle].set(tips), found.cost


def _squared_distances(beliefs, observed):
    difference = beliefs.mean[:, None, :2] - observed.tips
    return jnp.sum(difference * difference, axis=-1)


def _surprise(config, mode, beliefs, observed):
    """Twice the negative log likelihood of each pair but for a constant, `inf` outside the gates."""
    by_tip = jax.vmap(motion.innovation_distance, in_axes=(None, 0, None))
    distance = jax.vmap(by_tip, in_axes=(0, None, None))(beliefs, observed.tips, config.measurement_sd)
    reach = jnp.where(mode == CONFIRMED, config.gate, config.tentative_gate)
    near = _squared_distances(beliefs, observed) <= jnp.square(reach)[:, None]
    spread = 2 * jnp.log1p(motion.uncertainty(beliefs))
    return jnp.where(near & (distance < config.surprise), distance + spread[:, None], jnp.inf)
