"""People of a model of the face on disk, so that later videos of them know their size.

An `.npz` with the arrays `identity` (P, S), `covariance` (P, S, S) and `offset` (P, K, 3) in millimetres
(`jaxfilters.models.face.gallery.Gallery`), and `header`, a text in JSON:

    {"format": "jaxfilters people", "version": 1, "units": "mm", "names": [P names],
     "model": "the first 16 hexadecimal digits of a hash of the model's mean face and tensor"}

`jaxfilters track head-mono` writes one of whom it followed, `jaxfilters fit face-model --remember` of all examples.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxfilters.models.face.gallery import Gallery, joined
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.trackers.io.checkpoint import write_npz
from jaxfilters.trackers.io.errors import InputError, OutputError, shown
from jaxfilters.trackers.io.input_files import LARGEST, are_finite
from jaxfilters.trackers.io.npz import read_header, read_npz

FORMAT, VERSION = "jaxfilters people", 1
_ASYMMETRY = 1e-3
"""Largest difference of two opposite elements that is taken for rounding, relative to the largest element. Inverses in
single precision of a person's information after hundreds of frames differ by up to 1e-4."""
_WANTED = "expected an .npz with identity, covariance, offset and header, as `jaxfilters track head-mono` writes it"


class People(NamedTuple):
    """P people of one model of the face."""

    names: tuple[str, ...]
    gallery: Gallery


def write_people(path: Path, people: People, face: MultilinearFace) -> None:
    """Write people of a model; their folder is made if need be.

    Raises:
        OutputError: the file cannot be written.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "units": "mm",
        "names": list(people.names),
        "model": fingerprint(face),
    }
    arrays = {name: np.asarray(value) for name, value in people.gallery._asdict().items()}
    arrays["covariance"] = _symmetric(arrays["covariance"])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_npz(path, {"header": np.asarray(json.dumps(header)), **arrays})
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def read_people(paths: Sequence[Path], face: MultilinearFace) -> People:
    """People from one file or more, in JAX's default precision.

    Args:
        paths: The files.
        face: The model that they must be of.

    Raises:
        InputError: an unreadable or foreign file, another version, people of another model, arrays that do not fit it,
            are not finite, or covariances that are none.
    """
    found = [_read(path, face) for path in paths]
    return People(tuple(name for one in found for name in one.names), joined(*(one.gallery for one in found)))


def fingerprint(face: MultilinearFace) -> str:
    """What people of one model have in common, and those of others do not."""
    # Six digits: the same model read in another precision is the same.
    numbers = np.concatenate([np.asarray(part, np.float32).ravel() for part in (face.mean, face.tensor)])
    text = ",".join(f"{number:.5e}" for number in numbers)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read(path: Path, face: MultilinearFace) -> People:
    arrays = read_npz(path, _WANTED)
    if missing := [name for name in (*Gallery._fields, "header") if name not in arrays]:
        raise InputError(f"{path}: without {', '.join(missing)}; {_WANTED}.")
    header = read_header(arrays, path, _WANTED, FORMAT, VERSION, "mm")
    if header.get("model") != fingerprint(face):
        raise InputError(f"{path}: people of another model of the face than the one that is used (--model).")
    names = header.get("names")
    if not isinstance(names, list) or not names:
        raise InputError(f"{path}: names must be of one person or more; got {shown(names)}.")
    count, num_identities = len(names), face.num_identities
    shapes = ((count, num_identities), (count, num_identities, num_identities), (count, *face.mean.shape))
    for name, shape in zip(Gallery._fields, shapes, strict=True):
        _check(arrays[name], name, shape, path)
    arrays["covariance"] = _covariances(arrays["covariance"].astype(float), path)
    gallery = Gallery(*(jnp.asarray(arrays[name], float) for name in Gallery._fields))
    return People(tuple(str(name) for name in names), gallery)


def _covariances(given: np.ndarray, path: Path) -> np.ndarray:
    """Covariances (P, S, S), exactly symmetric, from those of a file."""
    symmetric = _symmetric(given)
    rounding = _ASYMMETRY * np.abs(given).max(axis=(1, 2), keepdims=True)
    if np.any(2 * np.abs(given - symmetric) > rounding) or np.any(np.linalg.eigvalsh(symmetric) <= 0):
        raise InputError(f"{path}: covariance must be symmetric and positive definite.")
    return symmetric


def _symmetric(matrices: np.ndarray) -> np.ndarray:
    return 0.5 * (matrices + matrices.swapaxes(-1, -2))


def _check(array: np.ndarray, name: str, shape: tuple[int, ...], path: Path) -> None:
    if array.shape != shape or array.dtype.kind != "f":
        raise InputError(f"{path}: {name} must be numbers {shape}; got {array.shape} {array.dtype}.")
    if not are_finite(array):
        raise InputError(f"{path}: {name} must be finite, at most {LARGEST:g}.")
