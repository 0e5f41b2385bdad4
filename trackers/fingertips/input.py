"""Where images of hands over a desk come from."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

from jaxfilters.models.synthetic.desk_hand import DeskFrame, desk_video
from jaxfilters.models.synthetic.desk_script import script
from jaxfilters.trackers.fingertips.keypoint_input import HandKeypoints, drawn_keypoints, open_keypoints
from jaxfilters.trackers.fingertips.rgbd_input import RgbdImage, RgbdVideo
from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import DEFAULT_FPS, LiveCamera, open_video, spread

DEMO_FPS, DEMO_SHAPE = 30.0, (480, 640)


class DemoHand:
    """A rendered hand as a source of images, with its truth."""

    def __init__(self, seed: int):
        self.name, self.fps, self.image_size = "synthetic hand", DEMO_FPS, (DEMO_SHAPE[1], DEMO_SHAPE[0])
        self._script = script(seed)
        self.frames = len(self._script.fingers)
        self.truth: DeskFrame | None = None
        """The last frame, with what is true of it."""
        self._key = jax.random.key(seed)

    def sample(self, most: int) -> list[np.ndarray]:
        """The open hand that every user shows at the start."""
        return [frame.image for frame in desk_video(self._key, np.ones((1, 5), bool), shape=DEMO_SHAPE)][:most]

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        """An open hand, which then draws, and handles things."""
        fingers, poses, _ = self._script
        for i, frame in enumerate(desk_video(self._key, fingers, shape=DEMO_SHAPE, poses=poses)):
            self.truth = frame
            yield i / self.fps, cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR)

    def trouble(self) -> str | None:
        """Nothing goes wrong."""
        return None


class DepthVideo:
    """A depth recording as a source of images, which are metres."""

    def __init__(self, path: str, fps: float | None):
        self._depth = open_depth(path, fps=fps)
        steps = np.diff(self._depth.times_s)
        self.name, self.frames = self._depth.name, len(self._depth)
        self.fps = float(1 / np.median(steps)) if len(steps) else fps or DEFAULT_FPS
        rows, cols = self._depth[0].shape
        self.image_size = (cols, rows)

    def sample(self, most: int) -> list[np.ndarray]:
        """At most so many images, spread over the recording."""
        return [self._depth[i] for i in spread(range(self.frames), most)]

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        """From the first to the last."""
        for time_s, image in zip(self._depth.times_s - self._depth.times_s[0], self._depth, strict=True):
            yield float(time_s), image

    def trouble(self) -> str | None:
        """What cannot be read is an error."""
        return None


class LiveHands:
    """A live camera, whose first images are for getting to know the user and do not come again."""

    is_live = True

    def __init__(self, camera: Any):
        self.name, self.fps, self.image_size = camera.name, camera.fps, camera.image_size
        self._camera, self._stream = camera, camera.images()

    def sample(self, most: int) -> list[np.ndarray]:
        """The next images, fewer if the camera falls silent."""
        found: list[np.ndarray] = []
        for _, image in self._stream:
            found += [] if image is None else [image]
            if len(found) == most or self.trouble():
                break
        return found

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        """Those that follow."""
        yield from self._stream

    def trouble(self) -> str | None:
        """What went wrong, if anything did."""
        return self._camera.trouble()


def open_hands(
    place: str | None,
    mask: str,
    *,
    fps: float | None,
    seed: int,
    depth: Path | None = None,
    keypoints: Path | None = None,
    image_size: tuple[int, int] | None = None,
) -> Any:
    """The source of images, or of keypoints, that a command was given.

    Raises:
        InputError: nothing there, nothing that can be read, or a mask, size or depths that do not go with it.
    """
    if depth is not None:
        return RgbdVideo(_colours_beside(depth, place, mask, keypoints, fps), depth)
    if keypoints is not None:
        if mask != "infrared":
            raise InputError(f"--mask {mask}: of no use with --keypoints, which need no mask.")
        return open_keypoints(keypoints, place, fps=fps, image_size=image_size)
    if image_size is not None:
        raise InputError("--image-size: of --keypoints only.")
    if place is None:
        if mask != "infrared":
            raise InputError(f"--mask {mask}: of no use without a video; the synthetic hand is an infrared image.")
        if fps is not None:
            raise InputError("--fps: of no use without a recording; the synthetic hand has its own.")
        return DemoHand(seed)
    if mask == "depth":
        if place.isdecimal():
            raise InputError("--mask depth: of a recording only; live cameras deliver colours.")
        return DepthVideo(place, fps)
    source = open_video(place, fps=fps)
    return LiveHands(source) if isinstance(source, LiveCamera) else source


def _colours_beside(depth: Path, place: str | None, mask: str, keypoints: Path | None, fps: float | None) -> Any:
    """The recording that depths belong to.

    Raises:
        InputError: it cannot be read, or there is none whose pixels depths could be of.
    """
    if keypoints is not None:
        raise InputError(f"--depth {depth}: of no use with --keypoints, which need no edges.")
    if mask == "depth":
        raise InputError(f"--depth {depth}: of no use with --mask depth, where VIDEO is the depth recording.")
    if place is None or place.isdecimal():
        raise InputError(f"--depth {depth}: expected VIDEO, the colour images of the same recording.")
    return open_video(place, fps=fps)


def shown(image: np.ndarray | HandKeypoints | RgbdImage) -> np.ndarray:
    """A picture (rows, cols, 3) of an image that is one, of depths or of keypoints."""
    if isinstance(image, HandKeypoints):
        return drawn_keypoints(image)
    if isinstance(image, RgbdImage):
        return image.image
    if image.ndim == 3:
        return image
    near = np.isfinite(image) & (image > 0)
    low, high = np.percentile(image[near], [1, 99]) if near.any() else (0.0, 1.0)
    grey = np.where(near, 255 * np.clip((high - np.where(near, image, 0)) / max(high - low, 1e-6), 0, 1), 0)
    return cv2.cvtColor(grey.astype(np.uint8), cv2.COLOR_GRAY2BGR)
