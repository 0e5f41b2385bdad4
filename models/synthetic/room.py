"""Video of a room that is watched by cameras which stand still: walkers, furniture, shadows, a textured floor."""

import math
from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters._xla.from_host import from_host
from jaxfilters._xla.noise import standard_normal
from jaxfilters.math.lie import RigidTransform, quaternion_from_matrix, quaternion_to_matrix
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.rendering.depth import ellipsoid_depth
from jaxfilters.models.synthetic.walkers import Walker, body
from jaxfilters.typing import AnyKey

_to_matrix, _from_matrix = map(compiled_quickly, (quaternion_to_matrix, quaternion_from_matrix))

SHADOW = 0.7
"""Share of the light that a shadow leaves."""
SHADOW_AXES_M, SHADOW_AWAY_M = (0.40, 0.22), (0.35, 0.15)
"""Semi-axes of the shadow on the floor, and its place beside the feet."""
NOISE_STD = 3.0
"""Of the sensor, grey values."""
TILE_M = 0.6
LEGS, NECK = 0.5, 0.86
"""Where trousers end and a head begins, in body heights."""
SKIN = (120.0, 150.0, 200.0)


@pytree_dataclass
class RoomCamera:
    """A camera in the room, without lens distortion."""

    pinhole: Pinhole
    T_camera_world: RigidTransform
    furniture: Float[Array, "rows cols"]
    """Depth along the optical axis, metres; `inf` where nothing stands."""
    empty: Float[Array, "rows cols 3"]
    """The image without people and noise: blue, green, red, 0 to 255."""
    shape: tuple[int, int] = field(metadata=dict(static=True))


def floor_camera(pinhole: Pinhole, T_camera_world: RigidTransform) -> FloorCamera:
    """The projection matrix of a pinhole camera."""
    K = np.asarray(pinhole.matrix(), float)
    rotation = np.asarray(_to_matrix(T_camera_world.rotation))
    return FloorCamera.from_matrix(K @ np.column_stack([rotation, T_camera_world.translation]), pinhole.shape)


def looking(position: tuple[float, float, float], heading_deg: float, pitch_deg: float) -> RigidTransform:
    """`T_camera_world` of a camera that looks along a heading from the X axis, turned down by a pitch."""
    a, b = math.radians(heading_deg), math.radians(pitch_deg)
    forward = np.array([math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), -math.sin(b)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    return RigidTransform(
        _from_matrix(from_host(rotation, jnp.float32)),
        from_host(-rotation @ np.asarray(position), jnp.float32),
    )


def room_camera(key: AnyKey, pinhole: Pinhole, T_camera_world: RigidTransform, furniture: Array) -> RoomCamera:
    """A camera before the empty room: tiles with a random pattern, furniture shaded by its slope."""
    empty = _empty_room(key, floor_camera(pinhole, T_camera_world), furniture)
    return RoomCamera(pinhole, T_camera_world, jnp.asarray(furniture), empty, pinhole.shape)


@compiled_quickly
def _empty_room(key: AnyKey, camera: FloorCamera, furniture: Array) -> Float[Array, "rows cols 3"]:
    v, u = jnp.meshgrid(*[jnp.arange(n, dtype=float) for n in camera.shape], indexing="ij")
    xy, depth = camera.floor_points(jnp.stack([u, v], axis=-1))
    tile = jnp.floor(xy / TILE_M).astype(jnp.int32)
    checks = (tile[..., 0] + tile[..., 1]) % 2
    grain = 18.0 * jax.random.uniform(key, camera.shape) - 9
    floor = jnp.array([128.0, 140.0, 150.0]) + 22.0 * checks[..., None] + grain[..., None]
    wall = jnp.array([176.0, 170.0, 160.0]) + grain[..., None]
    background = jnp.where(((depth > 0) & (depth < 40))[..., None], floor, wall)
    slope = jnp.abs(jnp.asarray(jnp.gradient(jnp.where(jnp.isfinite(furniture), furniture, 0.0), axis=0)))
    wood = jnp.array([60.0, 95.0, 140.0]) + 40 * jnp.clip(60 * slope, 0, 1)[..., None] + grain[..., None] / 2
    return jnp.where((furniture < jnp.where(depth > 0, depth, jnp.inf))[..., None], wood, background)


@jax.jit
def room_image(
    key: AnyKey, camera: RoomCamera, people: Walker, clothes: Float[Array, "people 2 3"], here: Bool[Array, " people"]
) -> tuple[UInt8[Array, "rows cols 3"], Int[Array, "rows cols"]]:
    """What the camera delivers, and who is visible at each pixel, -1 for nobody.

    Args:
        key: Of the noise.
        camera: Who looks.
        people: A batch of walkers.
        clothes: Colours of shirts and trousers, blue, green, red, 0 to 255.
        here: Who is in the room at all.
    """
    depths = jax.lax.map(lambda one: ellipsoid_depth(camera.pinhole, body(one).moved(camera.T_camera_world)), people)
    depths = jnp.where(here[:, None, None], depths, jnp.inf)
    visible_person, nearest = jnp.argmin(depths, axis=0), jnp.min(depths, axis=0)
    observed = nearest < camera.furniture
    rays, origin = _world_rays(camera)
    height = origin[2] + jnp.where(observed, nearest, 1.0) * rays[..., 2]
    share = height / people.height[visible_person]
    cloth = jnp.where((share > LEGS)[..., None], clothes[visible_person, 0], clothes[visible_person, 1])
    color = jnp.where((share > NECK)[..., None], jnp.array(SKIN), cloth)
    lit = camera.empty * _light(camera, rays, origin, people, here)[..., None]
    image = jnp.where(observed[..., None], color, lit) + NOISE_STD * standard_normal(key, (*camera.shape, 3))
    return jnp.clip(jnp.round(image), 0, 255).astype(jnp.uint8), jnp.where(observed, visible_person, -1)


def _world_rays(camera: RoomCamera):
    back = camera.T_camera_world.inverse()
    rays = back.apply(camera.pinhole.rays().reshape(-1, 3)) - back.translation
    return rays.reshape(*camera.shape, 3), back.translation


def _light(camera, rays, origin, people, here):
    """`SHADOW` on the floor beside people, 1 elsewhere."""
    down = jnp.where(rays[..., 2] < -1e-6, rays[..., 2], -1e-6)
    depth = -origin[2] / down
    # By components: a last axis of two leaves most of a vector register empty.
    x, y = (origin[axis] + depth * rays[..., axis] for axis in (0, 1))

    def darkened(middle: Array, is_here: Array) -> Array:
        across, along = (x - middle[0]) / SHADOW_AXES_M[0], (y - middle[1]) / SHADOW_AXES_M[1]
        return (across**2 + along**2 < 1) & is_here

    dark = jnp.any(jax.vmap(darkened)(people.xy + jnp.array(SHADOW_AWAY_M), here), axis=0)
    return jnp.where(dark & (depth < camera.furniture), SHADOW, 1.0)
