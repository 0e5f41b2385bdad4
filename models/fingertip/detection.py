"""Hands in a mask: palm, forearm, fingertips and where the fingers begin."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfilters.models.fingertip.arm import Palm, border_contact, find_arm, find_palm
from jaxfilters.models.fingertip.depth_edges import (
    DepthEdges,
    Windows,
    check_depth,
    depth_edges,
    goes_behind,
    own_surfaces,
    readings,
    with_edges_near,
)
from jaxfilters.models.fingertip.fingers import Bases, end_patches, ends_of, find_bases
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.observation import COVERAGE_SHAPE, MAX_TIPS, WHOLE_IMAGE, HandObservation
from jaxfilters.models.fingertip.tip_template import (
    SUPPRESSION,
    best_apart,
    correlation,
    peaks,
    tip_template,
)

WORKING_RADIUS = 6.5
"""Pixels: hands with thicker fingers are looked at in a smaller image, and only their tips in the whole one."""
SMALLEST_PALM = 1.7
"""Tip radii; what is thinner everywhere is no hand."""
BEHIND, NEAR = 0.6, 1.3
"""Palm radii: farther back than the one, or nearer to the palm than the other, there are no tips."""


LEAST_AGREEMENT = 0.75
"""Of a tip with a half disc on a finger of its own direction and thickness."""
THICKEST, SHORTEST = 1.7, 0.6
"""Tip radii: what is thicker where it ends, or nearer to where it begins, is a knuckle of a fist."""
AHEAD = 1.25
"""Radii from the middle of a tip to where the image is over if its border cuts the finger."""
MOST_FOR_SHORT_LABELS = 4 * 2**16
"""Pixels of a mask whose components are labelled in 16 bits, twice as fast; four pixels hold one component at most."""
LEAST_ALONG = 0.1
"""Part of the direction of an arm in which it is cut off before it is searched for tips."""
BESIDE = 2
"""Pixels beside a hand that are looked at with it: those that are hand in part, and what fills holes of its depths."""
MAX_CANDIDATES, CANDIDATES_APART = 24, 0.7
"""Places that are looked at more closely, and tip radii between them."""


class _Silhouette(NamedTuple):
    """One component of the mask, alone in its part of an image with fingers no thicker than the working radius."""

    image: UInt8[np.ndarray, "rows cols"]
    """0 to 255: the share of each pixel that is skin. It is 0 at borders that are not those of the mask."""
    corner: tuple[int, int]
    """Column and row of the whole image at (0, 0) here."""
    whole: tuple[int, int]
    """Rows and columns of the whole image."""
    step: Float[np.ndarray, "2"]
    """Pixels of the mask per pixel here."""

    def placed(self, points: np.ndarray) -> np.ndarray:
        """In the mask."""
        return (self.step - 1) / 2 + self.step * (points + self.corner)

    def coverage(self, inside: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "cell_rows cell_cols"]:
        """Shares of the cells of the whole image that are hand."""
        around, (left, top) = np.zeros(self.whole, np.uint8), self.corner
        around[top : top + len(inside), left : left + inside.shape[1]] = 255 * inside
        return cv2.resize(around, COVERAGE_SHAPE[::-1], interpolation=cv2.INTER_AREA) / np.float32(255)


class _Layout(NamedTuple):
    """Where palm and arm of a silhouette are, and how tips look there; pixels of its image."""

    inside: UInt8[np.ndarray, "rows cols"]
    palm: Palm
    axis: Float[np.ndarray, "2"]
    radius: float
    half_size: int
    min_correlation: float


class _View(NamedTuple):
    """Places that may be tips, and the silhouette in which they are looked at."""

    found: Float[np.ndarray, "n 2"]
    inset: Float[np.ndarray, "rows cols"]
    """Distance of each pixel to the outline."""
    windows: Windows
    """What shows how fingers end there."""


class _Tips(NamedTuple):
    """Candidates after a closer look."""

    points: Float[np.ndarray, "n 2"]
    scores: Float[np.ndarray, " n"]
    """0 of what is no tip."""
    bases: Bases


def no_hand() -> HandObservation:
    """The observation of a frame in which no hand is visible."""
    numbers, no = np.zeros(MAX_TIPS, np.float32), np.zeros(MAX_TIPS, bool)
    points, vector = np.zeros((MAX_TIPS, 2), np.float32), np.zeros(2, np.float32)
    hand: Any = {  # numpy's arrays until a device needs them
        "tips": points,
        "is_tip": no,
        "scores": numbers,
        "bases": points,
        "has_base": no,
        "palm": vector,
        "palm_radius": np.zeros((), np.float32),
        "axis": vector,
        "has_axis": np.zeros((), bool),
        "is_hand": np.zeros((), bool),
        "coverage": np.ones(COVERAGE_SHAPE, np.float32),
        "cell": np.full(2, WHOLE_IMAGE, np.float32),
    }
    return HandObservation(**hand)


def detect_hand(mask: np.ndarray, parameters: HandParameters, depth: np.ndarray | None = None) -> HandObservation:
    """The largest component of a mask that can be a hand; `no_hand()` if none can.

    Args:
        mask: (rows, cols) of bool: which pixels are skin.
        parameters: Of the user, for the camera that gave the mask.
        depth: As for `detect_hands`.

    Raises:
        ValueError: a mask that is not (rows, cols) of bool, or as for `detect_hands`.
    """
    return detect_hands(mask, parameters, depth, capacity=1)[0]


def detect_hands(
    mask: np.ndarray, parameters: HandParameters, depth: np.ndarray | None = None, *, capacity: int = 2
) -> tuple[HandObservation, ...]:
    """The largest components of a mask that can be hands, from left to right by their palms; then `no_hand()`.

    Hands that touch are one component, and one hand with the tips of both, at most `MAX_TIPS` of them. With depths,
    edges within the mask part fingers that touch, or lie before each other or the palm. A finger that is folded before
    the palm has no tip: it does not lead from its end to the palm on one surface.

    Args:
        mask: (rows, cols) of bool: which pixels are skin.
        parameters: Of the user, for the camera that gave the mask.
        depth: (rows, cols) metres along the optical axis in the pixels of the mask; what is not finite or not positive
            is no reading. Without it the outline of the mask decides alone.
        capacity: How many observations to give.

    Raises:
        ValueError: a mask that is not (rows, cols) of bool, a capacity below 1, or depth that is not (rows, cols) of
            floats, has another shape than the mask, or is not in metres.
    """
    if capacity < 1:
        raise ValueError(f"capacity must be at least 1; got {capacity}.")
    skin = checked_mask(mask)
    if depth is not None:
        check_depth(depth, skin)
    hands: list[HandObservation] = []
    for silhouette in _components(skin, parameters.tip_radius):
        hand = _hand(silhouette, parameters, depth)
        if hand is not None:
            hands.append(hand)
        if len(hands) == capacity:
            break
    hands.sort(key=lambda hand: float(hand.palm[0]))
    return (*hands, *[no_hand()] * (capacity - len(hands)))


def checked_mask(mask: np.ndarray) -> UInt8[np.ndarray, "rows cols"]:
    """The mask as OpenCV wants it, 0 or 1.

    Raises:
        ValueError: a mask that is not (rows, cols) of bool.
    """
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.ndim != 2 or mask.size == 0:
        got = f"{mask.dtype} {mask.shape}" if isinstance(mask, np.ndarray) else type(mask).__name__
        raise ValueError(f"mask must be a bool array (rows, cols) with pixels; got {got}.")
    return np.ascontiguousarray(mask).view(np.uint8)


def _components(skin: np.ndarray, tip_radius: float) -> Iterator[_Silhouette]:
    """Components that are large enough for a palm, largest first."""
    rows, cols = skin.shape
    shrink = max(1.0, tip_radius / WORKING_RADIUS)
    size = (max(1, round(cols / shrink)), max(1, round(rows / shrink)))
    step = np.array([cols / size[0], rows / size[1]])
    small = 255 * skin
    whole = int(shrink)
    if whole > 1 and not (rows % whole or cols % whole):
        # Means of whole pixels are many times as fast as those of fractions, which then have fewer pixels to go over.
        small = cv2.resize(small, (cols // whole, rows // whole), interpolation=cv2.INTER_AREA)
    small = cv2.resize(small, size, interpolation=cv2.INTER_AREA) if shrink > 1 else small
    inside = cv2.threshold(small, 127, 1, cv2.THRESH_BINARY)[1]
    ltype = cv2.CV_16U if inside.size < MOST_FOR_SHORT_LABELS else cv2.CV_32S
    count, labels, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=8, ltype=ltype)
    areas = stats[:, cv2.CC_STAT_AREA] * (np.arange(count) > 0)  # 0 is what is no component
    for label in np.argsort(-areas, kind="stable"):
        if areas[label] < math.pi * (SMALLEST_PALM * tip_radius / shrink) ** 2:
            return
        left, top, width, height = stats[label, : cv2.CC_STAT_AREA].tolist()
        corner = (max(0, left - BESIDE), max(0, top - BESIDE))
        part = np.s_[corner[1] : top + height + BESIDE, corner[0] : left + width + BESIDE]
        image = small[part]
        if areas[label] != areas.sum():
            image = cv2.copyTo(image, (labels[part] == label).view(np.uint8))
        yield _Silhouette(image, corner, small.shape, step)


def _hand(
    silhouette: _Silhouette, parameters: HandParameters, depth: Float[np.ndarray, "rows cols"] | None
) -> HandObservation | None:
    """What a component shows of a hand; `None` if it has no palm."""
    scale = float(silhouette.step.mean())
    radius = parameters.tip_radius / scale
    inside = cv2.threshold(silhouette.image, 127, 1, cv2.THRESH_BINARY)[1]
    inset = _inset(inside)
    contact = border_contact(inside)
    palm = find_palm(inset, contact)
    if palm.radius < SMALLEST_PALM * radius:
        return None
    arm = find_arm(inside, palm, contact)
    half_size = max(round(parameters.half_size / scale), math.ceil(radius) + 1)
    layout = _Layout(inside, palm, arm.direction, radius, half_size, parameters.min_correlation)
    found = _candidates(silhouette.image, layout)
    by_contour = _View(found, inset, Windows(silhouette.image, found))
    edges = None
    if depth is not None:
        step = tuple(silhouette.step.tolist())
        edges = depth_edges(readings(depth, silhouette.corner, inside.shape, step), inside, radius)
    if edges is None or not edges.is_behind.any():
        tips = _judged(layout, by_contour)
    else:
        by_edges = _parted(layout, silhouette.image, found, edges)
        tips = _uncovered(_judged(layout, by_edges, by_contour), len(by_edges.found), edges, radius)
    best = best_apart(tips.points, tips.scores, SUPPRESSION * radius, MAX_TIPS)
    bases = Bases(tips.bases.points[best], tips.bases.is_found[best])
    starts = np.where(bases.is_found[:, None], silhouette.placed(bases.points), 0.0)
    hand: Any = {
        "tips": _filled(silhouette.placed(tips.points[best])),
        "is_tip": np.arange(MAX_TIPS) < len(best),
        "scores": _filled(tips.scores[best]),
        "bases": _filled(starts),
        "has_base": _filled(bases.is_found),
        "palm": silhouette.placed(palm.center).astype(np.float32),
        "palm_radius": np.asarray(scale * palm.radius, np.float32),
        "axis": arm.direction.astype(np.float32),
        "has_axis": np.asarray(arm.is_observed),
        "is_hand": np.asarray(True),
        "coverage": silhouette.coverage(inside),
        "cell": (silhouette.step * silhouette.whole[::-1] / COVERAGE_SHAPE[::-1]).astype(np.float32),
    }
    return HandObservation(**hand)


def _inset(inside: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "rows cols"]:
    """Distance of each pixel to the outline; what lies beyond the border of the image is outside, as in an erosion."""
    padded = cv2.copyMakeBorder(inside, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return np.ascontiguousarray(cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1])


def _judged(layout: _Layout, *views: _View) -> _Tips:
    """Candidates with their bases, and scores above 0 of those that are tips, as their windows show them."""
    radius, inside = layout.radius, layout.inside
    found = np.concatenate([view.found for view in views])
    # Fingers are many times as fast together as one view after the other.
    layers = cv2.merge([view.inset for view in views]) if len(views) > 1 else views[0].inset
    layer = np.repeat(np.arange(len(views)), [len(view.found) for view in views]) if len(views) > 1 else None
    bases = find_bases(layers, found, layout.palm.center, radius, layer)
    towards = found - np.where(bases.is_found[:, None], bases.points, layout.palm.center)
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    parts = np.split(towards, np.cumsum([len(view.found) for view in views])[:-1])
    patches = [end_patches(*view.windows, part, radius) for view, part in zip(views, parts, strict=True)]
    ends = ends_of(np.concatenate(patches), np.concatenate([view.windows.points for view in views]), towards, radius)
    points = ends.points + found - np.concatenate([view.windows.points for view in views])
    is_finger = ~bases.is_found | (np.hypot(*(found - bases.points).T) > SHORTEST * radius)
    is_tip = is_finger & ends.is_end & (ends.scores > LEAST_AGREEMENT) & (ends.radii < THICKEST * radius)
    is_tip &= ~_is_cut(inside, points + AHEAD * ends.radii[:, None] * towards)
    return _Tips(points, np.where(is_tip, ends.scores, 0.0), bases)


def _parted(
    layout: _Layout,
    image: UInt8[np.ndarray, "rows cols"],
    found: Float[np.ndarray, "n 2"],
    edges: DepthEdges,
) -> _View:
    """What a silhouette with the places found in it shows on surfaces of their own, where edges are near."""
    cut = np.where(edges.is_behind, np.uint8(0), image)
    found = with_edges_near(edges, np.concatenate([found, _candidates(cut, layout)]), layout.radius)
    inset = _inset(cv2.threshold(cut, 127, 1, cv2.THRESH_BINARY)[1])
    return _View(found, inset, own_surfaces(cut, found, layout.radius))


def _uncovered(tips: _Tips, number: int, edges: DepthEdges, radius: float) -> _Tips:
    """The first tips, parted by edges, without those that do not lead to the palm, or go on behind something nearer."""
    towards = tips.points - tips.bases.points
    is_end = tips.bases.is_found & ~goes_behind(edges, tips.points, towards, radius)
    return tips._replace(scores=np.where(is_end | (np.arange(len(is_end)) >= number), tips.scores, 0.0))


def _candidates(image: np.ndarray, layout: _Layout) -> Float[np.ndarray, "n 2"]:
    """Places that may be ends of fingers, neither near nor behind the palm, several of each."""
    left, top, right, bottom = _before_arm(cv2.boundingRect(image), layout)
    window = image[top:bottom, left:right]
    template = tip_template(layout.radius, layout.half_size)
    found = peaks(correlation(window, template), layout.min_correlation)
    places = found.points + np.array([left, top])
    arm = places - layout.palm.center
    far = np.linalg.norm(arm, axis=1) > NEAR * layout.palm.radius
    score = np.where(far & (arm @ layout.axis > -BEHIND * layout.palm.radius), found.scores, 0.0)
    return places[best_apart(places, score, CANDIDATES_APART * layout.radius, MAX_CANDIDATES)]


def _before_arm(box: Sequence[int], layout: _Layout) -> list[int]:
    """Left, top, right and bottom of a box (left, top, width, height) without what lies behind the palm.

    Templates that are compared with the rest see all of their surroundings in it.
    """
    low, high = np.array(box[:2]), np.array(box[:2]) + box[2:]
    ends = np.stack([low, high - 1]) - layout.palm.center
    most = (ends * layout.axis).max(axis=0)
    for i, along in enumerate(layout.axis):
        if abs(along) > LEAST_ALONG:
            # Where the place that is farthest along the other side of the box is as far behind as tips can be.
            last = layout.palm.center[i] - (BEHIND * layout.palm.radius + most[1 - i]) / along
            if along > 0:
                low[i] = min(max(low[i], math.floor(last) - layout.half_size - 1), high[i] - 1)
            else:
                high[i] = max(min(high[i], math.ceil(last) + layout.half_size + 2), low[i] + 1)
    return [*low.tolist(), *high.tolist()]


def _is_cut(inside: UInt8[np.ndarray, "rows cols"], ahead: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Which fingers go on as far as the border of the image, by places ahead of what looks like their ends."""
    places = np.rint(ahead).astype(int)
    last = np.clip(places, 0, np.array(inside.shape[::-1]) - 1)
    return np.any(places != last, axis=1) & (inside[last[:, 1], last[:, 0]] > 0)


def _filled(values: np.ndarray) -> np.ndarray:
    """Padded to `MAX_TIPS`."""
    filled = np.zeros((MAX_TIPS, *values.shape[1:]), bool if values.dtype == np.bool_ else np.float32)
    filled[: len(values)] = values
    return filled
