"""Cameras, people and furniture of the paper's experiments, and both trackers run over many of them."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.calibration import Calibration
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.ellipsoid import pixel_grid, standing
from jaxfilters.models.person.scene import patch_depth
from jaxfilters.models.synthetic.standing_person import (
    NO_FLAWS,
    Flaws,
    Sight,
    flawed,
    shadow,
    sight,
    silhouette,
    standing_body,
)
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people import tracker
from jaxfilters.trackers.people.lifecycle import BIRTH_SD_M, MOST_LOG_ODDS
from jaxfilters.trackers.people.state import (
    BIAS,
    NUM_BIASES,
    TRACKED,
    CameraFrame,
    People,
    PeopleConfig,
    PeopleScene,
    nobody,
)
from jaxfilters.trackers.published.people import (
    ACQUIRE,
    PaperState,
    paper_start,
    paper_step,
    score_profile,
    with_person,
)
from jaxfilters.trackers.published.people_scene import PaperConfig, PaperScene, paper_scene
from jaxfilters.typing import AnyKey

SHAPE = (120, 160)
FLOOR = ((-4.0, -1.6), (2.0, -1.6), (2.0, 5.0), (-4.0, 5.0))
BARREL = np.array([-0.02, 0.0, 0.0, 0.0, 0.0])
"""Distortion of camera 2 as OpenCV has it."""
MODEL_M = (1.65, 0.40)
"""Height and width of the paper's ellipsoid."""
BODY_M = (1.66, 0.42)
DESK_SIZE_M, DESK_AHEAD_M = (1.2, 0.6, 0.73), 0.55
"""Of the box, and how far in front of the person its middle is."""
FRAME_S = 0.1
START_OFF_M = 0.15


def camera_1() -> Calibration:
    """160 x 120 pixels, 2.64 m high, heading +Y and 37 degrees down: what the paper's statements of view imply."""
    pitch = np.deg2rad(37)
    R = np.array([[1, 0, 0], [0, -np.sin(pitch), -np.cos(pitch)], [0, np.cos(pitch), -np.sin(pitch)]])
    return _calibration(139.0, R, (-1.0, -1.74, 2.64), np.zeros(5))


def camera_2() -> Calibration:
    """160 x 120 pixels, 3.09 m high, straight down, the long side of the image along Y; with barrel distortion."""
    R = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return _calibration(68.0, R, (-1.07, 1.32, 3.09), BARREL)


def _calibration(focal, R, center, distortion):
    K = np.array([[focal, 0, (SHAPE[1] - 1) / 2], [0, focal, (SHAPE[0] - 1) / 2], [0, 0, 1]])
    return Calibration(K, distortion, R, -R @ np.asarray(center), 0.0)


def floor_camera(calibration: Calibration) -> FloorCamera:
    """The camera without its distortion."""
    return FloorCamera.from_matrix(calibration.P, SHAPE)


def sight_of(calibration: Calibration) -> Sight:
    """What the pixels of a camera see, its distortion included."""
    grid = np.asarray(pixel_grid(SHAPE))
    straight = calibration.undistort(grid.reshape(-1, 2)).reshape(grid.shape)
    return sight(floor_camera(calibration), uv=jnp.asarray(straight, jnp.float32))


def straightened(
    calibration: Calibration, masks: Bool[np.ndarray | Array, "*runs rows cols"]
) -> UInt8[np.ndarray, "*runs rows cols"]:
    """Foreground probabilities times 255, without the distortion of the camera."""
    images = np.asarray(masks, np.uint8) * np.uint8(255)
    undistortion = Undistortion(SHAPE, calibration.K, calibration.distortion)
    flat = [undistortion.apply(image) for image in images.reshape(-1, *SHAPE)]
    return np.stack(flat).reshape(images.shape)


def desk(xy: Float[Array, " 2"]) -> Float[Array, "5 3 3"]:
    """The sides and the top of a box on the floor between a person and camera 1."""
    (x, y), (width, depth, height) = xy - jnp.array([0.0, DESK_AHEAD_M]), DESK_SIZE_M
    low, high = jnp.stack([x - width / 2, y - depth / 2]), jnp.stack([x + width / 2, y + depth / 2])
    along, across, up = jnp.array([width, 0.0, 0.0]), jnp.array([0.0, depth, 0.0]), jnp.array([0.0, 0.0, height])
    near, far = jnp.append(low, 0.0), jnp.append(high, 0.0)
    sides = [(near, along, up), (near, across, up), (far, -along, up), (far, -across, up), (near + up, along, across)]
    return jnp.stack([jnp.stack(side) for side in sides])


