"""The scene of the published tracker, and what the paper leaves open: occlusion, who is in view, which pixels count.

Section numbers are those of Kato, Nakazawa, Inokuchi, "Realtime human tracking using ellipsoid model", 1999.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.ellipsoid import (
    INSIDE,
    VISIBLE,
    Ellipsoid,
    ellipse_of,
    near_depth,
    outline,
    pixel_grid,
)
from jaxfilters.models.person.scene import patch_depth, patch_floor_distance
from jaxfilters.models.person.score import RING

STEP_HALVING = (0.05, 0.05, 0.025, 0.025, 0.0125, 0.0125)
"""Steps in metres that end finer than the paper's."""


class Occlusion(NamedTuple):
    """What hides people: how obstacles are measured, and where a body is before them."""

    of_patches: Callable[[FloorCamera, Array], Array]
    """`(camera, patches (n, 3, 3)) -> (rows, cols)`."""
    is_in_front: Callable[[FloorCamera, Ellipsoid, Array], Array]
    """`(camera, body, obstacles (rows, cols)) -> (rows, cols)` bool."""


def _axis_is_nearer(camera: FloorCamera, body: Ellipsoid, obstacles: Array) -> Array:
    return jnp.linalg.norm(body.center[:2] - camera.position()[:2]) < obstacles


def _surface_is_nearer(camera: FloorCamera, body: Ellipsoid, obstacles: Array) -> Array:
    return near_depth(camera.P, body, pixel_grid(camera.shape)) < obstacles


FLOOR_AXIS = Occlusion(patch_floor_distance, _axis_is_nearer)
"""The paper's: distances on the floor, and one of each person, that of the axis (section 3.3)."""
PER_PIXEL = Occlusion(patch_depth, _surface_is_nearer)
"""Depths of the surfaces, pixel by pixel."""


def endpoints_in_view(camera: FloorCamera, body: Ellipsoid) -> Bool[Array, ""]:
    """Whether the image shows the top or the foot of the ellipsoid: the paper's test."""
    up = jnp.array([0.0, 0.0, 1.0]) * body.semi_axes
    uv, depth = camera.project(jnp.stack([body.center - up, body.center + up]))
    rows, cols = camera.shape
    inside = jnp.all((uv >= -0.5) & (uv <= jnp.array([cols, rows]) - 0.5), axis=-1)
    return jnp.any(inside & (depth > 0))


def box_in_view(camera: FloorCamera, body: Ellipsoid) -> Bool[Array, ""]:
    """Whether the box around the outline meets the image; a camera inside the body sees it."""
    contour = outline(camera.P, body)
    box = ellipse_of(contour).box
    limit = jnp.array([camera.shape[1], camera.shape[0]]) - 0.5
    meets = jnp.all(box[:2] <= limit) & jnp.all(box[2:] >= -0.5)
    return jnp.where(contour.code == VISIBLE, meets, contour.code == INSIDE)


def whole_image(camera: FloorCamera, bodies: Ellipsoid, ring: int) -> Bool[Array, "rows cols"]:
    """All pixels count: [5]."""
    del bodies, ring
    return jnp.ones(camera.shape, bool)


def around_candidates(camera: FloorCamera, bodies: Ellipsoid, ring: int) -> Bool[Array, "rows cols"]:
    """Pixels in the box of all candidates and the ring around it count, so that people far away change nothing."""
    boxes = jax.vmap(lambda body: ellipse_of(outline(camera.P, body)).box)(bodies)
    uv = pixel_grid(camera.shape)
    low, high = jnp.min(boxes[:, :2], axis=0) - ring, jnp.max(boxes[:, 2:], axis=0) + ring
    return jnp.all((uv >= low) & (uv <= high), axis=-1)


def passes_outside(turn: Array, passes: int, people: Array) -> tuple[Array, Array]:
    """(pass, person) of a turn: everybody moves once, then everybody again."""
    del passes
    return turn // people, turn % people


