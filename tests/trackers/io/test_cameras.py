import json

import numpy as np
import pytest

from jaxfilters.models.calibration import Calibration
from jaxfilters.trackers.io.cameras import (
    open_camera,
    open_intrinsics,
    read_tsai,
    write_calibration,
    write_camera,
)
from jaxfilters.trackers.io.errors import InputError, OutputError

PITCH = np.deg2rad(37)
R = np.array([[1, 0, 0], [0, -np.sin(PITCH), -np.cos(PITCH)], [0, np.cos(PITCH), -np.sin(PITCH)]])
K = np.array([[139, 0, 79.5], [0, 139, 59.5], [0, 0, 1.0]])
T = -R @ [-1, -1.74, 2.64]
P = K @ np.column_stack([R, T])
POSE = {"image_size": [160, 120], "K": K.tolist(), "R": R.tolist(), "t": T.tolist()}
MATRIX = {"image_size": [160, 120], "P": P.tolist()}
XML = """<?xml version="1.0" encoding="UTF-8"?>
<Camera name="a">
<Geometry width="768" height="576" dpx="5.1e-03" dpy="4.6e-03"/>
<Intrinsic focal="5.5" kappa1="5.1e-03" cx="324" cy="282" sx="1.09"/>
<Extrinsic tx="8.2e+02" ty="-3.1e+03" tz="3.5e+04" rx="2.04" ry="-0.89" rz="-0.43"/>
</Camera>
"""


def written(tmp_path, settings):
    file = tmp_path / "camera.json"
    file.write_text(settings if isinstance(settings, str) else json.dumps(settings))
    return file


@pytest.mark.parametrize("settings", [MATRIX, POSE, {"image_size": [160, 120], "P": (-0.3 * P).tolist()}])
def test_a_matrix_of_any_scale_and_a_pose_are_the_same_camera(tmp_path, settings):
    name, camera, undistortion = open_camera(written(tmp_path, settings))
    assert (name, camera.shape, undistortion.is_identity) == ("camera", (120, 160), True)
    np.testing.assert_allclose(camera.P, P, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(camera.position(), [-1, -1.74, 2.64], rtol=1e-5)


def test_distortion_comes_along(tmp_path):
    lens = [-0.2, 0.05, 0.001, 0, 0]
    opened = open_camera(written(tmp_path, MATRIX | {"name": "hall", "K": K.tolist(), "distortion": lens}))
    assert opened.name == "hall"
    assert not opened.undistortion.is_identity
    np.testing.assert_array_equal(opened.undistortion.distortion, lens)
    np.testing.assert_array_equal(opened.undistortion.K, K)


def test_what_is_written_is_read(tmp_path):
    file = tmp_path / "new" / "camera.json"
    lens = np.array([-0.2, 0.05, 0.001, 0, 0])
    write_calibration(file, Calibration(K, lens, R, T, 0.31), (160, 120), name="hall")
    opened = open_camera(file, image_size=(160, 120))
    np.testing.assert_allclose(opened.camera.P, P, rtol=1e-5, atol=1e-5)
    assert opened.name == "hall"
    found, distortion, image_size = open_intrinsics(file)
    np.testing.assert_array_equal(found, K)
    np.testing.assert_array_equal(distortion, lens)
    assert image_size == (160, 120)
    assert json.loads(file.read_text())["note"] == "reprojection error 0.31 px"


def test_intrinsics_alone_are_no_camera(tmp_path):
    write_camera(tmp_path / "k.json", (160, 120), K=K)
    np.testing.assert_array_equal(open_intrinsics(tmp_path / "k.json")[1], np.zeros(5))
    with pytest.raises(InputError, match=r"P missing \(or R, t\)"):
        open_camera(tmp_path / "k.json")
    with pytest.raises(InputError, match="K missing"):
        open_intrinsics(written(tmp_path, MATRIX))


def changed(**entries):
    return MATRIX | {key: np.asarray(value).tolist() for key, value in entries.items()}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("{P: 1}", r"camera.json: not JSON"),
        ([1], "expected .*; got a list"),
        (MATRIX | {"focal": 3}, r"unknown entries \['focal'\]; known are"),
        ({"P": P.tolist()}, r"image_size must be \[columns, rows\], two positive integers; got None"),
        (changed(image_size=[160.0, 120.0]), "two positive integers"),
        ({"image_size": [160, 120]}, r"P missing \(or K, R, t\); expected"),
        (changed(P=P[:, :3]), r"P must be finite numbers of shape \(3, 4\); got shape \(3, 3\)"),
        (changed(P=P * np.nan), "P must be finite numbers"),
        (MATRIX | {"P": [[1, 2], [3]]}, "P must be numbers of shape"),
        (changed(P=np.zeros((3, 4))), "P is singular"),
        (changed(P=P[[0, 0, 2]]), "P is singular"),
        (changed(P=np.diag([-1, 1, 1]) @ P + [[0], [0], [0]] + np.outer([160, 0, 0], P[2])), "or P is mirrored"),
        (changed(P=K @ np.column_stack([R, -R @ [0, 0, -2.0]])), "height of -2 m; it must be above the floor"),
        (changed(P=P @ np.diag([1, 1, -1, 1])), "must be above the floor|mirrored"),
        (changed(distortion=np.zeros(5)), "distortion needs K"),
        (changed(K=K, distortion=np.zeros(4)), r"distortion must be finite numbers of shape \(5,\); got shape \(4,\)"),
        (changed(K=K + np.eye(3, k=1) * [0, 1, 0]), r"K must be \[\[fx, 0, cx\]"),
        (POSE | {"R": (R @ np.diag([-1, 1, 1])).tolist()}, "R must be a rotation; it is mirrored"),
        (POSE | {"R": (R * 1.1).tolist()}, "R must be a rotation; it is not orthonormal"),
        (POSE | MATRIX, "give one or the other"),
        (MATRIX | {"name": 5}, "name must be text; got 5"),
    ],
)
def test_what_is_no_camera_is_named(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        open_camera(written(tmp_path, settings))


def test_a_camera_that_looks_up_sees_no_floor(tmp_path):
    up = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1.0]]).T @ np.diag([1, -1, -1])
    settings = POSE | {"R": up.tolist(), "t": [0, 0, -2.0]}
    with pytest.raises(InputError, match="no floor in front of the camera"):
        open_camera(written(tmp_path, settings))


