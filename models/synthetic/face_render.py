"""Pictures of faces of ten landmarks, observed by any number of cameras.

Specification of the stereo head tracker, section 4. The projection of a landmark is the centre of its patch exactly.
"""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, UInt8

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.models.face.pose import place, rotation, turn
from jaxfilters.models.face.rig import NEAREST, CameraRig
from jaxfilters.models.synthetic.face_texture import AXES, NORMALS, FaceScene, patch
from jaxfilters.typing import AnyKey

NOISE_STD = 2.0
"""Of the sensor, grey levels."""
HEAD_CENTER_MM, HEAD_SEMI_AXES_MM = (0.0, 5.0, 70.0), (84.0, 118.0)
HEAD_GREY, EDGE = 150.0, 0.02
"""Mean of the head, and the softness of its outline in semi-axes."""
_SLANT, _ROUNDNESS = 10.0, 16.0
WINDOW_PX = 96
"""Side of the square in which a patch is drawn: over three of its standard deviations up to 2.5 pixels a millimetre."""


@pytree_dataclass
class Occluder:
    """An upright grey rectangle before the face."""

    center: Float[Array, " 3"]
    """World, millimetres."""
    half_size: Float[Array, " 2"]
    """Half width and half height, millimetres."""
    grey: Float[Array, ""]
    opacity: Float[Array, ""]
    """1 where it is there, 0 where it is not."""


@jax.jit
def render_face(
    key: AnyKey,
    scene: FaceScene,
    rig: CameraRig,
    pose: Float[Array, " 6"],
    shape: Float[Array, "10 3"],
    *,
    gain: Float[ArrayLike, ""] = 1.0,
    offset: Float[ArrayLike, ""] = 0.0,
    occluder: Occluder | None = None,
) -> UInt8[Array, "C rows cols"]:
    """What the cameras deliver: `round(gain * image + offset + noise)`, clipped to 0..255.

    Args:
        key: Of the noise, which is independent in all pixels.
        scene: Texture and backgrounds, one for each camera of the rig.
        rig: Cameras.
        pose: Of the head, millimetres and radians.
        shape: Landmarks in the model frame, millimetres.
        gain: Factor of the light.
        offset: Grey levels.
        occluder: Before the face, if any.

    Raises:
        ValueError: if the scene has not one background of the rig's image size for every camera.
    """
    if scene.background.shape != (rig.num_cameras, *rig.shape):
        raise ValueError(
            f"scene must have a background of shape {(rig.num_cameras, *rig.shape)}; got {scene.background.shape}."
        )
    cameras = range(rig.num_cameras)
    clean = jnp.stack([_camera_image(c, scene, rig, pose, shape, occluder) for c in cameras])
    noise = NOISE_STD * standard_normal(key, clean.shape, clean.dtype)
    return jnp.clip(jnp.round(gain * clean + offset + noise), 0, 255).astype(jnp.uint8)


def _camera_image(c, scene, rig, pose, shape, occluder):
    """The image of one camera without light and noise."""
    R = rotation(pose[3:])

    def in_camera(points):
        return turn(points, rig.rotation[c]) + rig.translation[c]

    axes, normals = (jnp.asarray(a, pose.dtype) for a in (AXES, NORMALS))
    image = _head(c, scene.background[c], rig, in_camera, pose, R)
    turned = (turn(turn(d, R), rig.rotation[c]) for d in (axes[:, 0], axes[:, 1], normals))
    image = _patches(image, scene.texture, rig.focal[c], rig.center[c], in_camera(place(shape, pose)), *turned)
    if occluder is not None:
        image = _occluded(image, occluder, rig.focal[c], rig.center[c], in_camera)
    return image


def _head(c, background, rig, in_camera, pose, R):
    """Background with an ellipse before it, upright along the head."""
    center = in_camera(place(jnp.asarray([HEAD_CENTER_MM], pose.dtype), pose))[0]
    down = turn(R[None, :, 1], rig.rotation[c])[0, :2]
    down = down / jnp.maximum(jnp.hypot(down[0], down[1]), 1e-3)
    visible = center[2] > NEAREST
    z = jnp.where(visible, center[2], 1.0)
    v, u = (jax.lax.broadcasted_iota(background.dtype, background.shape, axis) for axis in (0, 1))
    x = ((u - rig.center[c, 0]) * z / rig.focal[c, 0]) - center[0]
    y = ((v - rig.center[c, 1]) * z / rig.focal[c, 1]) - center[1]
    along = (x * down[0] + y * down[1]) / HEAD_SEMI_AXES_MM[1]
    across = (x * down[1] - y * down[0]) / HEAD_SEMI_AXES_MM[0]
    square = across**2 + along**2
    grey = HEAD_GREY + _ROUNDNESS * (0.5 - jnp.minimum(square, 1.5)) - _SLANT * across
    share = jnp.where(visible, jax.nn.sigmoid((1 - jnp.sqrt(square)) / EDGE), 0.0)
    return background + share * (grey - background)


def _patches(image, texture, focal, center, points, across, down, normals):
    """The image with the texture of every landmark added."""
    window = (min(WINDOW_PX, image.shape[0]), min(WINDOW_PX, image.shape[1]))
    last = jnp.asarray([image.shape[0] - window[0], image.shape[1] - window[1]])
    in_front = points[:, 2] > NEAREST
    points = jnp.where(in_front[:, None], points, jnp.asarray([0.0, 0.0, 1.0], points.dtype))
    cosine = -jnp.sum(normals * points, axis=-1) / jnp.linalg.norm(points, axis=-1)
    weight = jnp.where(in_front, jnp.clip((cosine - 0.05) / 0.25, 0.0, 1.0), 0.0)
    uv = points[:, :2] / points[:, 2:] * focal + center

    def add(image, landmark):
        uv, point, across, down, normal, weight, wave, phase, amplitude = landmark
        start = jnp.clip(jnp.round(uv[::-1]).astype(jnp.int32) - jnp.asarray(window) // 2, 0, last)
        v, u = (start[a] + jax.lax.broadcasted_iota(image.dtype, window, a) for a in (0, 1))
        ray = ((u - center[0]) / focal[0], (v - center[1]) / focal[1], 1.0)
        slope = sum(n * d for n, d in zip(normal, ray, strict=True))
        hit = slope < -1e-3
        depth = jnp.sum(normal * point) / jnp.where(hit, slope, -1.0)
        gap = [depth * d - p for d, p in zip(ray, point, strict=True)]
        x, y = (sum(a * g for a, g in zip(axis, gap, strict=True)) for axis in (across, down))
        grey = jnp.where(hit, weight * patch(wave, phase, amplitude, x, y), 0.0)
        drawn = jax.lax.dynamic_slice(image, start, window) + grey
        return jax.lax.dynamic_update_slice(image, drawn, start), None

    each = (uv, points, across, down, normals, weight, texture.wave, texture.phase, texture.amplitude)
    return jax.lax.scan(add, image, each)[0]


def _occluded(image, occluder, focal, center, in_camera):
    middle = in_camera(occluder.center[None])[0]
    z = jnp.where(middle[2] > NEAREST, middle[2], 1.0)
    x, y = middle[:2] / z * focal + center
    width, height = occluder.half_size / z * focal
    v, u = (jax.lax.broadcasted_iota(image.dtype, image.shape, axis) for axis in (0, 1))
    inside = (jnp.abs(u - x) <= width) & (jnp.abs(v - y) <= height) & (middle[2] > NEAREST)
    return jnp.where(inside, image + occluder.opacity * (occluder.grey - image), image)
