"""What a modelled person wears: glasses with a rim, and a reflection that moves over their lenses as the head turns.

Glasses cover brows and corners of eyes with edges that are not skin, and stay where they are when the face moves.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.face.pose import rotation, turn
from jaxfilters.models.synthetic.ict_face import IctModel, IctPerson
from jaxfilters.typing import AnyKey

LIDS = (tuple(range(36, 42)), tuple(range(42, 48)))
"""Of the right and the left eye, in iBUG's order."""
BEFORE_EYES_MM, TEMPLE_MM, OUTWARD_MM = 14.0, 95.0, 24.0
"""From the lids to the lenses, and from the lenses to the ears, backwards and to the side."""
LENS_RADIUS_MM = 90.0
"""Of the sphere that the front of a lens is part of."""
WINDOW = (-0.35, -0.25, -0.9)
"""Direction from the head to what lenses reflect, in the world; of any length but 0."""
REFLECTION_MM = 4.5
"""Half the side of a reflection."""
_RIM_POINTS = 28
_REFLECTION_FACES = np.array([(0, 2, 1), (1, 2, 3)])
_CORNERS = np.array([(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)])


@pytree_dataclass
class Glasses:
    """One pair, rigid with the head: two rims, a bridge, two temples."""

    points: Float[Array, "points 3"]
    """Millimetres in the model frame."""
    faces: Int[Array, "F 3"]
    """Triangles, wound counter-clockwise from outside."""
    lenses: Float[Array, "2 3"]
    """Middles of the right and the left lens."""
    semi: Float[Array, " 2"]
    """Half the width and half the height of a lens, millimetres."""


class _Tube(NamedTuple):
    points: np.ndarray
    faces: np.ndarray


def make_glasses(key: AnyKey, model: IctModel, person: IctPerson) -> Glasses:
    """Random glasses before the eyes of a person: lenses of 44 to 54 times 28 to 40 mm, rims of 1.5 to 4 mm."""
    draw = np.random.default_rng(np.asarray(jax.random.bits(key, (4,))))
    landmarks = np.asarray(person.neutral, float)[np.asarray(model.landmarks)]
    eyes = np.stack([landmarks[list(lids)].mean(axis=0) for lids in LIDS])
    semi = np.array([draw.uniform(22, 27), draw.uniform(14, 20)])
    # Lenses must leave room for the nose.
    semi[0] = min(semi[0], 0.5 * (eyes[1, 0] - eyes[0, 0]) - 6)
    thick, power = draw.uniform(1.5, 4.0), draw.uniform(2.0, 4.0)
    lenses = eyes + np.array([0.0, draw.uniform(0, 4), -BEFORE_EYES_MM])
    lenses[:, 2] = lenses[:, 2].min()
    tubes = [_rim(lens, semi, thick, power) for lens in lenses]
    edge = np.array([[semi[0], -0.35 * semi[1], 0], [-semi[0], -0.35 * semi[1], 0]])
    inner, outer = lenses + edge, lenses + edge[::-1]
    tubes.append(_bar(inner[0], inner[1], thick))
    for end, side in zip(outer, (-1, 1), strict=True):
        tubes.append(_bar(end, end + np.array([side * OUTWARD_MM, 0.0, TEMPLE_MM]), thick))
    starts = np.cumsum([0] + [len(tube.points) for tube in tubes[:-1]])
    faces = np.concatenate([start + tube.faces for start, tube in zip(starts, tubes, strict=True)])
    points = np.concatenate([tube.points for tube in tubes])
    as_float = lambda array: jnp.asarray(array, float)
    return Glasses(as_float(points), jnp.asarray(faces, jnp.int32), as_float(lenses), as_float(semi))


def reflections(glasses: Glasses, pose: Float[Array, " 6"]) -> Float[Array, "8 3"]:
    """Corners of a square of light on either lens, model frame; within the head where a lens does not show it.

    A lens shows it where its normal halves the angle between the directions to the camera and to `WINDOW`.

    Args:
        glasses: Of the head.
        pose: Of the head, millimetres and radians.
    """
    unit = lambda v: v / jnp.sqrt(jnp.sum(jnp.square(v)))
    half = unit(unit(jnp.asarray(WINDOW, float)) - unit(pose[:3]))
    normal = turn(half[None], rotation(pose[3:]).T)[0]
    place = LENS_RADIUS_MM * normal[:2]
    is_shown = jnp.all(jnp.abs(place) < glasses.semi - REFLECTION_MM) & (normal[2] < 0)
    corners = jnp.where(is_shown, place, 0.0) + REFLECTION_MM * jnp.asarray(_CORNERS, float)
    depth = jnp.where(is_shown, -1.0, 3 * BEFORE_EYES_MM)
    on_lens = jnp.concatenate([corners, jnp.full((4, 1), depth)], axis=1)
    return (glasses.lenses[:, None] + on_lens).reshape(-1, 3)


def reflection_faces() -> np.ndarray:
    """(4, 3) triangles of the corners of both reflections."""
    return np.concatenate([_REFLECTION_FACES, 4 + _REFLECTION_FACES])


def _rim(lens: np.ndarray, semi: np.ndarray, thick: float, power: float) -> _Tube:
    """A closed tube along a superellipse."""
    angle = np.linspace(0, 2 * np.pi, _RIM_POINTS, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    flat = semi * np.sign(around) * np.abs(around) ** (2 / power)
    outward = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    fill = np.zeros((_RIM_POINTS, 1))
    across = thick / 2 * np.concatenate([outward, fill], axis=1)
    return _tube(lens + np.concatenate([flat, fill], axis=1), across, np.array([0, 0, thick / 2]), closed=True)


def _bar(start: np.ndarray, end: np.ndarray, thick: float) -> _Tube:
    """A straight tube, a little higher than wide."""
    along = (end - start) / np.linalg.norm(end - start)
    up = np.array([0.0, 1.0, 0.0])
    return _tube(np.stack([start, end]), 0.7 * thick * up, thick / 2 * np.cross(along, up), closed=False)


def _tube(path: np.ndarray, across: np.ndarray, deep: np.ndarray, *, closed: bool) -> _Tube:
    """Four-sided, with half its sides given along the path."""
    across, deep = np.broadcast_to(across, path.shape), np.broadcast_to(deep, path.shape)
    points = np.stack([path + across + deep, path - across + deep, path - across - deep, path + across - deep], axis=1)
    n = len(path)
    here = np.arange(n if closed else n - 1)
    there, side = (here + 1) % n, np.arange(4)
    a, b = 4 * here[:, None] + side, 4 * here[:, None] + (side + 1) % 4
    c, d = 4 * there[:, None] + (side + 1) % 4, 4 * there[:, None] + side
    faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    flat = points.reshape(-1, 3)
    corners = flat[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = np.repeat((path[here] + path[there]) / 2, 4, axis=0)
    inward = np.sum(normal * (corners.mean(axis=1) - np.tile(middle, (2, 1))), axis=1) < 0
    return _Tube(flat, np.where(inward[:, None], faces[:, ::-1], faces))