class Appearance(NamedTuple):
    """How people appear: what they are made of, and what is wrong with their silhouettes."""

    is_ellipsoid: bool = False
    """The tracker's own ellipsoid instead of a body of six parts."""
    flaws: Flaws = NO_FLAWS
    with_shadow: bool = False
    taller: float = 1.0
    """Factor on the height."""
    with_blob: bool = False
    """A second silhouette as large as the first, somewhere else, that is nobody."""


APPEARANCES = {
    "ellipsoid": Appearance(True),
    "body": Appearance(),
    "holes": Appearance(flaws=Flaws()),
    "shadow": Appearance(flaws=Flaws(), with_shadow=True),
    "taller": Appearance(taller=1.05),
}
"""The columns of table 1 of Kato et al. (1999); `shadow` has holes too."""


class Runs(NamedTuple):
    """Sequences that have nothing to do with each other."""

    truth: Float[np.ndarray, "runs frames people 2"]
    """Metres."""
    starts: Float[np.ndarray, "runs people 2"]
    """Where the trackers believe people to be before the first frame."""
    masks: Bool[np.ndarray, "runs frames rows cols"]
    """With the distortion of the camera."""
    desks: Float[np.ndarray, "runs 5 3 3"] | None
    """In front of the first person."""


def near_start(key: AnyKey, shape: tuple[int, ...]) -> Array:
    """Up to 0.15 m off along each axis."""
    return jax.random.uniform(key, shape, minval=-START_OFF_M, maxval=START_OFF_M)


def simulate(
    key: AnyKey,
    calibration: Calibration,
    truth: Float[np.ndarray, "runs frames people 2"],
    appearance: Appearance,
    *,
    sizes_m: tuple[tuple[float, float], ...] = (BODY_M,),
    start_offset_m: Callable[[AnyKey, tuple[int, ...]], Array] = near_start,
    with_desk: bool = False,
) -> Runs:
    """What background subtraction gives of people on their ways; flaws are new in every frame.

    Args:
        key: Random key; a run depends on it and its number alone.
        calibration: Of the camera.
        truth: Where people are.
        appearance: How they appear.
        sizes_m: Height and width of each.
        start_offset_m: `(key, shape) -> offsets` of where the trackers start.
        with_desk: Whether there is a desk before the first of them.
    """
    sight = sight_of(calibration)
    desks = [np.asarray(desk(jnp.asarray(run[0, 0]))) for run in truth] if with_desk else None
    starts, masks = [], []
    for number, run in enumerate(truth):
        start_key, mask_key = jax.random.split(jax.random.fold_in(key, number))
        before = sight
        if desks is not None:
            before = sight._replace(furniture=patch_depth(sight.camera, jnp.asarray(desks[number])))
        starts.append(run[0] + np.asarray(start_offset_m(start_key, run[0].shape)))
        sizes = jnp.asarray(sizes_m) * jnp.array([appearance.taller, 1.0])
        switches = (appearance.is_ellipsoid, appearance.with_shadow, appearance.with_blob)
        masks.append(np.asarray(_masks(mask_key, before, jnp.asarray(run), sizes, appearance.flaws, *switches)))
    return Runs(truth, np.stack(starts), np.stack(masks), None if desks is None else np.stack(desks))


@partial(jax.jit, static_argnums=(5, 6, 7))
def _masks(key, sight, xy, sizes, flaws, is_ellipsoid, with_shadow, with_blob):
    def body(at, size):
        if not is_ellipsoid:
            return standing_body(at, size[0], size[1])
        return jax.tree.map(lambda leaf: leaf[None], standing(at, size[0], size[1]))

    def frame(key, places):
        flaw_key, blob_key = jax.random.split(key)
        mask = jnp.any(jax.vmap(lambda at, size: silhouette(sight, body(at, size)))(places, sizes), axis=0)
        if with_shadow:
            mask |= jnp.any(jax.vmap(lambda at: shadow(sight, at))(places), axis=0)
        if with_blob:
            away = jax.random.randint(blob_key, (2,), jnp.array([4, 6]), jnp.array([12, 24]))
            mask |= jnp.roll(mask, away, axis=(0, 1))
        return flawed(flaw_key, mask, flaws)

    return jax.vmap(frame)(jax.random.split(key, len(xy)), xy)


class Estimates(NamedTuple):
    """What a tracker says, runs first."""

    xy: Float[np.ndarray, "runs frames people 2"]
    """Metres."""
    score: Float[np.ndarray, "runs people"]
    """In the last frame, as are the following."""
    flatness: Float[np.ndarray, "runs people"]
    sd_radial: Float[np.ndarray, "runs people"]
    """Metres."""


def paper_room(calibration: Calibration, config: PaperConfig) -> PaperScene:
    """The room for the paper's tracker."""
    return paper_scene(floor_camera(calibration), FLOOR, config=config)


