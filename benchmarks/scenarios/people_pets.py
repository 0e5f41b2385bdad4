"""People on a real video, PETS 2009 S2.L1 View_001, followed automatically and compared with annotations.

Needs the folder `pets09_s2l1_view001` of JAXFILTERS_DATA. The whole video is decoded, straightened, given from its
background (median of every 20th frame) and tracked with the constants that everything else has; scores are on the
frames from the first to the last of the file of truth, `gt_0_399.csv` or what `--truth` names (columns `frame`, `id`,
`x_m`, `y_m` and, if there is one, `in_area`). Names without a suffix are of the tracks that remain of a recording,
smoothed and from before their confirmation; `_filtered` is what was known of the confirmed at every frame, `_simple` is
without a tracker: blobs that differ from the background, projected back to the floor and linked to the nearest.
`_merged` metrics count people who return under another identity of `gt_0_399.csv` as the same (`_pets.RETURNED_AS`);
there are none with `--truth`. A folder given with `--out` receives `tracks.csv` and `floor_plan.png`.
"""

import csv
import itertools
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.multi_object import FloorTracks, MultiObjectScores, evaluate, floor_tracks
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios._floor_plan import draw_floor_plan
from jaxfilters.benchmarks.scenarios._pets import SHAPE, Pets, images, load_pets, merged, merged_metrics
from jaxfilters.benchmarks.scenarios._simplest import followed_blobs
from jaxfilters.trackers.people.recorded import Sighting, smoothed
from jaxfilters.trackers.people.session import PeopleSession
from jaxfilters.trackers.people.state import CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import start, step

FRAMES_PER_SECOND = 7.0
"""Of the camera; the file says 10."""
PRIME_EVERY = 20
QUICK_FRAMES = 40
IN_METRES = (
    "mean_error_m",
    "localisation_error_m",
    "radial_error_m",
    "lateral_error_m",
    "radial_bias_m",
    "lateral_bias_m",
)
"""Biases are best at zero."""
COUNTED = ("id_switches", "transfers", "false_positives", "misses", "fragmentations")


class VideoRun(NamedTuple):
    """What the tracker made of the video."""

    confirmed: list[tuple[int, int, float, float]]
    """Frame, identity, X and Y in metres, as known at the time."""
    tracks: dict[int, list[Sighting]]
    """By identity, not yet smoothed."""
    tracking_s: np.ndarray
    """(frames,) seconds from the foreground to the report."""
    background_s: np.ndarray
    """(frames,) seconds from the straightened image to the foreground, and for outlines and records."""
    input_s: np.ndarray
    """(frames,) seconds for decoding and straightening."""


def run(*, quick: bool, seed: int, out: Path | None, truth: Path | None = None) -> dict[str, Metric]:
    """Follow everybody, print the scores, return them; nothing is random."""
    del seed
    pets = load_pets(recording_folder("pets09_s2l1_view001"), PeopleConfig())
    path = truth or pets.folder / "gt_0_399.csv"
    annotated = read_truth(path, pets)
    followed = follow_video(pets, QUICK_FRAMES if quick else None)
    last = min(int(annotated.frame[-1]), len(followed.tracking_s) - 1)
    if annotated.frame[0] > last:
        raise RecordingError(f"{path} begins with frame {annotated.frame[0]}, but only {last + 1} were tracked.")
    covered = (int(annotated.frame[0]), last)
    annotated = FloorTracks(*(rows[annotated.frame <= last] for rows in annotated))
    kept = smoothed(pets.scene.config, followed.tracks)
    metrics: dict[str, Metric] = {}
    simple = blobs(pets, last + 1)
    for suffix, rows in (("", positions(kept)), ("_filtered", followed.confirmed), ("_simple", simple)):
        estimate = within(rows, pets, covered)
        scores = evaluate(annotated, estimate, camera_xy_m=np.asarray(pets.camera.position())[:2])
        metrics |= score_metrics(scores, suffix)
        if truth is None:
            metrics |= merged_metrics(evaluate(merged(annotated), estimate), suffix)
    metrics |= _speed(followed)
    if out is not None:
        write_tracks(out / "tracks.csv", kept)
        draw_floor_plan(out / "floor_plan.png", annotated, within(positions(kept), pets, covered), pets.area)
    return metrics


