"""The scenario on a real video: its truth, its furniture, its pictures, and a few frames where the recording lies."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from jaxfilters.benchmarks.harness import main
from jaxfilters.benchmarks.multi_object import evaluate, floor_tracks
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios import _pets, people_pets
from jaxfilters.benchmarks.scenarios._floor_plan import TRUTH_COLOR, draw_floor_plan
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.people.recorded import Sighting
from jaxfilters.trackers.people.state import PeopleConfig

AREA = np.array([(0.0, 0.0), (4.0, 3.0)])
PETS = _pets.Pets(None, None, None, None, AREA)
"""Only the area counts for truth."""


def written(folder, text):
    path = folder / "truth.csv"
    path.write_text(text)
    return path


def test_truth_is_what_lies_in_the_area(tmp_path):
    """By its column, and by place where there is none; more columns do not matter."""
    by_column = written(tmp_path, "frame,id,x_m,y_m,in_area,more\n0,7,1,1,1,a\n0,8,2,2,0,b\n3,7,9,9,1,c\n")
    found = people_pets.read_truth(by_column, PETS)
    assert found.frame.tolist() == [0, 3]
    assert found.identity.tolist() == [7, 7]
    by_place = written(tmp_path, "frame,id,x_m,y_m\n0,7,1,1\n0,8,2,2\n3,7,9,9\n")
    assert people_pets.read_truth(by_place, PETS).identity.tolist() == [7, 8]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,id,x_m\n0,1,2\n", "is no file of truth"),
        ("frame,id,x_m,y_m\n0,1,2,here\n", "is no file of truth"),
        ("frame,id,x_m,y_m\n0,1,1,1\n0,1,2,2\n", "identity 1 stands twice in frame 0"),
        ("frame,id,x_m,y_m\n0,1,8,8\n", "has no row within the evaluation area"),
        ("", "has no row within the evaluation area"),
    ],
)
def test_files_that_are_no_truth_are_named(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(RecordingError, match=message) as error:
        people_pets.read_truth(path, PETS)
    assert str(path) in str(error.value)
    with pytest.raises(RecordingError, match="is no file of truth"):
        people_pets.read_truth(tmp_path / "missing.csv", PETS)


def test_people_who_return_under_another_identity_can_count_as_the_same():
    """Tracked as one identity throughout: a transfer and half of the positions wrong with the file's identities."""
    truth = floor_tracks(range(8), [15, 15, 15, 15, 14, 14, 14, 14], [(float(i), 0.0) for i in range(8)])
    other = floor_tracks([0, 1], [1, 1], [(0.0, 5.0), (0.0, 5.0)])
    both = floor_tracks(*(np.concatenate(pair) for pair in zip(truth, other, strict=True)))
    estimate = both._replace(identity=np.where(both.identity == 1, 1, 3))
    published, same = evaluate(both, estimate), evaluate(_pets.merged(both), estimate)
    assert (published.idf1, published.transfers, published.id_switches) == (pytest.approx(100 * 12 / 20), 1, 0)
    value = {name: metric.value for name, metric in _pets.merged_metrics(same, "_two").items()}
    assert value == {"idf1_merged_two": 100.0, "id_switches_merged_two": 0, "transfers_merged_two": 0}
    # A tracker that does as the file does has a switch then.
    renamed = evaluate(_pets.merged(both), both)
    assert (renamed.id_switches, renamed.idf1) == (1, pytest.approx(100 * 12 / 20))


