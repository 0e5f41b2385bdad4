"""`jaxfilters calibrate stereo` with rendered pictures of a board, seen by a rig that is known."""

import re

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.calibration_board import charuco_board
from jaxfilters.models.face.rig import triangulate
from jaxfilters.trackers.app.cli import FAILURE, main
from jaxfilters.trackers.io.rigs import open_rig

SIZE = (640, 480)
K = [np.array([[560.0, 0, 319], [0, 558, 241], [0, 0, 1]]), np.array([[570.0, 0, 322], [0, 569, 238], [0, 0, 1]])]
LENSES = [np.array([-0.12, 0.04, 0, 0, 0]), np.array([0.06, -0.02, 0, 0, 0])]
R = Rotation.from_rotvec([0.01, 0.12, -0.01]).as_matrix()
T = np.array([-0.12, 0.003, 0.012])
SQUARE, PIXELS = 0.04, 80
BOARD = ("--squares", "7x5", "--square-m", SQUARE, "--marker-m", 0.03)
PAIRS = 7


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


def rendered(K, lens, R, t):
    """The board as a camera with distortion sees it: every pixel looks up where its ray meets the board."""
    drawn = charuco_board((7, 5), SQUARE, 0.03).generateImage((7 * PIXELS, 5 * PIXELS))
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    straight = cv2.undistortPoints(np.stack([u, v], axis=-1).reshape(-1, 1, 2), K, lens).reshape(-1, 2)
    on_board = np.column_stack([straight, np.ones(len(straight))]) @ np.linalg.inv(np.column_stack([R[:, :2], t])).T
    metres = (on_board[:, :2] / on_board[:, 2:]).reshape(SIZE[1], SIZE[0], 2)
    # The drawing's first pixel covers the board from 0 to one pixel: its centre is half a pixel in.
    places = (metres / SQUARE * PIXELS - 0.5).astype(np.float32)
    return cv2.GaussianBlur(cv2.remap(drawn, *np.moveaxis(places, 2, 0), cv2.INTER_AREA, borderValue=128), (3, 3), 0.7)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Two folders, `left` and `right`."""
    folder = tmp_path_factory.mktemp("pictures")
    for side in ("left", "right"):
        (folder / side).mkdir()
    rng = np.random.default_rng(0)
    for i in range(PAIRS):
        turned = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix()
        t = rng.uniform([-0.02, -0.06, 0.42], [0.12, 0.06, 0.6]) - turned @ [0.14, 0.10, 0]
        cv2.imwrite(str(folder / "left" / f"{i:02d}.png"), rendered(K[0], LENSES[0], turned, t))
        cv2.imwrite(str(folder / "right" / f"{i:02d}.png"), rendered(K[1], LENSES[1], R @ turned, R @ t + T))
    return folder


def calibrate(*arguments):
    return main(["calibrate", "stereo", *map(str, arguments)])


@pytest.mark.system
def test_the_rig_comes_back(pictures, tmp_path, capsys):
    """Seven pictures of 24 corners that are good to 0.1 px or so: 0.3 % in focal length, 2 mm, half a degree."""
    out = tmp_path / "rig.json"
    assert calibrate(pictures / "left", pictures / "right", *BOARD, "--out", out) == 0
    message = capsys.readouterr().out
    baseline, pairs = re.search(r"baseline (\d+\.\d) mm, .* from 7 of (\d) pairs", message).groups()
    epipolar = re.search(r"epipolar error (\d\.\d+) px rms, (\d\.\d+) px in the worst pair", message).groups()
    assert abs(float(baseline) - 1000 * np.linalg.norm(T)) < 2
    assert pairs == "7"
    assert 0 < float(epipolar[0]) <= float(epipolar[1]) < 0.5
    opened = open_rig(out)
    assert [camera.name for camera in opened.cameras] == ["left", "right"]
    for camera, truth in zip(opened.cameras, K, strict=True):
        np.testing.assert_allclose(camera.K[[0, 1], [0, 1]], truth[[0, 1], [0, 1]], rtol=0.003)
        assert camera.image_size == SIZE
    np.testing.assert_allclose(opened.cameras[1].t_mm, 1000 * T, atol=2)
    assert np.degrees((Rotation.from_matrix(opened.cameras[1].R) * Rotation.from_matrix(R).inv()).magnitude()) < 0.5
    # What the rig is for: a head at 600 mm in true pixels is found to 0.5 % of its distance. Errors of the principal
    # points and of the rotation, larger by themselves, cancel here.
    head = np.array([[-60.0, -60, 600], [120, -60, 650], [120, 80, 600], [0, 80, 650], [60, 0, 600]])
    observed = [head, head @ R.T + 1000 * T]
    uv = np.stack([x[:, :2] / x[:, 2:] * k[[0, 1], [0, 1]] + k[:2, 2] for x, k in zip(observed, K, strict=True)])
    np.testing.assert_allclose(triangulate(opened.rig, jnp.asarray(uv, jnp.float32)), head, atol=3)


def test_pictures_of_different_moments_are_refused(pictures, tmp_path, capsys):
    shuffled = tmp_path / "shuffled"
    shuffled.mkdir()
    for i, j in enumerate([1, 2, 0, 4, 5, 6, 3]):
        (shuffled / f"{i}.png").write_bytes((pictures / "right" / f"{j:02d}.png").read_bytes())
    assert calibrate(pictures / "left", shuffled, *BOARD, "--out", tmp_path / "rig.json") == FAILURE
    assert re.search(r"epipolar lines, \d+\.\d px over all pairs; expected at most 3\. Were", capsys.readouterr().err)
    assert not (tmp_path / "rig.json").exists()


def test_folders_that_do_not_fit_are_named(pictures, tmp_path, capsys):
    out = ("--out", tmp_path / "rig.json")
    few = tmp_path / "few"
    few.mkdir()
    assert calibrate(pictures / "left", few, *BOARD, *out) == FAILURE
    assert f"{few}: no images in it" in capsys.readouterr().err
    cv2.imwrite(str(few / "0.png"), np.zeros((40, 50), np.uint8))
    assert calibrate(pictures / "left", few, *BOARD, *out) == FAILURE
    assert "7 and 1 pictures; expected one of each" in capsys.readouterr().err
    for i in range(1, PAIRS):
        cv2.imwrite(str(few / f"{i}.png"), np.zeros((40, 50), np.uint8))
    assert calibrate(pictures / "left", few, *BOARD, *out) == FAILURE
    assert "0.png: (50, 40) pixels" in capsys.readouterr().err
    for i in range(PAIRS):
        cv2.imwrite(str(few / f"{i}.png"), np.zeros((480, 640), np.uint8))
    assert calibrate(pictures / "left", few, *BOARD, *out) == FAILURE
    assert f"{few}: views must show 6 corners" in capsys.readouterr().err
    assert calibrate(pictures / "left", tmp_path / "none", *BOARD, *out) == FAILURE
    assert "none: no such folder" in capsys.readouterr().err