def follow_video(pets: Pets, frames: int | None) -> VideoRun:
    """As `jaxfilters track people` follows the first frames of the video; all of them without a number."""
    session = PeopleSession(pets.scene)
    session.prime([[image for i, image in enumerate(images(pets)) if i % PRIME_EVERY == 0]])
    confirmed: list[tuple[int, int, float, float]] = []
    clocks = []
    blank = CameraFrame(np.zeros(SHAPE, np.uint8), np.zeros((*SHAPE, 3), np.uint8), np.bool_(False))
    jax.block_until_ready(step(pets.scene, start(pets.scene), (blank,), np.float32(0)))
    before = time.perf_counter()
    for i, image in enumerate(itertools.islice(images(pets), frames)):
        read = time.perf_counter()
        now = session.process([image], i / FRAMES_PER_SECOND)
        confirmed += [
            (now.frame, identity, float(sighting.mean[0]), float(sighting.mean[1]))
            for identity, sighting in now.added
            if sighting.frame == now.frame
        ]
        done = time.perf_counter()
        clocks.append((read - before, done - read - now.seconds, now.seconds))
        if i % 100 == 99:
            sys.stderr.write(f"  {i + 1} frames\n")
        before = time.perf_counter()
    inputs, subtracting, tracking = np.transpose(clocks)
    return VideoRun(confirmed, session.tracks.recorder.tracks, tracking, subtracting, inputs)


def blobs(pets: Pets, frames: int) -> list[tuple[int, int, float, float]]:
    """Frame, identity, X and Y in metres of what differs from the median of every 20th image of the video."""
    empty = np.median(np.stack(list(itertools.islice(images(pets), 0, None, PRIME_EVERY))), axis=0).astype(np.uint8)
    return followed_blobs(itertools.islice(images(pets), frames), empty, pets.camera)


def read_truth(path: Path, pets: Pets) -> FloorTracks:
    """Annotations within the evaluation area.

    Raises:
        RecordingError: if the file cannot be read as such, or has no row.
    """
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        frame, identity = ([int(row[name]) for row in rows] for name in ("frame", "id"))
        xy = np.array([[float(row[name]) for name in ("x_m", "y_m")] for row in rows]).reshape(-1, 2)
        counts = [bool(int(row["in_area"])) for row in rows] if rows and "in_area" in rows[0] else pets.is_inside(xy)
        found = floor_tracks(frame, identity, xy, in_area=counts)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{path} is no file of truth (frame, id, x_m, y_m): {error!r}") from error
    if not len(found.frame):
        raise RecordingError(f"{path} has no row within the evaluation area.")
    return found


def positions(tracks: dict[int, list[Sighting]]) -> list[tuple[int, int, float, float]]:
    """Frame, identity, X and Y of everybody."""
    return [
        (sighting.frame, identity, float(sighting.mean[0]), float(sighting.mean[1]))
        for identity, track in tracks.items()
        for sighting in track
    ]


def within(rows: list[tuple[int, int, float, float]], pets: Pets, frames: tuple[int, int]) -> FloorTracks:
    """The rows of these frames, first and last included, within the evaluation area."""
    table = np.array(rows, float).reshape(-1, 4)
    table = table[(table[:, 0] >= frames[0]) & (table[:, 0] <= frames[1])]
    return floor_tracks(table[:, 0], table[:, 1], table[:, 2:], in_area=pets.is_inside(table[:, 2:]))


def score_metrics(scores: MultiObjectScores, suffix: str) -> dict[str, Metric]:
    """By name."""
    values = {name: float(value) for name, value in scores._asdict().items()}
    metrics = {f"{name}{suffix}": Metric(values[name], "%", "higher") for name in ("mota", "idf1")}
    metrics |= {f"{name}{suffix}": Metric(values[name], "m", "lower") for name in IN_METRES}
    return metrics | {f"{name}{suffix}": Metric(values[name], "", "lower") for name in COUNTED}


def write_tracks(path: Path, tracks: dict[int, list[Sighting]]) -> None:
    """`frame,id,x_m,y_m,height_m,score,mode` of all sightings, by frame."""
    rows = sorted((sighting.frame, identity, sighting) for identity, track in tracks.items() for sighting in track)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("frame", "id", "x_m", "y_m", "height_m", "score", "mode"))
        for frame, identity, sighting in rows:
            x, y, *_, height, _ = sighting.mean
            writer.writerow(
                (frame, identity, f"{x:.3f}", f"{y:.3f}", f"{height:.3f}", f"{sighting.score:.3f}", sighting.mode)
            )


def _speed(followed: VideoRun) -> dict[str, Metric]:
    tracking = followed.tracking_s
    both = tracking + followed.background_s
    rates = {"tracking": tracking, "with_background": both, "with_video": both + followed.input_s}
    metrics = {f"frames_per_second_{name}": 1 / float(np.median(times)) for name, times in rates.items()}
    metrics["frames_per_second"] = metrics["frames_per_second_with_background"]
    return {name: Metric(value, "frames/s", "higher") for name, value in metrics.items()}
