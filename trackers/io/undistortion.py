"""Images without lens distortion, by one map that is computed once."""

import cv2
import numpy as np


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
        self._maps = None
        if self.K is not None and self.distortion.any():
            rows, cols = shape
            self._maps = cv2.initUndistortRectifyMap(
                self.K, self.distortion, np.eye(3), self.K, (cols, rows), cv2.CV_16SC2
            )

    @property
    def is_identity(self) -> bool:
        """Whether images pass as they are."""
        return self._maps is None

    def apply(self, image: np.ndarray) -> np.ndarray:
        """The image (rows, cols[, 3]) straightened; black where the camera saw nothing.

        Raises:
            ValueError: an image of another size.
        """
        if image.shape[:2] != self.shape:
            raise ValueError(f"image must have {self.shape[0]} rows and {self.shape[1]} columns; got {image.shape}.")
        return image if self._maps is None else cv2.remap(image, *self._maps, cv2.INTER_LINEAR)
