"""Tracks in the formats of others: by images of the first camera, so that they can be read as detections of it."""

import json

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.calibration import decompose
from jaxfilters.trackers.io.detections import read_detections
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people import files
from jaxfilters.trackers.people.files import write_coco, write_mot
from jaxfilters.trackers.people.recorded import NO_IMAGE, Sighting
from jaxfilters.trackers.people.state import STATE, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene

WRITE = {"tracks_mot.txt": write_mot, "tracks_coco.json": write_coco}
IMAGES = {6: 3, 7: NO_IMAGE, 8: 4, 9: NO_IMAGE, 14: 7}
"""By moment: those of a camera at half the rate of another one, without a person at first and in image 5 and 6."""


@pytest.fixture(scope="module")
def scene(camera, floor):
    return people_scene([camera], floor, config=PeopleConfig(capacity=2, cell_m=2.0))


def tracks():
    mean = np.zeros(STATE)
    mean[[1, 4, 5]] = 1.0, 1.7, 0.45
    return {
        2: [
            Sighting(
                frame, 0.1 * frame, mean + 0.02 * frame * np.eye(STATE)[0], np.eye(STATE), 0.8, 0, "tracked", image
            )
            for frame, image in IMAGES.items()
        ]
    }


@pytest.mark.system
@pytest.mark.parametrize("name", WRITE)
def test_boxes_belong_to_the_images_of_the_first_camera_and_are_read_back(scene, camera, tmp_path, name):
    """The middle of each box is where the camera shows the middle of the person at that moment, to a pixel or two."""
    WRITE[name](tmp_path / name, scene, Undistortion(camera.shape), tracks())
    found = read_detections(tmp_path / name)
    assert sorted(found) == [3, 4, 7]
    for frame, image in IMAGES.items():
        if image != NO_IMAGE:
            (left, top, right, bottom, score), *others = found[image]
            middle = camera.project(jnp.array([0.02 * frame, 1.0, 0.85]))[0]
            np.testing.assert_allclose([(left + right) / 2, (top + bottom) / 2], middle, atol=2.0)
            assert (score, others) == (0.8, [])


@pytest.mark.parametrize("block", [3, 4096])
def test_boxes_are_in_pixels_with_the_distortion_of_the_lens(scene, camera, tmp_path, monkeypatch, block):
    """OpenCV projects the surface of the ellipsoid through the lens; the last person is behind the camera."""
    monkeypatch.setattr(files, "BLOCK", block)
    K, R, t = decompose(np.asarray(camera.P, float))
    lens = np.array([-0.28, 0.06, 0.002, -0.003, 0.01])
    places = [(-2.6, 0.8), (2.7, 0.6), (0.0, 3.0), (-0.4, -1.2), (1.2, 2.0), (0.0, -9.0)]
    people = {}
    for identity, place in enumerate(places):
        mean = np.zeros(STATE)
        mean[[0, 1, 4, 5]] = *place, 1.5 + 0.07 * identity, 0.4 + 0.02 * identity
        people[identity] = [Sighting(0, 0.0, mean, np.eye(STATE), 0.8, 0, "tracked", 0)]
    write_mot(tmp_path / "a.txt", scene, Undistortion(camera.shape, K, lens), people)
    rows = np.loadtxt(tmp_path / "a.txt", delimiter=",")
    assert rows[:, 1].tolist() == [1, 2, 3, 4, 5]
    polar, around = np.meshgrid(np.linspace(0, np.pi, 100), np.linspace(0, 2 * np.pi, 200))
    sphere = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1).reshape(
        -1, 3
    )
    moved = []
    for (x, y), identity, row in zip(places, people, rows, strict=False):
        height, width = people[identity][0].mean[4:6]
        surface = [x, y, height / 2] + sphere * [width / 2, width / 2, height / 2]
        uv, straight = (cv2.projectPoints(surface, cv2.Rodrigues(R)[0], t, K, k)[0][:, 0] for k in (lens, np.zeros(5)))
        low, high = uv.min(axis=0), uv.max(axis=0)
        np.testing.assert_allclose(row[2:6], [*low, *(high - low)], atol=0.1)
        moved.append(np.abs(low - straight.min(axis=0)).max())
    assert max(moved) > 1


def test_all_images_of_a_coco_file_are_listed(scene, camera, tmp_path):
    """Readers count them: the first person comes in image 3."""
    write_coco(tmp_path / "a.json", scene, Undistortion(camera.shape), tracks())
    assert [image["id"] for image in json.loads((tmp_path / "a.json").read_text())["images"]] == list(range(8))


@pytest.mark.parametrize("name", WRITE)
def test_without_people_there_are_no_boxes(scene, camera, tmp_path, name):
    WRITE[name](tmp_path / name, scene, Undistortion(camera.shape), {})
    assert read_detections(tmp_path / name) == {}
