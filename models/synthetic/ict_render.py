"""Pictures of modelled faces: a textured mesh with eyes, mouth and hair, lit from above, observed by C cameras."""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, UInt8

from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.pose import place, turn
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.rendering.folding import nearest_inverse, winning_pieces
from jaxfilters.models.rendering.geometry import Mesh, mesh_from_trimesh
from jaxfilters.models.rendering.triangles import TRIANGLES, mesh_parts
from jaxfilters.models.rendering.windows import COARSE, plan_windows
from jaxfilters.models.synthetic.face_render import NOISE_STD
from jaxfilters.models.synthetic.ict_face import IctModel, IctPerson, deformed
from jaxfilters.models.synthetic.ict_skin import (
    EYE_FIELD,
    HAIR_FIELD,
    LOW_MM,
    MOUTH_FIELD,
    PIXEL_MM,
    REFLECTION_FIELD,
    RIM_FIELD,
    Skin,
    map_place,
)
from jaxfilters.models.synthetic.ict_worn import LIDS, Glasses, reflection_faces, reflections
from jaxfilters.typing import AnyKey

EYE_RADIUS_MM, EYE_DEPTH_MM = 12.5, 10.6
"""Of the ball, and how far behind the middle of the lids its centre is."""
MOUTH_DEPTH_MM = 7.0
SKULL_HEIGHT_MM, SKULL_DEPTH_MM = 190.0, 95.0
"""Of the hair that closes the head behind the skin."""
LIGHT, AMBIENT, DIRECT = (-0.35, -0.65, -0.68), 0.42, 0.62
"""Direction to the light in the world, and what the surface gets without and from it."""
_INNER_LIPS = tuple(range(60, 68))
_AHEAD = np.array([0.0, 0.0, 600.0, 0.0, 0.0, 0.0])
"""A pose by which triangles are put in order."""


@pytree_dataclass
class IctHead:
    """All surfaces of a head, skin first."""

    faces: Int[Array, "F 3"]
    """Triangles, neighbours after one another."""
    place: Float[Array, "vertices 2"]
    """Place of each vertex on the map of the skin, (u, v) in millimetres."""
    eyes: Float[Array, "2 points 3"]
    """Balls of the right and the left eye, millimetres in the model frame."""
    skull: Float[Array, "points 3"]
    """Millimetres in the model frame."""
    glasses: Glasses | None
    """Which the person wears, if any."""


def make_ict_head(model: IctModel, person: IctPerson, glasses: Glasses | None = None) -> IctHead:
    """The head of a person: the skin, balls behind the lids, a dark sheet behind the lips, hair, perhaps glasses."""
    neutral, landmarks = np.asarray(person.neutral, float), np.asarray(model.landmarks)
    eye, eye_faces, eye_place = _eyeball()
    centers = [neutral[landmarks[list(lids)]].mean(axis=0) + np.array([0, 0, EYE_DEPTH_MM]) for lids in LIDS]
    skull, skull_faces, skull_place = _skull(neutral)
    mouth_faces = np.array([(0, i + 1, (i + 1) % len(_INNER_LIPS) + 1) for i in range(len(_INNER_LIPS))])
    mouth_place = np.tile(MOUTH_FIELD, (len(_INNER_LIPS) + 1, 1))
    pieces = [
        (map_place(np.asarray(model.neutral, float)), np.asarray(model.faces)),
        (eye_place, eye_faces),
        (eye_place, eye_faces),
        (mouth_place, mouth_faces),
        (skull_place, skull_faces),
    ]
    mouth = np.concatenate([[[0.0, 0.0, 0.0]], neutral[landmarks[list(_INNER_LIPS)]]])
    shown = [neutral, *(eye + center for center in centers), mouth, skull]
    if glasses is not None:
        points = [np.asarray(glasses.points), np.asarray(reflections(glasses, jnp.asarray(_AHEAD, float)))]
        fields, triangles = (RIM_FIELD, REFLECTION_FIELD), (np.asarray(glasses.faces), reflection_faces())
        pieces += [
            (np.tile(field, (len(one), 1)), faces) for field, one, faces in zip(fields, points, triangles, strict=True)
        ]
        shown += points
    starts = np.cumsum([0] + [len(places) for places, _ in pieces[:-1]])
    faces = np.concatenate([start + one for start, (_, one) in zip(starts, pieces, strict=True)])
    balls, vertices = np.stack(shown[1:3]), np.concatenate(shown)
    ordered = mesh_from_trimesh(trimesh.Trimesh(vertices, faces, process=False)).faces
    places = jnp.asarray(np.concatenate([places for places, _ in pieces]), float)
    return IctHead(ordered, places, jnp.asarray(balls, float), jnp.asarray(skull, float), glasses)


