"""From images of hands over a desk to what they show of each hand, and what is estimated of the user beforehand."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np

from jaxfilters.models.fingertip.detection import detect_hands
from jaxfilters.models.fingertip.first_image import fit_hand_parameters, fit_hand_to_mask, fit_partial_hand
from jaxfilters.models.fingertip.hand_parameters import HandParameters
from jaxfilters.models.fingertip.keypoints import KEYPOINT_POSTURE
from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.models.fingertip.segmentation import bright_mask, depth_mask, fit_desk, otsu_threshold, reading_mask
from jaxfilters.models.fingertip.side import thumb_side_log_odds
from jaxfilters.models.fingertip.skin import SkinModel, fit_skin_model, skin_mask, skin_models
from jaxfilters.models.fingertip.thumb import POSTURE, Posture, ThumbAngles, calibrated, usual
from jaxfilters.trackers.fingertips.events import Event, Recogniser
from jaxfilters.trackers.fingertips.keypoint_input import HandKeypoints, hands_of, parameters_of
from jaxfilters.trackers.fingertips.rgbd_input import RgbdImage
from jaxfilters.trackers.fingertips.session import USUAL, FingertipSession
from jaxfilters.trackers.fingertips.state import FingertipConfig, HandReport
from jaxfilters.trackers.tracker import checked_times

OPEN_HAND_IMAGES = 60
"""Images in which an open hand is looked for before a recording is followed."""
USUAL_TIP_RADIUS = 13.0
"""Pixels of an image with 480 rows, of a person who showed no open hand."""
FEWEST_FINGERS = 3
"""That a colour has to show at once, if not an open hand, to be that of skin, and for which thickness is measured."""
CLUSTER_IMAGES = 6
"""Images whose clusters of colour are tried, where no image shows an open hand in the colour of common skin."""
LEAST_SHOWN = 0.5
"""Fingertips an image, on average over these, that the colour of a hand shows."""
LEAST_DESK = 0.4
"""Of an image of depths, that has readings where it shows a desk; with fewer, what is behind the hand was removed."""
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
    num_fingers: int = 0
    """Fingers found without an open hand, by which images are compared."""


def track(
    images: Sequence[np.ndarray],
    times_s: np.ndarray,
    mask: str = "infrared",
    config: FingertipConfig | None = None,
    *,
    depths: Sequence[np.ndarray] | None = None,
    num_hands: int = 1,
    recogniser: Recogniser | None = None,
) -> tuple[HandReport, list[Event]]:
    """The fingertips in images in memory, and what the hands do.

    Args:
        images: (rows, cols) or (rows, cols, 3) uint8, or depths in metres; some of the first show an open hand.
        times_s: Seconds, strictly increasing, evenly.
        mask: How hands differ from the desk: they are brighter (`infrared`), above it (`depth`), or have the colour of
            skin (`colour`).
        config: Constants of the tracker.
        depths: (rows, cols) metres in the pixels of each image, not finite or not positive without a reading; their
            edges part fingers that touch or lie before each other. With the mask `depth` the images are these.
        num_hands: At most.
        recogniser: What names strokes; without one they have no label.

    Returns:
        The reports, (frames, hands, ...) on the host, and the events in their order.

    Raises:
        ValueError: There are fewer than two images, an unknown mask, or no image in which a hand differs from the desk;
            depths of another number, shape or unit, or beside the mask `depth`; or as for `checked_times`.
    """
    seconds = checked_times(times_s, len(images))
    if len(images) < 2:
        raise ValueError("images: expected two or more; got one.")
    if depths is not None and mask == "depth":
        raise ValueError("depths: of no use with the mask 'depth', whose images are depths.")
    if depths is not None and len(depths) != len(images):
        raise ValueError(f"depths: expected one for each of the {len(images)} images; got {len(depths)}.")
    user = estimate_user(images[:: max(1, len(images) // OPEN_HAND_IMAGES)], mask)
    session = FingertipSession(
        angles_of(user),
        handedness=user.parameters.handedness,
        num_hands=num_hands,
        height=float(images[0].shape[0]),
        fps=float(1 / np.median(np.diff(seconds))),
        config=config or USUAL,
        recogniser=recogniser,
    )
    seconds = seconds - seconds[0]
    frames: Sequence[np.ndarray | RgbdImage] = images
    if depths is not None:
        frames = [RgbdImage(*pair) for pair in zip(images, depths, strict=True)]
    reports = [session.process(hands_in(frame, user, num_hands), seconds[i : i + 1]) for i, frame in enumerate(frames)]
    session.finish()
    return jax.tree.map(lambda *rows: np.concatenate(rows), *reports), session.events


def estimate_user(images: Sequence[np.ndarray | HandKeypoints | RgbdImage], mask: str) -> User:
    """The user's hand and the desk from images in which the hand is open at some time; depths beside them do not count.

    Raises:
        ValueError: an unknown mask, no images, or none in which a hand differs from the desk.
    """
    kinds = {"infrared": _by_brightness, "depth": _by_height, "colour": _by_skin}
    if mask not in kinds:
        raise ValueError(f"mask: expected one of {', '.join(kinds)}; got {mask!r}.")
    if not len(images):
        raise ValueError("no image.")
    if isinstance(images[0], HandKeypoints):
        return User(*_of_keypoints(images), KEYPOINT_POSTURE)
    images = [image.image if isinstance(image, RgbdImage) else image for image in images]
    user, why = _best_user(kinds[mask], images)
    if user is not None and user.has_open_hand:
        return user
    if mask == "colour":
        user = _consistent(user, images[:: max(1, len(images) // CLUSTER_IMAGES)])
    if user is None:
        raise ValueError(f"no image in which a hand differs from the desk; {why}")
    return _with_side(user, images)


def _best_user(estimate: Callable[[Any], User], images: Sequence[Any]) -> tuple[User | None, str]:
    """The user of the first image with an open hand, else of that with most fingers, and what the last fault was."""
    best, why = None, "no colour shows a finger in most of them."
    for image in images:
        try:
            user = estimate(image)
        except ValueError as error:
            why = f"of the last one: {error}"
            continue
        if user.has_open_hand:
            return user, ""
        if best is None or user.num_fingers > best.num_fingers:
            best = user
    return best, why


def _consistent(by_skin: User | None, images: Sequence[Any]) -> User | None:
    """By the colour that shows most fingers over several images, a cluster's or that of common skin, if any does.

    A desk in the colour of skin may look like fingers between those of a hand, but not in every image.
    """
    users = [] if by_skin is None else [by_skin]
    for image in images:
        with suppress(ValueError):
            users.append(_by_clusters(image))
    shown = [np.mean([_num_tips(user, image) for image in images]) for user in users]
    best = int(np.argmax(shown)) if users else 0
    return users[best] if users and shown[best] >= LEAST_SHOWN else None


def _with_side(user: User, images: Sequence[Any]) -> User:
    """With the side of the thumb that the fingers of all images together make likelier."""
    hands = [detect_hands(user.segment(image), user.parameters, capacity=1)[0] for image in images]
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *hands)
    log_odds = np.asarray(jax.vmap(thumb_side_log_odds)(stacked))
    return user._replace(parameters=replace(user.parameters, handedness=1 if log_odds.sum() >= 0 else -1))


def _num_tips(user: User, image: np.ndarray) -> int:
    return int(detect_hands(user.segment(image), user.parameters, capacity=1)[0].is_tip.sum())


def angles_of(user: User) -> ThumbAngles:
    """The angles by which thumbs are known: the user's own, or the usual ones where no open hand was visible."""
    if not user.has_open_hand:
        return usual(user.posture)
    thumb, index = np.array([user.parameters.phi_thumb]), np.array([user.parameters.phi_index])
    return calibrated(thumb, index, user.posture)


