import json
import re

import cv2
import numpy as np
import pytest

from jaxfilters.models.calibration import Calibration, distort
from jaxfilters.models.calibration_board import charuco_board
from jaxfilters.trackers.app.cli import FAILURE, main
from jaxfilters.trackers.io.cameras import open_camera, open_intrinsics

PITCH = np.deg2rad(37)
R = np.array([[1, 0, 0], [0, -np.sin(PITCH), -np.cos(PITCH)], [0, np.cos(PITCH), -np.sin(PITCH)]])
K = np.array([[560.0, 0, 319.5], [0, 560, 239.5], [0, 0, 1]])
CAMERA = Calibration(K, np.array([-0.2, 0.06, 0, 0, 0]), R, -R @ [-1, -1.74, 2.64], 0.0)
SIZE = "640x480"


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


def points_file(folder, camera, *, n=20, height=1.8, noise=0.0):
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, 0.2, 0], [0, 3, height], (n, 3))
    pixels = camera.project(points) + rng.normal(0, noise, (n, 2))
    inside = ((pixels > 0) & (pixels < (639, 479))).all(axis=1)
    rows = np.column_stack([points, pixels])[inside]
    np.savetxt(folder / "points.csv", rows, delimiter=",", header="x_m,y_m,z_m,u,v", comments="")
    return folder / "points.csv"


def calibrate(*arguments):
    return main(["calibrate", *map(str, arguments)])


def test_points_in_space_with_distortion(tmp_path, capsys):
    file, out = points_file(tmp_path, CAMERA, n=60), tmp_path / "hall.json"
    assert calibrate("points", file, "--image-size", SIZE, "--distortion", "--out", out) == 0
    text = capsys.readouterr().out
    assert "camera at (-1.00, -1.74) m, 2.64 m above the floor" in text
    assert "reprojection error 0.0" in text
    assert "floor error 0.00" in text
    opened = open_camera(out, image_size=(640, 480))
    assert opened.name == "hall"
    np.testing.assert_allclose(opened.camera.P, CAMERA.P, rtol=1e-3, atol=0.05)


def test_points_on_the_floor_alone(tmp_path, capsys):
    straight = CAMERA._replace(distortion=np.zeros(5))
    file, out = points_file(tmp_path, straight, n=12, height=0.0), tmp_path / "camera.json"
    assert calibrate("points", file, "--image-size", SIZE, "--out", out) == 0
    assert "square pixels about the image's centre are assumed" in capsys.readouterr().out
    np.testing.assert_allclose(open_camera(out).camera.P, straight.P, rtol=1e-3, atol=0.01)
    assert calibrate("points", file, "--image-size", SIZE, "--distortion", "--out", out) == FAILURE
    assert "points in one plane, or nearly, do not show distortion" in capsys.readouterr().err


def test_points_with_known_intrinsics(tmp_path, capsys):
    file, out = points_file(tmp_path, CAMERA, n=12, height=0.0), tmp_path / "camera.json"
    (tmp_path / "k.json").write_text(
        json.dumps({"image_size": [640, 480], "K": K.tolist(), "distortion": CAMERA.distortion.tolist()})
    )
    given = ("--image-size", SIZE, "--intrinsics", tmp_path / "k.json", "--out", out)
    assert calibrate("points", file, *given) == 0
    np.testing.assert_allclose(open_camera(out).camera.P, CAMERA.P, rtol=1e-3, atol=0.01)
    assert calibrate("points", file, *given, "--distortion") == FAILURE
    assert "--distortion finds what --intrinsics" in capsys.readouterr().err
    given = ("--image-size", "320x240", "--intrinsics", tmp_path / "k.json", "--out", out)
    capsys.readouterr()
    assert calibrate("points", file, *given) == FAILURE
    assert "lies outside an image of 320x240" in capsys.readouterr().err


def test_the_worst_point_is_pointed_at(tmp_path, capsys):
    file = points_file(tmp_path, CAMERA._replace(distortion=np.zeros(5)), n=60)
    lines = file.read_text().splitlines()
    x, y, z, u, v = lines[7].split(",")
    lines[7] = f"{x},{y},{z},{float(u) + 25},{v}"
    file.write_text("\n".join(lines))
    assert calibrate("points", file, "--image-size", SIZE, "--out", tmp_path / "c.json") == 0
    assert "at worst (line 8)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x,y,z,u,v\n1,2,3,4,5\n", "expected a header x_m,y_m,z_m,u,v and numbers; the header is 'x,y,z,u,v'"),
        ("", "the header is ''"),
        ("x_m,y_m,z_m,u,v\n1,2,3,4,5\n1,2,3,4\n", "line 3 has 4 entries, its header 5"),
        ("x_m,y_m,z_m,u,v\n1,2,3,4,five\n", "line 2: v must be a number; got 'five'"),
        ("x_m,y_m,z_m,u,v\n1,2,3,4,5,6\n", "line 2 has 6 entries, its header 5"),
        ("x_m,y_m,z_m,u,v\n1,2,3,-4,5\n", "line 2: pixel (-4, 5) lies outside an image of 640x480"),
        ("x_m,y_m,z_m,u,v\n1,2,3,4,500\n", "line 2: pixel (4, 500) lies outside an image of 640x480"),
        ("x_m,y_m,z_m,u,v\n1,2,3,4,5\n2,3,4,5,6\n", "6 points or more are needed, or 4 at one height; got 2"),
        ("x_m,y_m,z_m,u,v\n", "got 0"),
    ],
)
def test_wrong_points_are_named(tmp_path, capsys, content, message):
    (tmp_path / "p.csv").write_text(content)
    assert calibrate("points", tmp_path / "p.csv", "--image-size", SIZE, "--out", tmp_path / "c.json") == FAILURE
    assert message in capsys.readouterr().err
    assert not (tmp_path / "c.json").exists()