def people_room(calibration: Calibration, config: PeopleConfig) -> PeopleScene:
    """The room for the modern tracker."""
    return tracker.people_scene((floor_camera(calibration),), FLOOR, config=config)


def run_paper(scene: PaperScene, runs: Runs, *, mode: int = ACQUIRE) -> Estimates:
    """The paper's tracker, from a mode of its own; it ignores distortion."""
    people = runs.starts.shape[1]
    state = paper_start(scene.config)
    for _ in range(people):
        state = with_person(state, (0.0, 0.0))
    found = []
    for number, (start, masks) in enumerate(zip(runs.starts, runs.masks, strict=True)):
        obstacles = scene.obstacles
        if runs.desks is not None:
            obstacles = scene.config.occlusion.of_patches(scene.camera, jnp.asarray(runs.desks[number]))
        begin = state._replace(xy=state.xy.at[:people].set(start), mode=jnp.full_like(state.mode, mode))
        found.append(_paper_run(replace(scene, obstacles=obstacles), begin, jnp.asarray(masks)))
    return _estimates(found, people)


@jax.jit
def _paper_run(scene: PaperScene, state: PaperState, masks):
    def advance(now, mask):
        now, report = paper_step(scene, now, mask)
        return now, (now.xy, report.score)

    last, (xy, score) = jax.lax.scan(advance, state, masks)
    profile = score_profile(scene, last, masks[-1])
    away = last.xy - scene.camera.position()[:2]
    away = away / jnp.linalg.norm(away, axis=-1, keepdims=True)
    sd = jnp.sqrt(jnp.einsum("ki,kij,kj->k", away, profile.covariance, away))
    return xy, score[-1], profile.flatness, sd


def run_people(
    scene: PeopleScene,
    runs: Runs,
    calibration: Calibration,
    *,
    height_m: tuple[float, float] | None = None,
    start_sd_m: float = BIRTH_SD_M,
) -> Estimates:
    """The modern tracker, without distortion; everybody is known, but not well where they start.

    Args:
        scene: The room.
        runs: What happens in it.
        calibration: What straightens the images.
        height_m: Belief in the height of people, mean and standard deviation; that of the tracker by default.
        start_sd_m: Belief in where they start, standard deviation.
    """
    height = height_m or (scene.config.height_m, scene.config.height_sd_m)
    found = []
    for number, (start, masks) in enumerate(zip(runs.starts, runs.masks, strict=True)):
        furniture = scene.furniture
        if runs.desks is not None:
            furniture = (patch_depth(scene.cameras[0], jnp.asarray(runs.desks[number])),)
        begin = known_people(scene.config, jnp.asarray(start, jnp.float32), start_sd_m, height)
        found.append(_people_run(replace(scene, furniture=furniture), begin, straightened(calibration, masks)))
    return _estimates(found, runs.starts.shape[1])


def _people_run(scene: PeopleScene, people: People, foreground: UInt8[np.ndarray, "frames rows cols"]):
    """One frame after the other: one program serves all rooms and numbers of frames."""
    image, reports = np.zeros((*SHAPE, 3), np.uint8), []
    for mask in foreground:
        frame = CameraFrame(mask, image, np.bool_(True))
        people, report = tracker.step(scene, people, (frame,), np.float32(FRAME_S))
        reports.append(report)
    last = reports[-1]
    return np.stack(jax.device_get([report.xy for report in reports])), last.score, last.flatness, last.sd_radial


def known_people(config: PeopleConfig, xy: Float[Array, "people 2"], sd: float, height: tuple[float, float]) -> People:
    """People who are tracked already, in the first slots, at rest as far as is known."""
    people, count = nobody(config), len(xy)
    known = jnp.arange(config.capacity) < count
    size = jnp.broadcast_to(jnp.array([height[0], config.width_m]), (count, 2))
    mean = people.belief.mean.at[:count, : BIAS.start].set(jnp.concatenate([xy, jnp.zeros((count, 2)), size], axis=-1))
    sds = jnp.array([sd, sd, config.speed_sd, config.speed_sd, height[1], config.width_sd_m, *[1.0] * NUM_BIASES])
    covariance = jnp.where(known[:, None, None], jnp.diag(sds**2), people.belief.covariance)
    return people._replace(
        belief=Gaussian(mean, covariance),
        mode=jnp.where(known, TRACKED, people.mode),
        identity=jnp.where(known, jnp.arange(config.capacity), people.identity).astype(people.identity.dtype),
        log_odds=jnp.where(known, MOST_LOG_ODDS, people.log_odds),
        next_identity=jnp.asarray(count, people.next_identity.dtype),
    )


def _estimates(found, people: int) -> Estimates:
    xy, *last = (np.stack([np.asarray(run[field]) for run in found]) for field in range(4))
    return Estimates(xy[:, :, :people], *(values[:, :people] for values in last))
