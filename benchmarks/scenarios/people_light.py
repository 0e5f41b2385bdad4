"""People on a real video whose light changes or whose camera moves: PETS 2009 S2.L1 View_001, disturbed.

Needs the folder `pets09_s2l1_view001` of JAXFILTERS_DATA. Every case changes the images of the first 200 frames, and
then takes the way of `jaxfilters track people`: the background from images spread over the disturbed recording, every
frame in turn, tracks smoothed at the end. `mota_undisturbed` is of the images as they are. From half of the frames on
`step` is 1.25 times as bright, `dim` .7 times, `lamp` has other factors for blue, green and red; `sun` follows a sine
of a fifth over the recording; `shake` turns the camera at random by 3 pixels (standard deviation, about each axis) in
each frame, `drift` by 6 pixels from the first to the last, `knock` by 15 pixels and a degree of roll at once.
"""

import itertools
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.multi_object import FloorTracks, evaluate
from jaxfilters.benchmarks.recordings import recording_folder
from jaxfilters.benchmarks.scenarios._pets import Pets, images, load_pets
from jaxfilters.benchmarks.scenarios.people_pets import FRAMES_PER_SECOND, positions, read_truth, within
from jaxfilters.trackers.background.registration import intrinsics
from jaxfilters.trackers.people.session import PRIMING_IMAGES, PeopleSession
from jaxfilters.trackers.people.state import PeopleConfig

NUM_FRAMES, QUICK_FRAMES = 200, 40
SHAKE_PX, DRIFT_PX, KNOCK_PX, KNOCK_ROLL = 3.0, 6.0, 15.0, np.deg2rad(1.0)

Disturbance = Callable[[np.ndarray, float], np.ndarray]
"""An image as it would have been, at a time from 0 at the first frame to 1 at the last."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow everybody in every case, and score it on the floor."""
    del out
    pets = load_pets(recording_folder("pets09_s2l1_view001"), PeopleConfig())
    frames = QUICK_FRAMES if quick else NUM_FRAMES
    plain = list(itertools.islice(images(pets), frames))
    annotated = read_truth(pets.folder / "gt_0_399.csv", pets)
    annotated = FloorTracks(*(rows[annotated.frame < len(plain)] for rows in annotated))
    metrics: dict[str, Metric] = {}
    for name, disturb in disturbances(intrinsics(pets.camera.P), seed).items():
        times = np.linspace(0.0, 1.0, len(plain))
        metrics |= _case(name, pets, annotated, [disturb(*one) for one in zip(plain, times, strict=True)])
    return metrics


def disturbances(K: np.ndarray, seed: int) -> dict[str, Disturbance]:
    """Every case by name, for a camera with these intrinsics (3, 3)."""
    random = np.random.default_rng(seed)
    focal = float(K[0, 0])
    lamp = np.array([0.8, 1.0, 1.15])

    def turned(image: np.ndarray, angles: np.ndarray) -> np.ndarray:
        H = K @ cv2.Rodrigues(angles)[0] @ np.linalg.inv(K)
        return cv2.warpPerspective(image, H, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)

    return {
        "undisturbed": lambda image, _: image,
        "step": lambda image, t: _brighter(image, 1.25 if t > 0.5 else 1.0),
        "dim": lambda image, t: _brighter(image, 0.7 if t > 0.5 else 1.0),
        "lamp": lambda image, t: _brighter(image, lamp if t > 0.5 else 1.0),
        "sun": lambda image, t: _brighter(image, 1 + 0.2 * np.sin(2 * np.pi * t)),
        "shake": lambda image, _: turned(image, random.normal(size=3) * SHAKE_PX / focal),
        "drift": lambda image, t: turned(image, np.array([0.0, t * DRIFT_PX / focal, 0.0])),
        "knock": lambda image, t: turned(image, (t > 0.5) * np.array([0.0, KNOCK_PX / focal, KNOCK_ROLL])),
    }


def _brighter(image: np.ndarray, gain: float | np.ndarray) -> np.ndarray:
    return np.clip(np.round(image * np.asarray(gain)), 0, 255).astype(np.uint8)


def _case(name: str, pets: Pets, annotated: FloorTracks, recording: list[np.ndarray]) -> dict[str, Metric]:
    session = PeopleSession(pets.scene)
    session.prime([recording[:: max(1, len(recording) // PRIMING_IMAGES)]])
    for i, image in enumerate(recording):
        session.process([image], i / FRAMES_PER_SECOND)
    covered = (0, len(recording) - 1)
    scores = evaluate(annotated, within(positions(session.tracks.smoothed()), pets, covered))
    sys.stderr.write(f"  {name}: {scores}\n")
    return {
        f"mota_{name}": Metric(scores.mota, "%", "higher"),
        f"idf1_{name}": Metric(scores.idf1, "%", "higher"),
        f"mean_error_m_{name}": Metric(scores.mean_error_m, "m", "lower"),
        f"camera_motion_px_{name}": Metric(session.camera_motion_px[0], "px", "lower"),
    }