STRAIGHT = CAMERA._replace(distortion=np.zeros(5))


@pytest.mark.parametrize("seed", range(4))
def test_a_floor_measured_with_a_tape_places_the_camera(tmp_path, capsys, seed):
    """Heights of a few centimetres, all of them errors: a projection matrix puts such cameras metres away."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform([-2, 0.2], [0, 3], (12, 2)), np.zeros(12)])
    pixels = STRAIGHT.project(floor) + rng.normal(0, 0.5, (12, 2))
    rows = np.column_stack([floor + rng.normal(0, 0.01, floor.shape), pixels])
    rows = rows[((pixels > 0) & (pixels < (639, 479))).all(axis=1)]
    file, out = tmp_path / "points.csv", tmp_path / "camera.json"
    np.savetxt(file, rows, delimiter=",", header="x_m,y_m,z_m,u,v", comments="")
    assert calibrate("points", file, "--image-size", SIZE, "--out", out) == 0
    text = capsys.readouterr().out
    assert "square pixels about the image's centre are assumed" in text
    focal_percent, *position_m = map(
        float, re.search(r"focal length ([\d.]+)%, position \(([\d.]+), ([\d.]+), ([\d.]+)\) m", text).groups()
    )
    assert 0 < focal_percent < 10
    assert 0 < max(position_m) < 0.3
    np.testing.assert_allclose(open_camera(out).camera.position(), STRAIGHT.position, atol=0.25)
    mirrored = rows * [-1, 1, 1, 1, 1]
    np.savetxt(file, mirrored, delimiter=",", header="x_m,y_m,z_m,u,v", comments="")
    assert calibrate("points", file, "--image-size", SIZE, "--out", out) == FAILURE


def test_low_steps_that_leave_the_camera_open_are_named(tmp_path, capsys):
    """Heights up to 30 cm over 2.8 m, pixels good to one: too high for a floor, too low for a projection matrix."""
    file, out = points_file(tmp_path, STRAIGHT, n=12, height=0.3, noise=1.0), tmp_path / "c.json"
    assert calibrate("points", file, "--image-size", SIZE, "--out", out) == FAILURE
    assert re.search(r"points.csv: points_m and pixels leave the camera open: .* Give points", capsys.readouterr().err)
    assert not out.exists()


def test_a_camera_that_its_reader_refuses_is_not_written(tmp_path, capsys):
    """Points in centimetres: a camera 264 m above the floor."""
    file, out = points_file(tmp_path, STRAIGHT, n=20), tmp_path / "camera.json"
    rows = np.loadtxt(file, delimiter=",", skiprows=1) * [100, 100, 100, 1, 1]
    np.savetxt(file, rows, delimiter=",", header="x_m,y_m,z_m,u,v", comments="")
    out.write_text("what was there")
    assert calibrate("points", file, "--image-size", SIZE, "--out", out) == FAILURE
    error = capsys.readouterr().err
    assert f"{out}: not written, since it could not be used: the camera stands 264 m above the floor" in error
    assert out.read_text() == "what was there"


def board_pictures(folder):
    """Pictures of a board, without distortion, and one of it lying on the floor; what the last one's pose is."""
    drawn = charuco_board((7, 5), 0.04, 0.03).generateImage((560, 400))
    turns = [(0.5, 0, 0), (-0.5, 0.1, 0.2), (0, 0.5, 0), (0.1, -0.5, -0.3), (-0.7, 0, 0)]
    files = []
    for i, turn in enumerate(turns):
        rotation = cv2.Rodrigues(np.asarray(turn, float))[0]
        t = np.array([0.02 * i - 0.04, 0.0, 0.45]) - rotation @ [0.14, 0.10, 0]
        to_metres = np.array([[0.04 / 80, 0, 0.02 / 80], [0, 0.04 / 80, 0.02 / 80], [0, 0, 1]])
        H = K @ np.column_stack([rotation[:, :2], t]) @ to_metres
        image = cv2.warpPerspective(drawn, H, (640, 480), flags=cv2.INTER_AREA, borderValue=128)
        files.append(folder / f"{i}.png")
        cv2.imwrite(str(files[-1]), image)
    return files, -rotation.T @ t * [1, -1, -1]


