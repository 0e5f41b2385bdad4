"""People in a corridor whose floor mirrors them, some of whom stand still: CAVIAR, OneLeaveShop1cor, end to end.

Needs the folder `caviar_corridor` of JAXFILTERS_DATA: the camera is calibrated from four points of the floor, the
background comes from the recording, and everybody is followed, as by `jaxfilters calibrate points` and
`jaxfilters track people`. Truth are the places on the floor below the annotated boxes, where these stand whole in the
image and on the part of the floor that is tracked. Where a nearer person hides the feet, the annotated box ends above
them; such places are on the line from the last one before to the next one after. `walker` is the one who walks alone
through the corridor with feet in the image. Scores change by 10 to 40 with rounding at this distance: they are means
over three runs, in two of which the grey levels of all images are changed by one at random; `mota_least` and
`mota_most` are those of single runs. `_mirrored`, `_backwards` and `_mirrored_backwards` are the same recording with
left and right exchanged, with its images in the opposite order, and both, two runs each; `mota_four_ways` is the mean
of the four. `_simple` is without a tracker: blobs that differ from the background, projected back to the floor and
linked to the nearest.
"""

import csv
import itertools
import sys
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Direction, Metric
from jaxfilters.benchmarks.multi_object import FloorTracks, evaluate, floor_tracks, match
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios._grey_levels import Disturbance, disturbances
from jaxfilters.benchmarks.scenarios._simplest import followed_blobs
from jaxfilters.benchmarks.scenarios.people_pets import positions
from jaxfilters.models.calibration import calibrate_floor
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import VideoFile
from jaxfilters.trackers.io.xml_files import read_xml
from jaxfilters.trackers.people.session import PRIMING_IMAGES, PeopleSession
from jaxfilters.trackers.people.state import PeopleScene
from jaxfilters.trackers.people.tracker import people_scene

FLOOR = np.array([[-1.0, -3.0], [4.5, -3.0], [4.5, 28.0], [-1.0, 28.0]])
WALKER = 5
BLANK_ROWS = 4
"""Lowest rows of the video, which are grey."""
BORDER_PX, LEAST_HEIGHT_PX, LEAST_WIDTH_PX = 2, 20, 8
"""Boxes that touch the border of the image, or of someone of whom nearly nothing shows, have no feet."""
QUICK_FRAMES = 40
RUNS, QUICK_RUNS = 3, 1
WAY_RUNS = 2
"""Of the recording mirrored and backwards."""
UNITS: dict[str, tuple[str, Direction]] = {
    "mota": ("%", "higher"),
    "idf1": ("%", "higher"),
    "mean_error_m": ("m", "lower"),
    "radial_error_m": ("m", "lower"),
    "lateral_error_m": ("m", "lower"),
    "walker_error_m": ("m", "lower"),
    "walker_found": ("", "higher"),
    "id_switches": ("", "lower"),
    "transfers": ("", "lower"),
}
"""Of the metrics, and which way is better."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow everybody, print the scores, return them."""
    del out
    folder = recording_folder("caviar_corridor")
    try:
        video = VideoFile(folder / "OneLeaveShop1cor.mpg")
        camera = corridor_camera(folder / "floor_points.csv", (video.image_size[1], video.image_size[0]))
        true = annotated(folder / "cols1gt.xml", camera)
    except (InputError, OSError, KeyError, ValueError, AttributeError) as error:
        raise RecordingError(f"{folder} cannot be read: {error!r}") from error
    taken = itertools.islice(video.images(), QUICK_FRAMES if quick else None)
    moments = [(time_s, image) for time_s, image in taken if image is not None]
    true = FloorTracks(*(column[true.frame < len(moments)] for column in true))
    corridor = Corridor(camera, FLOOR, true, moments, video.sample(PRIMING_IMAGES))
    ways = {"": corridor}
    if not quick:
        ways |= {"_mirrored": mirrored(corridor), "_backwards": backwards(corridor)}
        ways["_mirrored_backwards"] = mirrored(ways["_backwards"])
    metrics: dict[str, Metric] = {}
    for suffix, one in ways.items():
        runs = (QUICK_RUNS if quick else RUNS) if one is corridor else WAY_RUNS
        metrics |= _metrics(_runs(one, runs, seed), suffix)
    if not quick:
        metrics["mota_four_ways"] = Metric(float(np.mean([metrics[f"mota{s}"].value for s in ways])), "%", "higher")
    empty = np.median(np.stack(corridor.samples), axis=0).astype(np.uint8)
    blobs = followed_blobs((image for _, image in moments), empty, camera)
    simple = _scores(corridor, [row for row in blobs if _is_on_floor(np.array(row[2:]))])
    return metrics | _metrics([simple], "_simple")


class Corridor(NamedTuple):
    """A recording of the place."""

    camera: FloorCamera
    floor: np.ndarray
    """(corners, 2) metres."""
    true: FloorTracks
    moments: list[tuple[float, np.ndarray]]
    """Seconds, and (rows, cols, 3) images."""
    samples: list[np.ndarray]
    """Images from which the background is estimated."""


