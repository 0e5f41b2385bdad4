"""How tracks of fingertips begin, are confirmed, coast and end (section 2.4), and the strategies for it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.fingertip import motion
from jaxfilters.models.fingertip.motion import Motion
from jaxfilters.models.fingertip.observation import MAX_TIPS, HandObservation
from jaxfilters.trackers.fingertips.state import (
    CONFIRMED,
    FREE,
    TENTATIVE,
    FingertipConfig,
    HandState,
    Tracks,
    chosen,
    repeated,
)

LEAST_COVERED = 0.25
"""Of the cell of the image beneath a predicted fingertip, that the hand covers if it may be there."""


def no_hint(config: FingertipConfig, state: HandState, observed: HandObservation) -> Gaussian:
    """Predictions as they are: the paper looks at tips alone."""
    del config, observed
    return state.tracks.belief


def carried(config: FingertipConfig, state: HandState, observed: HandObservation) -> Gaussian:
    """Predictions of fingers that go where their palm goes, more or less; a palm that jumps is a mistake."""
    moved = observed.palm - state.palm
    velocity = moved / config.frame
    # More frames in the same time say no more of how a finger moves beside its palm.
    variance = (config.carried_sd / config.measurement_sd) ** 2 / config.frame + config.drive
    visible = observed.is_hand & (state.unseen == 0) & (jnp.sum(moved * moved) < config.gate**2)
    hint = jax.vmap(motion.correct_velocity, in_axes=(0, None, None, None))
    return hint(state.tracks.belief, jnp.where(visible, velocity, 0.0), variance, visible)


def detected(tip: Float[Array, "2"], filtered: Float[Array, "2"]) -> Float[Array, "2"]:
    """The detection itself, as the paper may be read."""
    del filtered
    return tip


def filtered(tip: Float[Array, "2"], filtered: Float[Array, "2"]) -> Float[Array, "2"]:
    """What detection and prediction say together."""
    del tip
    return filtered


def anywhere(
    config: FingertipConfig, tracks: Tracks, positions: Float[Array, "slots 2"], observed: HandObservation
) -> Bool[Array, " tips"]:
    """Every tip without a track begins one."""
    del config, tracks, positions
    return observed.is_tip


def away_from_others(
    config: FingertipConfig, tracks: Tracks, positions: Float[Array, "slots 2"], observed: HandObservation
) -> Bool[Array, " tips"]:
    """What lies on a fingertip that has a track is that one, detected twice."""
    apart = jnp.sum(jnp.square(observed.tips[:, None] - positions), axis=-1)
    taken = jnp.any((apart < config.apart**2) & (tracks.mode == CONFIRMED), axis=1)
    return observed.is_tip & ~taken


def always(positions: Float[Array, "slots 2"], observed: HandObservation) -> Bool[Array, " slots"]:
    """Every prediction is reported, as in the paper."""
    del observed
    return jnp.ones(len(positions), bool)


def on_hand(positions: Float[Array, "slots 2"], observed: HandObservation) -> Bool[Array, " slots"]:
    """A fingertip that is predicted where the image shows something else is folded, or has gone another way."""
    column, row = jnp.floor((positions + 0.5) / observed.cell).astype(jnp.int32).T
    rows, columns = observed.coverage.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    covered = observed.coverage[jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1)] >= LEAST_COVERED
    return (inside & covered) | ~observed.is_hand


def continued(
    config: FingertipConfig,
    tracks: Tracks,
    following: Gaussian,
    matched: Bool[Array, " slots"],
) -> tuple[Tracks, Bool[Array, " slots"]]:
    """Tracks after a frame, and which became fingertips; `following` are their beliefs in the next frame.

    A fingertip coasts while its next prediction is certain enough; what is not one yet ends with its first miss.
    """
    hits = tracks.hits + matched
    known = motion.uncertainty(following) < config.lost
    mode = jnp.where(tracks.mode == CONFIRMED, jnp.where(known, CONFIRMED, FREE), tracks.mode)
    mode = jnp.where((mode == TENTATIVE) & ~matched, FREE, mode)
    ready = (mode == TENTATIVE) & (hits >= config.min_hits) & known
    # A hand has five fingers: new ones wait until one of those that are coasting is given up.
    room = MAX_TIPS - jnp.sum(mode == CONFIRMED)
    ready &= jnp.cumsum(ready) <= room
    identity = jnp.where(mode == FREE, -1, tracks.identity)
    return (
        tracks._replace(
            belief=following,
            mode=jnp.where(ready, CONFIRMED, mode).astype(jnp.int32),
            identity=identity.astype(jnp.int32),
            hits=hits.astype(jnp.int32),
            missed=jnp.where(matched, 0, tracks.missed + 1).astype(jnp.int32),
            is_thumb=tracks.is_thumb & (mode != FREE),
        ),
        ready,
    )


def begun(
    config: FingertipConfig,
    moves: Motion,
    tracks: Tracks,
    tips: Float[Array, "tips 2"],
    new: Bool[Array, " tips"],
    memory: object,
) -> tuple[Tracks, Int32[Array, " slots"]]:
    """With tentative tracks of the `new` tips in free slots, as far as there are any, and the tip of each such slot.

    `memory` is that of the thumb test for a track that begins; the tip is -1 where no track begins.
    """
    free = tracks.mode == FREE
    rank = jnp.cumsum(free) - 1
    begins = free & (rank < jnp.sum(new))
    tip = jnp.argsort(~new)[jnp.clip(rank, 0, len(new) - 1)]
    fresh = jax.vmap(lambda at: motion.new_belief(at, max_speed=config.max_speed, measurement_sd=config.measurement_sd))
    belief = jax.vmap(motion.predict, in_axes=(None, 0, None))(moves, fresh(tips[tip]), config.drive)
    n = len(free)
    whole = jnp.zeros(n, jnp.int32)
    made = Tracks(belief, whole + TENTATIVE, whole - 1, whole + 1, whole, repeated(memory, n), whole > 0)
    return chosen(begins, made, tracks), jnp.where(begins, tip, -1).astype(jnp.int32)
