"""Find a hand without knowing where it was: many hypotheses of both hands, the likeliest pulled onto the image.

All hypotheses about one place are judged on the same readings, and the forearm is part of the model that is judged.
Otherwise a hypothesis could declare what it does not explain to be forearm: an open hand is then cheapest as a fist
turned upside down, whose "arm" are the fingers.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfilters._full_precision import dot
from jaxfilters._xla.compiled_quickly import compiled_lightly
from jaxfilters.math.lie import quaternion_normalize, quaternion_to_matrix
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.cost import count_observed
from jaxfilters.models.hand.limits import unusualness
from jaxfilters.models.hand.motion import per_coordinate
from jaxfilters.models.hand.registration import PosePrior, RegistrationConfig, Target, gauss_newton, target_from_image
from jaxfilters.models.hand.skeleton import HandGeometry, HandKinematics, forward_kinematics
from jaxfilters.models.hand.starting_poses import (
    GESTURES,
    PALM_TO_WRIST,
    Hypotheses,
    multiplied,
    of_every_gesture,
    second_axis,
    starting_poses,
)
from jaxfilters.models.rendering.comparison import compare_capsules
from jaxfilters.models.rendering.geometry import Capsules
from jaxfilters.models.rendering.placement import share_poses

SEARCH_RADIUS = 0.16
"""Metres about the middle of the palm within which readings are explained."""
SCALES = (0.85, 0.925, 1.0, 1.075, 1.15)
STRAIGHT, BENT = np.deg2rad([[0.0, 0.0, 0.0], [45.0, 0.0, 70.0]])
"""Angles of a finger in two of the variants of a finalist."""
TURN = 0.25
"""Radians about the palm's normal, to either side, of two more."""
ONE_OFF, OUTERMOST = 0.2, 0.45
"""Radians of spread by which a finger points where its neighbour did, and of one that nothing was matched to."""
BATCH = 20
"""Hypotheses in one compiled call; the variants of one finalist."""
NUM_VARIED = (4, 2)
"""Finalists that are varied, in the first and in the second round."""
NUM_REGISTERED, NUM_FINALISTS = 60, 6
"""Orientations that are registered with the middle one of the sizes, and hypotheses of these with every size."""
NUM_REPEATED = 2
"""Finalists that are registered with every size once more: the first time they start where the middle size has led."""
REGISTRATION_STRIDE, SCORING_STRIDE = 4, 2
"""Every how many pixels of the window one is used; coarser pixels mistake the back of a hand for its palm."""
MAX_ERROR = 0.05
"""Metres that one pixel costs at most."""
FOREARM_RADIUS = 0.028
"""Metres, of an average hand."""
FOREARM_DEPTH = 0.02
"""Metres from the skin of the forearm to its axis, about."""
FEWEST_ARM_PIXELS = 12
SIZE_STD = 0.1
"""Of the logarithm of the size of hands."""
UNUSUAL_SIZE = 0.001
"""Metres of cost that a hand one such standard deviation off the average must gain."""
UNUSUAL_POSE = 0.003
"""Metres of cost that a hand must gain whose angles are one standard deviation off usual ones, in the mean square. The
hand of the other side, or one turned over, explains many images as well, with fingers spread or bent in odd ways."""
POOR, DEEPER = 0.022, 0.025
"""Metres of cost of the best start from which on hands that much deeper are tried as well: where an edge or fingers
point at the camera, the middle of the palm is farther behind the visible surface than it is behind a palm's skin."""
COARSE = (0.04,) * 5 + (0.02,) * 3
FINE = (0.02,) * 3 + (0.01,) * 3
"""Widths of the robust weight, metres, one for each step."""
REGISTRATION = RegistrationConfig()


class Start(NamedTuple):
    """A pose with its hand, and how well they explain an image."""

    pose: Float[np.ndarray, " 22"]
    scale: float
    """Size of the hand relative to the average one."""
    side: float
    """+1 for a right hand, -1 for a left one."""
    cost: float
    """Metres: mean error over the readings near the hand, at most `MAX_ERROR`, and more for an unusual size or pose."""


