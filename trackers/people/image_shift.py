"""Disagreement of cameras about one person: a shift of the silhouette in the image of each further camera.

Every calibration is a little wrong, in a way that changes over the image and with distance: surveyed points, lens,
principal point. Two cameras then put the same feet in two places, and a search that takes both for exact finds a third:
nearer and taller, with a second person in what remains. Here the first camera defines the floor, and in each further
one every person has a shift of the image with a normal prior, over which the likelihood is maximised together with the
place (a profile likelihood); the covariance of readings holds what that leaves open (a considered nuisance).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._full_precision import dot
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person import foreground
from jaxfilters.trackers.people.silhouette_bias import pixel_m
from jaxfilters.trackers.people.silhouettes import View, log_likelihoods
from jaxfilters.trackers.people.state import PeopleScene

STEP = 1 / 3
"""Of the search, in standard deviations."""
_RIDGE = 1e-6


def has_shifts(scene: PeopleScene) -> bool:
    """Whether there is a further camera, and it may be wrong."""
    return len(scene.cameras) > 1 and scene.config.calibration_error > 0


def shift_sd(scene: PeopleScene) -> Float[Array, " cameras"]:
    """Prior standard deviation of the shifts of each camera, pixels; the first has none."""
    return jnp.array([0.0] + [scene.config.calibration_error * camera.shape[1] for camera in scene.cameras[1:]])


def shifted(views: View, shift: Float[Array, "cameras 2"]) -> View:
    """Windows of one person whose pixels (u, v) are where a camera without a shift would have them."""
    window = views.window
    return views._replace(window=window._replace(uv=window.uv - shift[:, None]))


def weighted(scene: PeopleScene, place: Float[Array, " 4"], views: View) -> View:
    """Windows of one person, each weighted by how well its camera is calibrated, the best that shows any of it by one.

    Errors that last are independent of the number of pixels. A log likelihood counts in the proportion in which the
    variance of an edge from shapes and lenses grows by that of the shift (a power likelihood; N. Friel and A. Pettitt,
    2008), square metres at the person.
    """
    config = scene.config
    size = jnp.stack([pixel_m(camera, place[:2]) for camera in scene.cameras])
    size = jnp.where(jnp.isfinite(size), size, 1.0)
    silhouette = config.silhouette_bias_m**2 + (config.silhouette_bias_px * size) ** 2
    weight = silhouette / (silhouette + (shift_sd(scene) * size) ** 2)
    best = jnp.max(jnp.where(jnp.any(views.visible > 0, axis=-1), weight, 0.0))
    return views._replace(area=views.area * jnp.where(best > 0, best, 1.0) / weight)


def best_shift(
    scene: PeopleScene,
    place: Float[Array, " shape"],
    views: View,
    contrasts: Float[Array, "cameras samples"],
    shift: Float[Array, "cameras 2"],
) -> Float[Array, "cameras 2"]:
    """The shift among neighbours of one that makes likelihood times prior largest, in each camera that shows anything.

    Args:
        scene: Cameras and constants.
        place: Of the person.
        views: Their windows, without a shift.
        contrasts: What candidates are compared with.
        shift: Pixels (u, v).
    """
    sd = shift_sd(scene)[:, None]
    candidates = shift + STEP * sd * foreground.lattice(2)[:, None]
    values = jax.vmap(lambda one: log_likelihoods(scene, place, shifted(views, one), contrasts))(candidates)
    values -= jnp.sum((candidates / jnp.maximum(sd, 1e-6)) ** 2, axis=-1) / 2
    best = jnp.take_along_axis(candidates, jnp.argmax(values, axis=0)[None, :, None], axis=0)[0]
    return jnp.where(jnp.any(views.visible > 0, axis=-1)[:, None], best, shift)


def displacement_by_shift(camera: FloorCamera, xy: Float[Array, " 2"], height: Float[Array, ""]) -> Float[Array, "3 2"]:
    """By how much X, Y and height of a silhouette change with a shift of the image, metres per pixel.

    The displacement is the one of the person that moves feet and head as the shift does; least squares, as these are
    four numbers.
    """

    def ends(place):
        return camera.project(jnp.stack([jnp.append(place[:2], 0.0), place]))[0].ravel()

    by_place = jax.jacfwd(ends)(jnp.append(xy, height))
    normal = dot(by_place.T, by_place)
    ridge = _RIDGE * jnp.trace(normal) * jnp.eye(3)
    return jnp.linalg.solve(normal + ridge, dot(by_place.T, jnp.tile(jnp.eye(2), (2, 1))))
