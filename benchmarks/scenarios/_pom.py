"""Two real cameras of one room, by their silhouettes, beside what a published method found in them."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.people.state import TRACKED, CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene, start, step

SHAPE = (120, 160)
FRAMES = range(160, 190)
FRAMES_PER_SECOND = 10.0
"""Not on record: at this rate people there walk 1 m/s."""
START_UP_FRAMES = 5
NEAR_M = 0.5
CAPACITY = 8


def pom_metrics(folder: Path) -> dict[str, Metric]:
    """Agreement of the tracker with the reference, after the start."""
    tracks = follow(folder)
    peaks = reference(folder)
    distances = np.array(
        [
            np.min(np.linalg.norm(tracks[frame] - peak, axis=-1), initial=np.inf)
            for frame in FRAMES[START_UP_FRAMES:]
            for peak in peaks.get(frame, [])
        ]
    )
    near = distances <= NEAR_M
    counts = [len(tracks[frame]) for frame in FRAMES[START_UP_FRAMES:]]
    return {
        "pom_agreement": Metric(float(near.mean()), "", "higher"),
        "pom_distance_m": Metric(float(distances[near].mean()) if near.any() else float("nan"), "m", "lower"),
        "pom_tracks_per_frame": Metric(float(np.mean(counts)), "", "lower"),
        "pom_peaks_per_frame": Metric(len(distances) / len(counts), "", "lower"),
    }


def follow(folder: Path) -> dict[int, np.ndarray]:
    """Places (people, 2) in metres of everybody who is tracked, by frame.

    Raises:
        RecordingError: if the recording cannot be read.
    """
    try:
        calibration = json.loads((folder / "calibration.json").read_text())
    except (OSError, ValueError) as error:
        raise RecordingError(f"{folder / 'calibration.json'} cannot be read: {error}") from error
    cameras = [FloorCamera.from_matrix(calibration[f"P_c{c}"], SHAPE) for c in (0, 1)]
    grid = calibration["grid"]
    width, depth = grid["nx"] * grid["cell_m"], grid["ny"] * grid["cell_m"] * grid["flip_y"]
    floor = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    scene = people_scene(cameras, floor, config=PeopleConfig(capacity=CAPACITY))
    people, found = start(scene), {}
    for frame in FRAMES:
        shown = tuple(_silhouette(folder, frame, c) for c in (0, 1))
        people, _ = step(scene, people, shown, np.float32(1 / FRAMES_PER_SECOND))
        found[frame] = np.asarray(people.belief.mean)[np.asarray(people.mode) == TRACKED, :2]
    return found


def reference(folder: Path) -> dict[int, list[np.ndarray]]:
    """Peaks of the published method by frame: places in metres."""
    peaks: dict[int, list[np.ndarray]] = {}
    with (folder / "pom_reference.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            peaks.setdefault(int(row["frame"]), []).append(np.array([float(row["x_m"]), float(row["y_m"])]))
    return peaks


def _silhouette(folder: Path, frame: int, camera: int) -> CameraFrame:
    path = folder / "silhouettes" / f"f{frame}-c{camera}.png"
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if mask is None or mask.shape != SHAPE:
        raise RecordingError(f"{path} is no image of {SHAPE[1]} x {SHAPE[0]} pixels.")
    # There are no colours: everybody wears the same.
    return CameraFrame(mask, np.zeros((*SHAPE, 3), np.uint8), np.bool_(True))
