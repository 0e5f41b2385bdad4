"""What each camera says of a person at a place: a window of the image, less what others explain."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import dot
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person import foreground
from jaxfilters.models.person.ellipsoid import (
    INSIDE,
    VISIBLE,
    Ellipsoid,
    Outline,
    ellipse_of,
    near_depth,
    outline,
    standing,
)
from jaxfilters.models.person.foreground import Window, contrast, log_likelihood_ratio, presence
from jaxfilters.trackers.people.silhouette_bias import displacement
from jaxfilters.trackers.people.state import PLACE, STRIDE, CameraFrame, PeopleConfig, PeopleScene

MARGIN = 0.3
"""Of the window beyond the farthest candidates, in its size: what is cut off would seem to speak for nobody."""
OVERLAP = 2.5
"""Sizes of an outline beyond which a body makes hardly any pixel foreground: one in a thousand."""
LEAST_SIZE_M = 0.1
AROUND = 0.15
"""How far the surroundings of a silhouette reach, in half heights of its outline."""


class View(NamedTuple):
    """One person's window in one camera; in `views` one row a camera."""

    window: Window
    foreground: Float[Array, " samples"]
    """Probability."""
    depth: Float[Array, " samples"]
    """Of furniture, metres."""
    visible: Float[Array, " samples"]
    """1 where the person would be visible in the image and before the furniture, else 0."""
    area: Float[Array, ""]
    """Over which the log likelihood is averaged: of the predicted outline, square pixels; more where it counts less."""


def place_of(mean: Float[Array, "*slots 9"]) -> Float[Array, "*slots 4"]:
    """X, Y, height and width of a state, metres."""
    return mean[..., jnp.array(PLACE)]


def observed_place(scene: PeopleScene, mean: Float[Array, " 9"]) -> Float[Array, " 4"]:
    """X, Y, height and width of the silhouette of a state: `place_of` displaced by its biases."""
    return place_of(mean) + displacement(scene, mean)


def body_of(place: Float[Array, "*batch shape"]) -> Ellipsoid:
    """The ellipsoid of X, Y, height and width, whatever follows; of a size that an outline can be had of."""
    return standing(place[..., :2], *(jnp.maximum(place[..., i], LEAST_SIZE_M) for i in (2, 3)))


def presence_of(
    config: PeopleConfig,
    P: Float[Array, "3 4"],
    place: Float[Array, " shape"],
    uv: Float[Array, "*pixels 2"],
    margin_px: Float[ArrayLike, ""] = 0.0,
) -> Float[Array, "*pixels"]:
    """`presence` of X, Y, height, width and, if it is known, the stride, in the camera of a projection matrix.

    Args:
        config: Constants.
        P: Projection matrix in canonical scale.
        place: Metres.
        uv: Pixels.
        margin_px: By which the silhouette is enlarged on all sides.
    """
    height, width = (jnp.maximum(place[i], LEAST_SIZE_M) for i in (2, 3))
    stride = place[STRIDE] if len(place) > STRIDE.start else None
    return presence(P, place[:2], height, width, uv, config.spread_px + margin_px, stride)