def people_outside(turn: Array, passes: int, people: Array) -> tuple[Array, Array]:
    """(pass, person) of a turn: all passes of one person, then those of the next."""
    del people
    return turn % passes, turn // passes


@dataclass(frozen=True)
class PaperConfig:
    """Constants and choices; Python values that are read when the tracker is built.

    Raises:
        ValueError: naming the field, what was expected and what came.
    """

    capacity: int = 8
    """People at a time."""
    steps_m: tuple[float, ...] = (0.05, 0.05, 0.05)
    """Between the nine candidates, one entry a pass; `STEP_HALVING` is finer."""
    ring_px: int = RING
    """Pixels around a silhouette that count against it."""
    acquired: float = 0.7
    """Binary score above which a person counts as found."""
    lost: float = 0.3
    """Score below which a person is not visible."""
    lost_frames: int = 10
    """Frames in turn, after which a person who is not visible is lost."""
    occlusion: Occlusion = FLOOR_AXIS
    """What hides people: `FLOOR_AXIS` or `PER_PIXEL`."""
    in_view: Callable[[FloorCamera, Ellipsoid], Array] = endpoints_in_view
    """Who is visible: `endpoints_in_view` or `box_in_view`."""
    region: Callable[[FloorCamera, Ellipsoid, int], Array] = whole_image
    """Which pixels count in the score of nine candidates: `whole_image` or `around_candidates`."""
    turns: Callable[[Array, int, Array], tuple[Array, Array]] = passes_outside
    """Whose turn it is: `passes_outside` or `people_outside`."""

    def __post_init__(self) -> None:
        for name in ("capacity", "lost_frames"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be a positive integer; got {value!r}.")
        if not isinstance(self.ring_px, int) or self.ring_px < 0:
            raise ValueError(f"ring_px must be 0 or more pixels; got {self.ring_px!r}.")
        if not self.steps_m or not all(0 < step < np.inf for step in self.steps_m):
            raise ValueError(f"steps_m must be one or more positive lengths in metres; got {self.steps_m!r}.")
        if not -1 <= self.lost < self.acquired <= 1:
            raise ValueError(
                f"lost and acquired must be scores, -1 <= lost < acquired <= 1; got {self.lost!r}, {self.acquired!r}."
            )


@pytree_dataclass
class PaperScene:
    """What the tracker knows of a place; `paper_scene` makes checked ones."""

    camera: FloorCamera
    obstacles: Float[Array, "rows cols"]
    """As `config.occlusion` measures them, metres; `inf` where nothing is."""
    floor: Float[Array, "corners 2"]
    """Polygon in which people can walk, metres."""
    config: PaperConfig = field(metadata=dict(static=True))


def paper_scene(
    camera: FloorCamera,
    floor: ArrayLike | Sequence,
    *,
    patches: ArrayLike | Sequence | None = None,
    config: PaperConfig | None = None,
) -> PaperScene:
    """What the tracker knows of a place.

    Args:
        camera: Who looks.
        floor: (corners, 2) polygon in which people can walk, metres.
        patches: (n, 3, 3) parallelograms that hide people, a corner and two edges each, metres; none by default.
        config: Constants and choices.

    Raises:
        ValueError: arrays of a wrong shape, or that are not finite.
    """
    config = config or PaperConfig()
    corners = np.asarray(floor, float)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.all(np.isfinite(corners)):
        raise ValueError(f"floor must be a polygon of at least 3 finite corners (n, 2); got shape {corners.shape}.")
    rectangles = np.zeros((0, 3, 3)) if patches is None else np.asarray(patches, float)
    if rectangles.ndim != 3 or rectangles.shape[1:] != (3, 3) or not np.all(np.isfinite(rectangles)):
        raise ValueError(f"patches must be finite, a corner and two edges each (n, 3, 3); got {rectangles.shape}.")
    obstacles = config.occlusion.of_patches(camera, jnp.asarray(rectangles, float))
    return PaperScene(camera, obstacles, jnp.asarray(corners, float), config)
