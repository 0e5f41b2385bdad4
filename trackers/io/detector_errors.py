"""By how much detectors misplace the landmarks of faces, on disk, and the file that comes with the package.

An `.npz` with, for each detector NAME, the arrays `NAME_mean` (K, 3) and `NAME_covariance` (3K, 3K), which describe the
part that all images of one person share, in millimetres on the model's axes, and `NAME_white` (K,), the standard
deviation of a coordinate from image to image in millimetres across the line of sight; of a detector of meshes also
`NAME_vertices` (V, 3), the mean mesh in millimetres on the model's axes; and `header`, a text in JSON:

    {"format": "jaxfilters detector errors", "version": 1, "units": "mm", "detectors": [names], "parameters": {...}}

`jaxfilters fit face-detector` writes them. The file of the package was measured on rendered people of the ICT face
model (Copyright (c) 2020 USC Institute for Creative Technologies, MIT License); it contains statistics and no part of
that model. The notice of its licence is in the file `NOTICE`.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.trackers.io.checkpoint import write_npz
from jaxfilters.trackers.io.errors import InputError, OutputError, shown
from jaxfilters.trackers.io.input_files import LARGEST, are_finite
from jaxfilters.trackers.io.npz import read_header, read_npz

FORMAT, VERSION = "jaxfilters detector errors", 1
FEWEST_VERTICES = 4
"""Of a mesh, for a rotation."""
DEFAULT_FILE = Path(__file__).with_name("detector_errors.npz")
"""What `jaxfilters fit face-detector` made of people of the ICT face model."""
_WANTED = "expected an .npz of `jaxfilters fit face-detector`"


class DetectorErrors(NamedTuple):
    """Of one detector, for the ten landmarks."""

    mean: Float[np.ndarray, "10 3"]
    """Millimetres on the model's axes: what all images of all people share."""
    covariance: Float[np.ndarray, "30 30"]
    """Millimetres squared, among people: what all images of one person share."""
    white: Float[np.ndarray, " 10"]
    """Standard deviation of a coordinate from image to image, millimetres across the line of sight."""
    vertices: Float[np.ndarray, "V 3"] | None = None
    """Mean mesh of people, millimetres about the mean vertex, on the axes of the package's general model; None for a
    detector without meshes."""


def save_detector_errors(path: Path, errors: dict[str, DetectorErrors], parameters: dict[str, Any]) -> None:
    """Write the errors of detectors by name; the folder is made if need be.

    Raises:
        OutputError: the file cannot be written.
    """
    header = {"format": FORMAT, "version": VERSION, "units": "mm", "detectors": list(errors), "parameters": parameters}
    arrays = {
        f"{name}_{part}": value
        for name, one in errors.items()
        for part, value in one._asdict().items()
        if value is not None
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_npz(path, {"header": np.asarray(json.dumps(header, allow_nan=False)), **arrays})
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def load_detector_errors(path: Path) -> dict[str, DetectorErrors]:
    """The errors of detectors by name.

    Raises:
        InputError: an unreadable or foreign file, another version, arrays of other shapes or not finite, covariances
            that are none, or standard deviations that are not positive.
    """
    arrays = read_npz(path, _WANTED)
    if "header" not in arrays:
        raise InputError(f"{path}: without header; {_WANTED}.")
    names = read_header(arrays, path, _WANTED, FORMAT, VERSION, "mm").get("detectors")
    if not isinstance(names, list) or not names:
        raise InputError(f"{path}: detectors must be one name or more; got {shown(names)}.")
    return {str(name): _errors(arrays, str(name), path) for name in names}


@cache
def default_detector_errors() -> dict[str, DetectorErrors]:
    """Those that come with the package, of OpenCV's cascades and of MediaPipe's face mesh."""
    return load_detector_errors(DEFAULT_FILE)


def _errors(arrays: dict[str, np.ndarray], name: str, path: Path) -> DetectorErrors:
    size = 3 * NUM_LANDMARKS
    shapes: dict[str, tuple[int, ...]] = {
        "mean": (NUM_LANDMARKS, 3),
        "covariance": (size, size),
        "white": (NUM_LANDMARKS,),
    }
    mesh = arrays.get(f"{name}_vertices")
    if mesh is not None:
        shapes["vertices"] = (max(len(mesh) if mesh.ndim else 0, FEWEST_VERTICES), 3)
    for part, shape in shapes.items():
        array = arrays.get(f"{name}_{part}")
        if array is None or array.shape != shape or array.dtype.kind != "f" or not are_finite(array):
            got = "none" if array is None else f"{array.shape} {array.dtype}"
            raise InputError(f"{path}: {name}_{part} must be finite numbers {shape} below {LARGEST:g}; got {got}.")
    one = DetectorErrors(**{part: arrays[f"{name}_{part}"].astype(float) for part in shapes})
    covariance = 0.5 * (one.covariance + one.covariance.T)
    scale = np.abs(covariance).max()
    if np.abs(covariance - one.covariance).max() > 1e-5 * scale or np.linalg.eigvalsh(covariance)[0] < -1e-5 * scale:
        raise InputError(f"{path}: {name}_covariance must be symmetric and positive semidefinite.")
    if np.any(one.white <= 0):
        raise InputError(f"{path}: {name}_white must be positive; got {one.white.min():.3g}.")
    return one._replace(covariance=covariance)
