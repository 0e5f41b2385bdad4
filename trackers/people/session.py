"""Everybody on a floor from the images of fixed cameras: background subtraction, the tracker, and what is kept."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxfilters.models.person.ellipsoid import VISIBLE, Outline
from jaxfilters.trackers.background.choice import Background, background
from jaxfilters.trackers.background.median import MedianBackground, evenly
from jaxfilters.trackers.background.registration import Registration, intrinsics
from jaxfilters.trackers.people.config import PeopleConfig
from jaxfilters.trackers.people.detected import DetectedForeground, combined
from jaxfilters.trackers.people.recorded import NO_IMAGE, Recorder, Sighting, smoothed
from jaxfilters.trackers.people.standing import emptied
from jaxfilters.trackers.people.state import TENTATIVE, TRACKED, CameraFrame, People, PeopleScene, Report
from jaxfilters.trackers.people.tracker import outlines, people_scene, start, step
from jaxfilters.trackers.tracker import checked_times

PRIMING_IMAGES = 40
"""Images from which the empty room is estimated before a recording is tracked."""
REFERENCE_EVERY = 500
"""Images of a camera that is registered after which its corners are taken from its background again."""
REPORTED_PX = 2.0
"""Motion of a corner of the image from which on a camera is reported to have turned."""
KEPT_BEYOND = 1.4
"""The background does not follow the image within a person's outline of this size."""
STANDS_M_PER_S = 0.3
"""Only where people are slower than this: others have left a place before it could become background, and the
background around them stays true. On frames 0-199 of PETS it gives .204 m in place of .209, on 200-399 .216 in place of
.344, where two people who walk together stood .7 m beside their places."""


class PeopleEstimate(NamedTuple):
    """The estimate after one frame; NumPy leaves."""

    frame: int
    time_s: float
    people: People
    report: Report
    added: list[tuple[int, Sighting]]
    """By identity: of this frame and, for newly confirmed people, of the frames before."""
    seconds: float
    """From the foreground to the report."""


