"""Hands as a detector's keypoints instead of images: what `track fingertips --keypoints` reads."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Float, UInt8

from jaxfilters.models.fingertip.detection import no_hand
from jaxfilters.models.fingertip.first_image import LEAST_SPREAD, base_angles
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.keypoints import (
    FINGERS,
    LEAST_CONFIDENCE,
    WRIST,
    observe_keypoints,
    thumb_side,
)
from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.trackers.articulated.recording import looks_normalized
from jaxfilters.trackers.io.errors import InputError, shortened
from jaxfilters.trackers.io.input_files import exists
from jaxfilters.trackers.io.keypoints import read_hands
from jaxfilters.trackers.io.recording import check_times
from jaxfilters.trackers.io.video_input import DEFAULT_FPS, LiveCamera, VideoSource, open_video, spread

_THUMB, _INDEX = 0, 1
_BONE, _BACKGROUND = (150, 150, 150), 40
_LONGEST_NAME = 160
"""Characters of the name of a file that a message repeats."""


class HandKeypoints(NamedTuple):
    """One frame, in place of an image."""

    points: Float[np.ndarray, "hands 21 2"]
    """Pixels; NaN where nothing was found."""
    confidence: Float[np.ndarray, "hands 21"]
    picture: UInt8[np.ndarray, "rows cols 3"]
    """To draw on: the image of a video, or an even background."""


class KeypointSource:
    """A recording of keypoints as a source of frames, over a video's images where there is one.

    A frame lies over the image with its number, both counted from 0. Its time is that of the file, which need not begin
    at 0.
    """

    def __init__(self, path: Path, video: VideoSource | None, fps: float | None, image_size: tuple[int, int] | None):
        """Read the keypoints.

        Args:
            path: Of the file or folder.
            video: What the keypoints were detected in.
            fps: Frames per second, in place of the times that the file has; `None` is these, and for frames without
                times the rate of the video, or else 30.
            image_size: Columns and rows of the images, where there is no video.

        Raises:
            InputError: keypoints that cannot be used, a live camera, or an image of unknown size.
        """
        if not exists(path):
            raise InputError(f"--keypoints {shortened(str(path), _LONGEST_NAME)}: no such file or folder.")
        if isinstance(video, LiveCamera):
            raise InputError(f"--keypoints {path}: of a recording only, not of a live camera.")
        found = read_hands(path, fps or (video.fps if video else DEFAULT_FPS))
        size = video.image_size if video else image_size
        if size is None:
            raise InputError(f"--keypoints {path}: give the video, or the size of its images with --image-size.")
        self.name, self.image_size, self.frames, self._video = str(path), size, len(found.frames), video
        scale = np.asarray(size, float) if looks_normalized(found.points) else np.ones(2)
        self._points, self._confidence = found.points * scale, found.confidence
        self._numbers, self._times_s = found.frames, found.frames / fps if fps else found.times_s
        self.began_s = float(self._times_s[0])
        check_times(self._times_s, str(path))
        steps = np.diff(self._times_s)
        self.fps = float(1 / np.median(steps)) if len(steps) else fps or DEFAULT_FPS
        self._length: int | None = None

    def sample(self, most: int) -> list[HandKeypoints]:
        """At most so many frames, spread over the recording, without the video's images."""
        blank = self._blank()
        return [self._frame(i, blank) for i in spread(range(self.frames), most)]

    def images(self) -> Iterator[tuple[float, HandKeypoints]]:
        """From the first to the last."""
        blank, picture, done = self._blank(), None, 0
        pictures = self._video.images() if self._video else iter(())
        for i, (time_s, number) in enumerate(zip(self._times_s, self._numbers, strict=True)):
            while done <= number and (following := next(pictures, None)) is not None:
                done, picture = done + 1, following[1]
            yield float(time_s), self._frame(i, picture if picture is not None and done == number + 1 else blank)
        self._length = done + sum(1 for _ in pictures)

    def trouble(self) -> str | None:
        """What went wrong with the video, or that it was read to its end and is of another length."""
        if self._video is None:
            return None
        if (trouble := self._video.trouble()) or self._length is None:
            return trouble
        first, last = int(self._numbers[0]), int(self._numbers[-1])
        # Keypoints of every n-th image end up to n - 1 images before the video.
        step = int(np.diff(self._numbers).min(initial=last + 1))
        other = f"{self._video.name}: {self._length} images beside frames {first} to {last} of keypoints"
        return None if last < self._length <= last + step else other

    def _frame(self, i: int, picture: np.ndarray) -> HandKeypoints:
        return HandKeypoints(self._points[i], self._confidence[i], picture)

    def _blank(self) -> np.ndarray:
        return np.full((self.image_size[1], self.image_size[0], 3), _BACKGROUND, np.uint8)


