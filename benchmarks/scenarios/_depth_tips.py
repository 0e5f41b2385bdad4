"""Fingertips in depth images with true joints: edges in the depth image beside the contour of the same mask alone.

Three sets: `rendered` are poses of the package's capsule hand, whose fingers touch, cross and fold before the palm;
`scanned` are motions of real hands rendered from scanned ones (`HELD`, looked at once before the two last changes to
the method); `camera` is the recording of a depth camera, whose joints are a fit. A forearm is added where there is
none, since the hand comes in from the border of the image. A tip counts if its surface is visible and its finger is
stretched; it is found if a detection is nearer than 1.3 tip radii. A detection is false if it is near no fingertip at
all.
"""

import math
import sys
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios._real_hands import HELD, NUM_FRAMES, WALL_M, load
from jaxfilters.models.fingertip.detection import detect_hand
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.hand.skeleton import hand_geometry, open_palm
from jaxfilters.models.synthetic.depth_sensor import DepthSensor, depth_from_millimetres
from jaxfilters.models.synthetic.hand import film_hand, kinect_v2

TIPS, BASES = [4, 8, 12, 16, 20], [2, 5, 9, 13, 17]
"""Joints: the ends of the fingers, and the knuckles from which on they can be stretched."""
STRETCHED = 0.8
"""Of the length of its bones, that a finger reaches from its knuckle."""
FINGER_RADIUS_M, FOREARM_RADIUS_M = 0.0075, 0.027
BEHIND_SURFACE_M, BEFORE_SURFACE_M = 0.022, 0.012
"""How far the middle of a visible fingertip lies behind what the image shows there, and before it, at most."""
GATE = 1.3
"""Tip radii."""
NUM_RENDERED, QUICK_NUM_RENDERED, NUM_SCANNED = 60, 4, 16
"""Poses, and frames of each motion; of the camera's recording all count."""
SENSOR = DepthSensor(flying_fraction=0.02, dropout_fraction=0.02)


class DepthHand(NamedTuple):
    """A depth image of a hand, and its fingertips."""

    depth: Float[np.ndarray, "rows cols"]
    """Metres; NaN or inf beside the hand."""
    tips: Float[np.ndarray, "5 3"]
    """Middles of the rounded ends, metres."""
    is_stretched: Bool[np.ndarray, "5"]
    matrix: Float[np.ndarray, "3 3"]


def depth_tip_metrics(*, quick: bool, seed: int) -> dict[str, Metric]:
    """Found and false percentages of all sets that are there, with edges and with the contour alone."""
    found = counted("rendered", rendered_hands(seed, QUICK_NUM_RENDERED if quick else NUM_RENDERED))
    if quick:
        return found
    for name, recordings in (("scanned", HELD), ("camera", ("hpx",))):
        try:
            found |= counted(name, (hand for recording in recordings for hand in recorded_hands(recording)))
        except RecordingError as error:
            sys.stderr.write(f"  without {name} hands: {error}\n")
    return found


def counted(name: str, hands: Iterator[DepthHand]) -> dict[str, Metric]:
    """Percentages of one set."""
    totals = {"edges": np.zeros(4, int), "contour": np.zeros(4, int)}
    for hand in hands:
        mask = cv2.medianBlur((np.nan_to_num(hand.depth, nan=WALL_M) < WALL_M - 0.1).astype(np.uint8), 3).view(bool)
        parameters = _parameters(hand, mask)
        for way, depth in (("edges", hand.depth), ("contour", None)):
            observed = detect_hand(mask, parameters, depth)
            found = np.asarray(observed.tips)[np.asarray(observed.is_tip)]
            totals[way] = totals[way] + np.array(count(hand, mask, found, parameters.tip_radius))
    metrics = {}
    for way, (shown, hit, reported, false) in totals.items():
        metrics[f"found_pct_depth_{name}_{way}"] = Metric(100 * hit / max(shown, 1), "%", "higher")
        metrics[f"false_pct_depth_{name}_{way}"] = Metric(100 * false / max(reported, 1), "%", "lower")
    return metrics


def count(
    hand: DepthHand, mask: Bool[np.ndarray, "rows cols"], found: Float[np.ndarray, "n 2"], radius: float
) -> tuple[int, int, int, int]:
    """Stretched fingertips that are visible, those of them that are found, detections, and false ones.

    What is nearer to the border than two radii is neither missed nor false.
    """
    pixels = hand.tips @ hand.matrix.T
    places = pixels[:, :2] / pixels[:, 2:]
    size = np.array(mask.shape[::-1])
    inside = ((places > 2 * radius) & (places < size - 2 * radius)).all(axis=1)
    apart = np.linalg.norm(places[:, None] - found, axis=-1)
    rows, columns = linear_sum_assignment(np.where(apart < GATE * radius, apart, 1e3 * radius))
    near = apart[rows, columns] < GATE * radius
    hit = np.isin(np.arange(len(places)), rows[near])
    shown = inside & hand.is_stretched & _is_visible(hand, mask, places)
    return int(shown.sum()), int((shown & hit).sum()), len(found), len(found) - int(near.sum())