def line_of_sight(scene: PeopleScene, xy: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Rows: unit vectors on the floor away from whichever camera is nearest, and at right angles."""
    centers = scene.centers()
    away = xy - centers[jnp.argmin(jnp.sum((xy - centers) ** 2, axis=-1))]
    distance = jnp.linalg.norm(away)
    # Straight below the camera any direction is as good.
    x, y = jnp.where(distance > 0.1, away / jnp.maximum(distance, 0.1), jnp.array([0.0, 1.0]))
    return jnp.stack([jnp.stack([x, y]), jnp.stack([y, -x])])


def view_of(
    config: PeopleConfig,
    camera: FloorCamera,
    furniture: Float[Array, "rows cols"],
    frame: CameraFrame,
    place: Float[Array, " 4"],
    axes: Float[Array, "4 4"],
    reach: Float[Array, " 2"],
) -> View:
    """The window in which a person is searched for: as far as `reach` along the first two `axes`, and a margin."""
    corners = jnp.array([[i, j, 0.0, 0.0] for i in (-1, 1) for j in (-1, 1)]) * jnp.append(reach, jnp.zeros(2))
    bodies = jax.vmap(body_of)(place + dot(corners, axes))
    contour = jax.vmap(outline, in_axes=(None, 0))(camera.P, bodies)
    boxes = jax.vmap(lambda one: ellipse_of(one).box)(contour)
    box = jnp.concatenate([jnp.min(boxes[:, :2], axis=0), jnp.max(boxes[:, 2:], axis=0)])
    margin = MARGIN * (box[2:] - box[:2]) + 1
    shown = frame.present & jnp.all(contour.code == VISIBLE)
    box = jnp.where(shown, box + jnp.concatenate([-margin, margin]), jnp.array([0.0, 0.0, 1.0, 1.0]))
    window = foreground.window(box, camera.shape, config.grid)
    probability = jnp.asarray(frame.foreground).ravel()[window.pixel].astype(float) / 255
    depth = furniture.ravel()[window.pixel]
    body = body_of(place)
    visible = window.inside * shown * (near_depth(camera.P, body, window.uv) < depth)
    return View(window, probability, depth, visible, area_of(outline(camera.P, body)))


def views_of(
    scene: PeopleScene,
    frames: tuple[CameraFrame, ...],
    place: Float[Array, " 4"],
    axes: Float[Array, "4 4"],
    reach: Float[Array, " 2"],
) -> View:
    """The windows of a person in all cameras, one row a camera."""
    views = [
        view_of(scene.config, camera, furniture, frame, place, axes, reach)
        for camera, furniture, frame in zip(scene.cameras, scene.furniture, frames, strict=True)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *views)


def area_of(contour: Outline) -> Float[Array, ""]:
    """Of an outline, square pixels; one at least."""
    (a, b), (_, c) = contour.shape
    return jnp.pi * jnp.sqrt(jnp.maximum(a * c - b**2, 1.0))


def overlapping(
    P: Float[Array, "3 4"],
    places: Float[Array, "slots shape"],
    others: Bool[Array, " slots"],
    uv: Float[Array, "samples 2"],
) -> Bool[Array, " slots"]:
    """Which of the others can be present at any pixel of a window in the camera of a projection matrix."""
    contour = jax.vmap(outline, in_axes=(None, 0))(P, jax.vmap(body_of)(places))
    reach = OVERLAP * jnp.sqrt(jnp.diagonal(contour.shape, axis1=-2, axis2=-1))
    low, high = jnp.min(uv, axis=0), jnp.max(uv, axis=0)
    meets = jnp.all((contour.center + reach >= low) & (contour.center - reach <= high), axis=-1)
    return others & ((meets & (contour.code == VISIBLE)) | (contour.code == INSIDE))


def unexplained_of(
    scene: PeopleScene, places: Float[Array, "slots shape"], others: Bool[Array, " slots"], views: View
) -> Float[Array, "cameras samples"]:
    """Probability that neither clutter nor any of the others makes the samples of a window foreground."""

    def in_camera(P, view):
        near = overlapping(P, places, others, view.window.uv)
        order = jnp.argsort(~near)

        def hide(turn, free):
            place = places[order[turn]]
            ahead = outline(P, body_of(place)).depth < view.depth
            return free * (1 - presence_of(scene.config, P, place, view.window.uv) * ahead)

        free = jnp.full(view.foreground.shape, 1 - foreground.CLUTTER)
        return jax.lax.fori_loop(0, jnp.sum(near), hide, free)

    return jax.vmap(in_camera)(scene.projections(), views)


def contrasts_of(views: View, unexplained: Float[Array, "cameras samples"]) -> Float[Array, "cameras samples"]:
    """What candidates are compared with in each camera; 0 where the person would not be visible."""
    return contrast(views.foreground, unexplained) * views.visible


def log_likelihoods(
    scene: PeopleScene, place: Float[Array, " shape"], views: View, contrasts: Float[Array, "cameras samples"]
) -> Float[Array, " cameras"]:
    """Log likelihood of a person at a place over that of nobody, in each camera, as of independent looks."""

    def in_camera(P, view, b):
        ratio = log_likelihood_ratio(presence_of(scene.config, P, place, view.window.uv), b)
        return ratio * view.window.area / view.area

    return scene.config.independent_patches * jax.vmap(in_camera)(scene.projections(), views, contrasts)


def log_likelihood(
    scene: PeopleScene, place: Float[Array, " shape"], views: View, contrasts: Float[Array, "cameras samples"]
) -> Float[Array, ""]:
    """`log_likelihoods` of all cameras together."""
    return jnp.sum(log_likelihoods(scene, place, views, contrasts))


def shares_seen(
    scene: PeopleScene, place: Float[Array, " shape"], views: View, unexplained: Float[Array, "cameras samples"]
) -> Float[Array, " cameras"]:
    """Of the silhouette, how much is in each image and hidden by nobody and nothing."""

    def in_camera(P, view, free):
        mine = presence_of(scene.config, P, place, view.window.uv)
        return jnp.sum(mine * free * view.visible) / jnp.maximum(jnp.sum(mine), 1e-6)

    return jax.vmap(in_camera)(scene.projections(), views, unexplained)


def crowding(
    scene: PeopleScene, place: Float[Array, " shape"], views: View, unexplained: Float[Array, "cameras samples"]
) -> Float[Array, " cameras"]:
    """Share of the surroundings of a silhouette in each camera that is foreground which no other person explains.

    Such foreground is of a person who is not tracked yet, of a shadow or of a reflection.
    """

    def in_camera(P, view, free):
        margin_px = AROUND * jnp.sqrt(outline(P, body_of(place)).shape[1, 1])
        mine = presence_of(scene.config, P, place, view.window.uv)
        around = presence_of(scene.config, P, place, view.window.uv, margin_px) * (1 - mine) * view.visible
        return jnp.sum(around * view.foreground * free) / jnp.maximum(jnp.sum(around), 1.0)

    return jax.vmap(in_camera)(scene.projections(), views, unexplained)
