"""The simplest things beside the six systems find what they should where nothing is hard, and a run has its names."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks import results_page
from jaxfilters.benchmarks.metrics import Metric, report
from jaxfilters.benchmarks.scenarios import _simplest as simplest
from jaxfilters.benchmarks.scenarios import systems
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.rig import monocular
from jaxfilters.trackers.people.demo_room import demo_room

SHAPE = np.random.default_rng(0).normal(0, 40, (10, 3))
POSES = np.array([[10.0, -5.0, 650.0, 0.1, -0.3, 0.2], [12.0, -4.0, 660.0, 0.12, -0.25, 0.18]])
"""Millimetres, and roll, yaw, pitch in radians about the camera's z, y and x axes in this order."""


def placed(pose):
    return Rotation.from_euler("ZYX", pose[3:]).apply(SHAPE) + pose[:3]


def sight(points, focal, offset_mm=0.0):
    x = points - [offset_mm, 0, 0]
    return focal * x[:, :2] / x[:, 2:] + [319.5, 239.5]


def test_poses_of_exact_points_are_found():
    rig = monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))
    uv = np.stack([sight(placed(pose), 800.0) for pose in POSES])
    np.testing.assert_allclose(simplest.pose_by_pnp(SHAPE, uv, rig), POSES, atol=1e-2)
    K = np.array([[800.0, 0, 319.5], [0, 800.0, 239.5], [0, 0, 1]])
    cameras = np.stack([K @ np.c_[np.eye(3), [-offset, 0, 0]] for offset in (0.0, 120.0)])
    both = np.stack([[sight(placed(pose), 800.0, offset) for offset in (0.0, 120.0)] for pose in POSES])
    np.testing.assert_allclose(simplest.pose_by_triangulation(SHAPE, both, cameras), POSES, atol=1e-6)


def test_blobs_are_projected_back_and_keep_their_names():
    """Two boxes whose lower edges stand on known places of the floor, a step to the side in every frame."""
    camera = demo_room(0, frames=2).cameras[0]
    places = [np.array([[-1.0 + 0.1 * i, 1.0], [1.5, 2.0 + 0.1 * i]]) for i in range(6)]
    images = [np.full((*camera.shape, 3), 100, np.uint8) for _ in places]
    for image, at in zip(images, places, strict=True):
        feet, _ = camera.project(jnp.asarray(np.c_[at, np.zeros(2)], jnp.float32))
        for u, v in np.round(np.asarray(feet)).astype(int):
            image[v - 60 : v, u - 10 : u + 10] = 250
    found = simplest.followed_blobs(images, np.full_like(images[0], 100), camera)
    assert len(found) == 12
    assert len({who for _, who, *_ in found}) == 2
    for frame, _, *place in found:
        assert np.linalg.norm(place - places[frame], axis=1).min() < 0.1


@pytest.mark.parametrize("fingers", [2, 3, 5])
def test_fingers_are_the_gaps_of_the_hull_and_one(fingers):
    rows, cols = np.mgrid[:240, :320]
    mask = (rows - 180) ** 2 + (cols - 160) ** 2 < 45**2
    angles = 0.45 * (np.arange(fingers) - (fingers - 1) / 2)
    for angle in angles:
        along, across = np.sin(angle), np.cos(angle)
        forward = (cols - 160) * along - (rows - 180) * across
        mask |= (forward > 0) & (forward < 130) & (np.abs((cols - 160) * across + (rows - 180) * along) < 8)
    assert simplest.fingers_by_hull(mask) == fingers
    ends = simplest.tips_by_hull(mask)
    assert len(ends) == fingers
    true = np.array([(160 + 130 * np.sin(angle), 180 - 130 * np.cos(angle)) for angle in angles])
    assert np.linalg.norm(ends[:, None] - true, axis=-1).min(axis=0).max() < 10  # half the width of these fingers is 8


def test_a_stroke_is_nearest_to_itself_drawn_larger_and_slower():
    known = {"V": np.array([[0.0, 0], [1, 2], [2, 0]]), "L": np.array([[0.0, 0], [0, 2], [1, 2]])}
    slow = np.concatenate([np.linspace([5, 5], [5, 25], 40), np.linspace([5, 25], [15, 25], 10)])
    assert simplest.nearest_by_warping(list(known.values()), list(known), [slow]) == ["L"]


def test_the_nearest_stroke_by_time_warping_is_that_of_the_recursion_over_all_pairs_of_places():
    rng = np.random.default_rng(0)
    known, strokes = (list(rng.normal(size=(num, 32, 3)).cumsum(axis=1)) for num in (30, 12))

    def cost(first, second):
        apart = np.linalg.norm(simplest._normalised(first)[:, None] - simplest._normalised(second), axis=-1)
        total = np.full((33, 33), np.inf)
        total[0, 0] = 0.0
        for i, j in np.ndindex(32, 32):
            total[i + 1, j + 1] = apart[i, j] + min(total[i, j + 1], total[i + 1, j], total[i, j])
        return total[-1, -1]

    expected = [str(np.argmin([cost(stroke, other) for other in known])) for stroke in strokes]
    assert simplest.nearest_by_warping(known, [str(i) for i in range(30)], strokes) == expected


ENVIRONMENT = {"jaxfilters": "0", "jax": "0", "numpy": "0", "python": "0", "cpu": "c", "cores": 1, "device": "d"}


def test_the_page_begins_with_recordings_whose_simplest_thing_was_measured_too():
    measured = {"mota": 98.916, "mota_simple": 62.44, "idf1": 92.0}
    found = {name: Metric(value, "%", "higher") for name, value in measured.items()}
    page = results_page.results_page([report("people-pets", found, ENVIRONMENT)], {})
    rows = [line for line in page.splitlines() if line.startswith("| people on a floor")]
    assert len(rows) == 1
    assert rows[0].endswith("| MOTA, higher is better | 98.9 % | 62.4 % | blobs, projected back |")
    assert "on recordings" not in results_page.results_page([report("scale", {}, ENVIRONMENT)], {})


@pytest.mark.system
def test_the_page_has_a_row_for_what_a_run_measures():
    found = systems.symbol_metrics(True, 0)
    assert found["symbols_right"].value > 80
    page = results_page.results_page([report("systems", found, ENVIRONMENT)], {})
    row = next(line for line in page.splitlines() if line.startswith("| symbols"))
    assert row.endswith("| nearest by dynamic time warping | 99.2 % |")
    assert f"| {found['symbols_right'].value:.3g} % | {found['symbols_right_simple'].value:.3g} % |" in row