@pytest.mark.parametrize("with_truth", [False, True])
def test_identities_are_merged_for_the_annotations_of_the_recording_only(monkeypatch, tmp_path, with_truth):
    """Another file may have other numbers; the stand-in follows 14 and 15 as one identity."""
    rows = "frame,id,x_m,y_m,in_area\n0,15,1,1,1\n1,15,1,1,1\n2,14,1,1,1\n"
    (tmp_path / "gt_0_399.csv").write_text(rows)
    camera = FloorCamera.from_matrix([[100, 0, 0, 0], [0, 0, -100, 300], [0, 1, 0, 5]], (120, 160))
    scene = SimpleNamespace(config=PeopleConfig())
    pets = PETS._replace(folder=tmp_path, camera=camera, scene=scene)
    mean = np.array([1.0, 1.0, 0, 0, 1.7, 0.45])
    tracks = {4: [Sighting(i, i / 7, mean, np.eye(6), 1.0, 0, "tracked") for i in range(3)]}
    followed = people_pets.VideoRun([(i, 4, 1.0, 1.0) for i in range(3)], tracks, *np.ones((3, 3)))
    monkeypatch.setattr(people_pets, "recording_folder", lambda name: tmp_path)
    monkeypatch.setattr(people_pets, "load_pets", lambda folder, config: pets)
    monkeypatch.setattr(people_pets, "follow_video", lambda pets, frames: followed)
    monkeypatch.setattr(people_pets, "smoothed", lambda config, tracks: tracks)
    monkeypatch.setattr(people_pets, "blobs", lambda pets, frames: followed.confirmed)
    metrics = people_pets.run(quick=False, seed=0, out=None, truth=tmp_path / "gt_0_399.csv" if with_truth else None)
    assert metrics["transfers"].value == 1
    assert metrics["idf1"].value == pytest.approx(100 * 2 / 3)
    assert ("idf1_merged" in metrics) != with_truth
    if not with_truth:
        for suffix in ("", "_filtered", "_simple"):
            assert metrics[f"transfers_merged{suffix}"].value == 0
            assert metrics[f"idf1_merged{suffix}"].value == 100


def test_estimates_count_within_the_frames_and_the_area():
    rows = [(0, 1, 1.0, 1.0), (1, 1, 1.0, 2.0), (1, 2, 5.0, 1.0), (2, 1, 1.0, 2.5), (3, 1, 1.0, 1.0)]
    found = people_pets.within(rows, PETS, (1, 2))
    assert found.frame.tolist() == [1, 2]
    np.testing.assert_allclose(found.xy_m, [(1, 2), (1, 2.5)])
    assert len(people_pets.within([], PETS, (0, 9)).frame) == 0


