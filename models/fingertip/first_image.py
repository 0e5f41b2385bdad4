"""What is measured of a user in a first image that shows an open hand."""

import math

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.fingertip.arm import border_contact, find_palm
from jaxfilters.models.fingertip.detection import checked_mask, detect_hand
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.observation import MAX_TIPS, HandObservation
from jaxfilters.models.fingertip.segmentation import bright_mask, otsu_threshold

LEAST_CONTRAST = 30
"""Grey values between a hand and a desk that a threshold can part."""
LEAST_AREA, MOST_AREA = 0.03, 0.4
"""Of the image, that a hand with its forearm covers."""
MOST_OF_NEAR = 0.7
"""Of the image, that a hand covers whose camera is so near that it does not see all of it."""
WINDOW = 9.0 / 6.5
"""Tip radii from the middle to the side of the template's window."""
FINGER_SHARE = 0.45
"""Palm radii: discs of this size fit into no finger."""
TIP_SHARE = 0.35
"""Of a finger's pixels, those farthest from the palm, over which its thickness is taken."""
LEAST_SPREAD = math.radians(8.0)
"""Between the bases of thumb and forefinger, from the palm."""


def fit_hand_parameters(image: np.ndarray) -> HandParameters:
    """Threshold, thickness of fingers, standard angles and side of the thumb, from an open hand brighter than the desk.

    Args:
        image: (rows, cols) uint8. In it the five fingers are spread, the thumb most, and the forearm comes in from the
            border.

    Raises:
        ValueError: an image that is not (rows, cols) of uint8, or that shows no such hand; the message says what is
            missing.
    """
    threshold = otsu_threshold(image)
    mask = bright_mask(image, threshold)
    contrast = float(image[mask].mean() - image[~mask].mean()) if mask.any() and not mask.all() else 0.0
    if contrast < LEAST_CONTRAST:
        raise ValueError(
            f"image must show a hand at least {LEAST_CONTRAST} grey values brighter than the desk; got {contrast:.0f}."
        )
    return fit_hand_to_mask(mask, threshold=threshold)


def fit_hand_to_mask(mask: np.ndarray, *, threshold: float = 128.0) -> HandParameters:
    """As `fit_hand_parameters`, from the mask of an open hand, whatever it was segmented from.

    Args:
        mask: (rows, cols) of bool: which pixels are skin.
        threshold: Passed on; masks from depth or colour have none.

    Raises:
        ValueError: a mask that is not (rows, cols) of bool, or that shows no open hand.
    """
    trial, observed = _looked_at(mask, threshold, MOST_AREA)
    radius = trial.tip_radius
    count = int(np.sum(observed.is_tip & observed.has_base))
    if count < MAX_TIPS:
        raise ValueError(f"mask must show an open hand with {MAX_TIPS} fingers spread; found {count} of them.")
    angles = base_angles(observed)
    order = np.argsort(angles)
    gaps = np.diff(angles[order])
    # The thumb stands farther from its neighbour than the little finger does.
    handedness = 1 if gaps[-1] > gaps[0] else -1
    thumb, index = (order[-1], order[-2]) if handedness == 1 else (order[0], order[1])
    phi_thumb, phi_index = float(handedness * angles[thumb]), float(handedness * angles[index])
    if phi_thumb - phi_index < LEAST_SPREAD:
        raise ValueError(
            f"mask must show thumb and forefinger at least {math.degrees(LEAST_SPREAD):.0f} degrees apart; "
            f"got {math.degrees(phi_thumb - phi_index):.0f}."
        )
    return HandParameters(
        threshold=threshold,
        tip_radius=radius,
        half_size=trial.half_size,
        phi_thumb=phi_thumb,
        phi_index=phi_index,
        handedness=handedness,
    )


def fit_partial_hand(mask: np.ndarray) -> tuple[HandParameters, int]:
    """Thickness of the fingers in a mask of a hand of which not all is in the image, and how many fingers there are.

    Angles and side of the thumb stay the usual ones.

    Args:
        mask: (rows, cols) of bool: which pixels are skin.

    Raises:
        ValueError: a mask that is not (rows, cols) of bool, that shows no finger, or a hand that is not in contact
            with the border.
    """
    trial, observed = _looked_at(mask, 128.0, MOST_OF_NEAR)
    return trial, int(np.sum(observed.is_tip & observed.has_base))


def _looked_at(mask: np.ndarray, threshold: float, most: float) -> tuple[HandParameters, HandObservation]:
    """Parameters with the thickness of fingers, and what detection finds with them."""
    hand = _largest(checked_mask(mask))
    share = float(hand.mean()) / 255
    if not LEAST_AREA <= share <= most:
        raise ValueError(f"mask must hold a hand on {LEAST_AREA:.0%} to {most:.0%} of the image; got {share:.1%}.")
    radius = _tip_radius(hand)
    trial = HandParameters(threshold, radius, max(round(WINDOW * radius), math.ceil(radius) + 1))
    observed = detect_hand(mask, trial)
    if not observed.has_axis:
        raise ValueError("mask must show the forearm as far as the border of the image; the hand does not touch it.")
    return trial, observed


def base_angles(hand: HandObservation) -> Float[np.ndarray, " tips"]:
    """Angles of the bases about the palm from the arm's axis, radians, counter-clockwise; 0 without a base."""
    x, y = (hand.bases - hand.palm).T
    ahead, left = x * hand.axis[0] + y * hand.axis[1], x * hand.axis[1] - y * hand.axis[0]
    return np.where(hand.has_base, np.arctan2(left, ahead), 0.0)


def _largest(mask: np.ndarray) -> UInt8[np.ndarray, "rows cols"]:
    """0 or 255: the largest component."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    if count < 2:
        return np.zeros_like(mask)
    return np.where(labels == 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA]), 255, 0).astype(np.uint8)


def _tip_radius(hand: UInt8[np.ndarray, "rows cols"]) -> float:
    """Half the thickness near their ends of what an opening with most of the palm takes off: fingers.

    Raises:
        ValueError: if nothing finger-like is left.
    """
    padded = cv2.copyMakeBorder(hand, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    palm = find_palm(depth, border_contact(hand))
    disc = FINGER_SHARE * palm.radius
    far = cv2.distanceTransform((depth <= disc).astype(np.uint8), cv2.DIST_L2, 5)
    fingers = ((hand > 0) & (far > disc + 1)).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(fingers)
    radii = []
    for label in range(1, count):
        if stats[label, cv2.CC_STAT_AREA] < 0.15 * palm.radius**2:
            continue
        y, x = np.nonzero(labels == label)
        distance = np.hypot(x - palm.center[0], y - palm.center[1])
        radii.append(float(depth[y, x][distance > np.percentile(distance, 100 * (1 - TIP_SHARE))].max()))
    if not radii:
        raise ValueError(f"mask must show an open hand with {MAX_TIPS} fingers spread; found 0 of them.")
    return float(np.clip(np.median(radii), 2.0, 100.0))