@jax.jit
def render_ict(
    key: AnyKey,
    model: IctModel,
    person: IctPerson,
    head: IctHead,
    skin: Skin,
    background: Float[Array, "C rows cols"],
    rig: CameraRig,
    pose: Float[Array, " 6"],
    weights: Float[Array, " expressions"],
    *,
    gain: Float[ArrayLike, ""] = 1.0,
    light: Float[ArrayLike, " 3"] | tuple[float, float, float] = LIGHT,
) -> UInt8[Array, "C rows cols"]:
    """What the cameras deliver: `round(gain * image + noise)`, clipped to 0..255.

    Args:
        key: Of the noise, which is independent in all pixels.
        model: Of all people.
        person: Who.
        head: Of the person.
        skin: Of the person.
        background: Grey levels.
        rig: Cameras.
        pose: Of the head, millimetres and radians.
        weights: Strengths of the expressions.
        gain: Factor of the light.
        light: Direction to the light in the world; of any length but 0.
    """
    skin_points = deformed(model, person, weights)
    lips = skin_points[model.landmarks[jnp.asarray(_INNER_LIPS)]]
    worn = [] if head.glasses is None else [head.glasses.points, reflections(head.glasses, pose)]
    vertices = jnp.concatenate([skin_points, *head.eyes, _inside(lips), head.skull, *worn])
    world = place(vertices, pose)
    to_light = jnp.asarray(light, world.dtype)
    toward = jnp.sum(_normals(world, head.faces) * to_light, axis=-1) / jnp.sqrt(jnp.sum(jnp.square(to_light)))
    toward = jnp.maximum(toward, 0.0)
    attributes = jnp.concatenate([head.place, (AMBIENT + DIRECT * toward)[:, None]], axis=-1)
    clean = jnp.stack(
        [_camera_image(c, rig, world, head.faces, attributes, skin, background[c]) for c in range(rig.num_cameras)]
    )
    noise = NOISE_STD * jax.random.normal(key, clean.shape, clean.dtype)
    return jnp.clip(jnp.round(gain * clean + noise), 0, 255).astype(jnp.uint8)


def _camera_image(c, rig, world, faces, attributes, skin, background):
    vertices = turn(world, rig.rotation[c]) + rig.translation[c]
    camera = Pinhole(rig.focal[c], rig.center[c], rig.shape)
    winner = _winners(camera, vertices, faces)
    u, v, light = _interpolated(camera, vertices, faces, attributes, winner)
    return jnp.where(winner >= 0, light * _sampled(skin.grey, u, v), background)


def _winners(camera, vertices, faces):
    """Which triangle is visible at each pixel, -1 for none."""
    parts = mesh_parts(camera, Mesh(vertices, faces))
    plan = plan_windows(parts.box, camera.shape, COARSE)
    winner = winning_pieces(parts, plan, TRIANGLES, nearest_inverse(parts, plan, TRIANGLES, camera.shape))
    return jnp.minimum(winner, len(faces) - 1)  # the last cluster is filled up with its last triangle