def find_starts(
    camera: Pinhole,
    observed: Float[Array, "rows cols"],
    center: Float[np.ndarray, " 3"],
    geometry: HandGeometry,
    scales: Sequence[float],
    sides: Sequence[float] = (1.0, -1.0),
    num_registered: int = NUM_REGISTERED,
) -> list[Start]:
    """Poses, sizes and sides of a hand that explain an image after registration, the best first.

    Args:
        camera: Of the window, 128 x 128 pixels that hold a hand about `center`.
        observed: Metres; `inf` is background, NaN without a reading.
        center: Middle of the palm, metres, roughly.
        geometry: The average hand.
        scales: Sizes to try; the middle one comes first.
        sides: Hands to try, 1 for right and -1 for left.
        num_registered: How many orientations are registered, each with the gesture that explains the image best.

    Returns:
        At most `NUM_FINALISTS` different ones.
    """
    image = (camera, jnp.asarray(observed), jnp.asarray(center, jnp.float32), geometry)
    tried, costs = _searched(image, center, scales, sides, num_registered)
    if not np.min(costs) < POOR:
        deeper = np.asarray(center) + np.array([0.0, 0.0, DEEPER])
        tried, costs = _joined((tried, costs), _searched(image, deeper, scales, sides, num_registered))
    return [
        Start(tried.poses[i], float(tried.scales[i]), float(tried.sides[i]), float(costs[i]))
        for i in _distinct(tried, costs)
    ]


