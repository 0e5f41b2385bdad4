"""The fingertips of one hand from frame to frame: one compiled step, the paper's (section 8.1) and the modern one.

A `Method` says how the pieces go together: `MODERN` and `PUBLISHED`. Two hands are two states.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.fingertip import motion
from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.models.fingertip.thumb import ThumbAngles, base_angle
from jaxfilters.trackers.fingertips import lifecycle, naming, sides
from jaxfilters.trackers.fingertips.association import likeliest, nearest_in_order
from jaxfilters.trackers.fingertips.state import (
    ABSENT,
    CONFIRMED,
    MANIPULATION,
    NEVER,
    SYMBOLIC,
    FingertipConfig,
    HandReport,
    HandState,
    Method,
    Tracks,
    no_tracks,
)
from jaxfilters.trackers.fingertips.thumbs import MEAN_SCORE, POSTERIOR
from jaxfilters.trackers.innovations import innovation_counts

MODERN = Method(
    lifecycle.carried,
    sides.by_fingers,
    likeliest,
    lifecycle.away_from_others,
    naming.by_place,
    lifecycle.filtered,
    lifecycle.on_hand,
    POSTERIOR,
)
PUBLISHED = Method(
    lifecycle.no_hint,
    sides.as_given,
    nearest_in_order,
    lifecycle.anywhere,
    naming.numbered,
    lifecycle.detected,
    lifecycle.always,
    MEAN_SCORE,
)
PUBLISHED_CONFIG = FingertipConfig(lost=300.0)
"""The published constants."""


def start(config: FingertipConfig, angles: ThumbAngles, *, method: Method = MODERN) -> HandState:
    """A hand of which nothing was observed yet."""
    never = jnp.asarray(NEVER, jnp.int32)
    return HandState(
        no_tracks(config, method.thumb.start(config, angles)),
        naming.no_fingers(),
        palm=jnp.zeros(2),
        palm_velocity=jnp.zeros(2),
        unseen=never,
        axis=jnp.array([0.0, -1.0]),
        axis_unseen=never,
        empty=jnp.zeros((), jnp.int32),
        disordered=jnp.zeros((), jnp.int32),
        turned=jnp.zeros((), bool),
        side_odds=jnp.asarray(sides.DECIDED, dtype=float),
        next_identity=jnp.zeros((), jnp.int32),
    )


@partial(jax.jit, static_argnames=("config", "method"))
def step(
    config: FingertipConfig,
    angles: ThumbAngles,
    state: HandState,
    observed: HandObservation,
    side: float | Float[Array, ""] = 1.0,
    *,
    method: Method = MODERN,
) -> tuple[HandState, HandReport]:
    """A hand after one more frame, and what is known of it then.

    Args:
        config: Constants.
        angles: Of this person's thumb and forefinger.
        state: The hand before.
        observed: What the frame shows; with no hand and no tip it is a frame to coast through.
        side: -1 for the hand whose thumb is clockwise of the arm's axis, at first: it may turn over.
        method: The strategies.
    """
    observed = _usable(observed)
    state = _sided(config, angles, state, observed, side, method)
    side = jnp.where(state.turned, -side, side)
    placed = _placed(config, state, observed)
    moves = motion.velocity_driven(config.frame)
    beliefs = method.hint(config, state, observed)
    tip, doubt = method.associate(config, placed, beliefs, observed)
    matched = tip >= 0
    corrected, info = jax.vmap(motion.correct)(beliefs, observed.tips[jnp.maximum(tip, 0)], matched)
    following = jax.vmap(motion.predict, in_axes=(None, 0, None))(moves, corrected, config.drive)
    tracks, ready = lifecycle.continued(config, state.tracks, following, matched)
    # Fingers of a hand that turned over have no names any more.
    unnamed = (tracks.mode == CONFIRMED) & (tracks.identity < 0)
    places = corrected.mean[:, :2]
    identity, fingers = method.name(config, placed, tracks, ready | unnamed, places, observed, side)
    tracks = tracks._replace(identity=identity)
    seen_twice = ~jnp.any(tip[:, None] == jnp.arange(len(observed.is_tip)), axis=0)
    new = seen_twice & method.may_begin(config, tracks, places, observed)
    tracks, first_tip = lifecycle.begun(config, moves, tracks, observed.tips, new, method.thumb.start(config, angles))
    tip = jnp.where(first_tip >= 0, first_tip, jnp.where(tracks.hits > 0, tip, -1))
    tracks, probability = _thumbs(config, angles, method, placed, tracks, observed, tip, side)

    after = placed._replace(
        tracks=tracks,
        fingers=fingers,
        disordered=jnp.where(doubt, placed.disordered + 1, 0).astype(jnp.int32),
        next_identity=(state.next_identity + jnp.sum(ready)).astype(jnp.int32),
    )
    innovations = jax.vmap(innovation_counts, in_axes=(0, None))(info, config.measurement_sd)
    sight = _Sight(corrected, observed.tips[jnp.maximum(tip, 0)], matched, probability, innovations)
    report = _report(config, after, observed, sight, method)
    gone = after.empty >= config.empty_frames
    nothing = start(config, angles, method=method)._replace(
        fingers=fingers, next_identity=after.next_identity, turned=after.turned, side_odds=after.side_odds
    )
    return jax.tree.map(lambda a, b: jnp.where(gone, a, b), nothing, after), report


@partial(jax.jit, static_argnames=("config", "method"))
def run(
    config: FingertipConfig,
    angles: ThumbAngles,
    state: HandState,
    observed: HandObservation,
    side: float | Float[Array, ""] = 1.0,
    *,
    method: Method = MODERN,
) -> tuple[HandState, HandReport]:
    """The state after all frames and the reports of each, frames first, as of `observed`; for `vmap` over hands."""

    def one(state: HandState, observed: HandObservation) -> tuple[HandState, HandReport]:
        return step(config, angles, state, observed, side, method=method)

    return jax.lax.scan(one, state, observed)


def predicted(config: FingertipConfig, state: HandState, frames: int = 1) -> Gaussian:
    """Belief in every slot so many frames after the last observed one; covariances by that of a measurement.

    Oka and Sato 2006, equations 10 and 11.

    Raises:
        ValueError: If `frames` is not at least 1.
    """
    if frames < 1:
        raise ValueError(f"frames must be at least 1; got {frames}.")
    if frames == 1:
        return state.tracks.belief
    moves = motion.velocity_driven(config.frame)
    return jax.vmap(lambda belief: motion.ahead(moves, belief, config.drive, frames - 1))(state.tracks.belief)


class _Sight(NamedTuple):
    """What became of the slots in a frame."""

    corrected: Gaussian
    tips: Array
    matched: Array
    probability: Array
    innovations: Array


def _usable(observed: HandObservation) -> HandObservation:
    """Without tips where there is no hand, or whose numbers are none; nothing that is not finite goes on."""
    palm_there = observed.is_hand & jnp.all(jnp.isfinite(observed.palm))
    is_tip = observed.is_tip & palm_there & jnp.all(jnp.isfinite(observed.tips), axis=-1)
    has_base = observed.has_base & is_tip & jnp.all(jnp.isfinite(observed.bases), axis=-1)
    has_axis = observed.has_axis & palm_there & jnp.all(jnp.isfinite(observed.axis))
    return observed._replace(
        tips=jnp.where(is_tip[:, None], observed.tips, 0.0),
        is_tip=is_tip,
        bases=jnp.where(has_base[:, None], observed.bases, 0.0),
        has_base=has_base,
        palm=jnp.where(palm_there, observed.palm, 0.0),
        axis=jnp.where(has_axis, observed.axis, 0.0),
        has_axis=has_axis,
        is_hand=palm_there,
    )


def _sided(
    config: FingertipConfig,
    angles: ThumbAngles,
    state: HandState,
    observed: HandObservation,
    side: float | Array,
    method: Method,
) -> HandState:
    """With the side of the thumb; where that is another one than before, no finger has a name, nor is one the thumb."""
    turned, odds = method.side(config, state, observed, side)
    new = no_tracks(config, method.thumb.start(config, angles))
    forgotten = state.tracks._replace(identity=new.identity, thumb=new.thumb, is_thumb=new.is_thumb)
    tracks, fingers = jax.tree.map(
        lambda a, b: jnp.where(turned != state.turned, a, b),
        (forgotten, naming.no_fingers()),
        (state.tracks, state.fingers),
    )
    return state._replace(tracks=tracks, fingers=fingers, turned=turned, side_odds=odds)


def _placed(config: FingertipConfig, state: HandState, observed: HandObservation) -> HandState:
    """With palm and axis of this frame, or the last ones that were observed."""
    follows = observed.is_hand & (state.unseen == 0)
    return state._replace(
        palm_velocity=jnp.where(follows, observed.palm - state.palm, 0.0),
        palm=jnp.where(observed.is_hand, observed.palm, state.palm),
        unseen=jnp.where(observed.is_hand, 0, jnp.minimum(state.unseen + 1, NEVER)).astype(jnp.int32),
        axis=jnp.where(observed.has_axis, observed.axis, state.axis),
        axis_unseen=jnp.where(observed.has_axis, 0, jnp.minimum(state.axis_unseen + 1, NEVER)).astype(jnp.int32),
        empty=jnp.where(jnp.any(observed.is_tip), 0, jnp.minimum(state.empty + 1, config.empty_frames)).astype(
            jnp.int32
        ),
    )


def _thumbs(
    config: FingertipConfig,
    angles: ThumbAngles,
    method: Method,
    placed: HandState,
    tracks: Tracks,
    observed: HandObservation,
    tip: Int32[Array, " slots"],
    side: float | Array,
) -> tuple[Tracks, Float[Array, " slots"]]:
    """Tracks with what the bases in this frame say of the thumb, and the probability of each to be it."""
    own = jnp.maximum(tip, 0)
    visible = (tip >= 0) & observed.has_base[own] & _knows_axis(config, placed)
    angle = jax.vmap(base_angle, in_axes=(0, None, None, None))(observed.bases[own], placed.palm, placed.axis, side)
    memories = jax.vmap(partial(method.thumb.observe, config, angles))(tracks.thumb, angle, visible)
    probability, is_thumb = method.thumb.judge(memories, tracks.is_thumb, tracks.mode == CONFIRMED)
    return tracks._replace(thumb=memories, is_thumb=is_thumb), probability


def _knows_axis(config: FingertipConfig, placed: HandState) -> Bool[Array, ""]:
    return placed.axis_unseen <= config.axis_frames


def _report(
    config: FingertipConfig, after: HandState, observed: HandObservation, sight: _Sight, method: Method
) -> HandReport:
    tracks = after.tracks
    is_there = sight.matched | method.may_coast(sight.corrected.mean[:, :2], observed)
    is_tip = (tracks.mode == CONFIRMED) & is_there
    reported = jax.vmap(method.report)(sight.tips, sight.corrected.mean[:, :2])
    position = jnp.where(sight.matched[:, None], reported, sight.corrected.mean[:, :2])
    uncertainty = jnp.maximum(motion.uncertainty(sight.corrected), 0.0)
    sd = jnp.hypot(config.measurement_sd * jnp.sqrt(uncertainty), config.misplacement_sd)
    thumb_out = jnp.any(tracks.is_thumb & is_tip)
    mode = jnp.where(jnp.any(is_tip), jnp.where(thumb_out, MANIPULATION, SYMBOLIC), ABSENT)
    return HandReport(
        identity=jnp.where(is_tip, tracks.identity, -1),
        is_tip=is_tip,
        is_observed=is_tip & sight.matched,
        position=jnp.where(is_tip[:, None], position, 0.0),
        sd=jnp.where(is_tip, sd, 0.0),
        innovations=jnp.where(is_tip[:, None], sight.innovations, 0),
        velocity=jnp.where(is_tip[:, None], sight.corrected.mean[:, 2:], 0.0),
        is_thumb=is_tip & tracks.is_thumb,
        thumb_probability=jnp.where(is_tip, sight.probability, 0.0),
        palm=after.palm,
        has_palm=observed.is_hand,
        axis=after.axis,
        has_axis=_knows_axis(config, after),
        mode=mode.astype(jnp.int32),
        num_tips=jnp.sum(is_tip).astype(jnp.int32),
    )
