"""Small rotations of a camera that should stand still: vibration, drift of its mount, a knock.

A camera that turns about its centre moves the image by the homography K R K^-1, whatever the scene (R. Hartley,
A. Zisserman, "Multiple view geometry in computer vision", 2004, section 8.4.2). The rotation R has three parameters.
They follow from corners of the background, found again in every image by optical flow (B. Lucas, T. Kanade 1981,
J. Bouguet 2001), by the least-squares rotation between two bundles of rays (W. Kabsch 1976) with weights that ignore
corners that move on their own, as those on people do.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

_COLS = 640
"""Columns of the images in which corners are searched for, at most: finer ones say no more of three angles."""
_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX = 120, 0.01, 12
_NEAR, _FAR = (15, 3), (21, 4)
"""Pixels of the window and levels of the pyramid for a camera that trembles, and for one that was knocked."""
_LEAST_CORNERS = 12
"""That agree with a rotation, below which it is not believed."""
_LEAST_SHARE = 0.3
"""Of the corners that were found again, the same."""
_SCALE_PX = 0.5
"""Of the weights of corners, Geman and McClure's: those farther off count little."""
_AGREES_PX = 1.5
_ITERATIONS = 6
_STILL_PX = 0.35
"""Largest motion of a corner of the image up to which a camera counts as still: the image is left as it is."""
_SAME_LIGHT = 0.02
_BEGINNING = 4
"""The pose of the calibration is the usual one in one of so many parts of a recording, the first."""


