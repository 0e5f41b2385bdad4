"""Contents of files by which a run that is continued is known to be the same run."""

import numpy as np
import pytest
import trimesh

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.io.cameras import CameraFile
from jaxfilters.trackers.io.scenes import SceneFile
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people.identity import identity_of

SHAPE = (120, 160)
FLOOR = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 4.0)])
K = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])


def camera_file(P, K=K, distortion=(-0.2, 0.05, 0, 0, 0), name="hall"):
    return CameraFile(name, FloorCamera.from_matrix(P, SHAPE), Undistortion(SHAPE, K, np.array(distortion)))


@pytest.fixture
def P(camera):
    return np.asarray(camera.P, float)


def scene_file(floor=FLOOR, edge=1.0, height=0.7, at=(1.0, 2.0)):
    mesh = trimesh.Trimesh(np.array([(0, 0, height), (1, 0, height), (0, 1, height)]), [(0, 1, 2)])
    outline = {"camera": 0, "polygon": np.array([(10.0, 10), (20, 10), (20, 20)]), "at": np.array(at)}
    return SceneFile(floor, edge * np.eye(3)[None], [mesh], [outline])


def boxes(score=0.9, frame=4):
    return {1: np.array([[1.0, 2, 3, 4, 1.0]]), frame: np.array([[5.0, 6, 7, 8, score]])}


def test_equal_contents_are_the_same_whatever_their_order_and_names(P):
    one = identity_of([camera_file(P)], scene_file(), [boxes()])
    other = identity_of([camera_file(P, name="moved")], scene_file(), [dict(reversed(boxes().items()))])
    assert one == other
    assert sorted(one) == ["cameras", "detections", "floor", "furniture"]


@pytest.mark.parametrize(
    ("part", "changed"),
    [
        ("cameras", lambda P: ([camera_file(P + 1e-3)], scene_file(), [boxes()])),
        ("cameras", lambda P: ([camera_file(P, distortion=(-0.2, 0.06, 0, 0, 0))], scene_file(), [boxes()])),
        ("cameras", lambda P: ([camera_file(P, K=1.001 * K)], scene_file(), [boxes()])),
        ("cameras", lambda P: ([camera_file(P, K=None)], scene_file(), [boxes()])),
        ("floor", lambda P: ([camera_file(P)], scene_file(floor=1.001 * FLOOR), [boxes()])),
        ("furniture", lambda P: ([camera_file(P)], scene_file(edge=1.001), [boxes()])),
        ("furniture", lambda P: ([camera_file(P)], scene_file(height=0.71), [boxes()])),
        ("furniture", lambda P: ([camera_file(P)], scene_file(at=(1.0, 2.01)), [boxes()])),
        ("detections", lambda P: ([camera_file(P)], scene_file(), [boxes(score=0.91)])),
        ("detections", lambda P: ([camera_file(P)], scene_file(), [boxes(frame=5)])),
        ("detections", lambda P: ([camera_file(P)], scene_file(), [])),
    ],
)
def test_what_changed_is_named(P, part, changed):
    before, after = identity_of([camera_file(P)], scene_file(), [boxes()]), identity_of(*changed(P))
    assert [name for name in before if before[name] != after[name]] == [part]
