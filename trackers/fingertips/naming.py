"""Which finger a track is that becomes a fingertip: a number of its own, or the name of a finger in the same place."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters.math import assignment
from jaxfilters.models.fingertip.observation import MAX_TIPS, HandObservation
from jaxfilters.models.fingertip.thumb import base_angle
from jaxfilters.trackers.fingertips.state import CONFIRMED, Fingers, FingertipConfig, HandState, Tracks

UPDATE_SHARE = 0.05
"""Of what a frame shows in the place that belongs to a name: a hand changes its posture slowly."""
_IN_TURN = 1e-2
"""Cost by which new names are given in the order of the tracks."""
_MOST, _GATE = 100.0, 400.0
"""Costs of a pair at most, and of none: every fingertip gets a name."""


def no_fingers() -> Fingers:
    """No name was given yet."""
    return Fingers(jnp.zeros(MAX_TIPS), jnp.zeros(MAX_TIPS), jnp.zeros(MAX_TIPS, bool))


def numbered(
    config: FingertipConfig,
    state: HandState,
    tracks: Tracks,
    ready: Bool[Array, " slots"],
    places: Float[Array, "slots 2"],
    observed: HandObservation,
) -> tuple[Int32[Array, " slots"], Fingers]:
    """The next number for each, as if it had never been there."""
    del config, places, observed
    number = state.next_identity + jnp.cumsum(ready) - 1
    return jnp.where(ready, number, tracks.identity).astype(jnp.int32), state.fingers


def by_place(
    config: FingertipConfig,
    state: HandState,
    tracks: Tracks,
    ready: Bool[Array, " slots"],
    places: Float[Array, "slots 2"],
    observed: HandObservation,
) -> tuple[Int32[Array, " slots"], Fingers]:
    """The name, of five, of the finger that was in this direction and at this distance from the palm.

    Directions are relative to those fingers that are there. Where a direction differs from those of all absent fingers,
    the track gets a name that was not given yet, if there is one. The names outlive the tracks, and the hand's absence.
    """
    names = jnp.arange(MAX_TIPS)
    fingers = state.fingers
    angle = jax.vmap(base_angle, in_axes=(0, None, None))(places, state.palm, state.axis)
    length = jnp.linalg.norm(places - state.palm, axis=1) / jnp.maximum(observed.palm_radius, 1.0)
    own = tracks.identity[:, None] == names
    present = own & ((tracks.mode == CONFIRMED) & ~ready)[:, None]
    turned = jnp.sum(jnp.where(present, _turn(angle[:, None], fingers.angle), 0.0))
    turned = turned / jnp.maximum(jnp.sum(present), 1)
    off = _turn(angle[:, None] - turned, fingers.angle) / config.angle_sd
    cost = off**2 + ((length[:, None] - fingers.length) / config.length_sd) ** 2
    rank = jnp.cumsum(ready)[:, None] - 1
    cost = jnp.where(fingers.known, cost, config.stranger + _IN_TURN * (rank - names) ** 2)
    named = assignment.match_gated(jnp.minimum(cost, _MOST), _GATE, ready, ~jnp.any(present, axis=0)).column
    identity = jnp.where(ready, named, tracks.identity).astype(jnp.int32)
    shows = (identity[:, None] == names) & (ready | (tracks.missed == 0) & (tracks.mode == CONFIRMED))[:, None]
    shows &= observed.is_hand
    return identity, _updated(fingers, shows, angle, length)


def _updated(
    fingers: Fingers, shows: Bool[Array, "slots names"], angle: Float[Array, " slots"], length: Float[Array, " slots"]
) -> Fingers:
    """With the places of this frame, in which each name is shown by one track at most."""
    there = jnp.any(shows, axis=0)
    share = jnp.where(fingers.known, UPDATE_SHARE, 1.0) * there
    direction = jnp.sum(jnp.where(shows, angle[:, None], 0.0), axis=0)
    distance = jnp.sum(jnp.where(shows, length[:, None], 0.0), axis=0)
    return Fingers(
        fingers.angle + share * _turn(direction, fingers.angle),
        fingers.length + share * (distance - fingers.length),
        fingers.known | there,
    )


def _turn(angle: Array, reference: Array) -> Array:
    """From one direction to another, from -pi to pi."""
    return jnp.mod(angle - reference + jnp.pi, 2 * jnp.pi) - jnp.pi
