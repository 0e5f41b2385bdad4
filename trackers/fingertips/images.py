"""From images of hands over a desk to what they show of each hand, and what is estimated of the user beforehand."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np

from jaxfilters.models.fingertip.detection import detect_hands
from jaxfilters.models.fingertip.first_image import fit_hand_parameters, fit_hand_to_mask
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.keypoints import KEYPOINT_POSTURE
from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.models.fingertip.segmentation import bright_mask, depth_mask, fit_desk, otsu_threshold
from jaxfilters.models.fingertip.skin import fit_skin_model, skin_mask
from jaxfilters.models.fingertip.thumb import POSTURE, Posture, ThumbAngles, calibrated, usual
from jaxfilters.trackers.fingertips.events import Event, Recogniser
from jaxfilters.trackers.fingertips.keypoint_input import HandKeypoints, hands_of, parameters_of
from jaxfilters.trackers.fingertips.session import FingertipSession
from jaxfilters.trackers.fingertips.state import HandReport

OPEN_HAND_IMAGES = 60
"""Images in which an open hand is looked for before a recording is followed."""
USUAL_TIP_RADIUS = 13.0
"""Pixels of an image with 480 rows, of a person who showed no open hand."""
Segment = Callable[[np.ndarray], np.ndarray]
"""`image -> mask` (rows, cols) bool."""


class User(NamedTuple):
    """What is known of the user and the desk."""

    parameters: HandParameters
    segment: Segment
    has_open_hand: bool
    """Whether an open hand was observed; otherwise the parameters are the usual ones."""
    posture: Posture = POSTURE
    """Of people's thumbs and forefingers, as what the images are segmented by shows them."""


def track(
    images: Sequence[np.ndarray],
    times_s: np.ndarray,
    mask: str = "infrared",
    *,
    num_hands: int = 1,
    recogniser: Recogniser | None = None,
) -> tuple[HandReport, list[Event]]:
    """The fingertips in images in memory, and what the hands do.

    Args:
        images: (rows, cols) or (rows, cols, 3) uint8, or depths in metres; some of the first show an open hand.
        times_s: Seconds, growing evenly.
        mask: How hands differ from the desk: they are brighter (`infrared`), above it (`depth`), or have the colour of
            skin (`colour`).
        num_hands: At most.
        recogniser: What names strokes; without one they have no label.

    Returns:
        The reports, (frames, hands, ...) on the host, and the events in their order.

    Raises:
        ValueError: There are fewer than two images, more or fewer than times, an unknown mask, or no image in which a
            hand differs from the desk.
    """
    if len(images) < 2 or len(images) != len(times_s):
        raise ValueError(f"times_s: expected one for each of two or more images; got {len(times_s)} and {len(images)}.")
    user = estimate_user(images[:: max(1, len(images) // OPEN_HAND_IMAGES)], mask)
    session = FingertipSession(
        angles_of(user),
        handedness=user.parameters.handedness,
        num_hands=num_hands,
        height=float(images[0].shape[0]),
        fps=float(1 / np.median(np.diff(times_s))),
        recogniser=recogniser,
    )
    seconds = np.asarray(times_s, float) - float(times_s[0])
    reports = [session.process(hands_in(image, user, num_hands), seconds[i : i + 1]) for i, image in enumerate(images)]
    session.finish()
    return jax.tree.map(lambda *rows: np.concatenate(rows), *reports), session.events


def estimate_user(images: Sequence[np.ndarray | HandKeypoints], mask: str) -> User:
    """The user's hand and the desk from images in which the hand is open at some time.

    Raises:
        ValueError: an unknown mask, no images, or none in which a hand differs from the desk.
    """
    kinds = {"infrared": _by_brightness, "depth": _by_height, "colour": _by_colour}
    if mask not in kinds:
        raise ValueError(f"mask: expected one of {', '.join(kinds)}; got {mask!r}.")
    if not len(images):
        raise ValueError("no image.")
    if isinstance(images[0], HandKeypoints):
        return User(*_of_keypoints(images), KEYPOINT_POSTURE)
    usual_user, why = None, ""
    image: Any
    for image in images:
        try:
            user = kinds[mask](image)
        except ValueError as error:
            why = str(error)
            continue
        if user.has_open_hand:
            return user
        usual_user = usual_user or user
    if usual_user is None:
        raise ValueError(f"no image in which a hand differs from the desk; of the last one: {why}")
    return usual_user


def angles_of(user: User) -> ThumbAngles:
    """The angles by which thumbs are known: the user's own, or the usual ones where no open hand was visible."""
    if not user.has_open_hand:
        return usual(user.posture)
    thumb, index = np.array([user.parameters.phi_thumb]), np.array([user.parameters.phi_index])
    return calibrated(thumb, index, user.posture)


def hands_in(image: np.ndarray | HandKeypoints, user: User, num_hands: int) -> HandObservation:
    """What an image, or a frame of keypoints, shows of each hand, (1, hands, ...) as a session wants it."""
    if isinstance(image, HandKeypoints):
        return hands_of(image, num_hands)
    found = detect_hands(user.segment(image), user.parameters, capacity=num_hands)
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves])[None], *found)


def _of_keypoints(frames: Sequence[Any]) -> tuple[HandParameters, Segment, bool]:
    parameters, is_open = parameters_of(list(frames))
    return parameters, lambda image: image, is_open


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
