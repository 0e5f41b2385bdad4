import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.synthetic.depth_sensor import DepthSensor, depth_from_millimetres, silhouette_edge

SHAPE = (200, 300)
QUIET = dict(noise_std=0.0)


@pytest.fixture
def disc():
    """A flat disc at 0.7 m before nothing."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return jnp.asarray(np.where(np.hypot(u - 150, v - 100) < 80, 0.7, np.inf), dtype=jnp.float32)


def sense(disc, seed=1, **options):
    return np.asarray(DepthSensor(**options).sense(jax.random.key(seed), disc)).astype(int)


def assert_fraction(count, total, fraction):
    """Binomial z-test at 4 sigma."""
    assert abs(count - total * fraction) < 4 * np.sqrt(total * fraction * (1 - fraction))


@pytest.mark.system
def test_without_flaws_it_is_the_image_in_millimetres_before_a_wall(disc):
    np.testing.assert_array_equal(sense(disc, **QUIET), np.where(np.isfinite(disc), 700, 3000))


def test_noise_has_the_stated_deviation_everywhere(disc):
    error = sense(disc, noise_std=0.004) - np.where(np.isfinite(disc), 700, 3000)
    for region in (np.isfinite(disc), np.isinf(disc)):
        n = region.sum()
        # Rounding to millimetres adds 1/12 to the variance; a variance estimate has deviation sqrt(2 / n).
        expected = 4.0**2 + 1 / 12
        assert abs(error[region].var() - expected) < 4 * expected * np.sqrt(2 / n)
        assert abs(error[region].mean()) < 4 * np.sqrt(expected / n)


def test_flying_pixels_lie_on_the_edge_between_object_and_background(disc):
    image = sense(disc, flying_fraction=0.5, **QUIET)
    flying = (image != 700) & (image != 3000)
    edge = np.asarray(silhouette_edge(disc))
    assert not np.any(flying & ~edge)
    assert_fraction(flying.sum(), edge.sum(), 0.5)
    depths = image[flying]
    assert depths.min() > 700
    assert depths.max() < 3000
    # Uniform between 0.7 and 3 m.
    assert abs(depths.mean() - 1850) < 4 * 2300 / np.sqrt(12 * len(depths))


def test_edge_is_the_object_pixels_that_touch_background():
    image = np.full((6, 7), np.inf)
    image[1:5, 1:5] = 1.0
    expected = np.zeros((6, 7), bool)
    expected[1:5, 1:5] = True
    expected[2:4, 2:4] = False
    np.testing.assert_array_equal(silhouette_edge(jnp.asarray(image)), expected)


def test_edge_ends_at_the_border_of_the_image():
    image = np.full((3, 4), np.inf)
    image[:, :2] = 1.0
    expected = np.zeros((3, 4), bool)
    expected[:, 1] = True
    np.testing.assert_array_equal(silhouette_edge(jnp.asarray(image)), expected)


def test_dropouts_are_zero_and_as_many_as_stated(disc):
    image = sense(disc, dropout_fraction=0.02, **QUIET)
    assert_fraction((image == 0).sum(), image.size, 0.02)
    kept = image != 0
    np.testing.assert_array_equal(image[kept], sense(disc, **QUIET)[kept])


@pytest.mark.system
def test_depths_beyond_the_range_of_the_format_saturate():
    far = DepthSensor(noise_std=0.0).sense(jax.random.key(1), jnp.full((2, 2), 100.0))
    np.testing.assert_array_equal(far, 65535)


def test_same_key_same_image_under_jit(disc):
    sensor = DepthSensor(flying_fraction=0.1, dropout_fraction=0.1)
    key = jax.random.key(7)
    np.testing.assert_array_equal(jax.jit(lambda s: s.sense(key, disc))(sensor), sensor.sense(key, disc))


def test_reading_back_gives_metres_and_nan_for_no_reading():
    depth = depth_from_millimetres(jnp.array([[0, 700], [1, 65535]], dtype=jnp.uint16))
    np.testing.assert_allclose(depth, [[np.nan, 0.7], [0.001, 65.535]], rtol=1e-6)