def test_without_the_recording_the_command_says_what_is_missing(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.delenv("JAXFILTERS_DATA", raising=False)
    assert main(["people-pets"]) == 2
    assert "people-pets: JAXFILTERS_DATA is not set; it must name the folder" in capsys.readouterr().err
    monkeypatch.setenv("JAXFILTERS_DATA", str(tmp_path))
    with pytest.raises(RecordingError, match="holds no folder pets09_s2l1_view001"):
        recording_folder("pets09_s2l1_view001")
    (tmp_path / "here").mkdir()
    assert recording_folder("here") == tmp_path / "here"


def test_truth_is_refused_where_nothing_is_compared_with_it(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("XLA_FLAGS", "")
    assert main(["people-speed", "--truth", str(tmp_path / "t.csv")]) == 2
    assert "--truth: people-speed compares with no file" in capsys.readouterr().err


@pytest.mark.system
def test_furniture_is_as_far_as_where_it_stands():
    """A post that is seen at the image of its foot has the depth of the foot there, along its line and its sign."""
    R = np.array([[1, 0, 0], [0, -0.5, -np.sqrt(0.75)], [0, np.sqrt(0.75), -0.5]])
    K = np.array([[100.0, 0, 79.5], [0, 100, 59.5], [0, 0, 1]])
    camera = FloorCamera.from_matrix(K @ np.column_stack([R, -R @ np.array([0, -4.0, 3.0])]), (120, 160))
    outlines = {
        "pole_line": [[79, 20], [79, 80]],
        "pole_width_px": 5,
        "sign_rect": [[70, 20], [90, 30]],
        "pole_ground_xy": [0.0, 0.5],
        "tripod_lines": [[[30, 60], [20, 90]], [[30, 60], [40, 90]]],
        "tripod_ground_xy": [-1.5, 0.2],
    }
    depth = _pets.furniture(camera, outlines)
    assert np.isinf(depth[60, 120])
    at_foot = camera.project(np.array([0.0, 0.5, 0.0], np.float32))
    col, row = np.asarray(at_foot[0]).round().astype(int)
    assert col in range(77, 83)
    assert depth[row, col] == pytest.approx(float(at_foot[1]), rel=0.02)
    assert np.all(np.isfinite(depth[25, 70:91]))
    assert np.all(np.isfinite([depth[90, 20], depth[90, 40]]))


def test_the_plan_shows_truth_and_tracks(tmp_path):
    truth = floor_tracks(range(20), [1] * 20, np.column_stack([np.linspace(0.5, 3.5, 20), np.full(20, 1.0)]))
    estimate = truth._replace(xy_m=truth.xy_m + np.array([0, 1.0]))
    draw_floor_plan(tmp_path / "plan.png", truth, estimate, AREA)
    picture = cv2.imread(str(tmp_path / "plan.png"))
    assert picture.shape[1] > picture.shape[0] > 200
    grey = np.argwhere(np.all(np.abs(picture.astype(int) - TRUTH_COLOR) < 3, axis=-1))
    colored = np.argwhere(np.ptp(picture.astype(int), axis=-1) > 120)
    # Y is upwards: the estimate, a metre farther, is drawn above.
    assert np.median(grey[:, 0]) - np.median(colored[:, 0]) == pytest.approx(45, abs=3)
    with pytest.raises(OSError, match="cannot write"):
        draw_floor_plan(tmp_path / "missing" / "plan.png", truth, estimate, AREA)


def test_tracks_are_written_by_frame(tmp_path):
    mean = np.array([1.0, 2.0, 0.1, 0.2, 1.75, 0.45])
    first, later = (Sighting(i, i / 7, mean, np.eye(6), 1.5, 0, "tracked") for i in (3, 4))
    people_pets.write_tracks(tmp_path / "tracks.csv", {5: [first, later], 2: [later]})
    lines = (tmp_path / "tracks.csv").read_text().splitlines()
    assert lines[0] == "frame,id,x_m,y_m,height_m,score,mode"
    assert lines[1] == "3,5,1.000,2.000,1.750,1.500,tracked"
    assert [line[:4] for line in lines[2:]] == ["4,2,", "4,5,"]


@pytest.mark.system
@pytest.mark.data
def test_the_recording_is_read_as_it_lies(data_dir):
    """Every annotated place projects into its annotated box, near the lower edge; the area is that of the column."""
    pets = _pets.load_pets(data_dir / "pets09_s2l1_view001", PeopleConfig(cell_m=1.5))
    path = data_dir / "pets09_s2l1_view001" / "gt_0_399.csv"
    rows = np.genfromtxt(path, delimiter=",", names=True)
    xy = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
    assert np.mean(pets.is_inside(xy) == rows["in_area"].astype(bool)) > 0.99
    uv, _ = pets.camera.project(np.insert(xy, 2, 0.0, axis=1).astype(np.float32))
    assert np.all((uv[:, 0] > rows["box_xmin"] - 15) & (uv[:, 0] < rows["box_xmax"] + 15))
    truth = people_pets.read_truth(path, pets)
    assert len(truth.frame) == int(rows["in_area"].sum())
    # Nobody is merged with a person who is there at the same time, and all who are merged exist.
    assert set(_pets.RETURNED_AS) | set(_pets.RETURNED_AS.values()) <= set(truth.identity.tolist())
    assert len(np.unique(_pets.merged(truth).identity)) == len(np.unique(truth.identity)) - len(_pets.RETURNED_AS)
    image = next(_pets.images(pets))
    assert image.shape == (*_pets.SHAPE, 3)


@pytest.mark.data
@pytest.mark.system
def test_people_are_followed_from_the_first_frames_on(monkeypatch, data_dir, tmp_path):
    monkeypatch.setenv("JAXFILTERS_DATA", str(data_dir))
    monkeypatch.setattr(people_pets, "PeopleConfig", lambda: PeopleConfig(capacity=8))
    metrics = people_pets.run(quick=True, seed=0, out=tmp_path)
    assert metrics["mota"].value > 80
    assert metrics["mean_error_m"].value < 0.35
    assert metrics["mota_filtered"].value < metrics["mota"].value
    assert metrics["frames_per_second_tracking"].value > metrics["frames_per_second"].value
    assert (tmp_path / "floor_plan.png").exists()
    assert (tmp_path / "tracks.csv").read_text().count("\n") > 60
