"""Frames a second of the people tracker for 1 to 50 people at four image sizes, with and without the background.

People stand in a room, in the same field of view at three sizes; everybody is tracked when the clock starts.
All have a capacity of 32 people. `fps_*` includes finding the foreground by the median background, from an image
without lens distortion in memory; `tracking_fps_*` begins with the foreground. `person_ms_*` is what each of the seven
others adds to the time of one alone. `candidates_per_second_*` counts the places and sizes that are compared with the
image while everybody is searched for. `background_ms_1080p` is the time of the background subtraction alone.

30 and 50 people at 640x480 stand farther apart, before a camera that is higher, with a capacity of 64;
`tracking_growth_30_to_50_people` is the ratio of their times, 1.67 where every person costs the same.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.timing import interleaved
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.synthetic.room import floor_camera, looking, room_camera, room_image
from jaxfilters.models.synthetic.walkers import Walker
from jaxfilters.trackers.background.choice import Background, background
from jaxfilters.trackers.people.fit import PASSES
from jaxfilters.trackers.people.lifecycle import MOST_LOG_ODDS
from jaxfilters.trackers.people.state import (
    NUM_BIASES,
    TRACKED,
    CameraFrame,
    People,
    PeopleConfig,
    PeopleScene,
    nobody,
)
from jaxfilters.trackers.people.tracker import people_scene, step

COUNTS, QUICK_COUNTS = (1, 2, 3, 8, 32), (1, 8)
SHAPES = {"160x120": (120, 160), "480x360": (360, 480), "1920x1080": (1080, 1920)}
QUICK_SHAPES = ("160x120", "480x360")
ROUNDS, QUICK_ROUNDS = 60, 5
FLOOR_M = ((-6.0, -5.0), (6.0, -5.0), (6.0, 7.0), (-6.0, 7.0))
FOCAL = 0.9
"""Of the width."""
DRAWN_COLS = 480
"""Wider images are enlarged from this: only the tracker's work depends on the size."""
CANDIDATES = 5**2 + PASSES * 2 * 3**3 + 3**4 + 2
"""Places and sizes of one person that are tried in a frame: a wide lattice, two narrow ones each pass, one for the
curvature, two for the flatness; more where two are so near that they may be one."""
FRAME_S = np.float32(0.1)
SETTLING_FRAMES = 12


class Setting(NamedTuple):
    """A camera, and a lattice of places where people stand."""

    capacity: int
    camera: tuple[tuple[float, float, float], float, float]
    """Position in metres, heading and pitch in degrees."""
    columns: tuple[float, float, int]
    """Least and greatest X in metres, and how many there are."""
    rows: tuple[float, float, int]
    """The same of Y."""


ROOM = Setting(32, ((0.0, -9.0, 5.0), 90.0, 24.0), (-4.0, 4.0, 8), (-3.0, 4.5, 4))
CROWD = Setting(64, ((0.0, -12.0, 7.0), 90.0, 28.0), (-5.0, 5.0, 10), (-3.0, 6.0, 5))
CROWD_SIZE, CROWD_SHAPE, CROWD_COUNTS = "640x480", (480, 640), (30, 50)
FULL_HD = "1920x1080"


class Recording(NamedTuple):
    """People who stand still, and what it takes to follow them."""

    scene: PeopleScene
    people: People
    """After some frames."""
    subtraction: Background
    image: np.ndarray
    """(rows, cols, 3) uint8."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Measure one size after the other, with all numbers of people in turn."""
    del out
    counts = QUICK_COUNTS if quick else COUNTS
    metrics: dict[str, Metric] = {}
    for name in QUICK_SHAPES if quick else SHAPES:
        recordings = {count: recording(seed, count, SHAPES[name]) for count in counts}
        metrics |= speed_metrics(name, recordings, QUICK_ROUNDS if quick else ROUNDS)
        if name == FULL_HD:
            one = interleaved({"background": partial(foreground, recordings[min(counts)])}, ROUNDS)["background"]
            metrics["background_ms_1080p"] = Metric(1e3 * one, "ms", "lower")
    if not quick:
        crowds = {count: recording(seed, count, CROWD_SHAPE, CROWD) for count in CROWD_COUNTS}
        metrics |= speed_metrics(CROWD_SIZE, crowds, ROUNDS)
    return metrics


def speed_metrics(name: str, recordings: dict[int, Recording], rounds: int) -> dict[str, Metric]:
    """Of images of one size, by the number of people."""
    functions: dict[str, Callable] = {}
    for count, one in recordings.items():
        functions[f"fps_{count}_people"] = lambda one=one: one_frame(one, foreground(one))
        functions[f"tracking_fps_{count}_people"] = partial(one_frame, one, foreground(one))
    seconds = interleaved(functions, rounds)
    metrics = {f"{key}_{name}": Metric(1 / value, "frames/s", "higher") for key, value in seconds.items()}
    for count, one in recordings.items():
        followed = int(jnp.sum(one.people.mode == TRACKED))
        metrics[f"followed_{count}_people_{name}"] = Metric(float(followed), "", "higher")
        rate = CANDIDATES * count / seconds[f"tracking_fps_{count}_people"]
        metrics[f"candidates_per_second_{count}_people_{name}"] = Metric(rate, "1/s", "higher")
    few, many = min(recordings), 8
    if many in recordings and few < many:
        cost = seconds[f"tracking_fps_{many}_people"] - seconds[f"tracking_fps_{few}_people"]
        metrics[f"person_ms_{name}"] = Metric(1e3 * cost / (many - few), "ms", "lower")
    if tuple(recordings) == CROWD_COUNTS:
        fewer, all_of_them = (seconds[f"tracking_fps_{count}_people"] for count in CROWD_COUNTS)
        metrics["tracking_growth_30_to_50_people"] = Metric(all_of_them / fewer, "", "lower")
    sys.stderr.write(f"  {name}: " + "  ".join(f"{key} {1 / value:.0f}" for key, value in seconds.items()) + "\n")
    return metrics


