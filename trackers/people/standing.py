"""Images of a room without the people who stand in it, for a background from a recording in which they never leave.

A temporal median takes whoever stands still for half of a recording for the room. A detector of upright people
(N. Dalal, B. Triggs, "Histograms of oriented gradients for human detection", 2005, as trained by OpenCV) finds them in
the sampled images. It also answers to railings and doors; only boxes count that have the size of a person who stands on
the floor there. Where boxes cover a pixel in most images, the room behind is guessed from its surroundings (A. Telea
2004), unless nothing moves there at all: then it is a thing. Boxes are wider than people, and people sway, so that the
room is often observed there all the same: of the colours that some images share, the one nearest to the guess.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.background.gain import in_one_light

_COLS, _MOST_ENLARGED = 800, 2.5
"""Width to which images are enlarged or reduced for the detector, which wants people of 96 pixels, and the limit."""
_HEAD, _FOOT, _HALF_WIDTH = 16 / 128, 112 / 128, 0.2
"""Of the detector's window: where a head and feet are, by its height; half of the width of a person by the height."""
_HEIGHTS_M = (1.3, 2.1)
_LEAST_SCORE = 0.3
"""Of a detection that counts: a false one only costs an image, a missed one leaves a person in the room."""
_LEAST_FREE = 0.25
"""Share of the images in which a pixel is free, below which the room behind is interpolated."""
_MOVES_LEVELS, _MOVES_SHARE = 40, 0.15
"""Share of the pixels of a person who stands still that change by so many levels in the course of a recording."""
_PERCENTILES = (10, 90)
"""Between which a pixel changes: who passes by does not count."""
_INPAINT_RADIUS_PX = 5.0
_RINGS, _RING_PX = 7, 4
"""Rings of a covered part, from its border inwards, each settled before the next is guessed; and their width."""
_SAME_LEVELS, _LEAST_SHARED = 12, 3
"""Largest difference of pixels that show the same thing, and images that must show it."""
_NEAR_GUESS_LEVELS = 40
"""Between the room and its guess, at most: people whose clothes are nearer to it are taken for the room."""
_NEAR_BOX_PX = 2


def emptied(
    camera: FloorCamera, floor: np.ndarray, images: Sequence[np.ndarray], blank: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """The images with the room in the place of the people who stand upright in it, and where they show nothing.

    Args:
        camera: Of the images.
        floor: (corners, 2) polygon in which people can stand, metres.
        images: (rows, cols, 3) uint8 spread over a recording, from one pose.
        blank: For each image (rows, cols), not zero where a camera that had turned showed nothing.

    Returns:
        As many images; those in which nothing was found as they were.
    """
    masks = [
        _mask(image.shape[:2], standing_boxes(camera, floor, image)) | (unknown > 0)
        for image, unknown in zip(images, blank, strict=True)
    ]
    somewhere = np.any(masks, axis=0)
    if not somewhere.any():
        return list(images)
    lit = in_one_light(images)
    values = np.stack([image[somewhere] for image in lit]).astype(np.int16)
    hidden = np.stack([mask[somewhere] for mask in masks])
    room, free = _free_median(values, hidden), (~hidden).mean(axis=0)
    empty = lit[len(lit) // 2].copy()
    empty[somewhere] = room
    covered = np.zeros(somewhere.shape, bool)
    covered[somewhere] = free < _LEAST_FREE
    covered = _changing(covered, lit)
    empty = _completed(empty, covered, lit)
    usable = covered.copy()
    usable[somewhere] |= free >= _LEAST_FREE
    return [np.where((mask & usable)[..., None], empty, image) for image, mask in zip(lit, masks, strict=True)]


def standing_boxes(camera: FloorCamera, floor: np.ndarray, image: np.ndarray) -> np.ndarray:
    """(n, 4) left, top, right and bottom of upright people on the floor, from head to feet, pixels."""
    scale = min(_COLS / image.shape[1], _MOST_ENLARGED)
    scaled = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    detector = cv2.HOGDescriptor()
    if any(size < need for size, need in zip(scaled.shape[:2], detector.winSize[::-1], strict=True)):
        return np.zeros((0, 4))
    detector.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector(), np.float32))
    found, _ = detector.detectMultiScale(
        scaled, hitThreshold=_LEAST_SCORE, winStride=(8, 8), padding=(16, 16), scale=1.1, groupThreshold=0
    )
    if not len(found):
        return np.zeros((0, 4))
    left, top, width, height = np.asarray(found, float).T / scale
    u, head, foot = left + width / 2, top + _HEAD * height, top + _FOOT * height
    tall = foot - head
    boxes = np.stack([u - _HALF_WIDTH * tall, head, u + _HALF_WIDTH * tall, foot], axis=-1)
    return boxes[_is_on_floor(camera, floor, u, head, foot)]


