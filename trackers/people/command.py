"""`jaxfilters track people`."""

import argparse
import json
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.trackers.app.progress import ProgressLine, warn
from jaxfilters.trackers.app.results import versions
from jaxfilters.trackers.app.video import OverlayVideo, side_by_side
from jaxfilters.trackers.io.cameras import open_camera
from jaxfilters.trackers.io.detections import read_detections
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.scenes import furniture_of, open_scene
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.io.video_input import LiveCamera, continued, open_video, together
from jaxfilters.trackers.people.demo_room import DemoRoom, demo_room
from jaxfilters.trackers.people.detected import DetectedForeground
from jaxfilters.trackers.people.drawing import drawn, write_plan
from jaxfilters.trackers.people.files import TracksWriter, write_coco, write_mot, write_report
from jaxfilters.trackers.people.recorded import Sighting
from jaxfilters.trackers.people.session import PRIMING_IMAGES, PeopleEstimate, PeopleSession
from jaxfilters.trackers.people.state import TRACKED, PeopleConfig, PeopleScene
from jaxfilters.trackers.people.tracker import people_scene


class Setup(NamedTuple):
    """What is watched, and by what."""

    scene: PeopleScene
    undistortions: list[Undistortion]
    sources: list[Any]
    demo: DemoRoom | None
    """The synthetic room, with its truth; None for real cameras."""
    detected: list[DetectedForeground]
    """Foreground from the boxes of a detector, one a camera; empty for background subtraction."""


class RunResult(NamedTuple):
    """What came of a run beside its tracks."""

    frames: int
    frames_per_second: float
    """Without the first frame, which compiles; NaN until there are two."""
    interrupted: bool


def track(options: argparse.Namespace) -> str:
    """Follow everybody, and leave the results in `options.out`.

    Raises:
        InputError: a source, a file or an option cannot be used.
        OutputError: the results cannot be written.
    """
    setup = _setup(options)
    run = _identity(setup, options)
    with closing(TracksWriter(options.out, setup.scene, run, resume=options.resume)) as writer:
        return _tracked(setup, options, writer)


def _tracked(setup: Setup, options: argparse.Namespace, writer: TracksWriter) -> str:
    began = time.perf_counter()
    session = as_input_error(lambda: PeopleSession(setup.scene, setup.detected or options.background))
    session.prime(
        [
            [undistortion.apply(image) for image in source.sample(PRIMING_IMAGES)]
            for source, undistortion in zip(setup.sources, setup.undistortions, strict=True)
        ]
    )
    writer.restore(session)
    result = _run(setup, options, session, writer)
    is_live = any(isinstance(source, LiveCamera) for source in setup.sources)
    tracks = session.tracks.recorder.tracks if is_live else session.tracks.smoothed()
    if not is_live:
        writer.replace(tracks)
    if options.mot:
        write_mot(options.out / "tracks_mot.txt", setup.scene, setup.undistortions[0], tracks)
    if options.coco:
        write_coco(options.out / "tracks_coco.json", setup.scene, setup.undistortions[0], tracks)
    write_plan(options.out / "plan.png", setup.scene, tracks)
    report = _report(setup, options, result, tracks, not is_live, time.perf_counter() - began)
    report["trouble"] += session.trouble()
    write_report(options.out / "report.json", report)
    return _summary(report, options)


def _identity(setup: Setup, options: argparse.Namespace) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    return {
        "input": [source.name for source in setup.sources],
        "image_sizes": [list(source.image_size) for source in setup.sources],
        "seed": options.seed,
        "background": options.background,
        "detections": [str(path) for path in options.detections],
        "version": version("jaxfilters"),
        **{f"config.{name}": value for name, value in json.loads(json.dumps(asdict(setup.scene.config))).items()},
    }


