"""The people tracker: a Kalman filter a person, measured by a joint search in the silhouettes.

People move with a steady velocity and white acceleration; their sizes are constant, and what displaces their
silhouettes decays.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int32

from jaxfilters._full_precision import dot, einsum
from jaxfilters._xla.compiled_quickly import compiled_fully
from jaxfilters._xla.from_host import from_host
from jaxfilters.gaussian.arithmetic import joseph
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.consider import consider
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.ellipsoid import Outline, outline
from jaxfilters.motion.models import constant_velocity
from jaxfilters.trackers.innovations import innovation_counts
from jaxfilters.trackers.people import detectability, lifecycle
from jaxfilters.trackers.people.appearance import appearances, identity_switch_correction
from jaxfilters.trackers.people.fit import Fit, as_measurement, fit_people
from jaxfilters.trackers.people.image_shift import displacement_by_shift, shift_sd
from jaxfilters.trackers.people.lifecycle import birth, cells_of, padded
from jaxfilters.trackers.people.silhouette_bias import bias_factor
from jaxfilters.trackers.people.silhouettes import body_of, observed_place
from jaxfilters.trackers.people.state import (
    BIAS,
    HEIGHT,
    PLACE,
    STATE,
    TRACKED,
    WIDTH,
    CameraFrame,
    People,
    PeopleConfig,
    PeopleScene,
    Report,
    chosen,
    nobody,
)

NO_DEPTH = 0.05
"""Standard deviation along the line of sight, in distances from the camera, from which on depth is not measured: the
pair of a desk that hides the feet and a border that hides the head gives as much, either alone gives less."""
CLEAR = 0.5
"""Share of the silhouette from which on clothes are looked at."""
HEIGHT_DRIFT, WIDTH_DRIFT = 0.01, 0.05
"""Metres per root second: posture; arms, stride and which side is visible."""
WHOLE = 0.95
"""Share of the silhouette from which on a person's height is measured: who touches another person (0.9) is taken to be
too tall or too short, and height decides the distance of people far away."""
MOST_CROWDING = 0.33
"""Share of the surroundings of a silhouette that may be foreground which no other person explains, for height and width
to be measured: 95 % of the people who stand alone in the synthetic room have less. Otherwise two people of a group
explain the foreground of a third as their own width, and a reflection below the feet as their height."""
_LEAST_HEIGHT_M = 0.5
LEAST_DT_S = 1e-3


def people_scene(
    cameras: Sequence[FloorCamera],
    floor: ArrayLike | Sequence,
    *,
    furniture: Sequence[ArrayLike] | None = None,
    config: PeopleConfig | None = None,
) -> PeopleScene:
    """What the tracker knows of a place.

    Args:
        cameras: In the order in which their images will come.
        floor: (corners, 2) polygon in which people can walk, metres.
        furniture: A depth image a camera (`models.person.scene`), metres, `inf` where nothing stands; none by default.
        config: Constants.

    Raises:
        ValueError: shapes that do not fit, no camera, a polygon without area, or a floor that no camera sees.
    """
    config = config or PeopleConfig()
    corners = np.asarray(floor, float)
    if not cameras:
        raise ValueError("cameras: at least one is needed.")
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.all(np.isfinite(corners)):
        raise ValueError(f"floor must be a polygon of at least 3 finite corners (n, 2); got shape {corners.shape}.")
    x, y = corners.T
    if abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) < 1e-6:
        raise ValueError("floor: its corners enclose no area, so nobody can walk anywhere.")
    depths = [jnp.full(camera.shape, jnp.inf) for camera in cameras] if furniture is None else list(furniture)
    if [np.shape(depth) for depth in depths] != [camera.shape for camera in cameras]:
        raise ValueError(
            f"furniture must be one depth image a camera, {[camera.shape for camera in cameras]}; "
            f"got {[np.shape(depth) for depth in depths]}."
        )
    images = tuple(jnp.asarray(depth, jnp.float32) for depth in depths)
    cells = padded(cells_of(tuple(cameras), images, corners, config))
    return PeopleScene(tuple(cameras), images, from_host(corners, jnp.float32), cells, config)


def start(scene: PeopleScene) -> People:
    """The state before the first frame."""
    return nobody(scene.config, len(scene.cameras))


@compiled_fully
def step(
    scene: PeopleScene, people: People, frames: tuple[CameraFrame, ...], dt: Float[ArrayLike, ""]
) -> tuple[People, Report]:
    """One time further: everybody predicted, searched for together, corrected, and new people added.

    Args:
        scene: What is known of the place.
        people: State after the last time.
        frames: What the cameras deliver, in their order.
        dt: Seconds since the last time; a negative value counts as 0.
    """
    dt = jnp.maximum(jnp.asarray(dt, float), 0.0)
    people = lifecycle.after_gap(scene.config, people, dt)
    active = lifecycle.is_active(people.mode)
    F, Q = motion(scene.config, dt)
    predicted = chosen(active, jax.vmap(joseph.predict, in_axes=(0, None, None))(people.belief, F, Q), people.belief)
    tracked = people.mode == TRACKED
    log_weights = detectability.predicted(people.detectability, dt, tracked)
    fit = fit_people(scene, predicted, people.shift, log_weights, active, lifecycle.seniority(people), frames)
    belief, nis, innovations = updated(scene, predicted, fit, dt)
    people = people._replace(
        belief=chosen(active, belief, people.belief),
        shift=fit.shift,
        detectability=detectability.updated(log_weights, fit.detection_evidence, tracked),
    )
    looked = jnp.any(jnp.stack([jnp.asarray(frame.present) for frame in frames]))
    people = lifecycle.existence(scene, people, fit, dt, looked)
    places = jnp.concatenate([_observed_places(scene, people), fit.stride], axis=1)
    active = lifecycle.is_active(people.mode)
    histograms, good = appearances(scene, places, active, frames)
    good &= fit.share_seen > CLEAR
    people = identity_switch_correction(people, histograms, good, dt)
    people = lifecycle.named(lifecycle.with_appearances(people, histograms, good))
    people = lifecycle.confirm(scene, people, birth(scene, places, active, frames))
    return people, _report(scene, people, fit, nis, innovations)


@compiled_fully
def outlines(scene: PeopleScene, people: People) -> tuple[Outline, ...]:
    """The outlines of everybody in each camera, one row a slot."""
    bodies = jax.vmap(body_of)(_observed_places(scene, people))
    return tuple(jax.vmap(outline, in_axes=(None, 0))(camera.P, bodies) for camera in scene.cameras)


def _observed_places(scene: PeopleScene, people: People) -> Array:
    return jax.vmap(observed_place, in_axes=(None, 0))(scene, people.belief.mean)


def _report(scene: PeopleScene, people: People, fit: Fit, nis: Array, innovations: Array) -> Report:
    covariance = people.belief.covariance[:, :2, :2]
    sight = fit.axes[:, 0, :2]
    radial = jnp.sqrt(jnp.maximum(einsum("ki,kij,kj->k", sight, covariance, sight), 0.0))
    return Report(
        people.identity,
        people.mode,
        people.belief.mean[:, :2],
        radial,
        people.belief.mean[:, HEIGHT],
        fit.score,
        fit.share_seen,
        fit.flatness,
        radial < NO_DEPTH * _distance(scene, people.belief.mean[:, :2]),
        nis,
        innovations,
    )


def _distance(scene: PeopleScene, xy: Array) -> Array:
    """From whichever camera is nearest, on the floor."""
    return jnp.min(jnp.linalg.norm(xy[:, None] - scene.centers(), axis=-1), axis=1)


def motion(config: PeopleConfig, dt: Float[Array, ""]) -> tuple[Float[Array, "9 9"], Float[Array, "9 9"]]:
    """Transition matrix and noise covariance of `dt` seconds.

    Y. Bar-Shalom et al., "Estimation with applications to tracking and navigation", 2001, section 6.2.2.
    """
    walk = constant_velocity(config.acceleration_sd**2, dims=2).discretize(dt)
    remains = jnp.exp(-dt / config.silhouette_bias_s)
    bias = jnp.zeros(STATE).at[BIAS].set(1.0)
    F = jnp.diag(1 - bias + remains * bias).at[:4, :4].set(walk.F)
    Q = jnp.diag((1 - remains**2) * bias).at[:4, :4].set(walk.Q)
    return F, Q.at[HEIGHT, HEIGHT].set(HEIGHT_DRIFT**2 * dt).at[WIDTH, WIDTH].set(WIDTH_DRIFT**2 * dt)


def updated(
    scene: PeopleScene, predicted: Gaussian, fit: Fit, dt: Float[Array, ""]
) -> tuple[Gaussian, Float[Array, " slots"], Int32[Array, "slots 2"]]:
    """Beliefs after the readings in turn, their mean normalised innovation squared, and `innovation_counts`.

    Args:
        scene: Cameras and constants.
        predicted: Beliefs of all slots.
        fit: What the images say.
        dt: Seconds since the frame before.
    """
    # What disagrees stays for seconds: as noise, it must be worth one look in two of its time constants.
    frames = 2 * scene.config.silhouette_bias_s / jnp.clip(dt, LEAST_DT_S, 2 * scene.config.silhouette_bias_s)
    readings = as_measurement(fit, scene.config.silhouette_sd_m)
    belief, nis = predicted, jnp.zeros(len(fit.score))
    innovations = jnp.zeros((len(fit.score), 2), jnp.int32)
    whole = jnp.any((fit.shares_seen > WHOLE) & (fit.crowding < MOST_CROWDING), axis=-1)
    for i in range(readings.y.shape[1]):
        mine = jax.tree.map(lambda leaf, i=i: leaf[:, i], readings)
        one = jax.vmap(lambda b, r, w, i=i: _of_one(scene, i, b, r, w, frames))
        belief, one_nis, counts = one(belief, mine, whole)
        nis += one_nis
        innovations += counts
    return belief, nis / jnp.maximum(jnp.sum(jnp.any(readings.observed, axis=-1), axis=-1), 1), innovations


def _of_one(scene, camera, belief, reading, whole, frames):
    in_state = jnp.eye(STATE)[jnp.array(PLACE)]
    H = dot(reading.H, in_state).at[:, BIAS].set(dot(reading.H, bias_factor(scene, belief.mean)))
    R = reading.R
    if camera:
        height = jnp.maximum(belief.mean[HEIGHT], _LEAST_HEIGHT_M)
        by_shift = displacement_by_shift(scene.cameras[camera], belief.mean[:2], height)
        loading = dot(shift_sd(scene)[camera] * reading.H[:, :3], by_shift)
        R += dot(frames * loading, loading.T)
    after, info = joseph.update(belief, reading.y, H, R, mask=reading.observed)
    size = (jnp.arange(STATE) == HEIGHT) | (jnp.arange(STATE) == WIDTH)
    after = jax.tree.map(lambda a, b: jnp.where(whole, a, b), after, consider(belief, after, size))
    return after, info.nis, innovation_counts(info)
