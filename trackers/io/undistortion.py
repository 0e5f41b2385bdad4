"""Images without lens distortion, by one map that is computed for the first of them."""

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property

import cv2
import numpy as np

from jaxfilters.models.calibration import undistort_pixels
from jaxfilters.trackers.io.video_input import FrameSet


class Undistortion:
    """What straightens the images of one camera; an image of a camera without distortion passes as it is."""

    def __init__(self, shape: tuple[int, int], K: np.ndarray | None = None, distortion: np.ndarray | None = None):
        """The map of a camera with intrinsics `K` (3, 3) and `distortion` k1, k2, p1, p2, k3 (OpenCV).

        Args:
            shape: Rows and columns of the images.
            K: Of the images as they come; the straightened ones keep it.
            distortion: (5,), or None for none.
        """
        self.shape = shape
        self.K = None if K is None else np.asarray(K, float)
        self.distortion = np.zeros(5) if distortion is None else np.asarray(distortion, float)

    @property
    def is_identity(self) -> bool:
        """Whether images pass as they are."""
        return self.K is None or not self.distortion.any()

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        # Made for the first image: a description alone is cheap to open.
        assert self.K is not None
        rows, cols = self.shape
        return cv2.initUndistortRectifyMap(self.K, self.distortion, np.eye(3), self.K, (cols, rows), cv2.CV_16SC2)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """The image (rows, cols[, 3]) straightened; black where the camera observed nothing.

        Raises:
            ValueError: an image of another size.
        """
        if image.shape[:2] != self.shape:
            raise ValueError(f"image must have {self.shape[0]} rows and {self.shape[1]} columns; got {image.shape}.")
        return image if self.is_identity else cv2.remap(image, *self._maps, cv2.INTER_LINEAR)

    def straightened(self, uv: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of the video, without lens distortion."""
        if self.is_identity:
            return np.asarray(uv, float)
        assert self.K is not None
        return undistort_pixels(np.reshape(uv, (-1, 2)), self.K, self.distortion).reshape(np.shape(uv))

    def distorted(self, uv: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of the video at which pixels without lens distortion appear in it."""
        if self.is_identity:
            return np.asarray(uv, float)
        assert self.K is not None
        flat = np.asarray(uv, float).reshape(-1, 2)
        rays = np.linalg.solve(self.K, np.column_stack([flat, np.ones(len(flat))]).T).T
        return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.K, self.distortion)[0].reshape(np.shape(uv))


def straightened(moments: Iterable[FrameSet], undistortions: Sequence[Undistortion]) -> Iterator[FrameSet]:
    """Moments whose images have no lens distortion, one undistortion for each source."""
    for moment in moments:
        pairs = zip(moment.images, undistortions, strict=True)
        images = tuple(None if image is None else undistortion.apply(image) for image, undistortion in pairs)
        yield moment._replace(images=images)