def _searched(
    image: tuple, center: np.ndarray, scales: Sequence[float], sides: Sequence[float], num_registered: int
) -> tuple[Hypotheses, np.ndarray]:
    """Hypotheses about one place after registration, and their costs."""
    tried = starting_poses(center, scales[len(scales) // 2], sides)
    _, costs = _refined(image, tried, ())
    tried = of_every_gesture(tried.rows(np.argsort(costs)[:num_registered]))
    _, costs = _refined(image, tried, ())
    tried, costs = _refined(image, _best_of_every(len(GESTURES), tried, costs), COARSE)
    finalists = tried.rows(_distinct(tried, costs))
    tried, costs = _judged(*_refined(image, _of_every_size(finalists, scales), FINE))
    best = tried.rows(_distinct(tried, costs)[:NUM_REPEATED])
    tried, costs = _joined((tried, costs), _judged(*_refined(image, _of_every_size(best, scales), FINE)))
    for count in NUM_VARIED[:1] if num_registered < NUM_REGISTERED else NUM_VARIED:
        best = tried.rows(_distinct(tried, costs))
        varied = _judged(*_refined(image, _variants(best.rows(slice(count)), sides), FINE))
        tried, costs = _joined((tried, costs), varied)
    return tried, costs


def _best_of_every(count: int, tried: Hypotheses, costs: np.ndarray) -> Hypotheses:
    """The cheapest of every `count` hypotheses in a row."""
    return tried.rows(np.argmin(costs.reshape(-1, count), axis=1) + count * np.arange(len(costs) // count))


def _of_every_size(tried: Hypotheses, scales: Sequence[float]) -> Hypotheses:
    """Every hypothesis with each of the sizes."""
    sizes = np.tile(np.asarray(scales, np.float32), len(tried.poses))
    return tried.rows(np.repeat(np.arange(len(tried.poses)), len(scales)))._replace(scales=sizes)


def _joined(one: tuple[Hypotheses, np.ndarray], other: tuple[Hypotheses, np.ndarray]) -> tuple[Hypotheses, np.ndarray]:
    """Hypotheses and their costs, those of `one` first."""
    return jax.tree.map(lambda first, second: np.concatenate([first, second]), one, other)


def _judged(tried: Hypotheses, costs: np.ndarray) -> tuple[Hypotheses, np.ndarray]:
    """Costs with what an unusual size and unusual angles cost more."""
    size = (np.log(tried.scales) / SIZE_STD) ** 2
    return tried, costs + UNUSUAL_SIZE * size + UNUSUAL_POSE * unusualness(tried.poses[:, 7:])


def _variants(finalists: Hypotheses, sides: Sequence[float]) -> Hypotheses:
    """What registration cannot reach from a finalist.

    One digit straight or bent, all fingers or those on one side off by one, and the hand of the other side, as it is or
    turned over.
    """
    poses, scales, found_sides = [], [], []
    turned_over, aside = np.array([0.0, 0.0, 1.0, 0.0]), np.array([math.cos(TURN / 2), 0.0, 0.0, math.sin(TURN / 2)])
    for pose, scale, side in zip(*finalists, strict=True):
        variants = []
        for digit in range(5):
            for angles in (STRAIGHT, BENT):
                variant = pose.copy()
                variant[7 + 3 * digit : 10 + 3 * digit] = angles if digit else 0.5 * angles[::-1]
                variants.append((variant, side))
        variants += [(_one_off(pose, first, outwards), side) for first in (1, 2, 3) for outwards in (1, -1)]
        other = -side if -side in sides else side
        for turn, to in ((turned_over, other), (np.array([1.0, 0.0, 0.0, 0.0]), other), (aside, side)):
            variants.append((_turned(pose, float(scale), turn), to))
        variants.append((_turned(pose, float(scale), aside * [1, -1, -1, -1]), side))
        for variant, to in variants:
            poses.append(variant)
            scales.append(scale)
            found_sides.append(to)
    return Hypotheses(np.stack(poses), np.asarray(scales, np.float32), np.asarray(found_sides, np.float32))


def _one_off(pose: np.ndarray, count: int, outwards: int) -> np.ndarray:
    """The last `count` fingers on the little finger's side (1), or the first on the thumb's (-1), off by one.

    Each takes the place of its neighbour; the outermost is stretched to where none was.
    """
    fingers = [4, 3, 2, 1][:count] if outwards > 0 else [1, 2, 3, 4][:count]
    moved = pose.copy()
    for i, finger in enumerate(fingers):
        angles = np.array([0.0, -outwards * OUTERMOST, 0.0])
        if i:
            neighbour = 7 + 3 * fingers[i - 1]
            angles = pose[neighbour : neighbour + 3] - [0.0, outwards * ONE_OFF, 0.0]
        moved[7 + 3 * finger : 10 + 3 * finger] = angles
    return moved


def _turned(pose: np.ndarray, scale: float, turn: np.ndarray) -> np.ndarray:
    """The pose turned in its own frame by a quaternion, about the middle of its palm."""
    before, turned = pose[3:7], multiplied(pose[3:7], turn)
    middle = pose[:3] - PALM_TO_WRIST * scale * second_axis(before)
    wrist = middle + PALM_TO_WRIST * scale * second_axis(turned)
    return np.concatenate([wrist, turned, pose[7:]]).astype(np.float32)


def registered(
    camera: Pinhole,
    observed: Float[Array, "rows cols"],
    center: Float[np.ndarray, " 3"],
    geometry: HandGeometry,
    start: Start,
) -> Start:
    """One pose after the same registration, with its cost, as `find_starts` would judge it."""
    image = (camera, jnp.asarray(observed), jnp.asarray(center, jnp.float32), geometry)
    one = Hypotheses(start.pose[None], np.full(1, start.scale, np.float32), np.full(1, start.side, np.float32))
    found, costs = _judged(*_refined(image, one, FINE))
    return start._replace(pose=found.poses[0], cost=float(costs[0]))


def costs_of(
    camera: Pinhole,
    observed: Float[Array, "rows cols"],
    center: Float[np.ndarray, " 3"],
    geometry: HandGeometry,
    starts: Sequence[Start],
) -> Float[np.ndarray, " s"]:
    """Costs of hands as they are, as `find_starts` would judge them on this window, metres."""
    image = (camera, jnp.asarray(observed), jnp.asarray(center, jnp.float32), geometry)
    tried = Hypotheses(*(np.asarray([start[i] for start in starts], np.float32) for i in range(3)))
    return _judged(*_refined(image, tried, ()))[1]


def _refined(image: tuple, tried: Hypotheses, widths: tuple[float, ...]) -> tuple[Hypotheses, np.ndarray]:
    """Hypotheses after a Gauss-Newton step for each of `widths`, and their costs, batch by batch."""
    steps = np.zeros(max(len(COARSE), len(FINE)), np.float32)
    steps[: len(widths)] = widths
    poses, costs = [], []
    for first in range(0, len(tried.poses), BATCH):
        part = tried.rows(slice(first, first + BATCH))
        count = len(part.poses)
        padded = jax.tree.map(lambda leaf, n=BATCH - count: np.concatenate([leaf, leaf[:1].repeat(n, axis=0)]), part)
        found, cost = _refine_batch(*image, padded, steps, np.int32(len(widths)))
        poses.append(np.asarray(found)[:count])
        costs.append(np.asarray(cost)[:count])
    return tried._replace(poses=np.concatenate(poses)), np.concatenate(costs)


@compiled_lightly
def _refine_batch(
    camera: Pinhole,
    observed: Float[Array, "rows cols"],
    center: Float[Array, " 3"],
    geometry: HandGeometry,
    batch: Hypotheses,
    widths: Float[Array, " w"],
    num_steps: Int[Array, ""],
) -> tuple[Float[Array, "h 22"], Float[Array, " h"]]:
    """Registered poses and their costs; without steps, the costs of the poses as they are."""
    shared = (camera, _near(camera, observed, center), geometry, widths, num_steps)
    return share_poses(_refine_each, batch, shared)


def _refine_each(batch: Hypotheses, shared: tuple) -> tuple[Float[Array, "h 22"], Float[Array, " h"]]:
    camera, near, geometry, widths, num_steps = shared
    coarse_camera, coarse = _every(REGISTRATION_STRIDE, camera, near)
    scoring_camera, evaluated = _every(SCORING_STRIDE, camera, near)
    root = jnp.diag(per_coordinate(0.06, 0.6, 0.6))

    def step(at: Array, start: Array, scale: Array, side: Array, target: Target, width: Array) -> Array:
        hand, prior = replace(geometry.scaled(scale), side=side), PosePrior(start, root)
        return gauss_newton(coarse_camera, target, hand, at, prior, width, REGISTRATION)[0]

    def cost(pose: Array, scale: Array, side: Array) -> Array:
        hand = forward_kinematics(pose, replace(geometry.scaled(scale), side=side))
        return explained(scoring_camera, evaluated, hand, pose, scale)

    starts, scales, sides = map(jnp.asarray, batch)
    targets = jax.vmap(partial(_without_arm, coarse_camera, coarse))(starts)
    # The loop is around the batch: a loop within it would be traced twice, once for one pose and once for all.
    steps = jax.vmap(step, (0, 0, 0, 0, 0, None))
    found = jax.lax.fori_loop(0, num_steps, lambda i, at: steps(at, starts, scales, sides, targets, widths[i]), starts)
    return found, jax.vmap(cost)(found, scales, sides)


def explained(
    camera: Pinhole,
    observed: Float[Array, "rows cols"],
    hand: HandKinematics,
    pose: Float[Array, " 22"],
    scale: Float[Array, ""],
) -> Float[Array, ""]:
    """Mean error in metres over the readings of an image that a hand and its forearm leave.

    The forearm runs from the wrist to the farthest reading beyond it, along the mean of those readings: bent at the
    wrist as it may be, and as short as the recording shows it.
    """
    wrist, away = pose[:3], quaternion_to_matrix(quaternion_normalize(pose[3:7]))[:, 1]
    points = camera.rays() * jnp.where(jnp.isfinite(observed), observed + FOREARM_DEPTH, 0.0)[..., None] - wrist
    beyond = jnp.isfinite(observed) & (dot(points, away) > 0.01)
    count = jnp.sum(beyond)
    mean = jnp.sum(jnp.where(beyond[..., None], points, 0.0), axis=(0, 1)) / jnp.maximum(count, 1)
    direction = jnp.where(count > FEWEST_ARM_PIXELS, mean / jnp.maximum(jnp.linalg.norm(mean), 1e-6), away)
    radius = FOREARM_RADIUS * scale
    length = jnp.max(jnp.where(beyond, dot(points, direction), 0.0)) - radius
    end = wrist + jnp.where(count > FEWEST_ARM_PIXELS, jnp.maximum(length, 1e-3), 1e-3) * direction
    inner = jnp.where(length > 0, radius, 0.5 * radius)
    limbs = Capsules(
        start=jnp.concatenate([hand.capsules.start, wrist[None]]),
        end=jnp.concatenate([hand.capsules.end, end[None]]),
        radius=jnp.concatenate([hand.capsules.radius, inner[None]]),
    )
    terms = compare_capsules(camera, limbs, observed, MAX_ERROR)
    readings = count_observed(observed)
    missed = MAX_ERROR * (readings - terms.overlap_count)
    return (terms.absolute_sum + missed) / jnp.maximum(readings, 1)


def _near(camera: Pinhole, observed: Float[Array, "rows cols"], center: Float[Array, " 3"]) -> Array:
    """The readings near the palm; background where they are farther away, else unknown."""
    points = camera.rays() * jnp.where(jnp.isfinite(observed), observed, 0.0)[..., None]
    outside = jnp.sum((points - center) ** 2, axis=-1) > SEARCH_RADIUS**2
    kept = jnp.where(outside, jnp.nan, observed)
    return jnp.where(observed > center[2] + SEARCH_RADIUS, jnp.inf, kept)


def _without_arm(camera: Pinhole, observed: Float[Array, "rows cols"], pose: Float[Array, " 22"]) -> Target:
    """The image without what lies beyond the wrist of a pose, which would pull the palm down the arm."""
    points = camera.rays() * jnp.where(jnp.isfinite(observed), observed, 0.0)[..., None]
    along = dot(points - pose[:3], quaternion_to_matrix(quaternion_normalize(pose[3:7]))[:, 1])
    arm = jnp.isfinite(observed) & (along > 0.02)
    return target_from_image(camera, jnp.where(arm, jnp.nan, observed))


def _distinct(tried: Hypotheses, costs: Float[np.ndarray, " h"]) -> np.ndarray:
    """Indices of the cheapest hypotheses of which no two are nearly the same, at most `NUM_FINALISTS`."""
    kept: list[int] = []
    for i in np.argsort(costs):
        pose, side = tried.poses[i], tried.sides[i]
        if not np.isfinite(costs[i]):
            continue
        for j in kept:
            other = tried.poses[j]
            turn = 2 * math.acos(min(1.0, abs(float(pose[3:7] @ other[3:7]))))
            near = np.linalg.norm(pose[:3] - other[:3]) < 0.02 and turn < math.radians(25)
            if side == tried.sides[j] and near and np.abs(pose[7:] - other[7:]).mean() < math.radians(20):
                break
        else:
            kept.append(int(i))
        if len(kept) == NUM_FINALISTS:
            break
    return np.asarray(kept, int)


def _every(stride: int, camera: Pinhole, observed: Array) -> tuple[Pinhole, Array]:
    shape = tuple(size // stride for size in observed.shape)
    return camera.crop(jnp.zeros(2), shape, stride), observed[::stride, ::stride]
