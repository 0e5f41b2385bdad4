"""`jaxfilters track people` from end to end: the synthetic room as a video file, its outputs, and wrong input."""

import csv
import json

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.app import stream
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.io.cameras import write_camera
from jaxfilters.trackers.people.demo_room import demo_room
from jaxfilters.trackers.tracker import STATUS_WORDS

FRAMES = 45


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A folder with a video of the room, its camera and its scene."""
    folder = tmp_path_factory.mktemp("room")
    room = demo_room(0, frames=FRAMES)
    rows, cols = room.cameras[0].shape
    writer = cv2.VideoWriter(str(folder / "room.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), room.fps, (cols, rows))
    for i in range(FRAMES):
        writer.write(room.image(0, i))
    writer.release()
    write_camera(folder / "camera.json", (cols, rows), P=np.asarray(room.cameras[0].P, float))
    (folder / "scene.json").write_text(json.dumps({"floor": room.floor.tolist()}))
    return folder, room


@pytest.fixture(scope="module")
def results(recording, tmp_path_factory):
    folder, _ = recording
    out = tmp_path_factory.mktemp("out") / "run"
    places = ["--camera", str(folder / "camera.json"), "--scene", str(folder / "scene.json")]
    assert main(["track", "people", str(folder / "room.mp4"), *places, "--out", str(out), "--mot", "--coco"]) == 0
    return out


@pytest.mark.system
def test_tracks_are_where_people_walked(recording, results):
    """Two people are on the floor for long enough; a decimetre or two is what silhouettes of 70 px can tell."""
    _, room = recording
    with (results / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {"frame", "time_s", "id", "x_m", "y_m", "x_std_m", "y_std_m", "height_m", "status"} <= set(rows[0])
    assert {row["status"] for row in rows} <= set(STATUS_WORDS)
    frames = [int(row["frame"]) for row in rows]
    assert frames == sorted(frames)
    errors = [
        np.linalg.norm(room.routes.xy[int(row["frame"])] - [float(row["x_m"]), float(row["y_m"])], axis=1).min()
        for row in rows
    ]
    assert len({row["id"] for row in rows}) >= 2
    assert np.median(errors) < 0.35


@pytest.mark.system
def test_every_output_can_be_read(results):
    report = json.loads((results / "report.json").read_text())
    assert report["frames"] == FRAMES
    assert report["smoothed"] is True
    assert report["trouble"] == []
    plan = cv2.imread(str(results / "summary.png"))
    assert plan.std() > 5
    video = cv2.VideoCapture(str(results / "overlay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == FRAMES
    lines = (results / "tracks_mot.txt").read_text().splitlines()
    assert all(len(line.split(",")) == 10 for line in lines)
    assert min(int(line.split(",")[0]) for line in lines) >= 1
    annotations = json.loads((results / "tracks_coco.json").read_text())["annotations"]
    rows = [[float(word) for word in line.split(",")] for line in lines]
    found = [(one["image_id"] + 1, one["track_id"] + 1, *one["bbox"]) for one in annotations]
    np.testing.assert_allclose(found, [row[:6] for row in rows])


@pytest.mark.system
@pytest.mark.parametrize("background", [None, "median"])
def test_boxes_of_a_detector_replace_silhouettes_or_join_them(recording, results, tmp_path, background):
    """The boxes that the first run wrote are where the people are; so are the tracks of the second run, from them."""
    folder, room = recording
    places = ["--camera", str(folder / "camera.json"), "--scene", str(folder / "scene.json")]
    boxes = ["--detections", str(results / "tracks_mot.txt"), "--no-video"]
    boxes += [] if background is None else ["--background", background]
    assert main(["track", "people", str(folder / "room.mp4"), *places, *boxes, "--out", str(tmp_path)]) == 0
    used = json.loads((tmp_path / "report.json").read_text())["background"]
    assert used == ("detections" if background is None else "detections, median")
    with (tmp_path / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len({row["id"] for row in rows}) >= 2
    xy = room.routes.xy
    errors = [
        np.linalg.norm(xy[int(row["frame"])] - [float(row["x_m"]), float(row["y_m"])], axis=1).min() for row in rows
    ]
    assert np.median(errors) < 0.35


@pytest.mark.system
def test_tracks_of_another_run_are_not_overwritten(recording, results, capsys):
    folder, _ = recording
    places = ["--camera", str(folder / "camera.json"), "--scene", str(folder / "scene.json")]
    before = (results / "track.csv").read_bytes()
    assert main(["track", "people", str(folder / "room.mp4"), *places, "--out", str(results)]) == 2
    assert "another run" in capsys.readouterr().err
    assert (results / "track.csv").read_bytes() == before


@pytest.mark.system
def test_a_run_is_not_continued_with_another_camera_floor_or_rate(recording, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(stream, "CHECKPOINT_EVERY_S", 0.0)
    folder, room = recording
    for name in ("camera.json", "scene.json"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    places = ["--camera", str(tmp_path / "camera.json"), "--scene", str(tmp_path / "scene.json")]
    command = ["track", "people", str(folder / "room.mp4"), *places, "--out", str(tmp_path / "run"), "--no-video"]
    assert main([*command, "--seconds", "0.3"]) == 0
    assert main([*command, "--resume", "--fps", "7"]) == 2
    assert "cannot be resumed: fps was None and is 7.0, rates was [10.0] and is [7.0]." in capsys.readouterr().err
    (tmp_path / "scene.json").write_text(json.dumps({"floor": (0.9 * room.floor).tolist()}))
    assert main([*command, "--resume"]) == 2
    assert "cannot be resumed: floor was" in capsys.readouterr().err
    (tmp_path / "scene.json").write_bytes((folder / "scene.json").read_bytes())
    moved = np.asarray(room.cameras[0].P, float) @ [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    write_camera(tmp_path / "camera.json", room.cameras[0].shape[::-1], P=moved)
    assert main([*command, "--resume"]) == 2
    assert "cannot be resumed: cameras was" in capsys.readouterr().err
    write_camera(tmp_path / "camera.json", room.cameras[0].shape[::-1], P=np.asarray(room.cameras[0].P, float))
    assert main([*command, "--resume", "--seconds", "0.5"]) == 0


@pytest.mark.system
def test_wrong_input_is_named(recording, tmp_path, capsys):
    folder, _ = recording
    video, out = str(folder / "room.mp4"), ["--out", str(tmp_path / "out")]
    scene = ["--scene", str(folder / "scene.json")]
    assert main(["track", "people", video, *out]) == 2
    assert "--scene" in capsys.readouterr().err
    assert main(["track", "people", video, *scene, *out]) == 2
    assert "--camera" in capsys.readouterr().err
    assert main(["track", "people", *scene, *out]) == 2
    assert "synthetic room" in capsys.readouterr().err
    assert main(["track", "people", "--fps", "5", *out]) == 2
    assert "--fps: of no use without a video" in capsys.readouterr().err
    write_camera(tmp_path / "small.json", (64, 48), P=np.eye(3, 4))
    assert main(["track", "people", video, "--camera", str(tmp_path / "small.json"), *scene, *out]) == 2
    assert "480x360" in capsys.readouterr().err
