"""Hand masks from colour images: skin by its chroma, estimated from the first image of a user."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfilters.models.fingertip.segmentation import SMOOTHING

SEED_CR, SEED_CB = (138, 180), (77, 124)
"""Chroma of most skin in most light, of 0 to 255 with 128 for grey (after Chai and Ngan 1999, cut where greys are)."""
LEAST_LUMA = 30
"""Darker pixels have no chroma that can be trusted."""
MARGIN = 2
"""Pixels on both sides of an outline that are left out of the estimate."""
SPREAD = 3.0
"""Standard deviation, levels of chroma, of the Gaussian over a histogram."""
PRIOR_COUNT = 2e-6
"""Density added to both histograms: a chroma that was never observed is as likely skin as not, and by the prior not."""
SKIN_PRIOR = 0.7
REFINEMENTS = 2
LEAST_AREA, MOST_AREA = 0.01, 0.5
"""Of the image, that the hand covers while its colour is estimated."""


@dataclass(frozen=True)
class SkinModel:
    """How likely a pixel of some chroma is skin of one user in one light."""

    probability: UInt8[np.ndarray, "256 256"]
    """255 times the probability of skin, by Cr and Cb."""


def fit_skin_model(image: np.ndarray) -> SkinModel:
    """The ratio of the histograms of the hand and of the rest, from an image in which a hand comes in from the border.

    The hand is at first the largest component with a chroma that most skin has, in contact with the border if one is;
    then what the model finds.

    Raises:
        ValueError: an image that is not (rows, cols, 3) of uint8, or that shows no skin, or hardly anything else.
    """
    _check_image(image)
    chroma = cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb)
    low, high = (LEAST_LUMA, SEED_CR[0], SEED_CB[0]), (255, SEED_CR[1], SEED_CB[1])
    hand = _hand_component(cv2.GaussianBlur(cv2.inRange(chroma, low, high), (0, 0), 2.0) > 127)
    model = _learnt(chroma, hand)
    for _ in range(REFINEMENTS):
        model = _learnt(chroma, _hand_component(skin_mask(image, model)))
    return model


def skin_mask(image: np.ndarray, model: SkinModel) -> Bool[np.ndarray, "rows cols"]:
    """Where skin is more likely than not, after smoothing of the probability.

    Args:
        image: (rows, cols, 3) uint8: blue, green, red.
        model: Of `fit_skin_model`.

    Raises:
        ValueError: an image that is not (rows, cols, 3) of uint8.
    """
    return cv2.threshold(skin_probability(image, model), 127, 1, cv2.THRESH_BINARY)[1].view(bool)


def skin_probability(image: np.ndarray, model: SkinModel) -> UInt8[np.ndarray, "rows cols"]:
    """255 times the probability of skin at each pixel, smoothed.

    Raises:
        ValueError: an image that is not (rows, cols, 3) of uint8.
    """
    _check_image(image)
    chroma = cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb)
    table = model.probability.astype(np.float32)
    found = cv2.calcBackProject([chroma], [1, 2], table, [0, 256, 0, 256], 1)
    return cv2.GaussianBlur(found, (0, 0), SMOOTHING)


def _learnt(chroma: np.ndarray, hand: Bool[np.ndarray, "rows cols"]) -> SkinModel:
    share = float(hand.mean())
    if not LEAST_AREA <= share <= MOST_AREA:
        raise ValueError(
            f"image must show a hand in the colours of skin on {LEAST_AREA:.0%} to {MOST_AREA:.0%} of it; "
            f"got {share:.1%}."
        )
    kernel = np.ones((2 * MARGIN + 1,) * 2, np.uint8)
    skin, rest = cv2.erode(hand.astype(np.uint8), kernel), 1 - cv2.dilate(hand.astype(np.uint8), kernel)
    densities = [_density(chroma, where) for where in (skin, rest)]
    skin_share = SKIN_PRIOR * densities[0]
    posterior = skin_share / (skin_share + (1 - SKIN_PRIOR) * densities[1])
    return SkinModel(np.rint(255 * posterior).astype(np.uint8))


def _density(chroma: np.ndarray, where: np.ndarray) -> Float[np.ndarray, "256 256"]:
    """Of Cr and Cb."""
    counts = cv2.calcHist([chroma], [1, 2], where, [256, 256], [0, 256, 0, 256])
    smooth = cv2.GaussianBlur(counts, (0, 0), SPREAD, borderType=cv2.BORDER_CONSTANT)
    return smooth / max(float(smooth.sum()), 1.0) + PRIOR_COUNT


def _hand_component(mask: Bool[np.ndarray, "rows cols"]) -> Bool[np.ndarray, "rows cols"]:
    """The largest component, among those at the border if there are any of a hand's size."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    at_border = np.isin(np.arange(len(areas)), border) & (areas >= LEAST_AREA * mask.size)
    return labels == np.argmax(np.where(at_border, areas, 0) if at_border.any() else areas) if areas.any() else mask


def _check_image(image: np.ndarray) -> None:
    is_array = isinstance(image, np.ndarray)
    if not is_array or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        got = f"{image.dtype} {image.shape}" if is_array else type(image).__name__
        raise ValueError(f"image must be a uint8 array (rows, cols, 3) with pixels; got {got}.")
