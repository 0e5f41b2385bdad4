"""People who walk on routes over a floor: bodies of jointed ellipsoids, not the one ellipsoid of the trackers."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.rendering.geometry import Ellipsoids

STRIDE_M = 1.4
"""Two steps."""
LEG_SWING, ARM_SWING = 0.42, 0.35
"""Largest angles from the vertical, radians."""
HIP, SHOULDER = 0.53, 0.82
"""Heights of the joints, in body heights."""
MODEL_HEIGHT_M, MODEL_WIDTH_M = 1.66, 0.42
"""Of the body whose parts are given below."""


@pytree_dataclass
class Walker:
    """A person at one time."""

    xy: Float[Array, " 2"]
    """Metres."""
    heading: Float[Array, ""]
    """Radians from the X axis to the direction of walking."""
    phase: Float[Array, ""]
    """Of the gait, radians; both legs are straight at 0 and at pi."""
    swing: Float[Array, ""]
    """1 walking, 0 standing."""
    height: Float[Array, ""]
    """Metres."""
    width: Float[Array, ""]
    """From arm to arm, metres."""


class Routes(NamedTuple):
    """Where everybody is over time."""

    xy: np.ndarray
    """(frames, people, 2) metres."""
    heading: np.ndarray
    """(frames, people) radians."""
    phase: np.ndarray
    """(frames, people) radians."""
    swing: np.ndarray
    """(frames, people), from 0 to 1."""


def body(walker: Walker) -> Ellipsoids:
    """Head, torso, thighs, shanks and arms in the world: eight ellipsoids."""
    angle = walker.swing * jnp.sin(walker.phase)
    legs, arms = LEG_SWING * angle, ARM_SWING * angle
    # The body sinks by what the straighter leg loses in height.
    hip = HIP * MODEL_HEIGHT_M * jnp.cos(legs)
    lift = hip - HIP * MODEL_HEIGHT_M
    shoulder = SHOULDER * MODEL_HEIGHT_M + lift
    upright = jnp.zeros(())
    centers = [_at(0.0, 0.0, 1.54 + lift), _at(0.0, 0.0, 1.17 + lift)]
    radii, tilts = [(0.10, 0.085, 0.12), (0.12, 0.17, 0.31)], [upright, upright]
    for side in (-1.0, 1.0):
        leg, arm = side * legs, -side * arms
        centers += [_hanging(0.08 * side, hip, reach, leg) for reach in (0.24, 0.66)]
        centers.append(_hanging(0.17 * side, shoulder, 0.30, arm))
        radii += [(0.085, 0.085, 0.26), (0.07, 0.065, 0.24), (0.06, 0.045, 0.34)]
        tilts += [leg, leg, arm]
    size = jnp.stack([walker.width / MODEL_WIDTH_M, walker.width / MODEL_WIDTH_M, walker.height / MODEL_HEIGHT_M])
    center = jnp.stack(centers) * size
    cos, sin = jnp.cos(walker.heading), jnp.sin(walker.heading)
    turn = jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])])
    center = jnp.concatenate([dot(center[:, :2], turn.T) + walker.xy, center[:, 2:]], axis=1)
    return Ellipsoids(center, _quaternions(walker.heading, jnp.stack(tilts)), jnp.array(radii) * size)


def _hanging(aside, joint, reach, angle):
    """Centre of a limb that hangs from a joint, swung forward by an angle."""
    return _at(reach * jnp.sin(angle), aside, joint - reach * jnp.cos(angle))


def _at(*coordinates):
    return jnp.stack([jnp.asarray(coordinate, float) for coordinate in coordinates])


def _quaternions(heading, tilt):
    """Turns by the heading about Z after swings by -tilt about Y, which moves the lower end forward."""
    c, s = jnp.cos(heading / 2), jnp.sin(heading / 2)
    a, b = jnp.cos(tilt / 2), -jnp.sin(tilt / 2)
    return jnp.stack([c * a, -s * b, c * b, s * a], axis=-1)


def along_routes(
    waypoints: list[np.ndarray], speeds_m_per_s: list[float], starts_s: list[float], frames: int, fps: float
) -> Routes:
    """People who walk along polylines with rounded corners, each at a steady speed from some time on.

    Before its start a person stands at the first corner, afterwards at the last.

    Args:
        waypoints: One (corners, 2) polyline a person, metres.
        speeds_m_per_s: One a person.
        starts_s: One a person.
        frames: How many.
        fps: Frames per second.
    """
    times = np.arange(frames) / fps
    walked = [
        _walk(corners, speed * np.maximum(times - start, 0.0))
        for corners, speed, start in zip(waypoints, speeds_m_per_s, starts_s, strict=True)
    ]
    xy = np.stack([place for place, _ in walked], axis=1)
    step = np.linalg.norm(np.diff(xy, axis=0, prepend=xy[:1]), axis=-1)
    return Routes(
        xy,
        np.stack([heading for _, heading in walked], axis=1),
        2 * math.pi * np.cumsum(step, axis=0) / STRIDE_M,
        np.clip(step * fps / 0.5, 0, 1),
    )


ROUNDING_M = 0.4
"""Length over which corners are rounded."""


def _walk(corners: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])

    def at(along):
        return np.stack([np.interp(along, lengths, corners[:, i]) for i in (0, 1)], axis=-1)

    window = np.linspace(-ROUNDING_M, ROUNDING_M, 17)
    place = at(np.clip(distance[:, None] + window, 0, lengths[-1])).mean(axis=1)
    ahead = at(np.clip(distance + 0.2, 0.2, lengths[-1])) - at(np.clip(distance - 0.2, 0, lengths[-1] - 0.2))
    return place, np.arctan2(ahead[:, 1], ahead[:, 0])
