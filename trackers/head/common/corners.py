"""Landmarks where the image of a face has corners: least eigenvalues of the structure tensor, near where they are due.

Everything is looked for in an upright image, in which the eyes' centres are level and `EYE_DISTANCE` apart. Lengths
named after it are shares of that distance.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.face.landmarks import EYES

EYE_DISTANCE = 96.0
"""Pixels."""
SHAPE, MIDDLE = (272, 240), (120.0, 80.0)
"""Of the upright image, rows and columns, and the point between the eyes in it."""
EYE_CORNER, EYE_DROP = 0.226, 0.04
"""How far the corners of an eye are from its centre to either side, and below the centre of its box."""
IRIS = (0.13, 0.18)
"""Radii about the middle of an iris: rims within the first are never an eye's corner, beyond the second may be."""
EYE_SPREAD, MOUTH_SPREAD = (0.05, 0.04), (0.05, 0.04)
"""How far the corners of eyes and mouth lie from where they are due."""
MOUTH_DROP = (1.15, 0.25)
"""How far the line between the lips is below the eyes, and how much that differs."""
MOUTH_WIDTH, MOUTH_ASIDE, MOUTH_SLOPE = (0.4, 1.2), 0.25, 0.35
"""Widths of that line, how far its middle may be from the face's, and how steep it may be."""


