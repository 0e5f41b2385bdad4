"""Finding a hand that is not tracked yet, and new starts that compete with a track: frame by frame, on the host."""

import math
from dataclasses import replace
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.observation import crop, has_reading_near
from jaxfilters.models.hand.skeleton import HandGeometry, forward_kinematics, hand_center
from jaxfilters.models.hand.start import BATCH, SCALES, SEARCH_RADIUS, Start, costs_of, find_starts, registered
from jaxfilters.models.rendering.depth import capsule_depth
from jaxfilters.trackers.hand_depth.detect import NEAREST, Sighting, hand_sightings
from jaxfilters.trackers.hand_depth.filtering import (
    WINDOW,
    Setup,
    TrackState,
    filled,
    particles_of,
    placed,
    pose_moments,
)

SAME_ARM = 1.5 * SEARCH_RADIUS
"""Metres between two places on one surface up to which they are judged together."""
CLEARLY = 0.9
"""Share of the cost of another place below which one is better than it."""
SECOND_CHANCE, RACE_INTERVAL, QUIET_INTERVAL = 0.3, 1.0, 3.0
"""Seconds from a start to the first race of new starts against the track, between races while it is doubtful, and
while it is not."""
NUM_RACING = BATCH
"""Hypotheses that are registered for a race."""
BETTER = 0.85
"""Share of the cost of the track, or of the hand that was asked for, below which another explanation is better."""
AS_GOOD = 1.1
"""Share of the cost of the track up to which another explanation puts it in doubt."""
DIFFERENT = 0.025
"""Metres between the joints of two explanations, in the mean, from which on they are different."""
DOUBTFUL_COST = 0.024
"""Metres, as `Start.cost`, above which a start explains the frame too badly to be believed."""
WORST_START = 0.032
"""Metres, likewise, above which nothing is believed to be a hand."""
LEAST_READ = 0.75
"""Share of what the tracked hand shows that needs readings for a race. Where fingers are hidden, many other poses
explain the rest as well, which says nothing against the track."""


def search(setup: Setup, state: TrackState, frame: np.ndarray, time: float) -> TrackState:
    """Place the ensemble anew where the frame shows a hand, of the known size if any.

    Where what it shows is no hand, `race_time` says when to look again: not in every frame, since it takes a second.
    """
    image = np.asarray(filled(jnp.asarray(frame), state.missing_is_background))
    starts = _starts(setup, state, hand_sightings(setup.camera, image))
    wanted = [start for start in starts if not start.side * float(state.side) < 0]
    found = min(wanted, key=lambda start: start.cost, default=None)
    if found is None or not found.cost < WORST_START:
        pause = SECOND_CHANCE if starts else 0.0
        return state._replace(race_time=jnp.asarray(time + pause, dtype=float))
    doubt = found.cost > DOUBTFUL_COST or _is_rivalled(setup, found, starts)
    return _begun(setup, state, found, time, doubt)


def _starts(setup: Setup, state: TrackState, sightings: list[Sighting]) -> list[Start]:
    """The starts about every sighting but those that another one on the same arm explains better.

    About the middle of a forearm alone, an upside-down hand is cheap whose "forearm" is the palm. Of two places on one
    arm, the one whose best start explains both counts: that with the lower of the higher costs, if it is clearly lower.
    """
    geometry = setup.likelihood.geometry
    windows = [_window(setup, sighting) for sighting in sightings]
    found = [find_starts(*window, geometry, _sizes(state), (1.0, -1.0)) for window in windows]

    def highest(starts: list[Start], pair: tuple[int, int]) -> float:
        if not starts:
            return math.inf
        return float(np.max([costs_of(*windows[i], geometry, starts) for i in pair], axis=0).min())

    beaten = set()
    for i, j in combinations(range(len(sightings)), 2):
        if sightings[i].surface == sightings[j].surface and math.dist(windows[i][2], windows[j][2]) < SAME_ARM:
            first, second = highest(found[i], (i, j)), highest(found[j], (i, j))
            beaten |= {j} if first < CLEARLY * second else {i} if second < CLEARLY * first else set()
    return [start for i, starts in enumerate(found) if i not in beaten for start in starts]


