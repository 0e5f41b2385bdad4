"""Foreground from the boxes of a detector: a silhouette of usual shape in every box, for the same search as ever."""

from collections.abc import Iterable, Mapping

import numpy as np

from jaxfilters.models.person.foreground import PARTS
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people.config import PeopleConfig

_BOX_WIDTH = 0.5 / max(part.radius for part in PARTS)
"""Width of a body in box widths, in units of the width that `PARTS` are given in."""
_SHARPNESS = 12
"""Exponent of the squared distance in units of an outline. Soft edges of `PARTS` are those of a population; where every
single silhouette has them, the most likely body is larger, and too near."""
_HIPS = PARTS[0].center + PARTS[0].half_height
_FILLING = (PARTS[0]._replace(center=_HIPS / 2, half_height=_HIPS / 2), *PARTS[1:])
"""Legs, trunk and head that fill a box. The legs of `PARTS` end 0.017 heights above the soles, which a camera that
looks down by 10 degrees takes for 0.17 m of floor."""
_MISSED = 0.1
"""Probability that a detector has no box where a person shows, at least; also that of a pixel of foreground there."""
_RELIABLE = 0.99
"""Largest probability of foreground, and 1 minus the smallest, that either sensor alone can claim for a pixel."""


def combined(subtracted: np.ndarray, detected: np.ndarray) -> np.ndarray:
    """Probability of foreground from two sensors that err independently, by the product of their odds.

    Where both agree the result is more certain than either. Foreground that no box holds (a shadow, a reflection, a
    door) counts less, and a box in which nothing differs from the background counts less as well.

    Args:
        subtracted: Probability of foreground by subtraction of the background, (rows, cols) from 0 to 1.
        detected: The same by the boxes of a detector.

    Returns:
        Probability of foreground, (rows, cols) float32.
    """
    s, d = np.clip(subtracted, 1 - _RELIABLE, _RELIABLE), np.clip(detected, _MISSED, _RELIABLE)
    foreground = s * d
    return (foreground / (foreground + (1 - s) * (1 - d))).astype(np.float32, copy=False)


class DetectedForeground:
    """Probability of foreground of one camera from boxes by frame; a `Background` that needs no background.

    Each box holds the silhouette of a body of usual proportions that fills it: legs, trunk and head of
    `models.person.foreground`. Where boxes overlap, either body makes a pixel foreground. The tracker's search, its
    floor, and its identities are those of silhouettes.
    """

    def __init__(
        self,
        boxes: Mapping[int, np.ndarray],
        undistortion: Undistortion,
        *,
        spread_px: float = PeopleConfig.spread_px,
    ):
        """Boxes of a recording whose images come in their order.

        Args:
            boxes: By frame from 0, (n, 5) left, top, right, bottom in pixels of the video, and score from 0 to 1.
            undistortion: What straightens the images of the camera.
            spread_px: How far the tracker takes silhouettes to reach beyond the edges of a body, as in its
                configuration; boxes end at the edges.
        """
        self._boxes, self._undistortion, self._spread_px = boxes, undistortion, spread_px
        self._frame = 0

    def prime(self, images: Iterable[np.ndarray]) -> None:
        """Nothing: boxes need no empty room."""

    def apply(self, image: np.ndarray, *, keep: np.ndarray | None = None) -> np.ndarray:  # noqa: ARG002
        """As `Background.apply`, of the frame after the one before."""
        boxes = self._boxes.get(self._frame)
        self._frame += 1
        absent = np.ones(image.shape[:2], np.float32)
        for *box, score in self._straight(boxes) if boxes is not None else ():
            _cover(absent, np.array(box) + self._spread_px * np.array([-1, -1, 1, 1]), score)
        return 1 - absent

    def state(self) -> dict[str, np.ndarray]:
        """As `Background.state`."""
        return {"frame": np.array(self._frame)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """As `Background.restore`."""
        self._frame = int(state["frame"])

    def _straight(self, boxes: np.ndarray) -> np.ndarray:
        """Boxes without lens distortion: by the middles of their sides, which are on the outline of a person."""
        left, top, right, bottom, score = boxes.T
        u, v = (left + right) / 2, (top + bottom) / 2
        sides = self._undistortion.straightened(np.stack([[left, v], [u, top], [right, v], [u, bottom]]).swapaxes(1, 2))
        return np.stack([sides[0, :, 0], sides[1, :, 1], sides[2, :, 0], sides[3, :, 1], score], axis=-1)


def _cover(absent: np.ndarray, box: np.ndarray, score: float) -> None:
    """Multiply the probability that nobody is at a pixel by that of the body in a box, in place."""
    left, top, right, bottom = box
    rows, cols = absent.shape
    margin = 0.25 * np.array([right - left, bottom - top])
    u0, u1 = (int(np.clip(edge, 0, cols)) for edge in (left - margin[0], right + margin[0] + 1))
    v0, v1 = (int(np.clip(edge, 0, rows)) for edge in (top - margin[1], bottom + margin[1] + 1))
    across = (np.arange(u0, u1) - (left + right) / 2) / (right - left)
    up = (bottom - np.arange(v0, v1)) / (bottom - top)
    here = np.ones((v1 - v0, u1 - u0), np.float32)
    for part in _FILLING:
        vertical = (up - part.center) / part.half_height
        squared = (across[None] / (_BOX_WIDTH * part.radius)) ** 2 + vertical[:, None] ** 2
        here *= 1 - 1 / (1 + squared**_SHARPNESS)
    absent[v0:v1, u0:u1] *= 1 - np.float32(score) * (1 - here)
