"""What is wrong when two images and the rig that they are said to be from do not fit together."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.head.stereo import epipolar

LEAST_SCORE = 0.8
"""Correlation below which two windows do not show the same."""
MOST_RETURN = 1.0
"""Pixels between a landmark and the match of its match."""
MOST_ASIDE = 2.0
"""Pixels between a match and its epipolar line."""
LARGE_SIZE, FEWEST = 24, 6
"""Pixels of the windows that are looked for all over an image, and how many of them must be found."""
_CLOSEST = 150.0
"""Millimetres to which lines are followed, before the cameras and behind them."""


def why_unmatched(
    images: UInt8[np.ndarray, "C rows cols"],
    rig: CameraRig,
    points: Float[np.ndarray, "K 2"],
    c: int,
    scores: Float[np.ndarray, " K"],
    returned: Float[np.ndarray, " K"],
) -> str:
    """Why landmarks have no match along their lines in image `c`, in one line for a person.

    Larger windows about the landmarks are looked for all over the image; where most of them are found tells whether
    the rig is wrong, the images are swapped or the face is too near or too far.

    Args:
        images: Grey.
        rig: Two cameras or more.
        points: Landmarks in the first image.
        c: The other image.
        scores: Correlations of the matches along the lines.
        returned: Pixels between each landmark and the match of its match.
    """
    half, found, at = LARGE_SIZE // 2, np.zeros(len(points)), np.zeros((len(points), 2))
    for k, (u, v) in enumerate(np.round(points).astype(int)):
        window = images[0][max(v - half, 0) : v + half, max(u - half, 0) : u + half]
        _, found[k], _, place = cv2.minMaxLoc(cv2.matchTemplate(images[c], window, cv2.TM_CCOEFF_NORMED))
        at[k] = points[k] + place - np.maximum((u - half, v - half), 0)
    observed = found >= LEAST_SCORE
    if observed.sum() < FEWEST:
        return (
            f"only {observed.sum()} of {len(points)} landmarks are found in image {c}, by a correlation of "
            f"{LEAST_SCORE:g}: it shows another moment or another scene, or the face is hidden."
        )
    inverse = np.linspace(-1 / _CLOSEST, 1 / _CLOSEST, 4001)
    away = np.linalg.norm(epipolar.projected_at(rig, points, inverse, source=0, target=c) - at[:, None], axis=-1)
    away = np.where(np.isnan(away), np.inf, away)
    error = float(np.median(away.min(axis=1)[observed]))
    if error > MOST_ASIDE:
        return (
            f"epipolar error: the rig contradicts the images; landmarks are {error:.1f} px from their epipolar lines "
            f"in image {c}, where {MOST_ASIDE:g} px are allowed: calibrate again, or take images of one moment."
        )
    nearness = float(np.median(inverse[away.argmin(axis=1)][observed]))
    if nearness <= 0:
        return f"the face is behind the cameras: images 0 and {c}, or their cameras, are swapped."
    if not epipolar.NEAREST < 1 / nearness < epipolar.FARTHEST:
        return (
            f"the face is {1 / nearness:.0f} mm away, where {epipolar.NEAREST:.0f} to {epipolar.FARTHEST:.0f} mm are "
            "expected: it is too near or too far, or the baseline of the rig is wrong."
        )
    k = int(np.where(scores < LEAST_SCORE, scores, np.where(returned > MOST_RETURN, 1.0, 2.0)).argmin())
    return (
        f"{NAMES[k]} has no match in image {c}: correlation {scores[k]:.2f}, {returned[k]:.1f} px off on the way back, "
        f"where {LEAST_SCORE:g} and {MOST_RETURN:g} px are needed."
    )