@pytest.mark.system
def test_pictures_of_a_board(tmp_path, capsys):
    files, position = board_pictures(tmp_path)
    size = ("--squares", "7x5", "--square-m", 0.04, "--marker-m", 0.03)
    out = tmp_path / "camera.json"
    assert calibrate("charuco", *files[:-1], *size, "--floor", files[-1], "--out", out) == 0
    text = capsys.readouterr().out
    assert "in 5 pictures: reprojection error 0." in text
    assert "the pose over the board on the floor" in text
    assert re.search(r"floor error 0\.00\d m on average", text)
    np.testing.assert_allclose(open_camera(out).camera.position(), position, atol=0.01)

    assert calibrate("charuco", *files, *size, "--out", out) == 0
    assert "where the camera stands is open" in capsys.readouterr().out
    np.testing.assert_allclose(open_intrinsics(out)[0][0, 0], 560, rtol=0.02)


def test_pictures_that_do_not_fit_are_named(tmp_path, capsys):
    files, _ = board_pictures(tmp_path)
    board = ("--square-m", 0.04, "--marker-m", 0.03, "--out", tmp_path / "c.json")
    assert calibrate("charuco", *files, "--squares", "2x5", *board) == FAILURE
    assert "squares must be three or more" in capsys.readouterr().err
    assert calibrate("charuco", files[0], "--squares", "7x5", *board) == FAILURE
    assert "with the board moved in between; 1 of 1 do" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((40, 50), np.uint8))
    assert calibrate("charuco", files[0], tmp_path / "small.png", "--squares", "7x5", *board) == FAILURE
    assert "small.png: (50, 40) pixels" in capsys.readouterr().err
    (tmp_path / "none.png").write_bytes(b"no picture")
    assert calibrate("charuco", tmp_path / "none.png", "--squares", "7x5", *board) == FAILURE
    assert "none.png: not a complete image" in capsys.readouterr().err


def test_parameters_that_fold_the_corners_are_converted_with_a_warning(tmp_path, capsys):
    """Values as in view 7 of PETS 2009: the file is read back, and the message has the share that is left out."""
    (tmp_path / "view.xml").write_text(
        '<Camera><Geometry width="720" height="576" dpx="0.00465" dpy="0.00465"/>'
        '<Intrinsic focal="3.69" kappa1="-0.062" cx="436" cy="258" sx="1"/>'
        '<Extrinsic tx="8600" ty="-450" tz="14600" rx="1.77" ry="0.36" rz="0.09"/></Camera>'
    )
    assert calibrate("tsai", tmp_path / "view.xml", "--out", tmp_path / "camera.json") == 0
    text = capsys.readouterr().out
    assert "px over 96." in text
    assert "warning: kappa1 = -0.062 folds the image" in text
    assert open_camera(tmp_path / "camera.json").undistortion.distortion.any()


@pytest.mark.data
def test_parameters_of_pets(data_dir, tmp_path, capsys):
    folder, out = data_dir / "pets09_s2l1_view001", tmp_path / "camera.json"
    assert calibrate("tsai", folder / "View_001.xml", "--image-size", "480x360", "--out", out) == 0
    text = capsys.readouterr().out
    assert "camera at (-28.94, -19.53) m, 7.07 m above the floor" in text
    theirs = json.loads((folder / "calibration.json").read_text())
    opened = open_camera(out, image_size=(480, 360))
    np.testing.assert_allclose(opened.camera.P, theirs["P_480x360"], rtol=1e-5, atol=1e-3)
    u, v = np.meshgrid(np.linspace(0, 479, 9), np.linspace(0, 359, 9))
    focal, middle = opened.undistortion.K[[0, 1], [0, 1]], opened.undistortion.K[:2, 2]
    x = (np.stack([u.ravel(), v.ravel()], axis=-1) - middle) / focal
    ours, expected = (distort(x, np.asarray(k)) for k in (opened.undistortion.distortion, theirs["opencv_distCoeffs"]))
    np.testing.assert_allclose(ours * focal, expected * focal, atol=0.01)


def test_pixels_on_one_line_are_named_with_their_file(tmp_path, capsys):
    file = tmp_path / "points.csv"
    file.write_text("x_m,y_m,z_m,u,v\n0,0,0,50,50\n4,0,0,50,50\n4,3,0,50,50\n0,3,0,50,50\n")
    assert calibrate("points", file, "--image-size", SIZE, "--out", tmp_path / "a.json") == FAILURE
    line = capsys.readouterr().err.strip()
    assert line.startswith(f"jaxfilters: error: {file}: pixels of all 4 points lie on one line")
    assert not (tmp_path / "a.json").exists()
