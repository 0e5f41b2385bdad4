"""`scene.json`: where people can walk, and what stands in front of them."""

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
import trimesh

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.scene import mesh_depth, patch_depth, upright_depth
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.json_files import read_json

_KEYS = {"floor", "patches", "meshes", "outlines", "note"}
_WANTED = (
    'expected {"floor": [[x, y], ...]} in metres, and optionally "patches": [[corner, edge, edge], ...] in metres, '
    '"meshes": ["desk.stl", ...] in metres, '
    '"outlines": [{"camera": 0, "polygon": [[u, v], ...], "at": [x, y]}, ...] in pixels without lens distortion'
)


class SceneFile(NamedTuple):
    """A place as a file describes it."""

    floor: np.ndarray
    """(corners, 2) metres."""
    patches: np.ndarray
    """(n, 3, 3): a corner and two edges each, metres."""
    meshes: list[trimesh.Trimesh]
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
    if unknown := set(settings) - _KEYS:
        raise InputError(f"{path}: unknown entries {sorted(unknown)}; {_WANTED}.")
    floor = _array(path, "floor", settings["floor"], (None, 2))
    patches = _array(path, "patches", settings.get("patches", np.zeros((0, 3, 3))), (None, 3, 3))
    return SceneFile(
        floor,
        patches,
        [_mesh(path, name) for name in settings.get("meshes", [])],
        [_outline(path, one) for one in settings.get("outlines", [])],
    )


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


def _array(path: Path, name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {name} must be numbers; {_WANTED}.") from None
    fits = array.ndim == len(shape) and all(want in (None, size) for want, size in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        raise InputError(f"{path}: {name} must be finite, of shape {shape}; got {array.shape}.")
    return array


def _mesh(path: Path, name: Any) -> trimesh.Trimesh:
    file = path.parent / str(name)
    try:
        mesh = trimesh.load_mesh(file)
    except Exception as error:  # trimesh raises whatever its readers raise
        raise InputError(f"{file}: not a mesh that can be read ({error}).") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{file}: holds no triangles.")
    return mesh


def _outline(path: Path, one: Any) -> dict[str, Any]:
    if not isinstance(one, dict) or {"polygon", "at"} - set(one) or set(one) - {"camera", "polygon", "at"}:
        raise InputError(f"{path}: an outline must have polygon and at, and may have camera; got {one!r}.")
    camera = one.get("camera", 0)
    if not isinstance(camera, int):
        raise InputError(f"{path}: camera of an outline must be a number from 0; got {camera!r}.")
    return {
        "camera": camera,
        "polygon": _array(path, "polygon", one["polygon"], (None, 2)),
        "at": _array(path, "at", one["at"], (2,)),
    }
