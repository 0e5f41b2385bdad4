"""People handed over between four cameras of one room, also with cameras of different rates and one that stops.

The room and its walkers are synthetic, so that places and identities are known; foreground is from the median
background, as for any video. Names without a suffix are of four cameras that all deliver every frame. In `_narrow` each
has the middle two fifths of its image only, so that people leave one view for the next and are often in one alone;
`_rates` has cameras of which some deliver every second or third frame; in `_stopped` the first camera delivers nothing
in the second half; `_one_camera` is the first camera alone, judged on what it sees. `handovers` counts how often, with
narrow views, another camera became the nearest of those that see a person whole.

Where JAXFILTERS_DATA names a folder with `pom_lab_2cam`, two real cameras follow, by their silhouettes. There is no
truth for them: `pom_agreement` is the share of the people that a published method found (Fleuret et al. 2008, on a grid
of 0.2 m) within 0.5 m of a person who is tracked. Where it has `pets09_s2l1_two_views` as well, `_two` are scores of
two real cameras of a street together and `_one` those of the better one alone (means over runs between which grey
levels differ by one), and `_two_refit` and `_one_refit` the same with another calibration, each of which is off by some
decimetres somewhere.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.multi_object import FloorTracks, evaluate, floor_tracks
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios._pets_two import two_view_metrics
from jaxfilters.benchmarks.scenarios._pom import pom_metrics
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.scene import walkable
from jaxfilters.trackers.background.choice import Background, background
from jaxfilters.trackers.people.demo_room import DemoRoom, demo_room
from jaxfilters.trackers.people.state import TRACKED, CameraFrame, People, PeopleConfig, PeopleScene
from jaxfilters.trackers.people.tracker import people_scene, start, step

NUM_CAMERAS = 4
NUM_SEEDS = 3
NUM_FRAMES, QUICK_FRAMES = 240, 60
PRIME_IMAGES = 24
WHOLE_M = (0.1, 1.5)
"""Heights that a camera must have in its image to see a person whole."""
CAPACITY = 12
NARROW = 0.4
"""Of the columns."""


class Setup(NamedTuple):
    """Some of the cameras, and when they deliver."""

    cameras: tuple[int, ...]
    every: tuple[int, ...] = (1, 1, 1, 1)
    """Frames of which each camera of the room delivers one."""
    first_stops: bool = False
    """Whether the first camera delivers nothing in the second half."""
    width: float = 1.0
    """Share of its columns, in the middle, that each camera has; nothing is visible beside them."""

    def delivers(self, camera: int, frame: int, frames: int) -> bool:
        """Whether a camera delivers a frame of a recording of some frames."""
        return frame % self.every[camera] == 0 and not (self.first_stops and camera == 0 and frame >= frames // 2)

    def is_observed(self, shape: tuple[int, int]) -> Bool[np.ndarray, " cols"]:
        """Which columns of an image (rows, cols) a camera has."""
        middle = (shape[1] - 1) / 2
        return np.abs(np.arange(shape[1]) - middle) <= self.width * middle


ALL = tuple(range(NUM_CAMERAS))
SETUPS = {
    "": Setup(ALL),
    "_narrow": Setup(ALL, width=NARROW),
    "_rates": Setup(ALL, every=(1, 2, 3, 2)),
    "_stopped": Setup(ALL, first_stops=True),
    "_one_camera": Setup((0,)),
}
"""By the suffix of their metrics."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow everybody in all setups, over all seeds together, and then on the recording."""
    del out
    frames = QUICK_FRAMES if quick else NUM_FRAMES
    found = [room_tracks(one, frames) for one in range(seed, seed + (1 if quick else NUM_SEEDS))]
    metrics: dict[str, Metric] = {}
    for suffix in SETUPS:
        truths, estimates = zip(*(tracks[suffix] for tracks in found), strict=True)
        metrics |= _scores(joined(truths), joined(estimates), suffix)
    rooms = [demo_room(one, cameras=NUM_CAMERAS, frames=frames) for one in range(seed, seed + len(found))]
    changes = [handovers(room, NARROW) for room in rooms]
    metrics["handovers"] = Metric(float(sum(changes)), "", "higher")
    real = (
        lambda: pom_metrics(recording_folder("pom_lab_2cam")),
        lambda: two_view_metrics(
            recording_folder("pets09_s2l1_two_views"),
            recording_folder("pets09_s2l1_view001"),
            quick=quick,
            seed=seed,
        ),
    )
    for measured in real:
        try:
            metrics |= measured()
        except RecordingError as error:
            sys.stderr.write(f"no real cameras: {error}\n")
    return metrics


def room_tracks(seed: int, frames: int) -> dict[str, tuple[FloorTracks, FloorTracks]]:
    """Truth and estimate of every setup, by suffix; all setups see the same images."""
    room = demo_room(seed, cameras=NUM_CAMERAS, frames=frames)
    subtractions = [_primed(room, camera) for camera in range(NUM_CAMERAS)]
    scenes = {suffix: _scene(room, setup) for suffix, setup in SETUPS.items()}
    people = {suffix: start(scene) for suffix, scene in scenes.items()}
    rows: dict[str, list[tuple]] = {suffix: [] for suffix in SETUPS}
    for i in range(frames):
        images = [room.image(camera, i) for camera in range(NUM_CAMERAS)]
        observed = [
            cv2.convertScaleAbs(one.apply(image), alpha=255.0) for one, image in zip(subtractions, images, strict=True)
        ]
        for suffix, setup in SETUPS.items():
            shown = tuple(
                CameraFrame(
                    np.where(setup.is_observed(room.cameras[c].shape), observed[c], np.uint8(0)),
                    images[c],
                    np.bool_(setup.delivers(c, i, frames)),
                )
                for c in setup.cameras
            )
            people[suffix], _ = step(scenes[suffix], people[suffix], shown, np.float32(1 / room.fps))
            rows[suffix] += confirmed(i, people[suffix])
    sys.stderr.write(f"  seed {seed}: {frames} frames of {NUM_CAMERAS} cameras\n")
    return {suffix: (truth(room, setup), _tracks(rows[suffix])) for suffix, setup in SETUPS.items()}