def _setup(options: argparse.Namespace) -> Setup:
    config = as_input_error(lambda: PeopleConfig(**({"capacity": options.capacity} if options.capacity else {})))
    if not options.sources:
        if options.camera or options.scene or options.detections:
            raise InputError("--camera, --scene, --detections: of no use without a video, as for the synthetic room.")
        room = demo_room(options.seed or 0)
        scene = people_scene(room.cameras, room.floor, furniture=room.furniture, config=config)
        return Setup(scene, [Undistortion(camera.shape) for camera in room.cameras], _demo_sources(room), room, [])
    if not options.scene:
        raise InputError("--scene: missing; a scene.json with the floor on which people walk, in metres.")
    if len(options.camera) != len(options.sources):
        raise InputError(
            f"--camera: one camera.json for each source, in their order; got {len(options.camera)} for "
            f"{len(options.sources)} sources. `jaxfilters calibrate` makes them."
        )
    if options.detections and len(options.detections) != len(options.sources):
        raise InputError(
            f"--detections: one file for each source, in their order; got {len(options.detections)} for "
            f"{len(options.sources)} sources."
        )
    sources = [open_video(source, fps=options.fps) for source in options.sources]
    files = [
        open_camera(path, image_size=source.image_size) for path, source in zip(options.camera, sources, strict=True)
    ]
    described = open_scene(options.scene)
    cameras = [file.camera for file in files]
    furniture = furniture_of(described, cameras)
    scene = as_input_error(lambda: people_scene(cameras, described.floor, furniture=furniture, config=config))
    undistortions = [file.undistortion for file in files]
    detected = [
        DetectedForeground(read_detections(path), undistortion)
        for path, undistortion in zip(options.detections, undistortions, strict=False)
    ]
    return Setup(scene, undistortions, sources, None, detected)


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


def _run(setup: Setup, options: argparse.Namespace, session: PeopleSession, writer: TracksWriter) -> RunResult:
    total = max((getattr(source, "frames", 0) for source in setup.sources), default=0) or None
    first, ends = session.tracks.frames, list[float]()
    video, interrupted = None, False
    name = f"overlay_from_{first}.mp4" if first else "overlay.mp4"
    try:
        with ProgressLine("tracking", total, done=first) as line:
            for moment in continued(together(setup.sources), setup.sources, first, session.tracks.time_s):
                images = [
                    None if image is None else undistortion.apply(image)
                    for image, undistortion in zip(moment.images, setup.undistortions, strict=True)
                ]
                now = session.process(images, moment.time_s)
                writer.append(now.added)
                writer.checkpoint(session)
                if options.video:
                    video = _draw(video, options.out / name, setup, session, now)
                ends.append(time.perf_counter())
                inside = int(np.sum(now.people.mode == TRACKED))
                line.show(now.frame + 1, f"{inside} {'person' if inside == 1 else 'people'}")
                if options.seconds and now.time_s >= options.seconds:
                    break
    except KeyboardInterrupt:
        interrupted = True
    finally:
        if video is not None:
            video.close()
    rate = (len(ends) - 1) / (ends[-1] - ends[0]) if len(ends) > 1 else float("nan")
    return RunResult(session.tracks.frames, rate, interrupted)


def _draw(
    video: OverlayVideo | None, path: Path, setup: Setup, session: PeopleSession, now: PeopleEstimate
) -> OverlayVideo:
    views = zip(session.last_images, session.last_outlines, strict=True)
    picture = side_by_side([drawn(image, outline, now.people) for image, outline in views], now.time_s)
    if video is None:
        video = OverlayVideo(path, max(source.fps for source in setup.sources), picture.shape)
    video.write(picture)
    return video


def _report(
    setup: Setup,
    options: argparse.Namespace,
    result: RunResult,
    tracks: dict[int, list[Sighting]],
    is_smoothed: bool,
    seconds: float,
) -> dict[str, Any]:
    rate = result.frames_per_second
    return {
        "input": [source.name for source in setup.sources],
        "frames": result.frames,
        "frames_per_second": round(rate, 2) if rate == rate else None,
        "seconds": round(seconds, 2),
        "people": len(tracks),
        "smoothed": is_smoothed,
        "interrupted": result.interrupted,
        "trouble": [trouble for source in setup.sources if (trouble := source.trouble())],
        "mean_error_m": None if setup.demo is None else _demo_error(setup.demo, tracks),
        "background": "detections" if setup.detected else options.background,
        "config": {name: getattr(setup.scene.config, name) for name in setup.scene.config.__dataclass_fields__},
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


def _summary(report: dict[str, Any], options: argparse.Namespace) -> str:
    for trouble in report["trouble"]:
        warn(trouble)
    speed = report["frames_per_second"]
    return (
        f"{report['frames']} frames in {report['seconds']:.1f} s"
        + (f" ({speed:.0f} frames/s once compiled)" if speed else "")
        + f", {report['people']} people"
        + (f", mean error {report['mean_error_m']:.2f} m" if report["mean_error_m"] is not None else "")
        + (", interrupted" if report["interrupted"] else "")
        + f"\nresults in {options.out}: tracks.csv, plan.png, report.json"
        + (", overlay.mp4" if options.video else "")
        + (", tracks_mot.txt" if options.mot else "")
        + (", tracks_coco.json" if options.coco else "")
    )
