"""Errors of silhouettes that last for seconds: how feet, head and sides that are all a little off move a person.

Shapes that are not the model's (clothes, shoes, stride, thresholds, calibration) are off by nearly the same amount from
frame to frame, so that many frames tell no more of them than one. They are a Gauss-Markov process in the state of each
person (A. Bryson, L. Henrikson, "Estimation using sampled data containing sequentially correlated noise", 1968):
normalised coordinates b with unit variance when nothing is known, and the covariance of the displacement L b that
follows from the geometry of the cameras.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._full_precision import dot
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.people.state import BIAS, HEIGHT, NUM_BIASES, PeopleScene

_MOST_BIAS_M = 1.0
"""Prior standard deviation of every coordinate of the displacement, which no camera can exceed."""


def pixel_m(camera: FloorCamera, xy: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
    """Metres that one pixel spans at the middle of people at places (X, Y); `inf` behind the camera."""
    first, second, third = camera.P[:, :3]
    focal = jnp.sqrt(jnp.linalg.norm(jnp.cross(first, third)) * jnp.linalg.norm(jnp.cross(second, third)))
    depth = camera.project(jnp.insert(xy, 2, 1.0, axis=-1))[1]
    return jnp.where(depth > 0, depth, jnp.inf) / focal


def edge_covariance(
    scene: PeopleScene,
    xy: Float[Array, " 2"],
    height: Float[Array, ""],
    edges_px: Sequence[float],
    information: Float[Array, "3 3"],
) -> Float[Array, "3 3"]:
    """Covariance of X, Y and height by errors of the edges of a silhouette, square metres.

    Every camera that has the middle of the person in its image measures the sides, the feet and the head, each at right
    angles to its line of sight and off by `silhouette_bias_m` and by some pixels. A foot that is off by s moves the
    person by s / sin(a) along a line of sight that falls by the angle a. The information of all cameras adds up.

    Args:
        scene: Cameras and constants.
        xy: Where the person stands, metres.
        height: Metres.
        edges_px: By how many pixels edges are off in each camera, one standard deviation.
        information: What is known of X, Y and height without the silhouette, inverse square metres.
    """
    height = jnp.maximum(height, 0.5)
    sees = jnp.stack([_has_middle(camera, xy, height) for camera in scene.cameras])
    sees = jnp.where(jnp.any(sees), sees, True)
    for camera, counts, edge_px in zip(scene.cameras, sees, edges_px, strict=True):
        jacobian = _silhouette_jacobian(camera.position(), xy, height)
        spread = edge_px * jnp.where(counts, pixel_m(camera, xy), 0.0)
        variance = scene.config.silhouette_bias_m**2 + spread**2
        information += dot(counts * jacobian.T, jacobian) / variance
    return jnp.linalg.inv(information)


def bias_factor(scene: PeopleScene, mean: Float[Array, " state"]) -> Float[Array, "4 biases"]:
    """The matrix L of the displacement of X, Y, height and width by the normalised biases, metres.

    Args:
        scene: Cameras and constants.
        mean: Of a state.
    """
    edges_px = [scene.config.silhouette_bias_px] * len(scene.cameras)
    information = jnp.eye(NUM_BIASES) / _MOST_BIAS_M**2
    covariance = edge_covariance(scene, mean[:2], mean[HEIGHT], edges_px, information)
    return jnp.pad(jnp.linalg.cholesky(covariance), ((0, 1), (0, 0)))


def displacement(scene: PeopleScene, mean: Float[Array, " state"]) -> Float[Array, " 4"]:
    """By how much X, Y, height and width of the silhouette are believed to differ from those of the person, metres."""
    return dot(bias_factor(scene, mean), mean[BIAS])


def _has_middle(camera, xy, height):
    (u, v), depth = camera.project(jnp.append(xy, height / 2))
    rows, cols = camera.shape
    return (depth > 0) & (u >= 0) & (u < cols) & (v >= 0) & (v < rows)


def _silhouette_jacobian(center, xy, height):
    """Rows: sides, feet and head at right angles to the line of sight, by X, Y and height."""
    away = xy - center[:2]
    distance = jnp.maximum(jnp.linalg.norm(away), 0.1)
    x, y = away / distance
    feet, head = jnp.arctan2(center[2], distance), jnp.arctan2(center[2] - height, distance)
    return jnp.array(
        [
            [y, -x, 0.0],
            [x * jnp.sin(feet), y * jnp.sin(feet), 0.0],
            [x * jnp.sin(head), y * jnp.sin(head), jnp.cos(head)],
        ]
    )
