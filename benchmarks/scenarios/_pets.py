"""The recording PETS 2009 S2.L1 View_001: camera, furniture, floor and images."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.multi_object import FloorTracks, MultiObjectScores, floor_tracks
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.scene import upright_depth
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people.state import PeopleConfig, PeopleScene
from jaxfilters.trackers.people.tracker import people_scene

SHAPE = (360, 480)
BEYOND_M = 3.0
"""How far people are followed beyond the evaluation area: most come from there."""
TRIPOD_LINE_PX = 3
RETURNED_AS = {14: 15}
"""Identities of `gt_0_399.csv` under which a person returns, to the identity that the person had before.

Person 15 leaves below the image after frame 205 and comes back as person 14 in frame 230, 3.6 s later and 1.6 m away:
a man in a dark leather jacket with a rolled white paper in his hand (frames 150 to 199 and 240 to 270, both views).
The published scores keep the identities of the file; only metrics with `_merged` in their names use this."""


class Pets(NamedTuple):
    """What is known of the place."""

    folder: Path
    camera: FloorCamera
    undistortion: Undistortion
    scene: PeopleScene
    area: np.ndarray
    """(2, 2) metres: least and greatest X, Y of the evaluation area."""

    def is_inside(self, xy: np.ndarray) -> np.ndarray:
        """(n,) which places (n, 2) lie in the evaluation area."""
        return np.all((xy >= self.area[0]) & (xy <= self.area[1]), axis=-1)


def load_pets(folder: Path, config: PeopleConfig) -> Pets:
    """The recording in a folder.

    Raises:
        RecordingError: if its calibration cannot be read.
    """
    try:
        calibration = json.loads((folder / "calibration.json").read_text())
    except (OSError, ValueError) as error:
        raise RecordingError(f"{folder / 'calibration.json'} cannot be read: {error}") from error
    camera = FloorCamera.from_matrix(calibration["P_480x360"], SHAPE)
    K, distortion = np.array(calibration["K_480x360"]), np.array(calibration["opencv_distCoeffs"])
    limits = calibration["evaluation_area"]
    area = np.array([[limits[f"{axis}{end}"] for axis in "xy"] for end in ("min", "max")])
    (left, near), (right, far) = area[0] - BEYOND_M, area[1] + BEYOND_M
    floor = [(left, near), (right, near), (right, far), (left, far)]
    depth = furniture(camera, calibration["occluders_undistorted_480x360"])
    scene = people_scene([camera], floor, furniture=[depth], config=config)
    return Pets(folder, camera, Undistortion(SHAPE, K, distortion), scene, area)


def furniture(camera: FloorCamera, outlines: dict[str, Any]) -> np.ndarray:
    """Depth image (rows, cols) in metres of the lamp post with its sign and of the tripod, as thin upright things."""
    post, tripod = np.zeros(camera.shape, np.uint8), np.zeros(camera.shape, np.uint8)
    top, foot = outlines["pole_line"]
    cv2.line(post, top, foot, 255, outlines["pole_width_px"])
    corner, opposite = outlines["sign_rect"]
    cv2.rectangle(post, corner, opposite, 255, cv2.FILLED)
    for start, end in outlines["tripod_lines"]:
        cv2.line(tripod, start, end, 255, TRIPOD_LINE_PX)
    depths = [
        np.where(mask > 0, np.asarray(upright_depth(camera, jnp.array(outlines[name], float))), np.inf)
        for mask, name in ((post, "pole_ground_xy"), (tripod, "tripod_ground_xy"))
    ]
    return np.minimum(*depths).astype(np.float32)


def images(pets: Pets) -> Iterator[np.ndarray]:
    """Straightened images (rows, cols, 3) uint8 of the video, one after the other.

    Raises:
        RecordingError: if the video does not open.
    """
    path = pets.folder / "vtest_480x360.avi"
    video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise RecordingError(f"{path} cannot be opened as a video.")
        while True:
            there, image = video.read()
            if not there:
                return
            yield pets.undistortion.apply(image)
    finally:
        video.release()


def merged(truth: FloorTracks) -> FloorTracks:
    """The annotations of `gt_0_399.csv`, in which people who return have the identity that they had before."""
    identity = [RETURNED_AS.get(identity, identity) for identity in truth.identity.tolist()]
    return floor_tracks(truth.frame, identity, truth.xy_m)


def merged_metrics(scores: MultiObjectScores, suffix: str) -> dict[str, Metric]:
    """By name, what depends on the identities of the truth: scores against `merged` annotations."""
    return {
        f"idf1_merged{suffix}": Metric(scores.idf1, "%", "higher"),
        f"id_switches_merged{suffix}": Metric(float(scores.id_switches), "", "lower"),
        f"transfers_merged{suffix}": Metric(float(scores.transfers), "", "lower"),
    }
