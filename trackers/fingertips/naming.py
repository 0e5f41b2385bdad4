"""Which finger a track is that becomes a fingertip: a number of its own, or one of five names by its place."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters.math import assignment
from jaxfilters.models.fingertip.observation import MAX_TIPS, HandObservation
from jaxfilters.models.fingertip.side import ANGLES, LENGTHS
from jaxfilters.models.fingertip.thumb import base_angle
from jaxfilters.trackers.fingertips.state import CONFIRMED, Fingers, FingertipConfig, HandState, Tracks

UPDATE_SHARE = 0.02
"""Of what a frame of 1/30 s shows in the place that belongs to a name: a hand changes its posture slowly."""
MOST, KEPT = 16.0, 8.0
"""Squared deviations of a fingertip from the place of a name that count at most, and what another name costs beside."""
_GATE = 1000.0
"""Cost of no name: every fingertip gets one."""


def no_fingers() -> Fingers:
    """Of a hand of which nothing was observed yet: people's."""
    return Fingers(jnp.asarray(ANGLES), jnp.asarray(LENGTHS))


def numbered(
    config: FingertipConfig,
    state: HandState,
    tracks: Tracks,
    ready: Bool[Array, " slots"],
    places: Float[Array, "slots 2"],
    observed: HandObservation,
    side: float | Array,
) -> tuple[Int32[Array, " slots"], Fingers]:
    """The next number for each, as if it had never been there."""
    del config, places, observed, side
    number = state.next_identity + jnp.cumsum(ready) - 1
    return jnp.where(ready, number, tracks.identity).astype(jnp.int32), state.fingers


def by_place(
    config: FingertipConfig,
    state: HandState,
    tracks: Tracks,
    ready: Bool[Array, " slots"],
    places: Float[Array, "slots 2"],
    observed: HandObservation,
    side: float | Array,
) -> tuple[Int32[Array, " slots"], Fingers]:
    """Thumb 0 to little finger 4, by direction and distance from the palm, in their order about it.

    Names are given when a track becomes a fingertip, to all that are there together: in their order, and the others
    keep theirs unless that is contradicted. Between such frames a name stays with its track, also where fingers cross.
    The places of the names follow the fingers slowly, and outlive the tracks and the hand's absence.
    """
    names, fingers = jnp.arange(MAX_TIPS), state.fingers
    there = tracks.mode == CONFIRMED
    angle = jax.vmap(base_angle, in_axes=(0, None, None, None))(places, state.palm, state.axis, side)
    length = jnp.linalg.norm(places - state.palm, axis=1) / jnp.maximum(observed.palm_radius, 1.0)
    off = _turn(angle[:, None], fingers.angle) / config.angle_sd
    cost = jnp.minimum(off**2 + ((length[:, None] - fingers.length) / config.length_sd) ** 2, MOST)
    is_other = (tracks.identity >= 0)[:, None] & (tracks.identity[:, None] != names)
    # The thumb has the greatest angle.
    order = jnp.argsort(jnp.where(there, -angle, jnp.inf))
    every = jnp.ones(MAX_TIPS, bool)
    found = assignment.match_noncrossing_gated((cost + KEPT * is_other)[order], _GATE, there[order], every).column
    named = jnp.zeros_like(found).at[order].set(found)
    identity = jnp.where(jnp.any(ready), jnp.where(there, named, -1), tracks.identity).astype(jnp.int32)
    shows = (identity[:, None] == names) & (there & (tracks.missed == 0) & observed.is_hand)[:, None]
    share = min(UPDATE_SHARE * config.frame, 1.0) * shows
    turn, longer = _turn(angle[:, None], fingers.angle), length[:, None] - fingers.length
    return identity, Fingers(
        fingers.angle + jnp.sum(share * turn, axis=0), fingers.length + jnp.sum(share * longer, axis=0)
    )


def _turn(angle: Array, reference: Array) -> Array:
    """From one direction to another, from -pi to pi."""
    return jnp.mod(angle - reference + jnp.pi, 2 * jnp.pi) - jnp.pi
