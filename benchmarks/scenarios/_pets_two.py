"""Two real, synchronised cameras of one street, PETS 2009 S2.L1 views 1 and 6, beside each of them alone."""

import csv
import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.multi_object import FloorTracks, MultiObjectScores, evaluate, floor_tracks
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios._grey_levels import Disturbance, disturbances
from jaxfilters.benchmarks.scenarios._pets import merged, merged_metrics
from jaxfilters.benchmarks.scenarios._simplest import followed_blobs
from jaxfilters.benchmarks.scenarios.people_pets import positions
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.io.cameras import CameraFile, open_camera
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.scenes import furniture_of, open_scene
from jaxfilters.trackers.io.video_input import VideoFile
from jaxfilters.trackers.people.session import PRIMING_IMAGES, PeopleSession
from jaxfilters.trackers.people.state import PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene

FRAMES_PER_SECOND = 7.0
VIEWS = (1, 6)
CALIBRATIONS = {"": "organisers", "_refit": "refit"}
"""Which calibration is used, by the suffix of its metrics."""
CALIBRATION_ERROR = 0.005
"""Both are known to disagree by decimetres; chosen on frames 0 to 199."""
QUICK_FRAMES = 40
RUNS, QUICK_RUNS = 3, 1
LOW_VIEW = 6
"""Of a camera 2.2 m above the floor."""
MIDDLE_M = 0.9
"""Height of the middle of a body."""


def two_view_metrics(folder: Path, truth_folder: Path, *, quick: bool, seed: int) -> dict[str, Metric]:
    """Scores with both cameras, and of the better one alone (the one of larger MOTA), for each calibration.

    They are means over runs between which the grey levels of the images differ by one; `mota_least` and `mota_most` are
    the worst and the best of these runs. `_low_view` are scores of the view of a low camera alone, of places in its
    image, and `_low_view_simple` of blobs in that view, projected to the floor. `_merged` metrics count people who
    return under another identity as the same (`_pets.RETURNED_AS`).

    Args:
        folder: `pets09_s2l1_two_views`.
        truth_folder: `pets09_s2l1_view001`, whose annotations hold for all views.
        quick: Whether only the first frames of the first calibration are tracked, once.
        seed: Of the differences of grey levels.

    Raises:
        RecordingError: The recordings cannot be read.
    """
    area = _area(truth_folder)
    frames = (0, QUICK_FRAMES - 1) if quick else (0, 399)
    annotated = _annotated(truth_folder / "gt_0_399.csv", area, frames)
    metrics: dict[str, Metric] = {}
    for suffix, calibration in itertools.islice(CALIBRATIONS.items(), 1 if quick else None):
        tracks = {
            views: [
                follow(folder, views, calibration, area, frames, disturb)
                for disturb in disturbances(QUICK_RUNS if quick else RUNS, seed)
            ]
            for views in (VIEWS, *((view,) for view in VIEWS))
        }
        scores = {views: [evaluate(annotated, run) for run in runs] for views, runs in tracks.items()}
        for views, found in scores.items():
            sys.stderr.write("".join(f"  views {views}, {calibration}: {one}\n" for one in found))
        better = max(((view,) for view in VIEWS), key=lambda views: np.mean([one.mota for one in scores[views]]))
        for views, name in ((VIEWS, "_two"), (better, "_one")):
            metrics |= _means([_metrics(one, f"{name}{suffix}") for one in scores[views]])
            again = [evaluate(merged(annotated), run) for run in tracks[views]]
            metrics |= _means([merged_metrics(one, f"{name}{suffix}") for one in again])
            mota = [one.mota for one in scores[views]]
            metrics[f"mota_least{name}{suffix}"] = Metric(min(mota), "%", "higher")
            metrics[f"mota_most{name}{suffix}"] = Metric(max(mota), "%", "higher")
        metrics |= _low_view(folder, calibration, annotated, tracks[(LOW_VIEW,)], area, frames, suffix)
    return metrics


def _low_view(folder, calibration, annotated, tracks, area, frames, suffix) -> dict[str, Metric]:
    try:
        camera = _camera(folder, LOW_VIEW, calibration)
    except InputError as error:
        raise RecordingError(str(error)) from error
    true = in_image(annotated, camera.camera)
    simple = evaluate(true, in_image(blobs(folder, LOW_VIEW, camera, area, frames), camera.camera))
    sys.stderr.write(f"  blobs in view {LOW_VIEW}, {calibration}: {simple}\n")
    scores = [evaluate(true, in_image(run, camera.camera)) for run in tracks]
    metrics = _means([_metrics(one, f"_low_view{suffix}") for one in scores])
    return metrics | _metrics(simple, f"_low_view_simple{suffix}")


def in_image(tracks: FloorTracks, camera: FloorCamera) -> FloorTracks:
    """The rows whose middle of the body is in the image."""
    uv, depth = (np.asarray(leaf) for leaf in camera.project(jnp.asarray(np.insert(tracks.xy_m, 2, MIDDLE_M, axis=1))))
    is_inside = (depth > 0) & np.all((uv >= 0) & (uv <= np.array(camera.shape[::-1]) - 1), axis=1)
    return FloorTracks(*(column[is_inside] for column in tracks))