def _is_on_floor(
    camera: FloorCamera, floor: np.ndarray, u: np.ndarray, head: np.ndarray, foot: np.ndarray
) -> np.ndarray:
    """(n,) whether people between these rows have their feet on the floor and the height of people."""
    P, ones = np.asarray(camera.P, float), np.ones_like(u)
    homogeneous = np.linalg.solve(P[:, [0, 1, 3]], np.stack([u, foot, ones]))
    x, y, _ = homogeneous / homogeneous[2]
    corners = np.asarray(floor, np.float32)
    inside = [cv2.pointPolygonTest(corners, (float(a), float(b)), False) >= 0 for a, b in zip(x, y, strict=True)]
    in_front = P[2] @ np.stack([x, y, 0 * ones, ones]) > 0
    rows = []
    for height in _HEIGHTS_M:
        _, v, depth = P @ np.stack([x, y, height * ones, ones])
        rows.append(v / depth)
    return in_front & np.array(inside, bool) & (rows[1] <= head) & (head <= rows[0])


def _mask(shape: tuple[int, int], boxes: np.ndarray) -> np.ndarray:
    mask = np.zeros(shape, bool)
    for left, top, right, bottom in boxes:
        low = np.maximum(np.floor([top, left]).astype(int) - _NEAR_BOX_PX, 0)
        high = np.ceil([bottom, right]).astype(int) + _NEAR_BOX_PX + 1
        mask[low[0] : high[0], low[1] : high[1]] = True
    return mask


def _free_median(values: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """(pixels, 3): median over the images (images, pixels, 3) in which a pixel is free; over all where it never is."""
    hidden = hidden & ~np.all(hidden, axis=0)
    ordered = np.sort(np.where(hidden[..., None], np.int16(1000), values), axis=0)
    middle = ((~hidden).sum(axis=0) - 1) // 2
    return np.take_along_axis(ordered, middle[None, :, None], axis=0)[0].astype(np.uint8)


def _completed(empty: np.ndarray, covered: np.ndarray, images: Sequence[np.ndarray]) -> np.ndarray:
    """The room where it is `covered` (rows, cols): of what the images show there, what is nearest to a guess."""
    found, covered = empty.copy(), covered.copy()
    kernel = np.ones((2 * _RING_PX + 1, 2 * _RING_PX + 1), np.uint8)
    for ring in range(_RINGS + 1):
        unknown = covered.astype(np.uint8)
        found = cv2.inpaint(found, unknown, _INPAINT_RADIUS_PX, cv2.INPAINT_TELEA)
        outer = covered if ring == _RINGS else covered & (cv2.erode(unknown, kernel) == 0)
        if not outer.any():
            break
        room, is_known = _nearest_shared(np.stack([image[outer] for image in images]).astype(np.int16), found[outer])
        known = outer.copy()
        known[outer] = is_known
        found[known] = room[is_known]
        covered &= ~known
    return found


def _nearest_shared(values: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(pixels, 3) the colour that some images (images, pixels, 3) share nearest to a guess, and where there is one."""
    apart = np.abs(values - guess.astype(np.int16)).max(axis=-1)
    shared = np.stack([(np.abs(values - one).max(axis=-1) <= _SAME_LEVELS).sum(axis=0) for one in values])
    apart = np.where(shared >= _LEAST_SHARED, apart, np.int16(1000))
    nearest = np.take_along_axis(values, apart.argmin(axis=0)[None, :, None], axis=0)
    others = np.abs(values - nearest).max(axis=-1) > _SAME_LEVELS
    return _free_median(values, others), apart.min(axis=0) < _NEAR_GUESS_LEVELS


def _changing(covered: np.ndarray, images: Sequence[np.ndarray]) -> np.ndarray:
    """The connected parts of a mask (rows, cols) that change as a person does who stands, not as a thing."""
    spread = np.zeros(covered.shape, np.float32)
    low, high = np.percentile(np.stack([image[covered] for image in images]), _PERCENTILES, axis=0)
    spread[covered] = (high - low).max(axis=-1)
    number, labels = cv2.connectedComponents(covered.astype(np.uint8))
    share = [np.mean(spread[labels == one] > _MOVES_LEVELS) for one in range(number)]
    return covered & (np.array(share) > _MOVES_SHARE)[labels]
