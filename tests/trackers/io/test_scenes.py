"""`scene.json`: furniture seen by a camera straight above, where depths are plain to see, and what is refused."""

import json

import numpy as np
import pytest
import trimesh

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.scenes import furniture_of, open_scene

FLOOR = [[0, 0], [4, 0], [4, 4], [0, 4]]


def _above() -> FloorCamera:
    """5 m above (2, 2), looking down, 20 px a metre on the floor."""
    R = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    K = np.array([[100.0, 0, 49.5], [0, 100, 49.5], [0, 0, 1]])
    return FloorCamera.from_matrix(K @ np.column_stack([R, -R @ [2, 2, 5]]), (100, 100))


def _write(tmp_path, **settings):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps({"floor": FLOOR} | settings))
    return path


@pytest.mark.system
def test_a_patch_and_a_mesh_stand_where_they_are_said_to(tmp_path):
    trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix((3, 2, 0.5))).export(tmp_path / "b.stl")
    patch = [[0.5, 1.5, 2.0], [1, 0, 0], [0, 1, 0]]
    scene = open_scene(_write(tmp_path, patches=[patch], meshes=["b.stl"]))
    (depth,) = furniture_of(scene, [_above()])
    # (1, 2) at height 2 is 3 m below the camera; (3, 2) at height 1 is 4 m below it.
    assert depth[50, round(49.5 - 100 / 3)] == pytest.approx(3.0, abs=1e-4)
    assert depth[50, round(49.5 + 100 / 4)] == pytest.approx(4.0, abs=1e-4)
    assert np.isinf(depth[10, 50])


def test_an_outline_hides_what_is_behind_its_place(tmp_path):
    polygon = [[10, 10], [30, 10], [30, 40], [10, 40]]
    scene = open_scene(_write(tmp_path, outlines=[{"polygon": polygon, "at": [1.0, 3.0]}]))
    (depth,) = furniture_of(scene, [_above()])
    assert np.isfinite(depth[20, 20])
    assert np.isinf(depth[60, 60])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"flor": []}, "unknown entries"),
        ({"floor": [[0, 0, 0]]}, "floor must be finite"),
        ({"patches": [[0, 1]]}, "patches must be finite"),
        ({"meshes": ["none.stl"]}, "none.stl"),
        ({"outlines": [{"at": [0, 0]}]}, "polygon and at"),
    ],
)
def test_wrong_scenes_are_refused(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        open_scene(_write(tmp_path, **settings))


def test_no_json_and_unknown_cameras_are_refused(tmp_path):
    path = tmp_path / "scene.json"
    path.write_text("{")
    with pytest.raises(InputError, match="not JSON"):
        open_scene(path)
    scene = open_scene(_write(tmp_path, outlines=[{"camera": 2, "polygon": FLOOR, "at": [0, 0]}]))
    with pytest.raises(InputError, match=r"cameras \[2\]"):
        furniture_of(scene, [_above()])
