"""Disturbances of the scenario of light, and the truths of the corridor and of two cameras; nobody is tracked here."""

import json

import numpy as np
import pytest

from jaxfilters.benchmarks.multi_object import FloorTracks, floor_tracks
from jaxfilters.benchmarks.scenarios import _pets_two, people_corridor
from jaxfilters.benchmarks.scenarios.people_light import DRIFT_PX, KNOCK_PX, SHAKE_PX, disturbances
from jaxfilters.trackers.background.registration import Registration
from jaxfilters.trackers.io.video_input import VideoFile

K = np.array([[200.0, 0, 79.5], [0, 200.0, 59.5], [0, 0, 1.0]])


@pytest.fixture(scope="module")
def image():
    coarse = np.random.default_rng(0).integers(40, 180, (15, 20, 3))
    return np.kron(coarse, np.ones((8, 8, 1))).astype(np.uint8)


def test_the_light_changes_as_it_says(image):
    cases = disturbances(K, 0)
    middle = slice(None), slice(None), slice(None)
    assert np.array_equal(cases["undisturbed"](image, 0.9), image)
    for name, gain in (("step", 1.25), ("dim", 0.7)):
        assert np.array_equal(cases[name](image, 0.5), image)
        np.testing.assert_allclose(cases[name](image, 0.51)[middle], gain * image, atol=0.5)
    np.testing.assert_allclose(cases["sun"](image, 0.25), 1.2 * image, atol=0.5)
    ratios = cases["lamp"](image, 1.0).reshape(-1, 3).sum(axis=0) / image.reshape(-1, 3).sum(axis=0)
    np.testing.assert_allclose(ratios, [0.8, 1.0, 1.15], atol=0.01)


def test_cameras_move_by_so_many_pixels(image):
    cases = disturbances(K, 1)
    registration = Registration(K)
    registration.straightened(image)

    def moved(name, t):
        registration.straightened(cases[name](image, t))
        u, v, w = K @ registration.state()["rotation"] @ np.linalg.inv(K) @ [79.5, 59.5, 1.0]
        return float(np.hypot(u / w - 79.5, v / w - 59.5))

    assert moved("drift", 1.0) == pytest.approx(DRIFT_PX, rel=0.03)
    assert moved("knock", 0.4) == pytest.approx(0.0, abs=0.1)
    assert moved("knock", 0.6) == pytest.approx(KNOCK_PX, rel=0.03)
    shakes = [moved("shake", t) for t in np.linspace(0, 1, 12)]
    # Two angles of this standard deviation: their root mean square is 1.41 times as much, here within two of its own.
    assert np.sqrt(np.mean(np.square(shakes))) == pytest.approx(np.sqrt(2) * SHAKE_PX, rel=0.42)


@pytest.mark.data
def test_the_corridor_has_its_people_on_its_floor(data_dir):
    folder = data_dir / "caviar_corridor"
    camera = people_corridor.corridor_camera(folder / "floor_points.csv", (288, 384))
    points = np.array([[0.0, 9.75, 0.0], [2.9, -1.1, 0.0]])
    np.testing.assert_allclose(camera.project(points)[0], [[91, 163], [322, 265]], atol=0.5)
    true = people_corridor.annotated(folder / "cols1gt.xml", camera)
    assert set(true.identity) == {1, 3, 4, 5}  # 0 walks out of the image below, 2 stands beyond the floor
    walker = true.xy_m[true.identity == 5]
    assert 3 < np.linalg.norm(walker[-1] - walker[0]) < 8
    assert np.median(np.linalg.norm(np.diff(walker, axis=0), axis=1)) < 0.1
    assert len(list(VideoFile(folder / "OneLeaveShop1cor.mpg").images())) == 295


def test_a_place_whose_feet_are_hidden_is_between_those_where_they_are_not():
    """The second person's box ends where that of the first begins in frame 1; in frame 2 it is beside it again."""
    frame, identity = np.repeat(np.arange(3), 2), np.tile([7, 8], 3)
    boxes = np.array(
        [[0, 0, 9, 50], [30, 0, 40, 40], [25, 5, 45, 55], [30, 0, 40, 20], [60, 0, 70, 50], [30, 0, 40, 40]]
    )
    feet = np.stack([boxes[:, [0, 2]].mean(axis=1), boxes[:, 3]], axis=-1)
    hidden = people_corridor.hidden_feet(frame, feet, boxes)
    np.testing.assert_array_equal(hidden, [False, False, False, True, False, False])
    floor = np.array([[1.0, 1], [0, 10], [1, 2], [0, 30], [1, 3], [0, 11]])
    found = people_corridor.interpolated(frame, identity, floor, hidden)
    np.testing.assert_allclose(found, np.where(hidden[:, None], [0.0, 10.5], floor))


@pytest.mark.data
def test_the_corridor_mirrored_and_backwards_has_its_people_where_its_images_have_them(data_dir):
    folder = data_dir / "caviar_corridor"
    camera = people_corridor.corridor_camera(folder / "floor_points.csv", (288, 384))
    true = people_corridor.annotated(folder / "cols1gt.xml", camera)
    true = FloorTracks(*(column[true.frame < 3] for column in true))
    images = np.random.default_rng(0).integers(0, 255, (3, 288, 384, 3), np.uint8)
    corridor = people_corridor.Corridor(camera, people_corridor.FLOOR, true, list(enumerate(images)), list(images))
    other = people_corridor.mirrored(people_corridor.backwards(corridor))
    np.testing.assert_array_equal(other.moments[0][1][:, ::-1], images[2])
    project = lambda camera, xy: np.asarray(camera.project(np.pad(xy, ((0, 0), (0, 1))))[0])
    first, last = other.true.xy_m[other.true.frame == 0], true.xy_m[true.frame == 2]
    np.testing.assert_allclose(project(other.camera, first)[:, 0], 383 - project(camera, last)[:, 0], atol=0.01)
    np.testing.assert_allclose(project(other.camera, first)[:, 1], project(camera, last)[:, 1], atol=0.01)


def test_two_cameras_are_judged_beside_the_better_one(tmp_path, monkeypatch):
    """Stand-ins: both views are a tenth off, view 1 misses half of the frames, view 6 three quarters."""
    area = {"xmin": -1, "xmax": 9, "ymin": -1, "ymax": 9}
    (tmp_path / "calibration.json").write_text(json.dumps({"evaluation_area": area}))
    rows = "".join(f"{t},3,{0.1 * t},2.0\n{t},4,20.0,2.0\n" for t in range(40))
    (tmp_path / "gt_0_399.csv").write_text("frame,id,x_m,y_m\n" + rows)

    def follow(folder, views, calibration, area, frames, disturb):
        kept = np.arange(40)[:: {(1, 6): 1, (1,): 2, (6,): 4}[views]]
        return floor_tracks(kept, np.full(len(kept), 8), np.stack([0.1 * kept + 0.1, np.full(len(kept), 2.0)], -1))

    monkeypatch.setattr(_pets_two, "_low_view", lambda *_: {})
    monkeypatch.setattr(_pets_two, "follow", follow)
    value = {k: m.value for k, m in _pets_two.two_view_metrics(tmp_path, tmp_path, quick=True, seed=0).items()}
    assert value["mota_two"] == pytest.approx(100)
    assert value["mota_one"] == pytest.approx(50)
    assert value["mean_error_m_two"] == pytest.approx(0.1)
    assert value["idf1_two"] == pytest.approx(100)
    assert "mota_two_refit" not in value
