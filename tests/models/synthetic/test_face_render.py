"""Drawn faces, against rays that NumPy intersects with the plane of each landmark."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.face.landmarks import MEAN_SHAPE
from jaxfilters.models.face.rig import nominal, project_shape
from jaxfilters.models.synthetic.face_render import Occluder, render_face
from jaxfilters.models.synthetic.face_texture import AXES, NORMALS, make_scene

SHAPE = jnp.asarray(MEAN_SHAPE, jnp.float32)
POSE = jnp.array([62.3, -4.1, 640.7, 0.12, 0.35, -0.15])
REPEATS = 16


@pytest.fixture(scope="module")
def scene():
    return make_scene(jax.random.key(1), (480, 640))


def averaged(scene, shape=SHAPE, **options):
    """Mean of images with different noise: standard deviation sqrt(4 + 1/12) / 4 = 0.51 grey levels."""
    keys = jax.random.split(jax.random.key(5), REPEATS)
    return sum(np.asarray(render_face(key, scene, nominal(), POSE, shape, **options), float) for key in keys) / REPEATS


def plain(scene):
    return replace(scene, texture=replace(scene.texture, amplitude=jnp.zeros(10)))


@pytest.fixture(scope="module")
def added(scene):
    """What the patches add to the picture of a head without any."""
    return averaged(scene) - averaged(plain(scene))


def expected_patches(scene, camera, pixels):
    """Sum over the landmarks at (row, column) pixels: plane and ray meet where a 3 x 3 system says."""
    R = Rotation.from_euler("ZYX", np.asarray(POSE[3:], float)).as_matrix()
    t = np.array([0.0 if camera == 0 else -120.0, 0, 0])
    total = np.zeros(len(pixels))
    for k in range(10):
        point = R @ MEAN_SHAPE[k] + np.asarray(POSE[:3], float) + t
        across, down = R @ AXES[k].T[:, 0], R @ AXES[k].T[:, 1]
        cosine = -(R @ NORMALS[k]) @ point / np.linalg.norm(point)
        weight = np.clip((cosine - 0.05) / 0.25, 0, 1)
        for i, (row, column) in enumerate(pixels):
            ray = np.array([(column - 319.5) / 800, (row - 239.5) / 800, 1.0])
            x, y, _ = np.linalg.solve(np.stack([across, down, -ray], axis=1), -point)
            wave, phase = np.asarray(scene.texture.wave[k], float), np.asarray(scene.texture.phase[k], float)
            waves = np.cos(wave @ [x, y] + phase).sum() * float(scene.texture.amplitude[k])
            total[i] += weight * np.exp(-(x * x + y * y) / 72) * waves
    return total


@pytest.mark.system
@pytest.mark.parametrize("camera", [0, 1])
def test_patches_are_where_their_planes_meet_the_rays(scene, added, camera):
    """Noise of a difference of means: 0.71; its rms over 200 pixels is below 0.86 (4 sigma of the rms)."""
    uv = np.asarray(project_shape(nominal(), SHAPE, POSE)[0])[camera]
    draw = np.random.default_rng(0)
    pixels = np.round(uv[draw.integers(0, 10, 200), ::-1] + draw.normal(0, 6, (200, 2))).astype(int)
    expected = expected_patches(scene, camera, pixels)
    error = added[camera][pixels[:, 0], pixels[:, 1]] - expected
    assert expected.std() > 15
    assert np.sqrt(np.mean(error**2)) < 0.86


@pytest.mark.system
def test_the_projected_landmark_is_the_centre_of_its_patch(scene):
    """One bright spot in place of waves: its weighted centre is within 0.15 px of the projection where planes face us.

    A slanted plane has its nearer half larger, hence only the landmarks of the mouth and the inner eyes.
    """
    spots = replace(scene.texture, wave=jnp.zeros((10, 14, 2)), phase=jnp.zeros((10, 14)), amplitude=jnp.full(10, 5.0))
    shape = SHAPE * jnp.array([3.0, 3.0, 1.0])  # so that spots do not touch
    bright = averaged(replace(scene, texture=spots), shape) - averaged(plain(scene), shape)
    uv = np.asarray(project_shape(nominal(), shape, POSE)[0])
    for camera in (0, 1):
        for k in (1, 2, 4):
            u, v = uv[camera, k]
            rows, columns = np.mgrid[round(v) - 25 : round(v) + 26, round(u) - 25 : round(u) + 26]
            grey = bright[camera][rows, columns]
            grey = np.where(grey > 3, grey, 0)
            center = np.array([(columns * grey).sum(), (rows * grey).sum()]) / grey.sum()
            np.testing.assert_allclose(center, [u, v], atol=0.15)


def test_noise_has_a_standard_deviation_of_two_grey_levels(scene):
    """With rounding sqrt(4 + 1/12); 600,000 pixels give it to 0.1 %."""
    a, b = (np.asarray(render_face(jax.random.key(i), scene, nominal(), POSE, SHAPE), float) for i in (0, 1))
    assert (a - b).std() / np.sqrt(2) == pytest.approx(np.sqrt(4 + 1 / 12), rel=0.01)
    assert abs((a - b).mean()) < 0.02


@pytest.mark.system
def test_head_is_a_brighter_ellipse_before_the_background(scene):
    image = averaged(plain(scene))[0]
    center = np.asarray(Rotation.from_euler("ZYX", POSE[3:]).as_matrix() @ [0, 5, 70] + np.asarray(POSE[:3]))
    u, v = center[:2] / center[2] * 800 + 239.5 + np.array([80, 0])
    inside = image[round(v) - 20 : round(v) + 20, round(u) - 20 : round(u) + 20]
    assert inside.mean() == pytest.approx(155, abs=6)
    assert np.abs(np.diff(inside)).max() < 4
    np.testing.assert_allclose(image[:, :100], np.asarray(scene.background)[0][:, :100], atol=2.6)


@pytest.mark.system
def test_gain_and_offset_act_on_everything_and_pixels_stay_within_bytes(scene):
    key = jax.random.key(2)
    plain_image, dim, bright = (
        np.asarray(render_face(key, scene, nominal(), POSE, SHAPE, gain=gain, offset=offset), float)
        for gain, offset in ((1.0, 0.0), (0.7, 10.0), (3.0, 0.0))
    )
    unclipped = (plain_image > 20) & (plain_image < 230)
    assert np.abs(dim - 0.7 * plain_image - 10)[unclipped].mean() < 1.5
    assert bright.max() == 255


@pytest.mark.system
def test_an_occluder_hides_what_is_behind_it_in_every_camera(scene):
    occluder = Occluder(jnp.array([60.0, 40.0, 600.0]), jnp.array([40.0, 20.0]), jnp.asarray(120.0), jnp.asarray(1.0))
    key = jax.random.key(4)
    hidden = np.asarray(render_face(key, scene, nominal(), POSE, SHAPE, occluder=occluder), float)
    observed = np.asarray(render_face(key, scene, nominal(), POSE, SHAPE), float)
    for camera, left in ((0, 0.0), (1, -120.0)):
        u, v = 800 * (60 + left) / 600 + 319.5, 800 * 40 / 600 + 239.5
        rows, columns = np.mgrid[0:480, 0:640]
        inside = (np.abs(columns - u) <= 800 * 40 / 600) & (np.abs(rows - v) <= 800 * 20 / 600)
        assert hidden[camera][inside].std() == pytest.approx(2.02, abs=0.1)
        np.testing.assert_array_equal(hidden[camera][~inside], observed[camera][~inside])
    absent = replace(occluder, opacity=jnp.asarray(0.0))
    np.testing.assert_array_equal(render_face(key, scene, nominal(), POSE, SHAPE, occluder=absent), observed)


def test_a_head_behind_the_camera_is_not_seen(scene):
    image = render_face(jax.random.key(6), scene, nominal(), POSE.at[2].set(-650.0), SHAPE)
    assert np.abs(np.asarray(image, float) - np.clip(scene.background, 0, 255)).max() < 12


def test_backgrounds_must_fit_the_rig(scene):
    small = replace(scene, background=scene.background[:1])
    with pytest.raises(ValueError, match="background of shape"):
        render_face(jax.random.key(0), small, nominal(), POSE, SHAPE)