def hands_in(image: np.ndarray | HandKeypoints | RgbdImage, user: User, num_hands: int) -> HandObservation:
    """What an image, or a frame of keypoints, shows of each hand, (1, hands, ...) as a session wants it.

    Raises:
        ValueError: depths beside the image that have another shape, or are not in metres.
    """
    if isinstance(image, HandKeypoints):
        return hands_of(image, num_hands)
    colours, depth = image if isinstance(image, RgbdImage) else (image, image if _is_depth(image) else None)
    found = detect_hands(user.segment(colours), user.parameters, depth, capacity=num_hands)
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves])[None], *found)


def _of_keypoints(frames: Sequence[Any]) -> tuple[HandParameters, Segment, bool]:
    parameters, is_open = parameters_of(list(frames))
    return parameters, lambda image: image, is_open


def _is_depth(image: np.ndarray) -> bool:
    return bool(np.issubdtype(image.dtype, np.floating))


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
    if reading_mask(image).mean() < LEAST_DESK:
        return _of_mask(reading_mask, image)
    desk = fit_desk(image)
    return _of_mask(lambda image: depth_mask(image, desk), image)


def _by_skin(image: np.ndarray) -> User:
    return _of_colour([fit_skin_model(image)], image)


def _by_clusters(image: np.ndarray) -> User:
    return _of_colour(skin_models(image), image)


def _of_colour(models: Iterable[SkinModel], image: np.ndarray) -> User:
    """By the model that finds an open hand, or most fingers."""
    best: User | None = None
    for model in models:
        user = _of_mask(partial(_skin_of, model), image)
        if user.has_open_hand:
            return user
        best = user if best is None or user.num_fingers > best.num_fingers else best
    if best is None:
        raise ValueError("no colour in it parts a hand from the desk.")
    return best


def _skin_of(model: SkinModel, image: np.ndarray) -> np.ndarray:
    return skin_mask(image, model)


def _of_mask(segment: Segment, image: np.ndarray) -> User:
    mask = segment(image)
    with suppress(ValueError):
        return User(fit_hand_to_mask(mask), segment, True)
    parameters, fingers = _usual(image.shape[0]), 0
    with suppress(ValueError):
        measured, fingers = fit_partial_hand(mask)
        # One finger may be thick for many reasons.
        parameters = measured if fingers >= FEWEST_FINGERS else parameters
    return User(parameters, segment, False, num_fingers=fingers)


def _usual(rows: int, threshold: float = 128.0) -> HandParameters:
    radius = max(USUAL_TIP_RADIUS * rows / 480, 2.0)
    return HandParameters(threshold=threshold, tip_radius=radius, half_size=round(radius) + 3)