def race(setup: Setup, state: TrackState, frame: np.ndarray, time: float) -> TrackState:
    """Let new starts compete with the track on one frame: the better one goes on, in doubt if they differ in vain.

    They look where the track is. A track that lost the hand altogether is lost by its own cost, and searched for. While
    much of the hand is hidden, the race is put off.
    """
    pose, _ = pose_moments(*particles_of(state.ensemble))
    scale, side = float(state.scale), float(state.side)
    palm = np.asarray(hand_center(pose, 0.6 * scale))
    if int(state.misses) or not (np.isfinite(palm).all() and palm[2] > NEAREST):
        return state._replace(race_time=jnp.asarray(time + RACE_INTERVAL, dtype=float))
    image = filled(jnp.asarray(frame), state.missing_is_background)
    camera, window = _cropped(setup.compiled(), image, jnp.asarray(palm))
    if _share_read(setup.compiled(), camera, window, pose, state.scale, state.side) < LEAST_READ:
        return state._replace(race_time=jnp.asarray(time + SECOND_CHANCE, dtype=float))
    average = setup.likelihood.geometry
    track = registered(camera, window, palm, average, Start(np.asarray(pose), scale, side, math.nan))
    sizes = (scale,) if setup.config.scale else (0.92 * scale, scale, 1.08 * scale)
    starts = find_starts(camera, window, palm, average, sizes, (1.0, -1.0), NUM_RACING)
    allowed = [start for start in starts if setup.config.hand == "auto" or start.side == side]
    rival = allowed[0] if allowed else track
    if rival.cost < BETTER * track.cost:
        return _begun(setup, state, rival, time, rival.cost > DOUBTFUL_COST or _is_rivalled(setup, rival, starts))
    doubt = track.cost > DOUBTFUL_COST or _is_rivalled(setup, track, starts)
    pause = RACE_INTERVAL if doubt else QUIET_INTERVAL
    return state._replace(doubt=jnp.asarray(doubt), race_time=jnp.asarray(time + pause, dtype=float))


def _is_rivalled(setup: Setup, found: Start, starts: list[Start]) -> bool:
    """Whether a different explanation of the same frame is about as good as the one found."""
    rivals = [start for start in starts if start.cost < AS_GOOD * found.cost]
    other_side = any(start.side != found.side and start.cost < found.cost for start in rivals)
    return other_side or any(_distance(setup.likelihood.geometry, start, found) > DIFFERENT for start in rivals)


def _begun(setup: Setup, state: TrackState, found: Start, time: float, doubt: bool) -> TrackState:
    """The state with an ensemble about a start."""
    key, place_key = jax.random.split(state.key)
    state = state._replace(
        scale=jnp.asarray(found.scale, dtype=float),
        side=jnp.asarray(found.side, dtype=float),
        doubt=jnp.asarray(doubt),
        race_time=jnp.asarray(time + SECOND_CHANCE, dtype=float),
        misses=jnp.zeros_like(state.misses),
        key=key,
    )
    return state._replace(
        ensemble=placed(place_key, setup.compiled(), jnp.asarray(found.pose), state.scale, state.side)
    )


def _sizes(state: TrackState) -> tuple[float, ...]:
    scale = float(state.scale)
    return SCALES if math.isnan(scale) else (scale,)


def _window(setup: Setup, sighting: Sighting) -> tuple[Pinhole, Array, np.ndarray]:
    """Camera, depth and middle of what is about a sighting."""
    camera, depth = _cropped(setup.compiled(), jnp.asarray(sighting.frame), jnp.asarray(sighting.center))
    return camera, depth, sighting.center


@compiled_quickly
def _cropped(setup: Setup, frame: Array, center: Array) -> tuple[Pinhole, Array]:
    return crop(setup.camera, frame, center, WINDOW, setup.spacing(center[2]))


@compiled_quickly
def _share_read(
    setup: Setup, camera: Pinhole, observed: Array, pose: Array, scale: Array, side: Array
) -> Float[Array, ""]:
    """Of the pixels of an image in which a hand would show, those that have a reading close by."""
    hand = forward_kinematics(pose, setup.sized(scale, side).geometry)
    shown = jnp.isfinite(capsule_depth(camera, hand.capsules))
    return jnp.sum(shown & has_reading_near(observed)) / jnp.maximum(jnp.sum(shown), 1)


def _distance(average: HandGeometry, one: Start, other: Start) -> float:
    """Between the joints of two hands, metres, in the mean."""
    joints = [np.asarray(_joints(np.asarray(each.pose), average, each.scale, each.side)) for each in (one, other)]
    return float(np.linalg.norm(joints[0] - joints[1], axis=-1).mean())


@compiled_quickly
def _joints(pose: Array, average: HandGeometry, scale: Array, side: Array) -> Array:
    geometry = replace(average.scaled(scale), side=jnp.asarray(side, average.side.dtype))
    return forward_kinematics(pose, geometry).joints