def eye_centers(six: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2 2"]:
    """Midpoints between the corners of the subject's right and left eye."""
    return six[list(EYES)].reshape(2, 2, 2).mean(axis=1)


def eyes_apart_px(six: Float[np.ndarray, "n 2"]) -> float:
    """Distance between these midpoints."""
    right, left = eye_centers(six)
    return float(np.linalg.norm(right - left))


def corners(
    image: UInt8[np.ndarray, "rows cols"], eyes: Float[np.ndarray, "2 4"], mouth: Float[np.ndarray, " 4"]
) -> Float[np.ndarray, "6 2"] | None:
    """Landmarks 0 to 5 in boxes (u, v, width, height); `None` if they are not clear.

    Eye corners are the strongest corners near where they are due from the eyes' centres, which are then taken again
    from what was found. Mouth corners are those near the ends of the dark line between the lips.
    """
    centers = eyes[:, :2] + 0.5 * eyes[:, 2:] - 0.5
    across = centers[1] - centers[0]
    centers = centers + EYE_DROP * np.array([-across[1], across[0]])
    for _ in range(2):
        to_upright = upright_from(centers)
        upright = warped(image, to_upright, SHAPE)
        strength = corner_strength(upright)
        strength = strength * off_the_irises(upright, apply(to_upright, centers))
        outwards = np.array([[-EYE_CORNER, 0], [EYE_CORNER, 0]] * 2)
        due = apply(to_upright, centers)[[0, 0, 1, 1]] + EYE_DISTANCE * outwards
        found = np.array([strongest(strength, place, EYE_SPREAD) for place in due])
        back = cv2.invertAffineTransform(to_upright)
        centers = eye_centers(apply(back, found))
    box = apply(to_upright, (mouth[:2] + 0.5 * mouth[2:] - 0.5)[None])[0]
    size = mouth[2:] * np.linalg.norm(to_upright[0, :2])
    ends = _ends_of_dark_line(upright, box, size)
    if ends is None:
        return None
    lips = [strongest(strength, place, MOUTH_SPREAD) for place in ends]
    return apply(back, np.concatenate([found, lips]))


def upright_from(centers: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 3"]:
    """Map from the image to the upright image, in which the eyes' centres are level about `MIDDLE`."""
    u, v = centers[1] - centers[0]
    turn = EYE_DISTANCE / (u * u + v * v) * np.array([[u, v], [-v, u]])
    return np.column_stack([turn, MIDDLE - turn @ centers.mean(axis=0)])


def warped(image: np.ndarray, to: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The image under an affine map, of the given rows and columns, its border continued outwards.

    What becomes much smaller is averaged first.
    """
    scale = float(np.linalg.norm(to[0, :2]))
    if scale < 0.7:
        rows, cols = image.shape
        size = (max(1, round(scale * cols)), max(1, round(scale * rows)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        back = np.array([cols / size[0], rows / size[1]])
        to = np.column_stack([to[:, :2] * back, to[:, 2] + to[:, :2] @ (0.5 * back - 0.5)])
    return cv2.warpAffine(image, to, shape[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def corner_strength(upright: np.ndarray) -> Float[np.ndarray, "rows cols"]:
    """Smaller eigenvalue of the structure tensor about each pixel [S3.2]."""
    smooth = cv2.GaussianBlur(upright, (0, 0), 1.5)
    return np.maximum(cv2.cornerMinEigenVal(smooth, 7, ksize=3), 0.0)


def strongest(
    strength: Float[np.ndarray, "rows cols"], due: Float[np.ndarray, " 2"], spread: tuple[float, float]
) -> Float[np.ndarray, " 2"]:
    """Where the strength, weighted by a Gaussian about `due`, is largest, to a part of a pixel."""
    due = np.clip(due, 2, np.array(strength.shape[::-1]) - 3)
    sigma = EYE_DISTANCE * np.asarray(spread)
    low = np.maximum(np.floor(due - 2.5 * sigma).astype(int), 1)
    high = np.minimum(np.ceil(due + 2.5 * sigma).astype(int) + 1, np.array(strength.shape[::-1]) - 1)
    u, v = np.arange(low[0], high[0]), np.arange(low[1], high[1])
    weight = np.exp(-0.5 * (((u - due[0]) / sigma[0]) ** 2 + (((v - due[1]) / sigma[1]) ** 2)[:, None]))
    value = weight * strength[low[1] : high[1], low[0] : high[0]]
    row, col = np.unravel_index(value[1:-1, 1:-1].argmax(), (len(v) - 2, len(u) - 2))
    about = value[row : row + 3, col : col + 3]
    offset = np.array([_peak(about[1]), _peak(about[:, 1])])
    return low + np.array([col + 1, row + 1]) + offset


def off_the_irises(
    upright: UInt8[np.ndarray, "rows cols"], centers: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, "rows cols"]:
    """Weights that are small on the darkest disc of each eye, whose rim has stronger corners than the eye."""
    smooth = cv2.GaussianBlur(upright, (0, 0), 0.05 * EYE_DISTANCE)
    weight = np.ones(upright.shape, np.float32)
    reach = int(IRIS[1] * EYE_DISTANCE) + 1
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    ring = np.clip((np.hypot(u, v) / EYE_DISTANCE - IRIS[0]) / (IRIS[1] - IRIS[0]), 0.02, 1)
    for center in centers.astype(int):
        low = center - int(0.11 * EYE_DISTANCE)
        eye = smooth[low[1] : 2 * center[1] - low[1], low[0] : 2 * center[0] - low[0]]
        row, col = np.unravel_index(eye.argmin(), eye.shape) + low[::-1]
        weight[row - reach : row + reach + 1, col - reach : col + reach + 1] *= ring
    return weight


def darkness(upright: UInt8[np.ndarray, "rows cols"]) -> Float[np.ndarray, "rows cols"]:
    """How much darker than around them thin streaks and small spots are, as a share of white."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (21, 21))
    dark = cv2.morphologyEx(upright, cv2.MORPH_BLACKHAT, kernel).astype(np.float32)
    return cv2.GaussianBlur(dark, (0, 0), 1.5) / 255


def apply(affine: Float[np.ndarray, "2 3"], points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Points under an affine map."""
    return points @ affine[:, :2].T + affine[:, 2]


def _peak(values: np.ndarray) -> float:
    """Offset of the vertex of the parabola through three values, at most half a step."""
    a, b, c = (float(value) for value in values)
    curvature = a - 2 * b + c
    return 0.0 if curvature >= 0 else float(np.clip(0.5 * (a - c) / curvature, -0.5, 0.5))


def _ends_of_dark_line(upright: np.ndarray, center: np.ndarray, size: np.ndarray) -> Float[np.ndarray, "2 2"] | None:
    """Both ends of the darkest streak in a box of the upright image and about it, the one on the left first."""
    dark, due = darkness(upright), MIDDLE[1] + MOUTH_DROP[0] * EYE_DISTANCE
    low, high = center - (0.5, 0.8) * size, center + 0.5 * size
    low[0], high[0] = min(low[0], MIDDLE[0] - 0.5 * EYE_DISTANCE), max(high[0], MIDDLE[0] + 0.5 * EYE_DISTANCE)
    low[1], high[1] = min(low[1], due - MOUTH_DROP[1] * EYE_DISTANCE), max(high[1], due)
    low, high = np.maximum(low.astype(int), 0), np.maximum(high.astype(int), 0)
    inside = dark[low[1] : high[1], low[0] : high[0]]
    if inside.size == 0 or inside.max() < 0.02:
        return None
    mask = (inside > 0.4 * np.percentile(inside, 99)).astype(np.uint8)
    _, labels = cv2.connectedComponents(mask)
    rows = np.arange(len(inside))[:, None] + low[1]
    nearness = np.exp(-0.5 * ((rows - due) / (MOUTH_DROP[1] * EYE_DISTANCE)) ** 2)
    weights = np.bincount(labels.ravel(), (inside * nearness).ravel())
    weights[0] = 0
    v, u = np.nonzero(labels == weights.argmax())
    ends = low + np.array([(edge, v[np.abs(u - edge) < 3].mean()) for edge in (u.min(), u.max())])
    width, slope = (ends[1] - ends[0]) / EYE_DISTANCE
    aside = abs(ends[:, 0].mean() - MIDDLE[0]) / EYE_DISTANCE
    fits = MOUTH_WIDTH[0] < width < MOUTH_WIDTH[1] and aside < MOUTH_ASIDE and abs(slope) < MOUTH_SLOPE * width
    return ends if fits else None