def truth(room: DemoRoom, setup: Setup) -> FloorTracks:
    """Who is on the floor and observed whole by a camera that is still running."""
    frames, xy = len(room), room.routes.xy
    observed = {c: sees_whole(room.cameras[c], xy, setup.width) for c in setup.cameras}
    on_floor = np.asarray(walkable(jnp.asarray(room.floor), jnp.asarray(xy)))
    rows = []
    for i in range(frames):
        running = [c for c in setup.cameras if any(setup.delivers(c, j, frames) for j in range(i, frames))]
        there = np.any([observed[c][i] for c in running], axis=0) & room.present(i) & on_floor[i]
        rows += [(i, identity, *xy[i, identity]) for identity in np.flatnonzero(there)]
    return _tracks(rows)


def sees_whole(camera: FloorCamera, xy: np.ndarray, width: float = 1.0) -> np.ndarray:
    """(..., people) who at places (..., people, 2) is whole, feet to head, in the middle columns of this share."""
    rows, cols = camera.shape
    inside = np.ones(xy.shape[:-1], bool)
    for height in WHOLE_M:
        uv, depth = (np.asarray(a) for a in camera.project(jnp.asarray(np.insert(xy, 2, height, axis=-1))))
        away = np.abs(uv - (np.array([cols, rows]) - 1) / 2)
        inside &= (depth > 0) & np.all(away < np.array([width * (cols - 1), rows - 1]) / 2, axis=-1)
    return inside


def handovers(room: DemoRoom, width: float) -> int:
    """How often the nearest camera that sees a person whole became another one."""
    centers = np.stack([np.asarray(camera.position())[:2] for camera in room.cameras])
    observed = np.stack([sees_whole(camera, room.routes.xy, width) for camera in room.cameras], axis=1)
    distance = np.linalg.norm(room.routes.xy[:, None] - centers[:, None], axis=-1)
    nearest = np.argmin(np.where(observed, distance, np.inf), axis=1)
    somewhere = np.asarray(observed.any(axis=1))
    changed = (np.diff(nearest, axis=0) != 0) & somewhere[1:] & somewhere[:-1]
    return int(changed.sum())


def confirmed(frame: int, people: People) -> list[tuple]:
    """Frame, identity, X and Y in metres of everybody who is tracked."""
    mode, identity, mean = (np.asarray(leaf) for leaf in (people.mode, people.identity, people.belief.mean))
    return [(frame, int(identity[k]), *map(float, mean[k, :2])) for k in np.flatnonzero(mode == TRACKED)]


def joined(parts: tuple[FloorTracks, ...]) -> FloorTracks:
    """Tracks of several recordings as of one, with frames and identities of their own."""
    apart = 1_000_000
    shifted = [
        FloorTracks(part.frame + i * apart, part.identity + i * apart, part.xy_m) for i, part in enumerate(parts)
    ]
    return FloorTracks(*(np.concatenate(leaf) for leaf in zip(*shifted, strict=True)))


def _primed(room: DemoRoom, camera: int) -> Background:
    subtraction = background("median")
    chosen = np.linspace(0, len(room) - 1, min(PRIME_IMAGES, len(room))).round().astype(int)
    subtraction.prime(room.image(camera, int(i)) for i in chosen)
    return subtraction


def _scene(room: DemoRoom, setup: Setup) -> PeopleScene:
    """What a camera does not have is as if something stood right before it."""
    furniture = [jnp.where(setup.is_observed(room.cameras[c].shape), room.furniture[c], 0.0) for c in setup.cameras]
    config = PeopleConfig(capacity=CAPACITY)
    return people_scene([room.cameras[c] for c in setup.cameras], room.floor, furniture=furniture, config=config)


def _tracks(rows: list[tuple]) -> FloorTracks:
    table = np.array(rows, float).reshape(-1, 4)
    return floor_tracks(table[:, 0], table[:, 1], table[:, 2:])


def _scores(true: FloorTracks, estimate: FloorTracks, suffix: str) -> dict[str, Metric]:
    scores = evaluate(true, estimate)
    sys.stderr.write(f"  {suffix[1:] or 'all cameras'}: {scores}\n")
    return {
        f"mota{suffix}": Metric(scores.mota, "%", "higher"),
        f"idf1{suffix}": Metric(scores.idf1, "%", "higher"),
        f"id_switches{suffix}": Metric(float(scores.id_switches), "", "lower"),
        f"mean_error_m{suffix}": Metric(scores.mean_error_m, "m", "lower"),
        f"false_positives{suffix}": Metric(float(scores.false_positives), "", "lower"),
        f"misses{suffix}": Metric(float(scores.misses), "", "lower"),
    }