def foreground(recording: Recording) -> np.ndarray:
    """(rows, cols) uint8: probability of foreground times 255."""
    return cv2.convertScaleAbs(recording.subtraction.apply(recording.image), alpha=255.0)


def one_frame(recording: Recording, observed: np.ndarray) -> tuple:
    """What the tracker says of one more frame, from the same state every time."""
    frame = CameraFrame(observed, recording.image, np.bool_(True))
    return step(recording.scene, recording.people, (frame,), FRAME_S)


def recording(seed: int, count: int, shape: tuple[int, int], setting: Setting = ROOM) -> Recording:
    """`count` people who are followed already, in images of a shape (rows, cols)."""
    camera = floor_camera(_pinhole(shape), looking(*setting.camera))
    scene = people_scene([camera], FLOOR_M, config=PeopleConfig(capacity=setting.capacity))
    places, sizes = crowd(seed, count, setting)
    image, empty = (_image(seed, places, sizes, shape, with_people, setting) for with_people in (True, False))
    subtraction = background("median")
    subtraction.prime([empty])
    made = Recording(scene, _followed(scene.config, places, sizes), subtraction, image)
    observed = foreground(made)
    for _ in range(SETTLING_FRAMES):
        made = made._replace(people=one_frame(made, observed)[0])
    return made


def crowd(seed: int, count: int, setting: Setting = ROOM) -> tuple[np.ndarray, np.ndarray]:
    """Places (count, 2), heights and widths (count, 2), metres: some of a lattice, who hardly hide each other."""
    rng = np.random.default_rng(seed)
    lattice = np.meshgrid(np.linspace(*setting.columns), np.linspace(*setting.rows))
    rows = np.stack(lattice, axis=-1).reshape(-1, 2)
    places = rng.permutation(rows + rng.uniform(-0.3, 0.3, rows.shape))
    sizes = np.stack([rng.normal(1.72, 0.06, len(rows)), rng.normal(0.45, 0.03, len(rows))], axis=-1)
    return places[:count], sizes[:count]


def _pinhole(shape):
    return Pinhole.from_intrinsics(FOCAL * shape[1], ((shape[1] - 1) / 2, (shape[0] - 1) / 2), shape)


def _image(seed, places, sizes, shape, with_people, setting=ROOM):
    rng, count = np.random.default_rng(seed + 1), len(places)
    small = (shape[0] * min(DRAWN_COLS, shape[1]) // shape[1], min(DRAWN_COLS, shape[1]))
    pinhole, transform = _pinhole(small), looking(*setting.camera)
    room_key, noise_key = jax.random.split(jax.random.key(seed))
    room = room_camera(room_key, pinhole, transform, jnp.full(small, jnp.inf))
    turned = rng.uniform(0, 2 * np.pi, (2, count))
    clothes = rng.uniform(0, 100, (count, 2, 3))
    # One program for all numbers of people: the others are not there.
    *leaves, clothes = (
        jnp.asarray(np.resize(leaf, (setting.capacity, *leaf.shape[1:])), jnp.float32)
        for leaf in (places, *turned, np.ones(count), *sizes.T, clothes)
    )
    here = (jnp.arange(setting.capacity) < count) & with_people
    image, _ = room_image(noise_key, room, Walker(*leaves), clothes, here)
    return cv2.resize(np.asarray(image), shape[::-1], interpolation=cv2.INTER_LINEAR)


def _followed(config: PeopleConfig, places, sizes) -> People:
    """Everybody in the first slots, where they are."""
    empty, count = nobody(config), len(places)
    here = jnp.arange(config.capacity) < count
    mean = np.zeros(empty.belief.mean.shape, np.float32)
    mean[:count, :2], mean[:count, 4:6] = places, sizes
    sd = jnp.array([0.1, 0.1, 0.3, 0.3, config.height_sd_m, config.width_sd_m, *[1.0] * NUM_BIASES])
    return empty._replace(
        belief=Gaussian(jnp.asarray(mean), jnp.broadcast_to(jnp.diag(sd**2), empty.belief.covariance.shape)),
        mode=jnp.where(here, TRACKED, empty.mode),
        identity=jnp.where(here, jnp.arange(config.capacity, dtype=jnp.int32), empty.identity),
        log_odds=jnp.where(here, MOST_LOG_ODDS, empty.log_odds),
        next_identity=jnp.asarray(count, jnp.int32),
    )
