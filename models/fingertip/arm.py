"""Palm and forearm in the silhouette of one hand."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

PALM_SHARE = 0.93
"""Of the largest distance from the outline: places with more, which the last erosions would leave, are averaged."""
FAR_PALM = 0.85
"""Of the largest distance from the outline, that a palm has at least if it is farthest from the border."""


class Palm(NamedTuple):
    """The largest disc in a hand."""

    center: Float[np.ndarray, "2"]
    """Pixels."""
    radius: float
    """Pixels."""


class ArmAxis(NamedTuple):
    """Where a forearm points."""

    direction: Float[np.ndarray, "2"]
    """Unit vector, towards the hand."""
    is_observed: bool
    """Whether the forearm reaches the border; else the direction is that in which the whole hand is long."""


def border_contact(silhouette: UInt8[np.ndarray, "rows cols"]) -> Int[np.ndarray, "n 2"]:
    """Pixels (n, 2) of the longest unbroken part of the image's border that lies in the silhouette."""
    rows, cols = silhouette.shape
    x, y = np.arange(cols), np.arange(rows)
    border = np.concatenate(
        [
            np.stack([x, np.zeros(cols, int)], axis=1),
            np.stack([np.full(rows, cols - 1), y], axis=1),
            np.stack([x[::-1], np.full(cols, rows - 1)], axis=1),
            np.stack([np.zeros(rows, int), y[::-1]], axis=1),
        ]
    )
    inside = silhouette[border[:, 1], border[:, 0]] > 0
    if not inside.any() or inside.all():
        return border[inside]
    start = int(np.argmin(inside))  # outside, so that no part is broken by where the border begins
    border, inside = np.roll(border, -start, axis=0), np.roll(inside, -start)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int8), [0]])))
    begins, ends = ends[::2], ends[1::2]
    longest = int(np.argmax(ends - begins))
    return border[begins[longest] : ends[longest]]


def find_palm(depth: Float[np.ndarray, "rows cols"], contact: Int[np.ndarray, "n 2"]) -> Palm:
    """Centre and radius of the palm: the last places that erosion of the silhouette would leave.

    Args:
        depth: Distance of each pixel to the outline, 0 outside, pixels; not 0 everywhere.
        contact: Of `border_contact`; of a forearm and a fist that are equally thick, the farther one is the hand.
    """
    places = cv2.findNonZero((depth > FAR_PALM * depth.max()).view(np.uint8))[:, 0]
    values = depth[places[:, 1], places[:, 0]]
    away = np.hypot(*(places - contact.mean(axis=0)).T) if len(contact) else np.zeros(len(places))
    seed = places[np.argmax(values * (1 + (1 / FAR_PALM - 1) * away / max(float(away.max()), 1e-6)))]
    near = np.hypot(*(places - seed).T) < 0.5 * depth.max()
    radius = float(values[near].max())
    return Palm(places[near & (values > PALM_SHARE * radius)].mean(axis=0), radius)


def find_arm(silhouette: UInt8[np.ndarray, "rows cols"], palm: Palm, contact: Int[np.ndarray, "n 2"]) -> ArmAxis:
    """Direction from the middle of where the silhouette (0 or not) leaves the image to the palm.

    Without contact with the border it is the principal axis of all pixels, from their centroid towards the palm.
    """
    if len(contact) == 0:
        return ArmAxis(_principal_axis(silhouette, palm), is_observed=False)
    return ArmAxis(_unit(palm.center - contact.mean(axis=0)), is_observed=True)


def _principal_axis(silhouette: np.ndarray, palm: Palm) -> np.ndarray:
    moments = cv2.moments(silhouette, binaryImage=True)
    centroid = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    spread = np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]])
    axis = np.linalg.eigh(spread)[1][:, 1]
    return axis if axis @ (palm.center - centroid) >= 0 else -axis


def _unit(vector: np.ndarray) -> np.ndarray:
    length = float(np.hypot(*vector))
    return vector / length if length > 1e-6 else np.array([0.0, -1.0])