def test_images_of_another_size_are_named(tmp_path):
    with pytest.raises(InputError, match="calibrated for images of 160x120; got images of 320x240"):
        open_camera(written(tmp_path, MATRIX), image_size=(320, 240))


def test_files_that_cannot_be_read_or_written(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.json: cannot be read"):
        open_camera(tmp_path / "nowhere.json")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot write"):
        write_camera(tmp_path / "file" / "camera.json", (160, 120), P=P)


def test_tsais_parameters_are_read(tmp_path):
    (tmp_path / "a.xml").write_text(XML)
    camera = read_tsai(tmp_path / "a.xml")
    assert camera.image_size == (768, 576)
    assert (camera.focal, camera.kappa1, camera.center, camera.sx) == (5.5, 5.1e-3, (324.0, 282.0), 1.09)
    assert (camera.pixel, camera.rotation) == ((5.1e-3, 4.6e-3), (2.04, -0.89, -0.43))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (XML.replace('focal="5.5" ', ""), "Intrinsic focal missing"),
        (XML.replace("Extrinsic", "Outside"), "Extrinsic tx missing"),
        (XML.replace('"5.5"', '"wide"'), "Intrinsic focal must be a finite number; got 'wide'"),
        (XML[:200], "a.xml: not XML"),
    ],
)
def test_xml_of_another_kind_is_named(tmp_path, content, message):
    (tmp_path / "a.xml").write_text(content)
    with pytest.raises(InputError, match=message):
        read_tsai(tmp_path / "a.xml")
    with pytest.raises(InputError, match="cannot be read"):
        read_tsai(tmp_path / "b.xml")
