"""Video of a modelled face with known truth, rendered frame by frame as it is asked for."""

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.face.rig import CameraRig, nominal, project_shape
from jaxfilters.models.synthetic.face_motion import FPS
from jaxfilters.models.synthetic.face_sequence import pieces, rendered
from jaxfilters.models.synthetic.face_texture import make_background
from jaxfilters.models.synthetic.ict_face import IctModel, IctPerson, deformed, make_ict_person, ten_landmarks
from jaxfilters.models.synthetic.ict_render import IctHead, make_ict_head, render_ict
from jaxfilters.models.synthetic.ict_skin import Skin, paint_skin
from jaxfilters.models.synthetic.ict_worn import make_glasses
from jaxfilters.typing import AnyKey


@dataclass(frozen=True)
class IctSequence:
    """A video and its truth, as `FaceSequence`; the images are made anew whenever they are asked for."""

    key: AnyKey
    """Of the noise."""
    model: IctModel
    person: IctPerson
    head: IctHead
    skin: Skin
    background: Float[Array, "C rows cols"]
    rig: CameraRig
    times: Float[np.ndarray, " frames"]
    """Seconds."""
    poses: Float[np.ndarray, "frames 6"]
    """Millimetres and radians."""
    expressions: Float[np.ndarray, "frames expressions"]
    """Strengths, in the order of `model.names`."""
    shapes: Float[np.ndarray, "frames 10 3"]
    """Landmarks in the model frame, millimetres about the centroid of the neutral face."""
    uv: Float[np.ndarray, "frames C 10 2"]
    """Their pixels, whether they are visible or behind the nose."""
    uv68: Float[np.ndarray, "frames C 68 2"]
    """The same of all landmarks of iBUG."""
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
        return render_ict(
            jax.random.fold_in(self.key, index),
            self.model,
            self.person,
            self.head,
            self.skin,
            self.background,
            self.rig,
            jnp.asarray(self.poses[index], float),
            jnp.asarray(self.expressions[index], float),
            gain=jnp.asarray(self.gain[index], float),
        )


def ict_sequence(
    key: AnyKey,
    model: IctModel,
    poses: Float[np.ndarray, "frames 6"],
    *,
    rig: CameraRig | None = None,
    expressions: Float[np.ndarray, "frames expressions"] | None = None,
    gain: Float[np.ndarray, " frames"] | None = None,
    has_glasses: bool = False,
    beard: float = 0.0,
) -> IctSequence:
    """A random person along a course of poses, millimetres and radians, at 30 frames a second.

    Args:
        key: Of person, skin, backgrounds and noise.
        model: Of all people.
        poses: Of the head.
        rig: Cameras; the two of `rig.nominal` if none.
        expressions: Strengths in the order of `model.names`; neutral if none.
        gain: Factor of the light; 1 if none.
        has_glasses: Whether the person wears a random pair; all else is the same without it.
        beard: Share of the skin about mouth and jaw that a beard hides; see `paint_skin`.
    """
    rig = nominal() if rig is None else rig
    identity_key, looks, walls, noise = jax.random.split(key, 4)
    person, num_frames = make_ict_person(identity_key, model), len(poses)
    expressions = np.zeros((num_frames, len(model.names))) if expressions is None else expressions
    glasses = make_glasses(jax.random.fold_in(looks, 2), model, person) if has_glasses else None
    shapes, uv68 = _truth(model, person, rig, jnp.asarray(poses, float), jnp.asarray(expressions, float))
    return IctSequence(
        key=noise,
        model=model,
        person=person,
        head=make_ict_head(model, person, glasses),
        skin=paint_skin(looks, model, beard=beard),
        background=jnp.stack([make_background(wall, rig.shape) for wall in jax.random.split(walls, rig.num_cameras)]),
        rig=rig,
        times=np.arange(num_frames) / FPS,
        poses=poses,
        expressions=expressions,
        shapes=np.asarray(shapes),
        uv=np.asarray(uv68)[:, :, list(FROM_68)],
        uv68=np.asarray(uv68),
        gain=np.ones(num_frames) if gain is None else gain,
    )


@jax.jit
def _truth(model, person, rig, poses, expressions):
    def of_frame(frame):
        pose, weights = frame
        vertices = deformed(model, person, weights)
        return ten_landmarks(model, vertices), project_shape(rig, vertices[model.landmarks], pose)[0]

    return jax.lax.map(of_frame, (poses, expressions))