def open_keypoints(
    path: Path, video: str | None, *, fps: float | None, image_size: tuple[int, int] | None
) -> KeypointSource:
    """The source of frames that a command was given.

    Raises:
        InputError: keypoints or a video that cannot be used.
    """
    if video is not None and image_size is not None:
        raise InputError("--image-size: the video says how large its images are.")
    return KeypointSource(path, None if video is None else open_video(video, fps=fps), fps, image_size)


def parameters_of(frames: list[HandKeypoints]) -> tuple[HandParameters, bool]:
    """The user's angles, and whether they come from an open hand, as medians over frames in which one is open.

    Raises:
        ValueError: no hand in any frame.
    """
    hands = [(points, observed) for frame in frames for points, observed in _hands(frame)[:1]]
    if not hands:
        raise ValueError("no frame with the wrist and a knuckle of a hand.")
    sides = [side for points, _ in hands if (side := thumb_side(points))]
    handedness = 1 if sum(sides) >= 0 else -1
    angles = np.array([handedness * base_angles(observed)[:2] for _, observed in hands if observed.is_tip.all()])
    if not len(angles):
        return HandParameters(handedness=handedness), False
    phi = np.median(angles, axis=0)
    if phi[_THUMB] - phi[_INDEX] < LEAST_SPREAD:
        return HandParameters(handedness=handedness), False
    return HandParameters(phi_thumb=float(phi[_THUMB]), phi_index=float(phi[_INDEX]), handedness=handedness), True


def hands_of(frame: HandKeypoints, num_hands: int) -> HandObservation:
    """What a frame shows of the largest hands, from left to right; (1, hands, ...)."""
    found = sorted((one for _, one in _hands(frame)[:num_hands]), key=lambda hand: float(hand.palm[0]))
    filled = [*found, *[no_hand()] * (num_hands - len(found))]
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves])[None], *filled)


def drawn_keypoints(frame: HandKeypoints) -> UInt8[np.ndarray, "rows cols 3"]:
    """The picture with the bones of every hand."""
    picture: Any = frame.picture.copy()
    for points, confidence in zip(frame.points, frame.confidence, strict=True):
        is_found = (confidence >= LEAST_CONFIDENCE) & np.isfinite(points).all(axis=1)
        for chain in FINGERS:
            for a, b in zip((WRIST, *chain), chain, strict=False):
                if is_found[a] and is_found[b]:
                    ends = np.clip(np.rint(points[[a, b]]), -10_000, 10_000).astype(int)
                    cv2.line(picture, tuple(ends[0]), tuple(ends[1]), _BONE, 1, cv2.LINE_AA)
    return picture


def _hands(frame: HandKeypoints) -> list[tuple[np.ndarray, HandObservation]]:
    """Keypoints and observation of every hand, the largest first."""
    pairs = zip(frame.points, frame.confidence, strict=True)
    hands = [(points, observe_keypoints(points, confidence)) for points, confidence in pairs]
    return sorted(((p, one) for p, one in hands if one.is_hand), key=lambda hand: -float(hand[1].palm_radius))