def mirrored(corridor: Corridor) -> Corridor:
    """The place with left and right exchanged, in the images as on the floor: X is the opposite."""
    across, exchange = np.array([-1.0, 1.0]), np.eye(3)
    exchange[0] = [-1.0, 0.0, corridor.camera.shape[1] - 1]
    P = exchange @ np.asarray(corridor.camera.P) @ np.diag([-1.0, 1.0, 1.0, 1.0])
    return Corridor(
        FloorCamera.from_matrix(P, corridor.camera.shape),
        corridor.floor[::-1] * across,
        corridor.true._replace(xy_m=corridor.true.xy_m * across),
        [(time_s, np.ascontiguousarray(image[:, ::-1])) for time_s, image in corridor.moments],
        [np.ascontiguousarray(image[:, ::-1]) for image in corridor.samples],
    )


def backwards(corridor: Corridor) -> Corridor:
    """The same recording with its images in the opposite order."""
    true, times = corridor.true, [time_s for time_s, _ in corridor.moments]
    images = [image for _, image in reversed(corridor.moments)]
    reverse = floor_tracks(len(times) - 1 - true.frame, true.identity, true.xy_m)
    return corridor._replace(true=reverse, moments=list(zip(times, images, strict=True)))


def _runs(corridor: Corridor, number: int, seed: int) -> list[dict[str, float]]:
    """Scores of several runs, all but the first with disturbed images."""
    scene = people_scene([corridor.camera], corridor.floor)
    return [
        _scores(corridor, _followed(scene, corridor.samples, corridor.moments, disturb))
        for disturb in disturbances(number, seed)
    ]


def _followed(
    scene: PeopleScene,
    samples: list[np.ndarray],
    moments: list[tuple[float, np.ndarray]],
    disturb: Disturbance,
) -> list[tuple[int, int, float, float]]:
    """Frame, identity, X and Y of smoothed tracks of disturbed images."""
    session = PeopleSession(scene)
    session.prime([[disturb(image) for image in samples]])
    for time_s, image in moments:
        session.process([disturb(image)], time_s)
    return positions(session.tracks.smoothed())


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
    floor, depth = (np.asarray(a) for a in camera.floor_points(jnp.asarray(feet)))
    shows = (
        (feet[:, 1] < camera.shape[0] - BLANK_ROWS - BORDER_PX) & (height > LEAST_HEIGHT_PX) & (width > LEAST_WIDTH_PX)
    )
    hidden = hidden_feet(frame, feet, np.stack([u - width / 2, v - height / 2, u + width / 2, v + height / 2], axis=-1))
    xy = interpolated(frame, identity, floor, hidden)
    return floor_tracks(frame, identity, xy, in_area=shows & _is_on_floor(xy) & (depth > 0))


def hidden_feet(frame: np.ndarray, feet: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(n,) whose feet (u, v) lie in the box (least u, v, greatest u, v) of a person who is nearer in the same frame.

    Where a person is hidden in part, the annotated box ends where the person begins who hides.
    """
    low_u, low_v, high_u, high_v = boxes.T
    u, v = feet.T[:, :, None]
    inside = (u > low_u) & (u < high_u) & (v > low_v) & (v < high_v) & (frame[:, None] == frame)
    return np.any(inside, axis=1)


def interpolated(frame: np.ndarray, identity: np.ndarray, xy: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """(n, 2) places, those that are hidden between others of the same person on the line from one to the next."""
    found = xy.copy()
    for one in np.unique(identity):
        shown = np.flatnonzero((identity == one) & ~hidden)
        shown = shown[np.argsort(frame[shown])]
        if len(shown):
            first, last = frame[shown[[0, -1]]]
            rows = np.flatnonzero((identity == one) & hidden & (frame > first) & (frame < last))
            found[rows] = np.stack([np.interp(frame[rows], frame[shown], xy[shown, i]) for i in (0, 1)], axis=-1)
    return found


def _is_on_floor(xy: np.ndarray) -> np.ndarray:
    """(...) which places (..., 2) are on the part of the floor that is tracked."""
    return np.all((xy > FLOOR.min(axis=0)) & (xy < FLOOR.max(axis=0)), axis=-1)


def _scores(corridor: Corridor, rows: list[tuple[int, int, float, float]]) -> dict[str, float]:
    """Of tracks, by name."""
    true, camera_xy_m = corridor.true, np.asarray(corridor.camera.position())[:2]
    table = np.array(rows, float).reshape(-1, 4)
    found = floor_tracks(table[:, 0], table[:, 1], table[:, 2:])
    scores = evaluate(true, found, camera_xy_m=camera_xy_m)
    sys.stderr.write(f"  {scores}\n")
    pairs = match(true, found)
    walks = true.identity[pairs.truth] == WALKER
    errors = np.linalg.norm(found.xy_m[pairs.estimate] - true.xy_m[pairs.truth], axis=-1)
    return {name: float(getattr(scores, name)) for name in UNITS if hasattr(scores, name)} | {
        "walker_error_m": float(errors[walks].mean()) if walks.any() else float("nan"),
        "walker_found": float(walks.sum() / max(1, np.sum(true.identity == WALKER))),
    }


def _metrics(runs: list[dict[str, float]], suffix: str) -> dict[str, Metric]:
    """Means over runs, and the extremes of the accuracy of several."""
    metrics = {f"{name}{suffix}": Metric(float(np.mean([one[name] for one in runs])), *UNITS[name]) for name in UNITS}
    if len(runs) > 1:
        mota = [one["mota"] for one in runs]
        metrics |= {f"mota_least{suffix}": Metric(min(mota), "%", "higher")}
        metrics |= {f"mota_most{suffix}": Metric(max(mota), "%", "higher")}
    return metrics
