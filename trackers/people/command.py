"""`jaxfilters track people`."""

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.trackers.app.options import config_from_args
from jaxfilters.trackers.app.results import versions
from jaxfilters.trackers.app.stream import RunResult, StreamRun, StreamSpec, check_unused
from jaxfilters.trackers.innovations import contradiction, innovation_share
from jaxfilters.trackers.io.cameras import open_camera
from jaxfilters.trackers.io.detections import read_detections
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.scenes import furniture_of, open_scene
from jaxfilters.trackers.io.undistortion import Undistortion, straightened
from jaxfilters.trackers.io.video_input import is_live, open_video, together
from jaxfilters.trackers.people.demo_room import DemoRoom, demo_room
from jaxfilters.trackers.people.detected import DetectedForeground
from jaxfilters.trackers.people.drawing import write_plan
from jaxfilters.trackers.people.files import by_frame, write_coco, write_mot
from jaxfilters.trackers.people.identity import identity_of
from jaxfilters.trackers.people.options import DEFAULT_BACKGROUND
from jaxfilters.trackers.people.recorded import Sighting, by_identity, smoothed
from jaxfilters.trackers.people.run import PeopleStream
from jaxfilters.trackers.people.session import PRIMING_IMAGES, PeopleSession
from jaxfilters.trackers.people.state import PeopleConfig, PeopleScene
from jaxfilters.trackers.people.table import STATUS, as_rows, from_rows, people_table
from jaxfilters.trackers.people.tracker import people_scene


class Setup(NamedTuple):
    """What is watched, and by what."""

    scene: PeopleScene
    undistortions: list[Undistortion]
    sources: list[Any]
    demo: DemoRoom | None
    """The synthetic room, with its truth; None for real cameras."""
    detected: list[DetectedForeground]
    """Foreground from the boxes of a detector, one a camera; empty without a detector."""
    contents: dict[str, Any]
    """Hashes of the files of cameras, scene and detections, by name; empty for the synthetic room."""


def track(options: argparse.Namespace) -> str:
    """Follow everybody, and leave the results in `options.out`.

    Raises:
        InputError: a source, a file or an option cannot be used. What was tracked before is written.
        OutputError: the results cannot be written.
        KeyboardInterrupt: with what is kept as its text; what was tracked before is written.
    """
    check_unused(options)
    setup = _setup(options)
    session = as_input_error(lambda: _session(setup, options))
    total = max((getattr(source, "frames", 0) for source in setup.sources), default=0) or None
    moments = straightened(together(setup.sources), setup.undistortions)
    spec = StreamSpec(
        *(setup.sources, moments, partial(_trouble, setup.sources), PeopleStream(session)),
        *(people_table(setup.scene), _identity(setup, options), total, partial(_prime, setup, session)),
    )
    with closing(StreamRun(options, spec)) as run:
        return _tracked(setup, options, session, run)


def _session(setup: Setup, options: argparse.Namespace) -> PeopleSession:
    if setup.detected and options.background is None:
        return PeopleSession(setup.scene, setup.detected, keep_tracks=False)
    return PeopleSession(setup.scene, options.background or DEFAULT_BACKGROUND, setup.detected, keep_tracks=False)


def _prime(setup: Setup, session: PeopleSession) -> None:
    """Estimate the empty rooms from images of the recordings."""
    session.prime(
        [
            [undistortion.apply(image) for image in source.sample(PRIMING_IMAGES)]
            for source, undistortion in zip(setup.sources, setup.undistortions, strict=True)
        ]
    )


def _tracked(setup: Setup, options: argparse.Namespace, session: PeopleSession, run: StreamRun) -> str:
    began = time.perf_counter()
    result = run.follow()
    is_smoothed = not any(map(is_live, setup.sources))
    # While it ran, rows were written and not kept: smoothing, and the formats of others, need all of them once.
    tracks = by_identity(from_rows(run.writer.results))
    tracks = smoothed(setup.scene.config, tracks) if is_smoothed else tracks
    if options.mot:
        write_mot(options.out / "tracks_mot.txt", setup.scene, setup.undistortions[0], tracks)
    if options.coco:
        write_coco(options.out / "tracks_coco.json", setup.scene, setup.undistortions[0], tracks)
    write_plan(options.out / "summary.png", setup.scene, tracks)
    report = _report(setup, options, result, tracks, time.perf_counter() - began) | {
        "frames": run.writer.frames,
        "smoothed": is_smoothed,
    }
    report["trouble"] += session.trouble()
    run.writer.finish(report, as_rows(by_frame(tracks)) if is_smoothed else None, status_names=np.asarray(STATUS))
    return run.conclude(result, _summary(report, options))


def _trouble(sources: Sequence[Any]) -> list[str]:
    return [trouble for source in sources if (trouble := source.trouble())]


