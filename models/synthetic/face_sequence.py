"""Video of a face with known truth, rendered frame by frame as it is asked for."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters._xla.from_host import from_host
from jaxfilters.models.face.landmarks import MOUTH, NOSTRILS
from jaxfilters.models.face.pose import place
from jaxfilters.models.face.rig import CameraRig, nominal, project_shape
from jaxfilters.models.synthetic.face import Identity, face_shape, make_identity
from jaxfilters.models.synthetic.face_motion import (
    FPS,
    MONOCULAR_PLACE_MM,
    STEREO_PLACE_MM,
    deformation_schedule,
    gain_schedule,
    motion,
    occlusion_schedule,
)
from jaxfilters.models.synthetic.face_render import Occluder, render_face
from jaxfilters.models.synthetic.face_texture import FaceScene, make_scene
from jaxfilters.typing import AnyKey

OCCLUDER_MARGIN_MM, OCCLUDER_NEARER_MM, OCCLUDER_GREY = (20.0, 14.0), 15.0, 120.0
"""Beyond mouth and nostrils to both sides and up and down, enough for their templates; before them; grey level."""


@dataclass(frozen=True)
class FaceSequence:
    """A video and its truth; the images are made anew whenever they are asked for, alike each time."""

    key: AnyKey
    """Of the noise."""
    identity: Identity
    scene: FaceScene
    rig: CameraRig
    times: Float[np.ndarray, " frames"]
    """Seconds."""
    poses: Float[np.ndarray, "frames 6"]
    """Millimetres and radians."""
    expressions: Float[np.ndarray, "frames 2"]
    shapes: Float[np.ndarray, "frames 10 3"]
    """Landmarks in the model frame, millimetres about the centroid of the neutral face."""
    uv: Float[np.ndarray, "frames C 10 2"]
    """Their pixels."""
    covered: Bool[np.ndarray, " frames"]
    """Whether a rectangle is before mouth and nostrils."""
    gain: Float[np.ndarray, " frames"]
    """Factor of the light."""

    def __len__(self) -> int:
        return len(self.times)

    def frames(self, start: int, stop: int) -> UInt8[np.ndarray, "frames C rows cols"]:
        """Images of the frames from `start` up to `stop`.

        Raises:
            ValueError: if these are not frames of the sequence.
        """
        return rendered(self._image, len(self), self.rig, start, stop)

    def chunks(self, size: int = 60) -> Iterator[tuple[int, UInt8[np.ndarray, "frames C rows cols"]]]:
        """First frame and images of successive pieces of at most `size` frames."""
        return pieces(self.frames, len(self), size)

    def _image(self, index):
        looks = self.shapes[index], self.poses[index], self.covered[index], self.gain[index]
        return _frame(self.key, index, self.scene, self.rig, *looks)


def rendered(
    image: Callable[[int], ArrayLike], length: int, rig: CameraRig, start: int, stop: int
) -> UInt8[np.ndarray, "frames C rows cols"]:
    """Images of the frames from `start` up to `stop` of a video of `length` frames, `image(index)` each.

    Raises:
        ValueError: if these are not frames of the video.
    """
    if not 0 <= start <= stop <= length:
        raise ValueError(f"start and stop must be within 0..{length}, in order; got {start} and {stop}.")
    images = np.empty((stop - start, rig.num_cameras, *rig.shape), np.uint8)
    for index in range(start, stop):
        images[index - start] = image(index)
    return images


def pieces(
    frames: Callable[[int, int], np.ndarray], length: int, size: int
) -> Iterator[tuple[int, UInt8[np.ndarray, "frames C rows cols"]]]:
    """First frame and images of successive pieces of at most `size` of `length` frames."""
    for start in range(0, length, size):
        yield start, frames(start, min(start + size, length))


def sequence(
    key: AnyKey,
    kind: str,
    num_frames: int,
    seed: int,
    *,
    rig: CameraRig | None = None,
    deform: bool = False,
    occlusion: bool = False,
) -> FaceSequence:
    """A random person who moves, with disturbances if asked for.

    Args:
        key: Of person, texture, backgrounds and noise.
        kind: `slow`, `fast` or `mix`.
        num_frames: How many.
        seed: Of the motion.
        rig: Cameras; the two of `rig.nominal` if none. Before one camera, the head moves about its axis.
        deform: Whether the face has the expressions of section 5.2.
        occlusion: Whether mouth and nostrils are covered for a while and the light goes down later (section 5.1).

    Raises:
        ValueError: as `motion`.
    """
    place_mm = STEREO_PLACE_MM if rig is None or rig.num_cameras > 1 else MONOCULAR_PLACE_MM
    return face_sequence(
        key,
        motion(kind, num_frames, seed, place_mm=place_mm),
        rig=rig,
        expressions=deformation_schedule(num_frames) if deform else None,
        covered=occlusion_schedule(num_frames) if occlusion else None,
        gain=gain_schedule(num_frames) if occlusion else None,
    )


def face_sequence(
    key: AnyKey,
    poses: Float[np.ndarray, "frames 6"],
    *,
    rig: CameraRig | None = None,
    expressions: Float[np.ndarray, "frames 2"] | None = None,
    covered: Bool[np.ndarray, " frames"] | None = None,
    gain: Float[np.ndarray, " frames"] | None = None,
) -> FaceSequence:
    """A random person along a course of poses, millimetres and radians, at 30 frames a second.

    Args:
        key: Of person, texture, backgrounds and noise.
        poses: Of the head.
        rig: Cameras; the two of `rig.nominal` if none.
        expressions: (e1, e2) of each frame; neutral if none.
        covered: Whether mouth and nostrils are behind a rectangle; never if none.
        gain: Factor of the light; 1 if none.
    """
    rig = nominal() if rig is None else rig
    identity_key, looks, noise = jax.random.split(key, 3)
    identity, num_frames = make_identity(identity_key), len(poses)
    expressions = np.zeros((num_frames, 2)) if expressions is None else expressions
    shapes, uv = _truth(identity, rig, from_host(poses), from_host(expressions))
    return FaceSequence(
        key=noise,
        identity=identity,
        scene=make_scene(looks, rig.shape, num_cameras=rig.num_cameras),
        rig=rig,
        times=np.arange(num_frames) / FPS,
        poses=poses,
        expressions=expressions,
        shapes=np.asarray(shapes),
        uv=np.asarray(uv),
        covered=np.zeros(num_frames, bool) if covered is None else covered,
        gain=np.ones(num_frames) if gain is None else gain,
    )


@compiled_quickly
def _truth(identity, rig, poses, expressions):
    shapes = jax.vmap(face_shape, in_axes=(None, 0, 0))(identity, expressions[:, 0], expressions[:, 1])
    return shapes, jax.vmap(project_shape, in_axes=(None, 0, 0))(rig, shapes, poses)[0]


@jax.jit
def _frame(
    key: AnyKey,
    index: Int[ArrayLike, ""],
    scene: FaceScene,
    rig: CameraRig,
    shape: Float[Array, "10 3"],
    pose: Float[Array, " 6"],
    covered: Bool[Array, ""],
    gain: Float[Array, ""],
) -> UInt8[Array, "C rows cols"]:
    # Opacity 0 rather than no occluder: one compiled program for all frames.
    occluder = _before_mouth(shape, pose, covered.astype(shape.dtype))
    return render_face(jax.random.fold_in(key, index), scene, rig, pose, shape, gain=gain, occluder=occluder)


def _before_mouth(shape, pose, opacity):
    """An occluder between the cameras and the mouth and nostrils, wherever the head is."""
    points = place(shape, pose)[jnp.asarray((*MOUTH, *NOSTRILS))]
    low, high = jnp.min(points, axis=0), jnp.max(points, axis=0)
    dtype = shape.dtype
    return Occluder(
        center=(low + high) / 2 - jnp.asarray([0.0, 0.0, OCCLUDER_NEARER_MM], dtype),
        half_size=(high - low)[:2] / 2 + jnp.asarray(OCCLUDER_MARGIN_MM, dtype),
        grey=jnp.asarray(OCCLUDER_GREY, dtype),
        opacity=opacity,
    )
