"""People and expressions of a statistical face model, in millimetres and the frame of the trackers.

The files `ict_landmarks68.npz` and `ict_face9409.npz` hold a mean face, 100 modes of identity that are scaled to unit
variance, and 57 expressions with ARKit's names, all additive:
`X = neutral + sum a_i identity_i + sum w_j expression_j`. They are in centimetres with y up and z out of the face;
here x is to the image's right, y down, z away from the camera.
"""

from dataclasses import field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfilters._full_precision import tensordot
from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.typing import AnyKey

ICT_FILES = {
    "ict_landmarks68.npz": ("vertex_ids",),
    "ict_face9409.npz": ("neutral", "quads", "identity", "expression", "expression_names"),
}
"""Files in the model's folder, and the arrays that are used of each."""
_TO_OURS = np.array([10.0, -10.0, -10.0])


@pytree_dataclass
class IctModel:
    """V vertices of the skin, of which 68 are landmarks; eyes, teeth and the inner mouth are not part of it."""

    neutral: Float[Array, "V 3"]
    """Mean face, millimetres, about the origin of the files, which lies within the head."""
    identity: Float[Array, "modes V 3"]
    """Displacements for one standard deviation of each mode."""
    expression: Float[Array, "expressions V 3"]
    """Displacements for expressions of strength 1."""
    landmarks: Int[Array, " 68"]
    """Vertices of the landmarks in iBUG's order."""
    faces: Int[Array, "F 3"]
    """Triangles."""
    names: tuple[str, ...] = field(metadata=dict(static=True))
    """Of the expressions."""


@pytree_dataclass
class IctPerson:
    """The face of one person, without expression."""

    neutral: Float[Array, "V 3"]
    """Millimetres about the centroid of the ten tracked landmarks."""


def read_ict(folder: Path) -> IctModel:
    """The face model in a folder.

    Raises:
        ValueError: if the folder lacks one of the two files, or one of them lacks an array.
    """
    paths = [folder / name for name in ICT_FILES]
    return ict_model(*(_arrays(path, *names) for path, names in zip(paths, ICT_FILES.values(), strict=True)))


def ict_model(points: dict[str, np.ndarray], surface: dict[str, np.ndarray]) -> IctModel:
    """The face model of the arrays of its two files.

    Args:
        points: Of the first of `ICT_FILES`.
        surface: Of the second.

    Raises:
        ValueError: if their shapes do not fit each other, they are not finite, or indices name vertices that are not
            there.
    """
    neutral, quads, landmarks = surface["neutral"], surface["quads"], points["vertex_ids"]
    num_vertices, names = len(np.atleast_1d(neutral)), np.atleast_1d(surface["expression_names"])
    shapes = {
        "identity": (*surface["identity"].shape[:1], num_vertices, 3),
        "expression": (len(names), num_vertices, 3),
    }
    for name, shape in {"neutral": (num_vertices, 3), **shapes}.items():
        array = surface[name]
        # Beyond this, lengths in millimetres overflow in single precision once they are squared.
        if array.shape != shape or array.dtype.kind != "f" or not np.all(np.abs(array.astype(float)) < 1e12):
            raise ValueError(f"{name} must be finite numbers {shape}; got {array.shape} {array.dtype}.")
    for name, indices, shape in (("quads", quads, (len(np.atleast_1d(quads)), 4)), ("vertex_ids", landmarks, (68,))):
        named = indices.shape == shape and indices.dtype.kind in "iu" and indices.size > 0
        if not named or indices.min() < 0 or indices.max() >= num_vertices:
            raise ValueError(f"{name} must name {shape} of {num_vertices} vertices by index; got {indices.shape}.")
    # The files wind their quads counter-clockwise from outside; turning y and z over keeps that.
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    mean, by_identity, by_expression = (
        jnp.asarray(surface[name].astype(np.float64) * _TO_OURS, float) for name in ("neutral", *shapes)
    )
    return IctModel(
        mean,
        by_identity,
        by_expression,
        jnp.asarray(landmarks, jnp.int32),
        jnp.asarray(faces, jnp.int32),
        tuple(str(name) for name in names),
    )


@jax.jit
def make_ict_person(key: AnyKey, model: IctModel) -> IctPerson:
    """A random person: standard normal weights of all modes of identity."""
    weights = jax.random.normal(key, (model.identity.shape[0],), model.neutral.dtype)
    neutral = model.neutral + tensordot(weights, model.identity, 1)
    return IctPerson(neutral - jnp.mean(ten_landmarks(model, neutral), axis=0))


@jax.jit
def deformed(model: IctModel, person: IctPerson, weights: Float[Array, " expressions"]) -> Float[Array, "V 3"]:
    """Vertices of a person with an expression, millimetres about the centroid of the ten *neutral* landmarks."""
    return person.neutral + tensordot(weights, model.expression, 1)


def ten_landmarks(model: IctModel, vertices: Float[Array, "V 3"]) -> Float[Array, "10 3"]:
    """The tracked landmarks among the vertices, in the trackers' order."""
    return vertices[model.landmarks[jnp.asarray(FROM_68)]]


def _arrays(path: Path, *names: str) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise ValueError(f"folder must hold {path.name}; {path.parent} does not.")
    with np.load(path) as file:
        missing = [name for name in names if name not in file]
        if missing:
            raise ValueError(f"{path} must hold {', '.join(names)}; it lacks {', '.join(missing)}.")
        return {name: file[name] for name in names}