class Registration:
    """Images of one camera as if it had not turned since its reference was taken."""

    def __init__(self, K: ArrayLike):
        """No reference yet.

        Args:
            K: (3, 3) intrinsic matrix of images without lens distortion, pixels.

        Raises:
            ValueError: K is not a finite, regular matrix (3, 3).
        """
        K = np.asarray(K, float)
        if K.shape != (3, 3) or not np.isfinite(K).all() or np.linalg.matrix_rank(K) < 3:
            raise ValueError(f"K must be a finite, regular matrix (3, 3); got {K!r}.")
        self._K = K
        self._reference: np.ndarray | None = None
        self._corners: np.ndarray = np.zeros((0, 2), np.float32)
        self._rotation: np.ndarray = np.eye(3)
        self.most_px = 0.0
        """The largest motion of a corner of the image so far that was undone, pixels."""
        self.failures = 0
        """Images in which no rotation could be found; they were taken for turned as the one before."""

    def prime(self, images: Sequence[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Take the reference from images spread over a recording, and straighten all of them.

        The reference pose is the median one of the first quarter of the images: a calibration is older than a
        recording, and knocks and drift come later.

        Args:
            images: (rows, cols[, 3]) uint8 of one shape, at least one, in their order.

        Returns:
            The images as from the reference pose, and where each shows nothing: (rows, cols) uint8, not zero there.
        """
        self.refer_to(images[0])
        rotations = np.stack([self._estimate(image) for image in images])
        beginning = rotations[: -(-len(rotations) // _BEGINNING)]
        angles = np.median([cv2.Rodrigues(one)[0][:, 0] for one in beginning], axis=0)
        usual = cv2.Rodrigues(angles)[0]
        # Rays of the first image turn by `usual` into the reference pose.
        back = [one @ usual.T for one in rotations]
        found = [self._turned(image, one) for image, one in zip(images, back, strict=True)]
        self.refer_to(found[0])
        self._rotation = np.eye(3)
        return found, [self._blank(images[0].shape[:2], one) for one in back]

    def straightened(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """An image as from the reference pose, and where it shows nothing.

        The first image is the reference, where there is none.

        Args:
            image: (rows, cols[, 3]) uint8.

        Returns:
            The image, and (rows, cols) uint8, 255 where the camera had no pixel; the image itself and None where the
            camera did not turn.
        """
        if self._reference is None:
            self.refer_to(image)
            return image, None
        self._rotation = self._estimate(image)
        moved = self._motion_px(self._rotation, image.shape)
        if moved < _STILL_PX:
            return image, None
        self.most_px = max(self.most_px, moved)
        return self._turned(image, self._rotation), self._blank(image.shape[:2], self._rotation)

    def as_last(self, image: np.ndarray) -> np.ndarray:
        """Another image (rows, cols[, 3]) of the moment that was straightened last, as from the reference pose."""
        return self._turned(image, self._rotation)

    def refer_to(self, image: np.ndarray) -> None:
        """Take corners from another image in the reference pose, as from a background that follows the light."""
        self._reference = _small_grey(image)
        found: Any = cv2.goodFeaturesToTrack(self._reference, _CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX)
        self._corners = np.zeros((0, 2), np.float32) if found is None else found[:, 0]

    def state(self) -> dict[str, np.ndarray]:
        """The reference, as arrays to save; empty before the first image."""
        if self._reference is None:
            return {}
        counts = np.array([self.most_px, self.failures])
        return {"reference": self._reference, "corners": self._corners, "rotation": self._rotation, "counts": counts}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from what `state` gave."""
        if state:
            self._reference, self._corners, self._rotation = (state[k] for k in ("reference", "corners", "rotation"))
            self.most_px, self.failures = float(state["counts"][0]), int(state["counts"][1])

    def _estimate(self, image: np.ndarray) -> np.ndarray:
        """The rotation that turns rays of the reference into those of the image; the last one where none is found."""
        assert self._reference is not None
        if len(self._corners) < _LEAST_CORNERS:
            return self._rotation
        grey, step = _small_grey(image), _step(image)
        grey = _as_bright(grey, self._reference)
        found = self._from_corners(grey, self._rotation, step, *_NEAR)
        if found is None:
            found = self._from_corners(grey, self._coarse(grey, step), step, *_FAR)
        if found is not None:
            return found
        self.failures += 1
        return self._rotation

    def _from_corners(
        self, grey: np.ndarray, guess: np.ndarray, step: int, side_px: int, levels: int
    ) -> np.ndarray | None:
        assert self._reference is not None
        start = _moved(self._homography(guess, step), self._corners).astype(np.float32)
        found, good, _ = cv2.calcOpticalFlowPyrLK(
            self._reference,
            grey,
            self._corners,
            start.copy(),
            winSize=(side_px, side_px),
            maxLevel=levels,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        here, there = self._corners[good[:, 0] > 0], found[good[:, 0] > 0]
        if len(here) < _LEAST_CORNERS:
            return None
        # Whatever else moves, if only a part of the room stands where it stood, the camera does.
        still = np.linalg.norm(_moved(self._homography(self._rotation, step), here) - there, axis=1) < _STILL_PX
        if np.mean(still) > _LEAST_SHARE:
            return self._rotation
        rotation = self._robust_rotation(here, there, step)
        misses = np.linalg.norm(_moved(self._homography(rotation, step), here) - there, axis=1)
        agree = np.sum(misses < _AGREES_PX)
        return rotation if agree >= max(_LEAST_CORNERS, _LEAST_SHARE * len(here)) else None

    def _robust_rotation(self, here: np.ndarray, there: np.ndarray, step: int) -> np.ndarray:
        """Reweighted least squares from the median motion on, with weights that narrow to their final scale."""
        middle = np.median(there - here, axis=0)
        misses = np.linalg.norm(there - here - middle, axis=1)
        rays, turned = self._rays(here, step), self._rays(there, step)
        rotation = np.eye(3)
        for scale in np.maximum(_SCALE_PX, 8.0 * 0.5 ** np.arange(_ITERATIONS)):
            weights = 1 / (1 + (misses / scale) ** 2) ** 2
            rotation = _kabsch(rays, turned, weights)
            misses = np.linalg.norm(_moved(self._homography(rotation, step), here) - there, axis=1)
        return rotation

    def _coarse(self, grey: np.ndarray, step: int) -> np.ndarray:
        """The rotation of the shift of the whole image, by phase correlation: for knocks that flow cannot follow."""
        assert self._reference is not None
        window = cv2.createHanningWindow(grey.shape[::-1], cv2.CV_32F)
        (u, v), _ = cv2.phaseCorrelate(self._reference.astype(np.float32), grey.astype(np.float32), window)
        middle = (np.array(grey.shape[::-1]) - 1) / 2
        rays = self._rays(np.stack([middle, middle + np.array([u, v])]), step)
        axis = np.cross(rays[0], rays[1])
        return cv2.Rodrigues(axis)[0]

    def _rays(self, uv: np.ndarray, step: int) -> np.ndarray:
        rays = np.insert(np.asarray(uv, float) * step, 2, 1.0, axis=1) @ np.linalg.inv(self._K).T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def _homography(self, rotation: np.ndarray, step: int = 1) -> np.ndarray:
        K = np.diag([1 / step, 1 / step, 1.0]) @ self._K
        return K @ rotation @ np.linalg.inv(K)

    def _turned(self, image: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """The image in the pose that `rotation` turns into its own; beyond its border, the pixels of the border."""
        if self._motion_px(rotation, image.shape) < _STILL_PX:
            return image
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(
            image, self._homography(rotation), image.shape[1::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
        )

    def _blank(self, shape: tuple[int, int], rotation: np.ndarray) -> np.ndarray:
        """Where an image that `_turned` gives shows nothing, 255."""
        blank = np.zeros(shape, np.uint8)
        if self._motion_px(rotation, shape) < _STILL_PX:
            return blank
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(blank, self._homography(rotation), shape[::-1], flags=flags, borderValue=255.0)

    def _motion_px(self, rotation: np.ndarray, shape: tuple[int, ...]) -> float:
        rows, cols = shape[:2]
        corners = np.array([[0, 0], [cols - 1, 0], [0, rows - 1], [cols - 1, rows - 1]], float)
        return float(np.linalg.norm(_moved(self._homography(rotation), corners) - corners, axis=1).max())


def intrinsics(P: ArrayLike) -> np.ndarray:
    """(3, 3) intrinsic matrix of a projection matrix (3, 4), by RQ decomposition (Hartley and Zisserman, 6.2.4)."""
    K = cv2.decomposeProjectionMatrix(np.asarray(P, float))[0]
    return K / K[2, 2]


def _kabsch(rays: np.ndarray, turned: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The rotation R that minimises the weighted sum of squares of R ray - turned ray."""
    left, _, right = np.linalg.svd((turned * weights[:, None]).T @ rays)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _moved(homography: np.ndarray, uv: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(np.asarray(uv, float).reshape(-1, 1, 2), homography)[:, 0]


def _step(image: np.ndarray) -> int:
    return max(1, -(-image.shape[1] // _COLS))


def _small_grey(image: np.ndarray) -> np.ndarray:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    step = _step(image)
    if step == 1:
        return grey
    rows, cols = grey.shape[0] // step, grey.shape[1] // step
    return cv2.resize(grey[: rows * step, : cols * step], (cols, rows), interpolation=cv2.INTER_AREA)


def _as_bright(grey: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Grey values scaled to the mean of the reference: optical flow takes brightness for constant."""
    gain = max(1.0, cv2.mean(reference)[0]) / max(1.0, cv2.mean(grey)[0])
    return grey if abs(gain - 1) < _SAME_LIGHT else cv2.convertScaleAbs(grey, alpha=gain)
