"""Real motion: its geometry on made-up numbers, its markers against chains, and the recordings where they lie."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import _exact_tilt
from jaxfilters.benchmarks.scenarios import _real_mocap as mocap
from jaxfilters.benchmarks.scenarios import _real_motion as motion
from jaxfilters.benchmarks.scenarios._real_markers import Marker, marked_hand
from jaxfilters.models.articulated.anatomy import relaxed_angles, template_shape
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.kinematics import finger_points
from jaxfilters.models.articulated.layout import five_fingers
from jaxfilters.models.articulated.projection import Perspective


def test_errors_are_those_of_a_shape_from_its_root():
    rng = np.random.default_rng(1)
    truth = rng.standard_normal((6, 5, 3))
    plain, scaled = motion.root_relative_errors(0.5 * truth + 7.0, truth, root=2)
    others = np.delete(truth - truth[:, 2:3], 2, axis=1)
    assert plain == pytest.approx(0.5 * np.linalg.norm(others, axis=-1).mean())
    assert scaled == pytest.approx(0, abs=1e-12)


@pytest.mark.system
@pytest.mark.parametrize("tilt", _exact_tilt.TILTS.values())
def test_a_hand_with_exact_keypoints_is_tilted_as_it_says(tilt):
    """The middle finger's base lies above the wrist in the image, and nearer to the camera by the sine of the tilt."""
    layout = five_fingers(3)
    hand = articulated_hand(layout, projection=Perspective(_exact_tilt.CAMERA))
    x = _exact_tilt.true_state(layout, tilt)
    base = np.asarray(hand.points(x))[2, 0] - np.asarray(x[layout.position])
    assert base[1] < 0  # y points down
    assert -base[2] / np.hypot(base[1], base[2]) == pytest.approx(np.sin(np.radians(tilt)), abs=0.02)


@pytest.mark.system
def test_markers_lie_between_joints_and_on_the_palm():
    layout = five_fingers()
    markers = (Marker("a", palm=(0.5, 0.1, -0.2)), Marker("b", finger=1, along=1.5), Marker("c", finger=4, along=3.0))
    hand = marked_hand(articulated_hand(layout), markers)
    x = jnp.zeros(layout.size).at[layout.quaternion].set(jnp.array([1.0, 0, 0, 0]))
    x = (
        x.at[layout.static]
        .set(jnp.asarray(template_shape()))
        .at[layout.angles]
        .set(jnp.asarray(relaxed_angles(layout).ravel()))
    )
    joints = np.asarray(finger_points(x, layout))
    width, height, thickness = np.asarray(x[layout.palm])
    expected = [(0.5 * height, 0.1 * thickness, -0.2 * width), joints[1, 1:3].mean(axis=0), joints[4, 3]]
    np.testing.assert_allclose(hand.marker_points(x), expected, atol=1e-4)
    np.testing.assert_allclose(hand.observe(x), np.array(expected)[:, :2].ravel(), atol=1e-4)


def test_a_triangle_is_known_from_its_sides():
    triangle = mocap.triangle_from_sides(55.2, 44.8, 32.4)
    sides = [np.linalg.norm(triangle[i] - triangle[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(sides, (55.2, 44.8, 32.4))
    np.testing.assert_allclose(mocap.hand_axes(triangle), np.eye(3), atol=1e-12)


@pytest.mark.data
def test_detections_lie_where_their_truth_is_seen(data_dir):
    """Median distance of a few pixels: intrinsics, axes and order of the markers fit together."""
    for chosen in motion.SETS.values():
        found = motion.load(data_dir, chosen, chosen.networks[0], 50)
        observed = np.asarray(found.camera.project(jnp.asarray(found.truth, jnp.float32)))
        assert np.median(np.linalg.norm(observed - found.pixels, axis=-1)) < 6.0
        assert 0.5 < found.noise < 12.0


@pytest.mark.system
@pytest.mark.data
def test_one_frame_lifted_within_limits_is_nearer_than_its_back_projection(data_dir):
    """By more than four standard errors of the difference, over poses a third of a second apart."""
    chosen = motion.SETS["nyu"]
    found = motion.load(data_dir, chosen, chosen.networks[0], 800)
    found = found._replace(pixels=found.pixels[::10], truth=found.truth[::10])
    flat, lifted = (
        np.array(
            [
                motion.root_relative_errors(p[None], t[None], chosen.root)[0]
                for p, t in zip(way(chosen, found).points, found.truth, strict=True)
            ]
        )
        for way in (motion.onto_root_plane, motion.frame_by_frame)
    )
    nearer = flat - lifted
    assert nearer.mean() > 4 * nearer.std() / np.sqrt(len(nearer))