def track(
    images: Sequence[Sequence[np.ndarray | None]],
    times_s: ArrayLike,
    scene: PeopleScene,
    config: PeopleConfig | None = None,
    *,
    subtraction: str | Sequence[Background] = "median",
    detected: Sequence[DetectedForeground] = (),
) -> dict[int, list[Sighting]]:
    """Everybody's smoothed track in recorded images, by identity.

    Args:
        images: For each time, (rows, cols, 3) uint8 of every camera in the order of the scene, without lens distortion;
            `None` where a camera has nothing new.
        times_s: Seconds, strictly increasing.
        scene: Cameras, floor and furniture, as `people_scene` makes them.
        config: Constants in place of those of the scene.
        subtraction: As for `PeopleSession`.
        detected: As for `PeopleSession`.

    Returns:
        The tracks: positions and velocities in metres with their covariances, one `Sighting` a frame.

    Raises:
        ValueError: As for `checked_times` and `PeopleSession`.
    """
    seconds = checked_times(times_s, len(images))
    if config is not None:
        scene = people_scene(scene.cameras, scene.floor, furniture=scene.furniture, config=config)
    session = PeopleSession(scene, subtraction, detected)
    every = max(1, len(images) // PRIMING_IMAGES)
    session.prime([[one for one in views[::every] if one is not None] for views in zip(*images, strict=True)])
    for views, time_s in zip(images, seconds - seconds[0], strict=True):
        session.process(views, float(time_s))
    return session.tracks.smoothed()


class PeopleTracks:
    """The tracker over foreground that is given, frame by frame, with everybody's track so far."""

    def __init__(self, scene: PeopleScene, *, keep_tracks: bool = True):
        """Nobody yet.

        Args:
            scene: Cameras, floor and furniture.
            keep_tracks: As for `PeopleSession`.
        """
        self.scene, self.recorder = scene, Recorder(keep_tracks=keep_tracks)
        self.frames, self.people = 0, start(scene)
        self.time_s = 0.0
        self.images = np.zeros(len(scene.cameras), np.int64)
        """(cameras,) how many images each camera has delivered."""

    def step(self, observed: tuple[CameraFrame, ...], time_s: float) -> PeopleEstimate:
        """The estimate after the next frame.

        Args:
            observed: What every camera delivers, in the order of the scene.
            time_s: Seconds since the first frame, growing.
        """
        began = time.perf_counter()
        dt = np.float32(time_s - self.time_s)
        self.people, report = jax.block_until_ready(step(self.scene, self.people, observed, dt))
        seconds, self.time_s = time.perf_counter() - began, time_s
        people, reported = jax.device_get((self.people, report))
        present = np.array([bool(frame.present) for frame in observed])
        image = int(self.images[0]) if present[0] else NO_IMAGE
        added = self.recorder.add(self.frames, image, time_s, people, reported)
        self.images += present
        self.frames += 1
        return PeopleEstimate(self.frames - 1, time_s, people, reported, added, seconds)

    def smoothed(self) -> dict[int, list[Sighting]]:
        """All tracks that were kept, smoothed backwards in time: for a recording that has ended."""
        return smoothed(self.scene.config, self.recorder.tracks)

    def state(self) -> dict[str, Any]:
        """What the next frame needs, but for the tracks: arrays by name."""
        return {
            "people": self.people,
            "clock": np.array([self.frames, self.time_s]),
            "images": self.images.copy(),
            "recorder": self.recorder.state(),
        }

    def restore(self, state: dict[str, Any], tracks: Sequence[tuple[int, Sighting]] = ()) -> None:
        """Continue from what `state` gave; with the tracks up to then, where they are kept."""
        self.people, (frames, self.time_s) = state["people"], map(float, state["clock"])
        self.frames, self.images = int(frames), np.array(state["images"])
        self.recorder.restore(state["recorder"], tracks)


class PeopleSession:
    """The tracker over images."""

    def __init__(
        self,
        scene: PeopleScene,
        subtraction: str | Sequence[Background] = "median",
        detected: Sequence[DetectedForeground] = (),
        *,
        keep_tracks: bool = True,
    ):
        """Nobody yet, and backgrounds of which nothing is known: `prime` them with images of a recording.

        Args:
            scene: Cameras, floor and furniture.
            subtraction: Of the background: `median`, `mog2` or `knn`, or one object for each camera that gives the
                foreground of its images, such as `DetectedForeground`.
            detected: For each camera, boxes of a detector, which decide together with `subtraction` what is foreground.
            keep_tracks: Whether all rows stay in memory, about a kilobyte a person and frame, for `tracks.smoothed()`.
                Without them the memory depends on the capacity and not on the length of the run; what `process` returns
                is then the only place that has the rows.

        Raises:
            ValueError: if there is no such method, or not one object for each camera.
        """
        _check_count("subtraction", subtraction, len(scene.cameras))
        if detected:
            _check_count("detected", detected, len(scene.cameras))
        self.tracks, self._detected = PeopleTracks(scene, keep_tracks=keep_tracks), list(detected)
        self._backgrounds: list[Background] = (
            [background(subtraction) for _ in scene.cameras] if isinstance(subtraction, str) else list(subtraction)
        )
        # A detector sees the image as it is; only backgrounds need a camera that stands still.
        self._registrations = (
            [Registration(intrinsics(camera.P)) for camera in scene.cameras] if isinstance(subtraction, str) else []
        )
        self._images = [np.zeros((*camera.shape, 3), np.uint8) for camera in scene.cameras]
        self._outlines: list[Outline] | None = None
        self._estimate: PeopleEstimate | None = None

    def prime(self, samples: Sequence[Sequence[np.ndarray]]) -> None:
        """Estimate each camera's background from images spread over its recording; none where it has no samples."""
        for camera, (model, images) in enumerate(zip(self._backgrounds, samples, strict=True)):
            if images and self._registrations:
                straight, blank = self._registrations[camera].prime(evenly(images))
                scene = self.tracks.scene
                empty = emptied(scene.cameras[camera], np.asarray(scene.floor), straight, blank)
                model.prime(empty)
                if isinstance(model, MedianBackground):
                    parts = zip(empty, blank, straight, strict=True)
                    model.estimate_reflection([cv2.copyTo(room, unknown, one.copy()) for room, unknown, one in parts])
                self._renew_reference(camera)
            elif images:
                model.prime(images)

    def process(self, images: Sequence[np.ndarray | None], time_s: float) -> PeopleEstimate:
        """The estimate after the next images.

        Args:
            images: (rows, cols, 3) uint8 of every camera, without lens distortion; `None` where it has nothing new.
            time_s: Seconds since the first images, growing.

        Raises:
            ValueError: if there is not one entry for each camera, or an image has another shape.
        """
        _check_images(images, self.tracks.scene)
        observed = tuple(self._observed(i, image) for i, image in enumerate(images))
        self._estimate = self.tracks.step(observed, time_s)
        self._outlines = _on_host(outlines(self.tracks.scene, self._estimate.people))
        return self._estimate

    @property
    def last_images(self) -> list[np.ndarray]:
        """The newest image of every camera."""
        return self._images

    @property
    def last_outlines(self) -> list[Outline]:
        """Everybody's outline in every camera after the last images."""
        assert self._outlines is not None, "No images were processed yet."
        return self._outlines

    @property
    def camera_motion_px(self) -> list[float]:
        """By how much each camera has turned away from its reference at most, at a corner of its image; pixels."""
        return [one.most_px for one in self._registrations]

    def trouble(self) -> list[str]:
        """What happened to cameras and light, one line each, for a person; nothing of what needed no remedy."""
        moved = [
            f"camera {camera}: turned by up to {moved:.0f} pixels; its images were turned back to the first pose"
            for camera, moved in enumerate(self.camera_motion_px)
            if moved > REPORTED_PX
        ]
        lost = [
            f"camera {camera}: the background was estimated anew {model.restarts} times, because most of the image had "
            "changed; nobody is found there in the meantime"
            for camera, model in enumerate(self._backgrounds)
            if isinstance(model, MedianBackground) and model.restarts
        ]
        mirrored = [
            f"camera {camera}: the floor mirrors {model.reflection:.0%} of people; reflections count as background"
            for camera, model in enumerate(self._backgrounds)
            if isinstance(model, MedianBackground) and model.reflection
        ]
        return moved + lost + mirrored

    def state(self) -> dict[str, Any]:
        """What the next images need, but for the tracks: arrays by name."""
        return self.tracks.state() | {
            "backgrounds": [model.state() for model in self._backgrounds],
            "registrations": [one.state() for one in self._registrations],
            "detected": [one.state() for one in self._detected],
        }

    def restore(self, state: dict[str, Any], tracks: Sequence[tuple[int, Sighting]] = ()) -> None:
        """Continue from what `state` gave; with the tracks up to then, where they are kept."""
        self.tracks.restore(state, tracks)
        for model, saved in zip(self._backgrounds, state["backgrounds"], strict=True):
            model.restore(saved)
        for registration, saved in zip(self._registrations, state["registrations"], strict=True):
            registration.restore(saved)
        for one, saved in zip(self._detected, state["detected"], strict=True):
            one.restore(saved)
        people = jax.device_get(self.tracks.people)
        self._outlines = _on_host(outlines(self.tracks.scene, people))

    def _observed(self, camera: int, image: np.ndarray | None) -> CameraFrame:
        if image is None:
            last = self._images[camera]
            return CameraFrame(np.zeros(last.shape[:2], np.uint8), last, np.bool_(False))
        if self._registrations and self.tracks.images[camera] % REFERENCE_EVERY == REFERENCE_EVERY - 1:
            self._renew_reference(camera)
        boxes = self._detected[camera].apply(image) if self._detected else None
        image, blank = self._registrations[camera].straightened(image) if self._registrations else (image, None)
        self._images[camera], keep = image, self._occupied(camera)
        if blank is not None:
            keep = blank if keep is None else keep | blank
        probability = self._backgrounds[camera].apply(image, keep=keep)
        if boxes is not None:
            probability = combined(probability, boxes if blank is None else self._registrations[camera].as_last(boxes))
        if blank is not None:
            probability = np.where(blank > 0, np.float32(0.5), probability)
        return CameraFrame(cv2.convertScaleAbs(probability, alpha=255.0), image, np.bool_(True))

    def _renew_reference(self, camera: int) -> None:
        empty = self._backgrounds[camera].state().get("background")
        if empty is not None:
            self._registrations[camera].refer_to(empty)

    def _occupied(self, camera: int) -> np.ndarray | None:
        """Non-zero where people stand still after the last images, where the background must not follow."""
        if self._outlines is None:
            return None
        people, shape = jax.device_get(self.tracks.people), self._images[camera].shape[:2]
        outline, mask = self._outlines[camera], np.zeros(shape, np.uint8)
        is_there = (people.mode == TRACKED) | (people.mode == TENTATIVE)
        stands = np.linalg.norm(people.belief.mean[:, 2:4], axis=1) < STANDS_M_PER_S
        for slot in np.flatnonzero(is_there & stands & (outline.code == VISIBLE)):
            reach = KEPT_BEYOND * np.sqrt(np.diagonal(outline.shape[slot]))
            low, high = outline.center[slot] - reach, outline.center[slot] + reach
            u = np.clip(np.round([low[0], high[0]]), 0, shape[1]).astype(int)
            v = np.clip(np.round([low[1], high[1]]), 0, shape[0]).astype(int)
            mask[v[0] : v[1], u[0] : u[1]] = 255
        return mask


def _check_images(images: Sequence[np.ndarray | None], scene: PeopleScene) -> None:
    _check_count("images", images, len(scene.cameras))
    for number, (camera, image) in enumerate(zip(scene.cameras, images, strict=True)):
        if image is not None and image.shape != (expected := (*camera.shape, 3)):
            raise ValueError(f"images: camera {number} must deliver the shape {expected}; got {image.shape}.")


def _check_count(name: str, given: str | Sequence, cameras: int) -> None:
    if not isinstance(given, str) and len(given) != cameras:
        raise ValueError(f"{name}: expected one for each of {cameras} cameras; got {len(given)}.")


def _on_host(found: tuple[Outline, ...]) -> list[Outline]:
    return list(jax.device_get(found))
