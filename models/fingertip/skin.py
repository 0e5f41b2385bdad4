"""Hand masks from colour images: skin by its colour, estimated from the first image of a user.

The first guess of where the hand is, the seed, is what has the chroma of most skin. On a desk that has it too, such as
one of wood, that is the desk: `skin_models` then offers models from clusters of colour and brightness, from which
`fit_hand_to_mask` has to choose.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.cluster.vq import kmeans2
from scipy.ndimage import gaussian_filter1d

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
CLUSTERS = (2, 3, 4)
"""Numbers of clusters that are tried."""
CLUSTER_WEIGHTS = (0.5, 1.5, 1.5)
"""Of luma, Cr and Cb in the distance between colours: light and shadow change luma more than anything."""
LEVELS, LEVEL_SPREAD = 8, 0.7
"""Parts of the range of luma in a model from a cluster, and standard deviation in them of its smoothing."""
LEAST_AREA, MOST_AREA, MOST_OF_CLUSTER = 0.01, 0.5, 0.7
"""Of the image, that the hand covers while its colour is estimated; that from a cluster may be near to the camera."""


@dataclass(frozen=True)
class SkinModel:
    """How likely a pixel of some chroma is skin of one user in one light."""

    probability: UInt8[np.ndarray, "levels 256 256"]
    """255 times the probability of skin, by luma, in equal parts, Cr and Cb; of one level, brightness says nothing."""


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
    return _refined(image, chroma, hand, levels=1)


def skin_models(image: np.ndarray) -> Iterator[SkinModel]:
    """Models from other seeds than `fit_skin_model`'s: clusters of colour and brightness (k-means), largest first.

    Each takes a component of one cluster for the hand; at most one of them is right.

    Raises:
        ValueError: an image that is not (rows, cols, 3) of uint8.
    """
    _check_image(image)
    chroma = cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb)
    weights = np.array(CLUSTER_WEIGHTS, np.float32)
    small = cv2.resize(cv2.GaussianBlur(chroma, (0, 0), 2.0), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    samples = small.reshape(-1, 3) * weights
    for count in CLUSTERS:
        centers, _ = kmeans2(samples, count, minit="++", rng=0, iter=20, missing="warn")
        nearest = np.argmin(np.sum((samples[:, None] - centers) ** 2, axis=2), axis=1).reshape(small.shape[:2])
        for cluster in np.argsort(-np.bincount(nearest.ravel(), minlength=count), kind="stable"):
            seed = cv2.resize(
                (nearest == cluster).astype(np.uint8), image.shape[1::-1], interpolation=cv2.INTER_NEAREST
            )
            try:
                yield _refined(image, chroma, _hand_component(seed.view(bool)), levels=LEVELS)
            except ValueError:
                # A cluster that is too small, or most of the image.
                continue


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
    if len(model.probability) == 1:
        table = model.probability[0].astype(np.float32)
        found = cv2.calcBackProject([chroma], [1, 2], table, [0, 256, 0, 256], 1)
    else:
        # OpenCV takes a table of three dimensions for an image with channels.
        y, cr, cb = cv2.split(chroma)
        level = (y.astype(np.uint32) * len(model.probability)) >> 8
        found = model.probability.ravel()[(level << 16) + (cr.astype(np.uint32) << 8) + cb]
    return cv2.GaussianBlur(found, (0, 0), SMOOTHING)


def _refined(image: np.ndarray, chroma: np.ndarray, hand: Bool[np.ndarray, "rows cols"], levels: int) -> SkinModel:
    """From a first guess of where the hand is, and then from what the model finds."""
    model = _learned(chroma, hand, levels)
    for _ in range(REFINEMENTS):
        model = _learned(chroma, _hand_component(skin_mask(image, model)), levels)
    return model


def _learned(chroma: np.ndarray, hand: Bool[np.ndarray, "rows cols"], levels: int) -> SkinModel:
    share, most = float(hand.mean()), MOST_AREA if levels == 1 else MOST_OF_CLUSTER
    if not LEAST_AREA <= share <= most:
        raise ValueError(
            f"image must show a hand in the colours of skin on {LEAST_AREA:.0%} to {most:.0%} of it; got {share:.1%}."
        )
    kernel = np.ones((2 * MARGIN + 1,) * 2, np.uint8)
    skin, rest = cv2.erode(hand.astype(np.uint8), kernel), 1 - cv2.dilate(hand.astype(np.uint8), kernel)
    densities = [_density(chroma, where, levels) for where in (skin, rest)]
    skin_share = SKIN_PRIOR * densities[0]
    posterior = skin_share / (skin_share + (1 - SKIN_PRIOR) * densities[1])
    return SkinModel(np.rint(255 * posterior).astype(np.uint8))


def _density(chroma: np.ndarray, where: np.ndarray, levels: int) -> Float[np.ndarray, "levels 256 256"]:
    """Of luma, Cr and Cb."""
    counts = cv2.calcHist([chroma], [0, 1, 2], where, [levels, 256, 256], [0, 256] * 3)
    smooth = np.stack([cv2.GaussianBlur(one, (0, 0), SPREAD, borderType=cv2.BORDER_CONSTANT) for one in counts])
    if levels > 1:
        smooth = gaussian_filter1d(smooth, LEVEL_SPREAD, axis=0, mode="constant")
    return smooth / max(float(smooth.sum()), 1.0) + PRIOR_COUNT / levels


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
