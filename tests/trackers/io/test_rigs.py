import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.trackers.io.errors import InputError, OutputError
from jaxfilters.trackers.io.rigs import RigCamera, open_rig, write_rig

K = [[800.0, 0, 319.5], [0, 790.0, 239.5], [0, 0, 1]]
TURN = Rotation.from_rotvec([0.02, -0.1, 0.03]).as_matrix()
LENS = [-0.2, 0.05, 0.001, 0, 0]
LEFT = {"name": "left", "image_size": [640, 480], "K": K, "distortion": LENS}
RIGHT = {"image_size": [640, 480], "K": K, "R": TURN.tolist(), "t": [-120, 1, 4]}


def opened(tmp_path, settings):
    file = tmp_path / "rig.json"
    file.write_text(settings if isinstance(settings, str) else json.dumps(settings))
    return open_rig(file)


@pytest.mark.system
def test_a_file_becomes_a_rig_and_what_straightens_its_images(tmp_path):
    cameras, rig, undistortions = opened(tmp_path, {"cameras": [LEFT, RIGHT], "note": "by hand"})
    assert [camera.name for camera in cameras] == ["left", "camera 2"]
    assert (rig.num_cameras, rig.shape) == (2, (480, 640))
    assert [one.is_identity for one in undistortions] == [False, True]
    np.testing.assert_array_equal(undistortions[0].distortion, LENS)
    points = np.array([[-40.0, 20, 600], [30, -50, 700]])
    uv, _ = rig.project(points)
    for observed, R, t in zip(np.asarray(uv), (np.eye(3), TURN), (np.zeros(3), [-120.0, 1, 4]), strict=True):
        theirs = cv2.projectPoints(points, cv2.Rodrigues(R)[0], np.asarray(t), np.asarray(K), np.zeros(5))[0]
        # Single precision: 1e-7 of 800 px, a few operations.
        np.testing.assert_allclose(observed, theirs.reshape(-1, 2), atol=2e-3)


def test_what_is_written_is_read(tmp_path):
    file = tmp_path / "new" / "rig.json"
    written = [
        RigCamera("left", (640, 480), np.asarray(K), np.asarray(LENS), np.eye(3), np.zeros(3)),
        RigCamera("right", (640, 480), np.asarray(K), np.zeros(5), TURN, np.array([-120.0, 1, 4])),
    ]
    write_rig(file, written, note='0.3 px, "good"')
    for camera, read in zip(written, open_rig(file).cameras, strict=True):
        assert camera[:2] == read[:2]
        for one, other in zip(camera[2:], read[2:], strict=True):
            np.testing.assert_array_equal(one, other)
    assert json.loads(file.read_text())["note"] == '0.3 px, "good"'
    with pytest.raises(OutputError, match="cannot write"):
        write_rig(file / "below", written)


WRONG = {
    "no list": ({"cameras": 3}, r"cameras must be a list of two or more; got 3; expected \{"),
    "one camera": ({"cameras": [LEFT]}, "cameras must be a list of two or more; got 1"),
    "unknown entry": ({"cameras": [LEFT, RIGHT], "unit": "m"}, r"unknown entries \['unit'\]"),
    "not an object": ({"cameras": [LEFT, 7]}, r"cameras\[1\]: expected .*; got 7"),
    "unknown of a camera": ({"cameras": [LEFT, RIGHT | {"fx": 1}]}, r"cameras\[1\]: unknown entries \['fx'\]"),
    "a name": ({"cameras": [LEFT | {"name": 1}, RIGHT]}, r"cameras\[0\]: name must be text; got 1"),
    "no size": ({"cameras": [LEFT, {**RIGHT, "image_size": [640]}]}, r"cameras\[1\]: image_size must be"),
    "two sizes": (
        {"cameras": [LEFT, {**RIGHT, "image_size": [320, 240]}]},
        r"cameras\[1\]: image_size must be that of the first camera; got 640x480 and 320x240",
    ),
    "no K": ({"cameras": [{"image_size": [640, 480]}, RIGHT]}, r"cameras\[0\]: K missing"),
    "skew": (
        {"cameras": [LEFT, RIGHT | {"K": [[800, 1, 0], [0, 800, 0], [0, 0, 1]]}]},
        r"cameras\[1\]: K must be \[\[",
    ),
    "singular": ({"cameras": [LEFT, RIGHT | {"K": [[0, 0, 0], [0, 800, 0], [0, 0, 1]]}]}, r"cameras\[1\]: K must be"),
    "NaN": ({"cameras": [LEFT, RIGHT | {"t": [float("nan"), 0, 0]}]}, r"cameras\[1\]: t must be finite numbers"),
    "text": (
        {"cameras": [LEFT, RIGHT | {"t": "left"}]},
        r"cameras\[1\]: t must be numbers of shape \(3,\); got 'left'",
    ),
    "lens": ({"cameras": [LEFT | {"distortion": [0.1]}, RIGHT]}, r"cameras\[0\]: distortion .* got shape \(1,\)"),
    "no R": ({"cameras": [LEFT, {key: RIGHT[key] for key in ("image_size", "K", "t")}]}, r"cameras\[1\]: R missing"),
    "no t": ({"cameras": [LEFT, {key: RIGHT[key] for key in ("image_size", "K", "R")}]}, r"cameras\[1\]: t missing"),
    "mirror": ({"cameras": [LEFT, RIGHT | {"R": np.diag([1, 1, -1]).tolist()}]}, r"cameras\[1\]: R .* is mirrored"),
    "scaled": ({"cameras": [LEFT, RIGHT | {"R": (1.00001 * TURN).tolist()}]}, "not orthonormal to 1e-06"),
    "first moved": ({"cameras": [LEFT | {"t": [1, 0, 0]}, RIGHT]}, r"cameras\[0\]: R and t must be the identity"),
    "no baseline": ({"cameras": [LEFT, RIGHT | {"t": [0, 0, 0]}]}, r"cameras\[1\]: t puts it where cameras\[0\] is"),
    "twice": ({"cameras": [LEFT, RIGHT, RIGHT]}, r"cameras\[2\]: t puts it where cameras\[1\] is; the baseline is 0"),
    "no JSON": ("{", "not JSON"),
    "a list": ("[]", "got a list"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_rigs_are_named(tmp_path, what):
    settings, message = WRONG[what]
    with pytest.raises(InputError, match=rf"rig\.json: .*{message}"):
        opened(tmp_path, settings)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.json: cannot be read"):
        open_rig(tmp_path / "none.json")