def _is_visible(hand: DepthHand, mask: np.ndarray, places: Float[np.ndarray, "5 2"]) -> Bool[np.ndarray, "5"]:
    """Whether the surface at the place of a tip is that of its finger."""
    visible = np.zeros(len(places), bool)
    for i, (x, y) in enumerate(np.rint(places).astype(int)):
        if 0 < x < mask.shape[1] - 1 and 0 < y < mask.shape[0] - 1 and mask[y, x]:
            behind = hand.tips[i, 2] - float(np.nanmedian(hand.depth[y - 1 : y + 2, x - 1 : x + 2]))
            visible[i] = -BEFORE_SURFACE_M < behind < BEHIND_SURFACE_M
    return visible


def _parameters(hand: DepthHand, mask: Bool[np.ndarray, "rows cols"]) -> HandParameters:
    """A finger of the usual thickness at the distance of the hand."""
    radius = FINGER_RADIUS_M * float(hand.matrix[0, 0]) / float(np.nanmedian(hand.depth[mask]))
    return HandParameters(tip_radius=radius, half_size=max(round(9 / 6.5 * radius), math.ceil(radius) + 1))


def rendered_hands(seed: int, number: int) -> Iterator[DepthHand]:
    """Random poses of the capsule hand before a Kinect, the palm towards the camera or away from it, in turn."""
    rng = np.random.default_rng(seed)
    poses = np.stack([_random_pose(rng, turned=bool(i % 2)) for i in range(number)])
    camera = kinect_v2()
    film = film_hand(jax.random.key(seed), jnp.asarray(poses, jnp.float32), hand_geometry(), camera, SENSOR)
    matrix = np.asarray(camera.matrix(), float)
    for depth_mm, joints in zip(film.depth_mm, np.asarray(film.joints), strict=True):
        depth = np.array(depth_from_millimetres(depth_mm))
        yield _hand(np.where(depth < WALL_M, depth, np.inf), joints, matrix, 0.0)


def recorded_hands(name: str) -> Iterator[DepthHand]:
    """Frames of a motion or a recording, see `load`.

    Raises:
        RecordingError: the data are not there.
    """
    recording = load(name, NUM_SCANNED if name in HELD else NUM_FRAMES, evenly=True)
    matrix = np.asarray(recording.camera.matrix(), float)
    for depth, joints in zip(recording.depth, recording.joints, strict=True):
        near = np.where(depth < WALL_M - 0.1, depth, np.inf)
        yield _hand(near, joints, matrix, FINGER_RADIUS_M, has_forearm=name == "hpx")


def _hand(
    depth: np.ndarray, joints: Float[np.ndarray, "21 3"], matrix: np.ndarray, inset: float, *, has_forearm: bool = False
) -> DepthHand:
    """With a forearm, and tips that are `inset` metres inside of the last joints."""
    last = joints[TIPS] - joints[np.array(TIPS) - 1]
    tips = joints[TIPS] - inset * last / np.linalg.norm(last, axis=1, keepdims=True)
    bones = np.linalg.norm(np.diff(joints, axis=0), axis=1)
    lengths = np.array([bones[base:tip].sum() for base, tip in zip(BASES, TIPS, strict=True)])
    reach = np.linalg.norm(joints[TIPS] - joints[BASES], axis=1)
    arm = np.inf if has_forearm else _forearm(depth.shape, joints, matrix)
    return DepthHand(np.fmin(depth, arm).astype(np.float32), tips, reach > STRETCHED * lengths, matrix)


def _forearm(shape: tuple[int, ...], joints: Float[np.ndarray, "21 3"], matrix: np.ndarray) -> np.ndarray:
    """Depth of a round forearm from the wrist to the border, at the wrist's distance; `inf` beside it."""
    wrist, focal = joints[0], float(matrix[0, 0])
    along = (wrist - joints[9])[:2]
    along = along / np.linalg.norm(along)
    begin = wrist[:2] / wrist[2] * focal + matrix[:2, 2]
    v, u = np.mgrid[: shape[0], : shape[1]]
    ahead = (u - begin[0]) * along[0] + (v - begin[1]) * along[1]
    aside = (u - begin[0]) * along[1] - (v - begin[1]) * along[0]
    away = np.where(ahead > 0, np.abs(aside), np.hypot(ahead, aside)) * wrist[2] / focal
    bulge = np.sqrt(np.maximum(FOREARM_RADIUS_M**2 - away**2, 0.0))
    return np.where(away < FOREARM_RADIUS_M, wrist[2] - 0.8 * bulge, np.inf)


def _random_pose(rng: np.random.Generator, *, turned: bool) -> Float[np.ndarray, " 22"]:
    """Each finger is folded before the palm in 30 % of the poses, else nearly straight; neighbours touch and cross."""
    pose = np.array(open_palm(jnp.array([0.0, 0.09, 0.6])), float)
    for first in (10, 13, 16, 19):
        is_folded = rng.random() < 0.3
        pose[first] = np.deg2rad(rng.uniform(60, 85) if is_folded else rng.uniform(-5, 30))
        pose[first + 2] = np.deg2rad(rng.uniform(80, 100) if is_folded else rng.uniform(0, 15))
        pose[first + 1] = np.deg2rad(rng.uniform(-8, 8))
    pose[7:10] = np.deg2rad([rng.uniform(-15, 30), rng.uniform(0, 15), rng.uniform(-20, 20)])
    turn = rng.normal(size=3) * [0.35, 0.35, 0.3] + np.array([0.0, math.pi if turned else 0.0, 0.0])
    angle = np.linalg.norm(turn)
    pose[3:7] = [math.cos(angle / 2), *(math.sin(angle / 2) * turn / angle)]
    return pose