def _identity(setup: Setup, options: argparse.Namespace) -> dict[str, Any]:
    """What two runs must share for one to continue the other."""
    return {
        "input": [source.name for source in setup.sources],
        "image_sizes": [list(source.image_size) for source in setup.sources],
        # With --fps, the time stamps of a video do not count, even where its rate is the same.
        "fps": options.fps,
        "rates": [None if is_live(source) else source.fps for source in setup.sources],
        "seed": options.seed,
        "background": _foreground_of(setup, options),
        **setup.contents,
        "version": version("jaxfilters"),
        **{f"config.{name}": value for name, value in json.loads(json.dumps(asdict(setup.scene.config))).items()},
    }


def _foreground_of(setup: Setup, options: argparse.Namespace) -> str:
    """What decides where foreground is, for the report."""
    if not setup.detected:
        return options.background or DEFAULT_BACKGROUND
    return "detections" if options.background is None else f"detections, {options.background}"


def _setup(options: argparse.Namespace) -> Setup:
    config = as_input_error(partial(config_from_args, PeopleConfig(), options))
    if not options.sources:
        if options.camera or options.scene or options.detections or options.fps is not None:
            raise InputError(
                "--camera, --scene, --detections, --fps: of no use without a video, as for the synthetic room."
            )
        room = demo_room(options.seed or 0)
        scene = people_scene(room.cameras, room.floor, furniture=room.furniture, config=config)
        return Setup(scene, [Undistortion(camera.shape) for camera in room.cameras], _demo_sources(room), room, [], {})
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
    boxes = [read_detections(path) for path in options.detections]
    detected = [
        DetectedForeground(one, undistortion, spread_px=config.spread_px)
        for one, undistortion in zip(boxes, undistortions, strict=False)
    ]
    return Setup(scene, undistortions, sources, None, detected, identity_of(files, described, boxes))


class _DemoSource:
    """One camera of the synthetic room as a source of images."""

    def __init__(self, room: DemoRoom, camera: int):
        self.name, self.fps = f"synthetic camera {camera}", room.fps
        rows, cols = room.cameras[camera].shape
        self.image_size = (cols, rows)
        self._room, self._camera = room, camera
        self._sampled: dict[int, np.ndarray] = {}
        """Images that the recording will show once more."""

    def sample(self, most: int) -> list[np.ndarray]:
        every = max(1, len(self._room) // most)
        self._sampled = {i: self._room.image(self._camera, i) for i in range(0, len(self._room), every)[:most]}
        return list(self._sampled.values())

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        for i in range(len(self._room)):
            sampled = self._sampled.pop(i, None)
            yield i / self.fps, self._room.image(self._camera, i) if sampled is None else sampled

    def trouble(self) -> str | None:
        return None


def _demo_sources(room: DemoRoom) -> list[Any]:
    return [_DemoSource(room, camera) for camera in range(len(room.cameras))]


def _report(
    setup: Setup,
    options: argparse.Namespace,
    result: RunResult,
    tracks: dict[int, list[Sighting]],
    seconds: float,
) -> dict[str, Any]:
    rate = result.frames_per_second
    rows = as_rows(by_frame(tracks))
    return {
        "input": [source.name for source in setup.sources],
        "frames_per_second": round(rate, 2) if rate == rate else None,
        "seconds": round(seconds, 2),
        "people": len(tracks),
        "interrupted": result.interrupt is not None,
        "trouble": result.trouble,
        "mean_error_m": None if setup.demo is None else _demo_error(setup.demo, tracks),
        "innovations": innovation_share(rows.innovations, rows.frame).report(),
        "background": _foreground_of(setup, options),
        "config": asdict(setup.scene.config),
        "versions": versions(),
    }


def _demo_error(room: DemoRoom, tracks: dict[int, list[Sighting]]) -> float | None:
    """Mean distance of every sighting from whoever really is nearest, metres."""
    errors = [
        np.linalg.norm(room.routes.xy[sighting.frame] - sighting.mean[:2], axis=1).min()
        for track in tracks.values()
        for sighting in track
    ]
    return round(float(np.mean(errors)), 4) if errors else None


def _summary(report: dict[str, Any], options: argparse.Namespace) -> str:
    speed = report["frames_per_second"]
    return (
        f"{report['frames']} frames in {report['seconds']:.1f} s"
        + (f" ({speed:.0f} frames/s once compiled)" if speed else "")
        + f", {report['people']} people"
        + (f", mean error {report['mean_error_m']:.2f} m" if report["mean_error_m"] is not None else "")
        + (", interrupted" if report["interrupted"] else "")
        + contradiction(report["innovations"])
        + f"\nresults in {options.out}: track.csv, track.npz, report.json, summary.png"
        + (", overlay.mp4" if options.video else "")
        + (", tracks_mot.txt" if options.mot else "")
        + (", tracks_coco.json" if options.coco else "")
    )
