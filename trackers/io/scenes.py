"""`scene.json`: where people can walk, and what stands in front of them."""

import io
import logging
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.scene import mesh_depth, patch_depth, upright_depth
from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.input_files import are_finite, read_bytes
from jaxfilters.trackers.io.json_files import read_json, refuse_unknown

if TYPE_CHECKING:
    import trimesh

_KEYS = {"floor", "patches", "meshes", "outlines", "note"}
_WANTED = (
    'expected {"floor": [[x, y], ...]} in metres, and optionally "patches": [[corner, edge, edge], ...] in metres, '
    '"meshes": ["desk.stl", ...] in metres, '
    '"outlines": [{"camera": 0, "polygon": [[u, v], ...], "at": [x, y]}, ...] in pixels without lens distortion'
)
_WIDEST_M = 500.0
"""Of a floor, and of where anything stands beside its middle: the tracker keeps a grid with steps of 0.3 m."""
_FARTHEST_PX = 1e6
_MESHES = {".stl", ".obj", ".ply", ".off"}
# Without a handler of its own, what its readers say of a damaged file would go to the standard error stream.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


class SceneFile(NamedTuple):
    """A place as a file describes it."""

    floor: np.ndarray
    """(corners, 2) metres."""
    patches: np.ndarray
    """(n, 3, 3): a corner and two edges each, metres."""
    meshes: "list[trimesh.Trimesh]"
    outlines: list[dict[str, Any]]


def open_scene(path: str | Path) -> SceneFile:
    """Read and check a `scene.json`.

    Raises:
        InputError: an unreadable file, unknown entries, or values of a wrong shape.
    """
    path = Path(path)
    settings = read_json(path, _WANTED)
    if "floor" not in settings:
        raise InputError(f"{path}: {_WANTED}.")
    refuse_unknown(settings, _KEYS, path)
    floor = _array(path, "floor", settings["floor"], (None, 2))
    if len(floor) < 3:
        raise InputError(f"{path}: floor must be a polygon of 3 corners or more; got {len(floor)}.")
    _check_extent(floor, f"{path}: floor")
    patches = _array(path, "patches", settings.get("patches") or np.zeros((0, 3, 3)), (None, 3, 3))
    if len(patches):
        _check_extent(np.concatenate([floor, patches[:, 0, :2]]), f"{path}: patches")
    meshes = [_mesh(path, name) for name in _listed(settings, "meshes", path)]
    return SceneFile(floor, patches, meshes, [_outline(path, one) for one in _listed(settings, "outlines", path)])


def furniture_of(scene: SceneFile, cameras: list[FloorCamera]) -> list[np.ndarray]:
    """Depth images of everything that stands in the place, one a camera, metres.

    Raises:
        InputError: an outline for a camera that does not exist.
    """
    if wrong := [one["camera"] for one in scene.outlines if not 0 <= one["camera"] < len(cameras)]:
        raise InputError(f"scene: outlines for cameras {wrong}; there are {len(cameras)}, counted from 0.")
    return [_furniture(scene, camera, number) for number, camera in enumerate(cameras)]


def _furniture(scene: SceneFile, camera: FloorCamera, number: int) -> np.ndarray:
    depth = np.full(camera.shape, np.inf, np.float32)
    if len(scene.patches):
        depth = np.minimum(depth, np.asarray(patch_depth(camera, jnp.asarray(scene.patches, jnp.float32))))
    for mesh in scene.meshes:
        depth = np.minimum(depth, np.asarray(mesh_depth(camera, np.asarray(mesh.vertices), np.asarray(mesh.faces))))
    for one in scene.outlines:
        if one["camera"] == number:
            inside = np.zeros(camera.shape, np.uint8)
            cv2.fillPoly(inside, [np.round(one["polygon"]).astype(np.int32)], 1)
            there = np.asarray(upright_depth(camera, jnp.asarray(one["at"], jnp.float32)))
            depth = np.where(inside > 0, np.minimum(depth, there), depth)
    return depth


def _listed(settings: dict[str, Any], entry: str, path: Path) -> list[Any]:
    """The list under `entry`; an empty one where there is none, or null."""
    value = settings.get(entry)
    if not isinstance(value, list | None):
        raise InputError(f"{path}: {entry} must be a list; got {shown(value)}; {_WANTED}.")
    return value or []


def _check_extent(points_m: np.ndarray, place: str) -> None:
    """Raise `InputError` where points (n, 2) lie farther from each other than any floor is wide."""
    width, depth = np.ptp(points_m, axis=0)
    if max(width, depth) > _WIDEST_M:
        raise InputError(
            f"{place} spans {width:.4g} x {depth:.4g} m, expected at most {_WIDEST_M:g} m; it must be in metres (is it "
            "in millimetres?)."
        )


def _array(path: Path, name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {name} must be numbers; got {shown(value)}; {_WANTED}.") from None
    fits = array.ndim == len(shape) and all(want in (None, size) for want, size in zip(shape, array.shape, strict=True))
    if not fits or not are_finite(array):
        raise InputError(f"{path}: {name} must be finite, of shape {shape}; got {array.shape}.")
    return array


def _mesh(path: Path, name: Any) -> "trimesh.Trimesh":
    import trimesh  # a tenth of a second, for scenes with meshes

    if not isinstance(name, str) or Path(name).suffix.lower() not in _MESHES:
        raise InputError(f"{path}: meshes must be names of files ({', '.join(sorted(_MESHES))}); got {shown(name)}.")
    file = path.parent / name
    content = read_bytes(file, "expected a mesh")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # From memory: a reader that knows the folder would open what the file names.
            mesh = trimesh.load_mesh(io.BytesIO(content), file_type=file.suffix[1:].lower())
    except Exception as error:  # trimesh raises whatever its readers raise
        raise InputError(f"{file}: not a mesh that can be read ({shortened(str(error))}).") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{file}: holds no triangles.")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if not are_finite(vertices) or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{file}: not a mesh that can be read (vertices that are not finite, or not there).")
    _check_extent(vertices[:, :2], str(file))
    return mesh


def _outline(path: Path, one: Any) -> dict[str, Any]:
    if not isinstance(one, dict) or {"polygon", "at"} - set(one) or set(one) - {"camera", "polygon", "at"}:
        raise InputError(f"{path}: an outline must have polygon and at, and may have camera; got {shown(one)}.")
    camera = one.get("camera", 0)
    if type(camera) is not int or camera < 0:
        raise InputError(f"{path}: camera of an outline must be a number from 0; got {shown(camera)}.")
    polygon = _array(path, "polygon", one["polygon"], (None, 2))
    if len(polygon) < 3 or np.abs(polygon).max() > _FARTHEST_PX:
        raise InputError(
            f"{path}: polygon of an outline must be 3 pixels or more, near the image; got {shown(one['polygon'])}."
        )
    return {"camera": camera, "polygon": polygon, "at": _array(path, "at", one["at"], (2,))}
