"""Multilinear models of the face on disk, and the one that comes with the package.

An `.npz` with the arrays `mean` (K, 3) and `tensor` (K, 3, S, A) in millimetres, `identity_mean` (S,),
`identity_covariance` (S, S), `expression_mean` (A,), `expression_covariance` (A, A), and `header`, a text in JSON:

    {"format": "jaxfilters face model", "version": 1, "source": "where the faces are from", "units": "mm",
     "names": [K names of landmarks], "pairs": [[right, left], ...], "parameters": {...}}

x is to the image's right, y down, z away from a camera that the face faces. `jaxfilters fit face-model` writes them.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters._xla.from_host import from_host
from jaxfilters.models.face.landmarks import PEOPLE_SHAPE
from jaxfilters.models.face.mirroring import Pairs, mirror_map
from jaxfilters.models.face.multilinear import MultilinearFace, shape
from jaxfilters.models.face.person_prior import log_size
from jaxfilters.trackers.io.checkpoint import write_npz
from jaxfilters.trackers.io.errors import InputError, OutputError, shortened, shown
from jaxfilters.trackers.io.input_files import LARGEST, are_finite
from jaxfilters.trackers.io.npz import read_header, read_npz

FORMAT, VERSION = "jaxfilters face model", 1
DEFAULT_FILE = Path(__file__).with_name("face_model.npz")
"""What `jaxfilters fit face-model` makes without data: faces of the generator."""
SIZE_STD = 0.055
"""Of the logarithm of the size of people: 5.3 % among those of the ICT face model, and means of other populations are
2 % smaller."""
_ARRAYS = {
    "mean": ("K", 3),
    "tensor": ("K", 3, "S", "A"),
    "identity_mean": ("S",),
    "identity_covariance": ("S", "S"),
    "expression_mean": ("A",),
    "expression_covariance": ("A", "A"),
}
_WANTED = f"expected an .npz of `jaxfilters fit face-model`, with {', '.join(_ARRAYS)} and header"


class FaceModelFile(NamedTuple):
    """A model of the face, and what is known of it."""

    model: MultilinearFace
    names: tuple[str, ...]
    """Of the landmarks."""
    pairs: Pairs
    """(right, left) indices of landmarks."""
    source: str
    """Where the faces are from."""
    parameters: dict[str, Any]
    """How the model was made."""


def save_face_model(path: str | Path, file: FaceModelFile) -> None:
    """Write a model; its folder is made if need be.

    Raises:
        OutputError: the file cannot be written.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "source": file.source,
        "units": "mm",
        "names": list(file.names),
        "pairs": [[int(index) for index in pair] for pair in file.pairs],
        "parameters": file.parameters,
    }
    arrays = {name: np.asarray(getattr(file.model, name)) for name in _ARRAYS}
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_npz(Path(path), {"header": np.asarray(json.dumps(header, allow_nan=False)), **arrays})
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def load_face_model(path: str | Path) -> FaceModelFile:
    """A model as it was written, in JAX's default precision.

    Raises:
        InputError: an unreadable or foreign file, another version, arrays that do not fit each other or are not finite,
            or covariances that are none.
    """
    path = Path(path)
    arrays, header = _read(path)
    sizes: dict[str, int] = {}
    for name, wanted in _ARRAYS.items():
        _check_array(arrays[name], name, wanted, sizes, path)
    for name in ("identity_covariance", "expression_covariance"):
        _check_covariance(arrays[name], name, path)
    names, pairs = _landmarks(header, sizes["K"], path)
    model = MultilinearFace(**{name: from_host(arrays[name]) for name in _ARRAYS})
    return FaceModelFile(model, names, pairs, str(header.get("source", "")), header["parameters"])


def default_face_model() -> FaceModelFile:
    """The model that comes with the package: ten landmarks, estimated from faces of the generator."""
    return load_face_model(DEFAULT_FILE)


