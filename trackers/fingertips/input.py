"""Where images of hands over a desk come from, and what is learnt of the user before they are followed."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np

from jaxfilters.models.fingertip.detection import detect_hands
from jaxfilters.models.fingertip.first_image import fit_hand_parameters, fit_hand_to_mask
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.models.fingertip.segmentation import bright_mask, depth_mask, fit_desk, otsu_threshold
from jaxfilters.models.fingertip.skin import fit_skin_model, skin_mask
from jaxfilters.models.synthetic.desk_hand import DeskFrame, desk_video
from jaxfilters.models.synthetic.desk_script import script
from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import LiveCamera, open_video

OPEN_HAND_IMAGES = 60
"""Images in which an open hand is looked for before a recording is followed."""
DEMO_FPS, DEMO_SHAPE = 30.0, (480, 640)
USUAL_TIP_RADIUS = 13.0
"""Pixels of an image with 480 rows, of somebody who showed no open hand."""
Segment = Callable[[np.ndarray], np.ndarray]
"""`image -> mask` (rows, cols) bool."""


class User(NamedTuple):
    """What is known of the user and the desk."""

    parameters: HandParameters
    segment: Segment
    has_open_hand: bool
    """Whether an open hand was seen; otherwise the parameters are the usual ones."""


class DemoHand:
    """A rendered hand as a source of images, with its truth."""

    def __init__(self, seed: int):
        self.name, self.fps, self.image_size = "synthetic hand", DEMO_FPS, (DEMO_SHAPE[1], DEMO_SHAPE[0])
        self._script = script(seed)
        self.frames = len(self._script.fingers)
        self.truth: list[DeskFrame] = []
        """Of the frames so far, without their images."""
        self._key = jax.random.key(seed)

    def sample(self, most: int) -> list[np.ndarray]:
        """The open hand that every user shows at the start."""
        return [frame.image for frame in desk_video(self._key, np.ones((1, 5), bool), shape=DEMO_SHAPE)][:most]

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        """An open hand, which then draws, and handles things."""
        fingers, poses, _ = self._script
        for i, frame in enumerate(desk_video(self._key, fingers, shape=DEMO_SHAPE, poses=poses)):
            self.truth.append(frame)
            yield i / self.fps, cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR)

    def trouble(self) -> str | None:
        """Nothing goes wrong."""
        return None


class DepthVideo:
    """A depth recording as a source of images, which are metres."""

    def __init__(self, path: str, fps: float | None):
        self._depth = open_depth(path, fps=fps or DEMO_FPS)
        steps = np.diff(self._depth.times_s)
        self.name, self.frames = self._depth.name, len(self._depth)
        self.fps = fps or (float(1 / np.median(steps)) if len(steps) else DEMO_FPS)
        rows, cols = self._depth[0].shape
        self.image_size = (cols, rows)

    def sample(self, most: int) -> list[np.ndarray]:
        """Every n-th image."""
        return [self._depth[i] for i in range(0, self.frames, max(1, self.frames // most))][:most]

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        """From the first to the last."""
        for time_s, image in zip(self._depth.times_s - self._depth.times_s[0], self._depth, strict=True):
            yield float(time_s), image

    def trouble(self) -> str | None:
        """What cannot be read is an error."""
        return None


class LiveHands:
    """A live camera, whose first images are for getting to know the user and do not come again."""

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


def open_hands(place: str | None, mask: str, *, fps: float | None, seed: int) -> Any:
    """The source of images that a command was given.

    Raises:
        InputError: nothing there, nothing that can be read, or a mask that does not go with it.
    """
    if place is None:
        if mask != "infrared":
            raise InputError(f"--mask {mask}: of no use without a video; the synthetic hand is seen in infrared.")
        return DemoHand(seed)
    if mask == "depth":
        if place.isdecimal():
            raise InputError("--mask depth: of a recording only; live cameras deliver colours.")
        return DepthVideo(place, fps)
    source = open_video(place, fps=fps)
    return LiveHands(source) if isinstance(source, LiveCamera) else source


def know_user(source: Any, mask: str) -> User:
    """What the images in which the user's hand is open say; of a live camera the first ones, which are then gone.

    Raises:
        InputError: images that show nothing in the colours of skin.
    """
    images = source.sample(OPEN_HAND_IMAGES)
    if not images:
        raise InputError(f"{source.name}: no image.")
    learn = {"infrared": _by_brightness, "depth": _by_height, "colour": _by_colour}[mask]
    usual, why = None, ""
    for image in images:
        try:
            user = learn(image)
        except ValueError as error:
            why = str(error)
            continue
        if user.has_open_hand:
            return user
        usual = usual or user
    if usual is None:
        raise InputError(f"{source.name}: no image in which a hand can be told from the desk; of the last one: {why}")
    return usual


def hands_in(image: np.ndarray, user: User, num_hands: int) -> HandObservation:
    """What an image shows of each hand, (1, hands, ...) as a session wants it."""
    found = detect_hands(user.segment(image), user.parameters, capacity=num_hands)
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves])[None], *found)


def shown(image: np.ndarray) -> np.ndarray:
    """A picture (rows, cols, 3) of an image that is one, or of depths."""
    if image.ndim == 3:
        return image
    near = np.isfinite(image) & (image > 0)
    low, high = np.percentile(image[near], [1, 99]) if near.any() else (0.0, 1.0)
    grey = np.where(near, 255 * np.clip((high - np.where(near, image, 0)) / max(high - low, 1e-6), 0, 1), 0)
    return cv2.cvtColor(grey.astype(np.uint8), cv2.COLOR_GRAY2BGR)


def _grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image


def _by_brightness(image: np.ndarray) -> User:
    grey = _grey(image)
    try:
        parameters, is_open = fit_hand_parameters(grey), True
    except ValueError:
        parameters, is_open = _usual(grey.shape[0], otsu_threshold(grey)), False
    return User(parameters, lambda image: bright_mask(_grey(image), parameters.threshold), is_open)


def _by_height(image: np.ndarray) -> User:
    desk = fit_desk(image)
    return _of_mask(lambda image: depth_mask(image, desk), image)


def _by_colour(image: np.ndarray) -> User:
    model = fit_skin_model(image)
    return _of_mask(lambda image: skin_mask(image, model), image)


def _of_mask(segment: Segment, image: np.ndarray) -> User:
    try:
        return User(fit_hand_to_mask(segment(image)), segment, True)
    except ValueError:
        return User(_usual(image.shape[0]), segment, False)


def _usual(rows: int, threshold: float = 128.0) -> HandParameters:
    radius = max(USUAL_TIP_RADIUS * rows / 480, 2.0)
    return HandParameters(threshold=threshold, tip_radius=radius, half_size=round(radius) + 3)
