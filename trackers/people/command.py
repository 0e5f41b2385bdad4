"""`jaxfilters track people`."""

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np

from jaxfilters.models.person.ellipsoid import VISIBLE
from jaxfilters.trackers.app.progress import ProgressLine
from jaxfilters.trackers.app.results import versions
from jaxfilters.trackers.app.track_command import refusing
from jaxfilters.trackers.app.video import OverlayVideo, side_by_side
from jaxfilters.trackers.background.choice import Background, background
from jaxfilters.trackers.io.cameras import open_camera
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.scenes import furniture_of, open_scene
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.io.video_input import PRIMING_IMAGES, LiveCamera, Moment, open_video, together
from jaxfilters.trackers.people.demo_room import DemoRoom, demo_room
from jaxfilters.trackers.people.drawing import drawn, write_plan
from jaxfilters.trackers.people.files import TrackTableWriter, replace_tracks, write_mot, write_report
from jaxfilters.trackers.people.following import follow
from jaxfilters.trackers.people.recorded import Recorder, Sighting, smoothed
from jaxfilters.trackers.people.state import TENTATIVE, TRACKED, CameraFrame, People, PeopleConfig, PeopleScene
from jaxfilters.trackers.people.tracker import outlines, people_scene

KEPT_BEYOND = 1.4
"""The background is not learnt within a person's outline of this size."""


class Place(NamedTuple):
    """What is watched, and by what."""

    scene: PeopleScene
    undistortions: list[Undistortion]
    sources: list[Any]
    demo: DemoRoom | None
    """The synthetic room, with its truth; None for real cameras."""


class Followed(NamedTuple):
    """What came of a run."""

    recorder: Recorder
    frames: int
    frames_per_second: float
    """Of everything but the first frame, which compiles; NaN until there are two."""
    interrupted: bool


def track_people(options: argparse.Namespace) -> None:
    """Follow everybody, and leave the results in `options.out`.

    Raises:
        InputError: a source, a file or an option cannot be used.
        OutputError: the results cannot be written.
    """
    place = _place(options)
    table = TrackTableWriter(options.out, place.scene, overwrite=False)
    began = time.perf_counter()
    try:
        followed = _follow(place, options, table)
    finally:
        table.close()
    tracks = followed.recorder.tracks
    live = any(isinstance(source, LiveCamera) for source in place.sources)
    if not live:
        tracks = smoothed(place.scene.config, tracks)
        replace_tracks(table.path, place.scene, tracks)
    if options.mot:
        write_mot(options.out / "tracks_mot.txt", place.scene, tracks)
    write_plan(options.out / "plan.png", place.scene, tracks)
    report = _report(place, options, followed, tracks, not live, time.perf_counter() - began)
    write_report(options.out / "report.json", report)
    _tell(report, options)


def _place(options: argparse.Namespace) -> Place:
    config = refusing(lambda: PeopleConfig(**({"capacity": options.capacity} if options.capacity else {})))
    if not options.sources:
        if options.camera or options.scene:
            raise InputError("--camera, --scene: of no use without a video; the synthetic room has its own.")
        room = demo_room(options.seed or 0)
        scene = people_scene(room.cameras, room.floor, furniture=room.furniture, config=config)
        return Place(scene, [Undistortion(camera.shape) for camera in room.cameras], _demo_sources(room), room)
    if not options.scene:
        raise InputError("--scene: missing; a scene.json with the floor on which people walk, in metres.")
    if len(options.camera) != len(options.sources):
        raise InputError(
            f"--camera: one camera.json for each source, in their order; got {len(options.camera)} for "
            f"{len(options.sources)} sources. `jaxfilters calibrate` makes them."
        )
    sources = [open_video(source, fps=options.fps) for source in options.sources]
    files = [
        open_camera(path, image_size=source.image_size) for path, source in zip(options.camera, sources, strict=True)
    ]
    described = open_scene(options.scene)
    cameras = [file.camera for file in files]
    furniture = furniture_of(described, cameras)
    scene = refusing(lambda: people_scene(cameras, described.floor, furniture=furniture, config=config))
    return Place(scene, [file.undistortion for file in files], sources, None)