def _means(runs: list[dict[str, Metric]]) -> dict[str, Metric]:
    """Of the metrics of several runs."""
    return {
        name: replace(metric, value=float(np.mean([run[name].value for run in runs])))
        for name, metric in runs[0].items()
    }


def follow(
    folder: Path,
    views: tuple[int, ...],
    calibration: str,
    area: np.ndarray,
    frames: tuple[int, int],
    disturb: Disturbance,
) -> FloorTracks:
    """Smoothed tracks within the area (2, 2), metres, of a run from the first to the last of the disturbed frames.

    Raises:
        RecordingError: The recordings cannot be read.
    """
    try:
        files = [_camera(folder, view, calibration) for view in views]
        described = open_scene(folder / "scene.json")
        videos = [VideoFile(folder / f"View_{view:03d}.mp4", FRAMES_PER_SECOND) for view in views]
        # Outlines of furniture are drawn on view 1, camera 0 of the scene.
        kept = described._replace(outlines=[one for one in described.outlines if VIEWS[one["camera"]] in views])
        cameras = [file.camera for file in files]
        config = PeopleConfig(calibration_error=CALIBRATION_ERROR)
        scene = people_scene(cameras, kept.floor, furniture=furniture_of(kept, cameras), config=config)
    except InputError as error:
        raise RecordingError(str(error)) from error
    session = PeopleSession(scene)
    pairs = list(zip(videos, files, strict=True))
    session.prime(
        [[file.undistortion.apply(disturb(image)) for image in video.sample(PRIMING_IMAGES)] for video, file in pairs]
    )
    moments: Iterator = zip(*(video.images() for video in videos), strict=False)
    first, last = frames
    for i, moment in enumerate(itertools.islice(moments, first, last + 1)):
        images = [file.undistortion.apply(disturb(image)) for file, (_, image) in zip(files, moment, strict=True)]
        session.process(images, i / FRAMES_PER_SECOND)
    return _inside([(first + row[0], *row[1:]) for row in positions(session.tracks.smoothed())], area)


def blobs(folder: Path, view: int, file: CameraFile, area: np.ndarray, frames: tuple[int, int]) -> FloorTracks:
    """What the simplest method finds in one view: blobs, projected to the floor and linked.

    Raises:
        RecordingError: The recordings cannot be read.
    """
    try:
        video = VideoFile(folder / f"View_{view:03d}.mp4", FRAMES_PER_SECOND)
    except InputError as error:
        raise RecordingError(str(error)) from error
    straight = file.undistortion.apply
    empty = np.median(np.stack([straight(image) for image in video.sample(PRIMING_IMAGES)]), axis=0).astype(np.uint8)
    moments: Iterator = itertools.islice(video.images(), frames[0], frames[1] + 1)
    images = (straight(image) for _, image in moments)
    return _inside([(frames[0] + row[0], *row[1:]) for row in followed_blobs(images, empty, file.camera)], area)


def _camera(folder: Path, view: int, calibration: str) -> CameraFile:
    return open_camera(folder / f"cam{view}_{calibration}.json", image_size=(768, 576))  # of both videos


def _inside(rows: list[tuple], area: np.ndarray) -> FloorTracks:
    """Of frame, identity, X and Y in metres; places within the area."""
    table = np.array(rows, float).reshape(-1, 4)
    inside = np.all((table[:, 2:] >= area[0]) & (table[:, 2:] <= area[1]), axis=-1)
    return floor_tracks(table[:, 0], table[:, 1], table[:, 2:], in_area=inside)


def _area(folder: Path) -> np.ndarray:
    try:
        limits = json.loads((folder / "calibration.json").read_text())["evaluation_area"]
        return np.array([[limits[f"{axis}{end}"] for axis in "xy"] for end in ("min", "max")])
    except (OSError, ValueError, KeyError) as error:
        raise RecordingError(f"{folder / 'calibration.json'} cannot be read: {error!r}") from error


def _annotated(path: Path, area: np.ndarray, frames: tuple[int, int]) -> FloorTracks:
    try:
        with path.open(newline="") as file:
            rows = [(int(r["frame"]), int(r["id"]), float(r["x_m"]), float(r["y_m"])) for r in csv.DictReader(file)]
    except (OSError, KeyError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read: {error!r}") from error
    table = np.array(rows, float)
    counts = np.all((table[:, 2:] >= area[0]) & (table[:, 2:] <= area[1]), axis=-1)
    counts &= (table[:, 0] >= frames[0]) & (table[:, 0] <= frames[1])
    return floor_tracks(table[:, 0], table[:, 1], table[:, 2:], in_area=counts)


def _metrics(scores: MultiObjectScores, suffix: str) -> dict[str, Metric]:
    return {
        f"mota{suffix}": Metric(scores.mota, "%", "higher"),
        f"idf1{suffix}": Metric(scores.idf1, "%", "higher"),
        f"mean_error_m{suffix}": Metric(scores.mean_error_m, "m", "lower"),
        f"localisation_error_m{suffix}": Metric(scores.localisation_error_m, "m", "lower"),
        f"id_switches{suffix}": Metric(float(scores.id_switches), "", "lower"),
        f"transfers{suffix}": Metric(float(scores.transfers), "", "lower"),
    }
