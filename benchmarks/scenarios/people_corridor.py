"""People in a corridor whose floor mirrors them, some of whom stand still: CAVIAR, OneLeaveShop1cor, end to end.

Needs the folder `caviar_corridor` of JAXFILTERS_DATA: the camera is calibrated from four points of the floor, the
background comes from the recording, and everybody is followed, as by `jaxfilters calibrate points` and
`jaxfilters track people`. Truth are the places on the floor below the annotated boxes, where these stand whole in the
image and on the part of the floor that is tracked. `walkers` are the two people who walk alone through the corridor.
`_simple` is without a tracker: blobs that differ from the background, projected back to the floor and linked to the
nearest.
"""

import csv
import itertools
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.multi_object import FloorTracks, evaluate, floor_tracks, match
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios._simplest import followed_blobs
from jaxfilters.models.calibration import calibrate_floor
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import VideoFile
from jaxfilters.trackers.io.xml_files import read_xml
from jaxfilters.trackers.people.session import PRIMING_IMAGES, PeopleSession
from jaxfilters.trackers.people.tracker import people_scene

FLOOR = np.array([[-1.0, -3.0], [4.5, -3.0], [4.5, 28.0], [-1.0, 28.0]])
WALKERS = (0, 5)
BORDER_PX, LEAST_HEIGHT_PX, LEAST_WIDTH_PX = 2, 20, 8
"""Boxes that touch the border of the image, or of someone of whom nearly nothing shows, have no feet."""
QUICK_FRAMES = 40


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow everybody, print the scores, return them; nothing is random."""
    del seed, out
    folder = recording_folder("caviar_corridor")
    try:
        video = VideoFile(folder / "OneLeaveShop1cor.mpg")
        camera = corridor_camera(folder / "floor_points.csv", (video.image_size[1], video.image_size[0]))
        true = annotated(folder / "cols1gt.xml", camera)
    except (InputError, OSError, KeyError, ValueError, AttributeError) as error:
        raise RecordingError(f"{folder} cannot be read: {error!r}") from error
    session = PeopleSession(people_scene([camera], FLOOR))
    samples = video.sample(PRIMING_IMAGES)
    session.prime([samples])
    last = QUICK_FRAMES if quick else None
    for time_s, image in itertools.islice(video.images(), last):
        session.process([image], time_s)
    rows = [
        (one.frame, identity, *one.mean[:2]) for identity, track in session.tracks.smoothed().items() for one in track
    ]
    empty = np.median(np.stack(samples), axis=0).astype(np.uint8)
    blobs = followed_blobs((image for _, image in itertools.islice(video.images(), last)), empty, camera)
    simple = [row for row in blobs if _is_on_floor(np.array(row[2:]))]
    true = FloorTracks(*(column[true.frame < session.tracks.frames] for column in true))
    camera_xy_m = np.asarray(camera.position())[:2]
    return _scores(true, _tracks(rows), camera_xy_m) | _scores(true, _tracks(simple), camera_xy_m, "_simple")


def corridor_camera(path: Path, shape: tuple[int, int]) -> FloorCamera:
    """The camera from its floor points (x_m, y_m, z_m, u, v)."""
    with path.open(newline="") as file:
        rows = np.array([[float(row[k]) for k in ("x_m", "y_m", "z_m", "u", "v")] for row in csv.DictReader(file)])
    return FloorCamera.from_matrix(calibrate_floor(rows[:, :3], rows[:, 3:], (shape[1], shape[0])).P, shape)


def annotated(path: Path, camera: FloorCamera) -> FloorTracks:
    """Places of the people whose feet show, metres, from CAVIAR's boxes (centre and size, pixels)."""
    boxes = [
        [int(frame.attrib["number"]), int(one.attrib["id"]), *(float(box.attrib[k]) for k in ("xc", "yc", "w", "h"))]
        for frame in read_xml(path, "expected CAVIAR's annotations").iter("frame")
        for one in frame.iter("object")
        for box in one.iter("box")
    ]
    frame, identity, u, v, width, height = np.array(boxes).T
    feet = np.stack([u, v + height / 2], axis=-1)
    xy, depth = (np.asarray(a) for a in camera.floor_points(jnp.asarray(feet)))
    shows = (feet[:, 1] < camera.shape[0] - BORDER_PX) & (height > LEAST_HEIGHT_PX) & (width > LEAST_WIDTH_PX)
    return floor_tracks(frame, identity, xy, in_area=shows & _is_on_floor(xy) & (depth > 0))


def _is_on_floor(xy: np.ndarray) -> np.ndarray:
    """(...) which places (..., 2) are on the part of the floor that is tracked."""
    return np.all((xy > FLOOR.min(axis=0)) & (xy < FLOOR.max(axis=0)), axis=-1)


def _tracks(rows: list) -> FloorTracks:
    """Of frame, identity, X and Y."""
    table = np.array(rows, float).reshape(-1, 4)
    return floor_tracks(table[:, 0], table[:, 1], table[:, 2:])


def _scores(true: FloorTracks, found: FloorTracks, camera_xy_m: np.ndarray, suffix: str = "") -> dict[str, Metric]:
    scores = evaluate(true, found, camera_xy_m=camera_xy_m)
    sys.stderr.write(f"  {scores}\n")
    pairs = match(true, found)
    walks = np.isin(true.identity[pairs.truth], WALKERS)
    errors = np.linalg.norm(found.xy_m[pairs.estimate] - true.xy_m[pairs.truth], axis=-1)
    found_share = walks.sum() / max(1, np.isin(true.identity, WALKERS).sum())
    return {
        f"mota{suffix}": Metric(scores.mota, "%", "higher"),
        f"idf1{suffix}": Metric(scores.idf1, "%", "higher"),
        f"mean_error_m{suffix}": Metric(scores.mean_error_m, "m", "lower"),
        f"radial_error_m{suffix}": Metric(scores.radial_error_m, "m", "lower"),
        f"lateral_error_m{suffix}": Metric(scores.lateral_error_m, "m", "lower"),
        f"walkers_error_m{suffix}": Metric(float(errors[walks].mean()) if walks.any() else float("nan"), "m", "lower"),
        f"walkers_found{suffix}": Metric(float(found_share), "", "higher"),
        f"id_switches{suffix}": Metric(float(scores.id_switches), "", "lower"),
        f"transfers{suffix}": Metric(float(scores.transfers), "", "lower"),
    }