class _DemoSource:
    """One camera of the synthetic room as a source of images."""

    def __init__(self, room: DemoRoom, camera: int):
        self.name, self.fps = f"synthetic camera {camera}", room.fps
        rows, cols = room.cameras[camera].shape
        self.image_size = (cols, rows)
        self._room, self._camera = room, camera

    def sample(self, most: int) -> list[np.ndarray]:
        every = max(1, len(self._room) // most)
        return [self._room.image(self._camera, i) for i in range(0, len(self._room), every)][:most]

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        for i in range(len(self._room)):
            yield i / self.fps, self._room.image(self._camera, i)

    def trouble(self) -> str | None:
        return None


def _demo_sources(room: DemoRoom) -> list[Any]:
    return [_DemoSource(room, camera) for camera in range(len(room.cameras))]


def _follow(place: Place, options: argparse.Namespace, table: TrackTableWriter) -> Followed:
    backgrounds = _backgrounds(place, options.background)
    recorder = Recorder()
    images = [np.zeros((*camera.shape, 3), np.uint8) for camera in place.scene.cameras]
    keep: list[np.ndarray | None] = [None] * len(images)
    total = max((getattr(source, "frames", 0) for source in place.sources), default=0)
    video, ends = None, []
    interrupted, index = False, -1

    def moments() -> Iterator[tuple[float, tuple[CameraFrame, ...]]]:
        for moment in together(place.sources):
            _straighten(place, moment, images)
            yield moment.time_s, _frames(moment, images, backgrounds, keep)

    try:
        with ProgressLine("tracking", total or 1_000_000) as line:
            for now in follow(place.scene, moments(), recorder):
                index = now.frame
                shown = jax.tree.map(np.asarray, outlines(place.scene, now.people))
                keep[:] = [
                    _occupied(outline, now.people, image.shape[:2])
                    for outline, image in zip(shown, images, strict=True)
                ]
                table.append(now.added)
                if options.video:
                    video = _draw(video, options.out, place, images, shown, now.people, now.time_s)
                ends.append(time.perf_counter())
                inside = int(np.sum(now.people.mode == TRACKED))
                line.show(min(index + 1, total or index + 1), f"{inside} {'person' if inside == 1 else 'people'}")
                if options.seconds and now.time_s >= options.seconds:
                    break
    except KeyboardInterrupt:
        interrupted = True
    finally:
        if video is not None:
            video.close()
    rate = (len(ends) - 1) / (ends[-1] - ends[0]) if len(ends) > 1 else float("nan")
    return Followed(recorder, index + 1, rate, interrupted)


def _backgrounds(place: Place, name: str) -> list[Background]:
    made = []
    for source, undistortion in zip(place.sources, place.undistortions, strict=True):
        one = refusing(lambda: background(name))
        if samples := source.sample(PRIMING_IMAGES):
            one.prime([undistortion.apply(image) for image in samples])
        made.append(one)
    return made


def _straighten(place: Place, moment: Moment, images: list[np.ndarray]) -> None:
    """Put in the new images without lens distortion; the last ones stay where a camera has nothing new."""
    for i, (image, undistortion) in enumerate(zip(moment.images, place.undistortions, strict=True)):
        if image is not None:
            images[i] = undistortion.apply(image)


def _frames(moment, images, backgrounds, keep) -> tuple[CameraFrame, ...]:
    frames = []
    for i, (new, image, model) in enumerate(zip(moment.images, images, backgrounds, strict=True)):
        if new is None:
            frames.append(CameraFrame(np.zeros(image.shape[:2], np.uint8), image, np.bool_(False)))
            continue
        probability = model.apply(image, keep=keep[i])
        frames.append(CameraFrame(cv2.convertScaleAbs(probability, alpha=255.0), image, np.bool_(True)))
    return tuple(frames)


def _occupied(seen: Any, people: People, shape: tuple[int, int]) -> np.ndarray:
    """Non-zero where people stand."""
    mask = np.zeros(shape, np.uint8)
    for slot in np.flatnonzero(((people.mode == TRACKED) | (people.mode == TENTATIVE)) & (seen.code == VISIBLE)):
        reach = KEPT_BEYOND * np.sqrt(np.diagonal(seen.shape[slot]))
        low, high = seen.center[slot] - reach, seen.center[slot] + reach
        u, v = np.clip(np.round([low[0], high[0]]), 0, shape[1]), np.clip(np.round([low[1], high[1]]), 0, shape[0])
        mask[int(v[0]) : int(v[1]), int(u[0]) : int(u[1])] = 255
    return mask


def _draw(video, out: Path, place: Place, images, shown, people: People, time_s: float) -> OverlayVideo:
    picture = side_by_side([drawn(image, seen, people) for image, seen in zip(images, shown, strict=True)], time_s)
    if video is None:
        video = OverlayVideo(out / "overlay.mp4", max(source.fps for source in place.sources), picture.shape)
    video.write(picture)
    return video


def _report(
    place: Place,
    options: argparse.Namespace,
    followed: Followed,
    tracks: dict[int, list[Sighting]],
    is_smoothed: bool,
    seconds: float,
) -> dict[str, Any]:
    rate = followed.frames_per_second
    return {
        "input": [source.name for source in place.sources],
        "frames": followed.frames,
        "frames_per_second": round(rate, 2) if rate == rate else None,
        "seconds": round(seconds, 2),
        "people": len(tracks),
        "smoothed": is_smoothed,
        "interrupted": followed.interrupted,
        "trouble": [trouble for source in place.sources if (trouble := source.trouble())],
        "mean_error_m": None if place.demo is None else _demo_error(place.demo, tracks),
        "background": options.background,
        "config": {name: getattr(place.scene.config, name) for name in place.scene.config.__dataclass_fields__},
        "versions": versions(),
    }


def _demo_error(room: DemoRoom, tracks: dict[int, list[Sighting]]) -> float | None:
    """Mean distance of every sighting from whoever really is nearest, metres."""
    errors = [
        np.linalg.norm(room.routes.xy[seen.frame] - seen.mean[:2], axis=1).min()
        for track in tracks.values()
        for seen in track
    ]
    return round(float(np.mean(errors)), 4) if errors else None


def _tell(report: dict[str, Any], options: argparse.Namespace) -> None:
    for trouble in report["trouble"]:
        print(f"jaxfilters: warning: {trouble}", file=sys.stderr)
    speed = report["frames_per_second"]
    print(
        f"{report['frames']} frames in {report['seconds']:.1f} s"
        + (f" ({speed:.0f} frames/s once compiled)" if speed else "")
        + f", {report['people']} people"
        + (f", mean error {report['mean_error_m']:.2f} m" if report["mean_error_m"] is not None else "")
        + (", interrupted" if report["interrupted"] else "")
        + f"\nresults in {options.out}: tracks.csv, plan.png, report.json"
        + (", overlay.mp4" if options.video else "")
        + (", tracks_mot.txt" if options.mot else "")
    )