def _interpolated(camera, vertices, faces, attributes, winner):
    """Attributes at the pixels, linear over each triangle in space.

    The ray d meets the triangle (a, b, c) at weights in the proportion of d . (b x c), d . (c x a), d . (a x b).
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    edges = jnp.stack([jnp.cross(b, c - b), jnp.cross(c, a - c), jnp.cross(a, b - a)], axis=1)
    ones = jnp.ones_like(attributes[:, :1])
    corners = jnp.concatenate([attributes, ones], axis=-1)[faces]
    table = jnp.sum(corners[..., None] * edges[:, :, None], axis=1).reshape(len(faces), -1)
    chosen = jnp.moveaxis(table[jnp.maximum(winner, 0)], -1, 0)  # one gather; the rest is elementwise
    x, y, _ = jnp.moveaxis(camera.rays(), -1, 0)
    *values, total = (chosen[i] * x + chosen[i + 1] * y + chosen[i + 2] for i in range(0, len(chosen), 3))
    hit = (winner >= 0) & (total != 0)
    return [jnp.where(hit, value / jnp.where(hit, total, 1.0), 0.0) for value in values]


def _sampled(grey, u, v):
    """The map at places in millimetres, bilinear."""
    x, y = (u - LOW_MM[0]) / PIXEL_MM - 0.5, (v - LOW_MM[1]) / PIXEL_MM - 0.5
    return jax.scipy.ndimage.map_coordinates(grey, [y, x], order=1, mode="nearest")


def _normals(vertices, faces):
    """Outward unit normals of the vertices."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = jnp.cross(b - a, c - a)
    summed = jnp.zeros_like(vertices).at[faces.reshape(-1)].add(jnp.repeat(normal, 3, axis=0))
    return summed / jnp.maximum(jnp.linalg.norm(summed, axis=-1, keepdims=True), 1e-6)


def _inside(lips):
    """A fan behind the lips, wider than their opening."""
    middle = jnp.mean(lips, axis=0)
    back = jnp.asarray([0.0, 0.0, MOUTH_DEPTH_MM], lips.dtype)
    rim = middle + jnp.asarray([1.08, 1.4, 1.0], lips.dtype) * (lips - middle) + back
    return jnp.concatenate([(middle + 1.5 * back)[None], rim])


def _eyeball():
    """Points about the centre of a ball, its triangles, and their places on the map."""
    rings, sectors = np.radians(np.linspace(9, 81, 9)), np.linspace(0, 2 * np.pi, 18, endpoint=False)
    ring, sector = np.meshgrid(rings, sectors, indexing="ij")
    points = np.stack([np.sin(ring) * np.cos(sector), np.sin(ring) * np.sin(sector), -np.cos(ring)], axis=-1)
    points = EYE_RADIUS_MM * np.concatenate([[[0.0, 0.0, -1.0]], points.reshape(-1, 3)])
    return points, _outward(points, _fan(len(rings), len(sectors))), points[:, :2] + EYE_FIELD


def _fan(rings, sectors):
    """Triangles of a pole and rings around it."""
    following = (np.arange(sectors) + 1) % sectors
    faces = [np.stack([np.zeros(sectors, int), 1 + np.arange(sectors), 1 + following], axis=-1)]
    for ring in range(rings - 1):
        here, there = 1 + ring * sectors, 1 + (ring + 1) * sectors
        faces.append(np.stack([here + np.arange(sectors), there + np.arange(sectors), there + following], axis=-1))
        faces.append(np.stack([here + np.arange(sectors), there + following, here + following], axis=-1))
    return np.concatenate(faces)


def _outward(points, faces):
    """Triangles wound counter-clockwise from outside of a convex body about the origin."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    outward = np.sum(np.cross(b - a, c - a) * a, axis=-1)
    return np.where((outward < 0)[:, None], faces[:, ::-1], faces)


def _skull(neutral):
    """Half an ellipsoid that closes the head behind the upper edge of the skin."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    unit = np.asarray(ball.vertices)
    top = neutral[neutral[:, 1].argmin()]
    upper = neutral[neutral[:, 1] < top[1] + 80]
    semi = np.array([0.92 * np.ptp(upper[:, 0]) / 2, SKULL_HEIGHT_MM / 2, SKULL_DEPTH_MM])
    center = np.array([upper[:, 0].mean(), top[1] + semi[1] - 2, top[2] + 45])
    points = unit * np.where(unit[:, 2:] > 0, semi, semi * [1, 1, 0.1]) + center
    return points, _outward(unit, np.asarray(ball.faces)), 35.0 * unit[:, :2] + HAIR_FIELD