def people_face_model() -> FaceModelFile:
    """The model for people: that of the package about the mean face of people, whose shape does not tell their size.

    Synthetic faces vary about a face that is flatter than people's, which turns estimates by some degrees of pitch, and
    how their sizes go with their shapes is no more than how they were generated: by it, the sizes that follow from the
    exact shapes of people of the ICT face model have errors of 7 %, where these people differ by 5.6 %.
    """
    file = default_face_model()
    face = file.model
    moved = PEOPLE_SHAPE - np.asarray(shape(face, face.identity_mean, face.expression_mean), float)
    moved = moved - moved.mean(axis=0)
    face = replace(face, mean=face.mean + jnp.asarray(moved, face.mean.dtype))
    source, parameters = f"{file.source}, as people are", file.parameters | {"size_std": SIZE_STD}
    return file._replace(model=with_sizes(face, SIZE_STD), source=source, parameters=parameters)


def with_sizes(face: MultilinearFace, size_std: float) -> MultilinearFace:
    """A model whose people have the shapes of another one's, and sizes that do not depend on their shapes.

    It has one parameter of identity more, which scales a face with all its expressions.

    Args:
        face: Model.
        size_std: Standard deviation of the logarithm of the size (`log_size`).
    """
    product = lambda a, b: jnp.matmul(a, b, precision="highest")
    # The same numbers in single and double precision: files of people say which model they are of.
    single = lambda a: np.asarray(a, np.float32).astype(float)
    mean, tensor, identity, expression = map(single, (face.mean, face.tensor, face.identity_mean, face.expression_mean))
    # Of all expressions, a sum of parameters that is about 1 whatever the expression: with it the mean scales as well.
    alike = expression / np.sum(expression**2)
    scaling = np.einsum("kdsa,s->kda", tensor, identity) + mean[..., None] * alike
    slope = jax.grad(lambda identity: log_size(face, identity))(face.identity_mean)
    # Whatever size the other parameters change is taken back by the new one.
    joined = jnp.concatenate([jnp.eye(face.num_identities, dtype=slope.dtype), -slope[None]])
    covariance = product(product(joined, face.identity_covariance), joined.T)
    return replace(
        face,
        tensor=jnp.concatenate([face.tensor, jnp.asarray(scaling[:, :, None], face.tensor.dtype)], axis=2),
        identity_mean=jnp.append(face.identity_mean, 0.0),
        identity_covariance=covariance.at[-1, -1].add(size_std**2),
    )


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays = read_npz(path, _WANTED)
    if missing := [name for name in (*_ARRAYS, "header") if name not in arrays]:
        raise InputError(f"{path}: without {', '.join(missing)}; {_WANTED}.")
    return arrays, read_header(arrays, path, _WANTED, FORMAT, VERSION, "mm")


def _check_array(array: np.ndarray, name: str, shape: tuple, sizes: dict[str, int], path: Path) -> None:
    """Sizes that arrays share are those of the first that has them."""
    fits = array.ndim == len(shape) and array.dtype.kind == "f"
    if fits:
        expected = tuple(
            sizes.setdefault(s, n) if isinstance(s, str) else s for s, n in zip(shape, array.shape, strict=True)
        )
        fits = array.shape == expected and array.size > 0
    if not fits:
        raise InputError(f"{path}: {name} must be numbers {shape} with {sizes}; got {array.shape} {array.dtype}.")
    if not are_finite(array):
        raise InputError(f"{path}: {name} must be finite, at most {LARGEST:g}.")


def _check_covariance(array: np.ndarray, name: str, path: Path) -> None:
    array = array.astype(float)
    scale = np.abs(array).max()
    if np.abs(array - array.T).max() > 1e-5 * scale or np.linalg.eigvalsh(array).min() < -1e-5 * scale:
        raise InputError(f"{path}: {name} must be symmetric and positive semidefinite.")
    if np.any(np.diagonal(array) <= 0):
        raise InputError(f"{path}: {name} must have positive variances; got {np.diagonal(array).min():.3g}.")


def _landmarks(header: dict[str, Any], num_landmarks: int, path: Path) -> tuple[tuple[str, ...], Pairs]:
    names, pairs = header.get("names"), header.get("pairs", ())
    if not isinstance(names, list) or len(names) != num_landmarks:
        raise InputError(f"{path}: names must be of {num_landmarks} landmarks; got {shown(names)}.")
    try:
        checked = tuple((int(right), int(left)) for right, left in pairs)
        mirror_map(checked, num_landmarks)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: pairs must be [right, left] indices of landmarks ({shortened(str(error))})."
        ) from None
    return tuple(str(name) for name in names), checked
