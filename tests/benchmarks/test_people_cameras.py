"""The scenario of several cameras: who counts as seen, what counts as handed over, and a small run."""

import numpy as np
import pytest

from jaxfilters.benchmarks.multi_object import floor_tracks
from jaxfilters.benchmarks.scenarios import _pets_two, _pom, people_cameras
from jaxfilters.benchmarks.scenarios.people_cameras import SETUPS, Setup, handovers, joined, sees_whole, truth
from jaxfilters.trackers.people import demo_room as demo
from jaxfilters.trackers.people.demo_room import demo_room

pytestmark = pytest.mark.optimised


@pytest.fixture(scope="module")
def room():
    return demo_room(0, cameras=4, frames=150)


@pytest.fixture
def half_size(monkeypatch):
    """Images of half the width and height, drawn in a quarter of the time."""
    rows, cols = demo.SHAPE
    monkeypatch.setattr(demo, "SHAPE", (rows // 2, cols // 2))
    monkeypatch.setattr(demo, "FOCAL_PX", demo.FOCAL_PX / 2)


def test_cameras_deliver_as_their_setup_says():
    frames = range(12)
    rates = [[SETUPS["_rates"].delivers(camera, i, 12) for i in frames] for camera in range(4)]
    assert [sum(one) for one in rates] == [12, 6, 4, 6]
    assert [SETUPS["_stopped"].delivers(0, i, 12) for i in frames] == [True] * 6 + [False] * 6
    assert all(SETUPS["_stopped"].delivers(camera, 11, 12) for camera in (1, 2, 3))
    assert all(SETUPS[""].delivers(camera, i, 12) for camera in range(4) for i in frames)


@pytest.mark.system
def test_somebody_is_seen_whole_from_the_feet_to_the_head(room):
    """In front of the first camera, too near to it, and beside its view."""
    camera = room.cameras[0]
    places = np.array([(0.0, 2.0), (-0.3, -2.6), (8.0, 0.0)])
    assert sees_whole(camera, places).tolist() == [True, False, False]
    beside = np.array([(0.0, 2.0), (2.2, 2.0)])
    assert sees_whole(camera, beside).all()
    assert sees_whole(camera, beside, 0.4).tolist() == [True, False]


@pytest.mark.system
def test_people_are_handed_over_and_nobody_counts_who_is_not_seen(room):
    """With narrow views, more of the time is spent in one of them alone; a camera that stops sees nobody."""
    assert handovers(room, people_cameras.NARROW) > 10
    everybody, one = truth(room, SETUPS[""]), truth(room, Setup((0,), width=people_cameras.NARROW))
    assert 0 < len(one.frame) < 0.8 * len(everybody.frame)
    stopped = truth(room, Setup((0,), first_stops=True, width=people_cameras.NARROW))
    assert stopped.frame.max() == 74
    np.testing.assert_array_equal(stopped.frame, one.frame[one.frame < 75])


def test_a_narrow_view_is_the_middle_of_the_image():
    observed = Setup((0,), width=0.4).is_observed((10, 100))
    assert np.flatnonzero(observed).tolist() == list(range(30, 70))
    assert Setup((0,)).is_observed((10, 101)).all()


def test_recordings_are_kept_apart():
    one = floor_tracks([0, 1], [3, 3], [(0, 0), (1, 1)])
    both = joined((one, one))
    assert len(np.unique(both.frame)) == 4
    assert len(np.unique(both.identity)) == 2
    np.testing.assert_array_equal(both.xy_m[2:], one.xy_m)


def test_scores_are_of_all_seeds_together(monkeypatch, capsys):
    """Stand-ins are a decimetre off, and miss one of three people; there are no recordings."""
    monkeypatch.delenv("JAXFILTERS_DATA", raising=False)
    rows = [(i, who) for i in range(4) for who in range(3)]
    true = floor_tracks(*np.transpose(rows), [(2.0 * who, 0.1 * i) for i, who in rows])
    observed = true.identity < 2
    found = floor_tracks(true.frame[observed], true.identity[observed], true.xy_m[observed] + [0.1, 0.0])
    tracks = dict.fromkeys(SETUPS, (true, found))
    monkeypatch.setattr(people_cameras, "room_tracks", lambda seed, frames: tracks)
    monkeypatch.setattr(people_cameras, "demo_room", lambda seed, cameras, frames: seed)
    monkeypatch.setattr(people_cameras, "handovers", lambda room, width: 10 + room)
    value = {name: metric.value for name, metric in people_cameras.run(quick=False, seed=0, out=None).items()}
    for suffix in SETUPS:
        assert value[f"mota{suffix}"] == pytest.approx(100 * 2 / 3)
        assert value[f"mean_error_m{suffix}"] == pytest.approx(0.1)
        assert value[f"misses{suffix}"] == 3 * 4
        assert value[f"id_switches{suffix}"] == value[f"false_positives{suffix}"] == 0
    assert value["handovers"] == 10 + 11 + 12
    assert "no real cameras: JAXFILTERS_DATA is not set" in capsys.readouterr().err


@pytest.mark.system
@pytest.mark.usefixtures("half_size")
def test_nobody_is_lost_between_four_cameras(monkeypatch):
    monkeypatch.setattr(people_cameras, "SETUPS", {name: SETUPS[name] for name in ("_narrow", "_rates")})
    tracks = people_cameras.room_tracks(1, 80)
    for suffix, (true, found) in tracks.items():
        scores = people_cameras.evaluate(true, found)
        assert scores.id_switches == 0, suffix
        assert scores.mean_error_m < 0.1, suffix
        assert scores.mota > 80, suffix


def test_the_better_view_is_scored_with_merged_identities_as_well(monkeypatch, tmp_path):
    """View 6 alone loses a third of the positions; view 1 and both follow 14 and 15 as one identity."""
    truth = floor_tracks(range(6), [15, 15, 15, 14, 14, 14], [(float(i), 0.0) for i in range(6)])
    one = truth._replace(identity=np.full(6, 7))
    lost = one._replace(frame=one.frame[:4], identity=one.identity[:4], xy_m=one.xy_m[:4])
    monkeypatch.setattr(_pets_two, "_area", lambda folder: None)
    monkeypatch.setattr(_pets_two, "_annotated", lambda path, area, frames: truth)
    monkeypatch.setattr(_pets_two, "_low_view", lambda *_: {})
    monkeypatch.setattr(_pets_two, "follow", lambda folder, views, *more: lost if views == (6,) else one)
    metrics = _pets_two.two_view_metrics(tmp_path, tmp_path, quick=False, seed=0)
    value = {name: metric.value for name, metric in metrics.items()}
    for suffix in ("_two", "_one", "_two_refit", "_one_refit"):
        assert (value[f"mota{suffix}"], value[f"idf1{suffix}"], value[f"transfers{suffix}"]) == (100, 50, 1)
        assert (value[f"idf1_merged{suffix}"], value[f"transfers_merged{suffix}"]) == (100, 0)
        assert value[f"id_switches_merged{suffix}"] == 0


def test_scores_of_two_views_are_means_over_runs_with_other_grey_levels(monkeypatch, tmp_path):
    """Each run loses as many of the last positions as the grey levels of its image differ in places."""
    truth = floor_tracks(range(100), np.full(100, 3), [(float(i), 0.0) for i in range(100)])
    image = np.full((5, 5, 3), 128, np.uint8)
    losses = []

    def follow(folder, views, calibration, area, frames, disturb):
        losses.append(int((disturb(image) != image).sum()))
        return floor_tracks(*(column[: 100 - losses[-1]] for column in truth))

    monkeypatch.setattr(_pets_two, "_area", lambda folder: None)
    monkeypatch.setattr(_pets_two, "_annotated", lambda path, area, frames: truth)
    monkeypatch.setattr(_pets_two, "_low_view", lambda *_: {})
    monkeypatch.setattr(_pets_two, "follow", follow)
    metrics = _pets_two.two_view_metrics(tmp_path, tmp_path, quick=False, seed=0)
    first = losses[: _pets_two.RUNS]
    assert first[0] == 0
    assert 0 < first[1] != first[2] > 0
    np.testing.assert_allclose(metrics["mota_two"].value, 100 - np.mean(first))
    np.testing.assert_allclose(metrics["mota_least_two"].value, 100 - max(first))
    assert metrics["mota_most_two"].value == 100


def test_people_outside_the_image_do_not_count():
    """The middles of their bodies are in the middle of the image, left of it, below it, in a corner, and behind it."""
    camera = demo_room(0, frames=1).cameras[0]
    (rows, cols), P = camera.shape, np.asarray(camera.P, float)
    pixels = np.array([[cols / 2, rows / 2], [-2, rows / 2], [cols / 2, rows + 1], [cols - 2, rows - 2]])
    homography = np.stack([P[:, 0], P[:, 1], P[:, 2] * _pets_two.MIDDLE_M + P[:, 3]], axis=1)
    places = np.linalg.solve(homography, np.pad(pixels, ((0, 0), (0, 1)), constant_values=1).T).T
    behind = 2 * np.asarray(camera.position())[:2] - places[0, :2] / places[0, 2]
    xy = np.vstack([places[:, :2] / places[:, 2:], behind])
    kept = _pets_two.in_image(floor_tracks(np.zeros(5), range(5), xy), camera)
    assert kept.identity.tolist() == [0, 3]


@pytest.mark.data
def test_peaks_of_the_published_method_are_looked_for_among_the_tracks(data_dir, monkeypatch):
    """Stand-ins are a decimetre from every peak, but for one frame in which nobody is followed."""
    folder = data_dir / "pom_lab_2cam"
    peaks = _pom.reference(folder)
    tracks = {i: np.reshape([peak + np.array([0.1, 0.0]) for peak in peaks.get(i, [])], (-1, 2)) for i in _pom.FRAMES}
    empty = _pom.FRAMES[-1]
    tracks[empty] = np.zeros((0, 2))
    monkeypatch.setattr(_pom, "follow", lambda folder: tracks)
    value = {name: metric.value for name, metric in _pom.pom_metrics(folder).items()}
    evaluated = [len(peaks.get(i, [])) for i in _pom.FRAMES[_pom.START_UP_FRAMES :]]
    assert value["pom_agreement"] == pytest.approx(1 - len(peaks[empty]) / sum(evaluated))
    assert value["pom_distance_m"] == pytest.approx(0.1)
    assert value["pom_peaks_per_frame"] == pytest.approx(np.mean(evaluated))
    assert value["pom_tracks_per_frame"] == pytest.approx(np.mean(evaluated) - len(peaks[empty]) / len(evaluated))


@pytest.mark.data
def test_the_reference_has_its_peaks_within_the_grid(data_dir):
    peaks = _pom.reference(data_dir / "pom_lab_2cam")
    assert set(peaks) == set(_pom.FRAMES)
    assert sum(len(found) for found in peaks.values()) == 58
    assert all(0 < x < 7.4 and -7.6 < y < 0 for found in peaks.values() for x, y in found)
