"""Normalised correlation against OpenCV and scipy; oracle 3 of the specification, first half."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from jaxfilters.models.face import correlation
from jaxfilters.models.face.correlation import inside, score_sums, window_sums

cut, score_map = jax.jit(correlation.cut, static_argnums=2), jax.jit(correlation.score_map, static_argnums=3)
ncc, score_points = jax.jit(correlation.ncc), jax.jit(correlation.score_points)
ROWS, COLS = 90, 120


def picture(seed=0, shape=(ROWS, COLS)):
    """A smooth texture of 8-bit grey levels."""
    noise = np.random.default_rng(seed).normal(0, 1, shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(120 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def sampled(image, point, size=16):
    """A window by scipy, border pixels repeated."""
    offsets = np.arange(size) - (size - 1) / 2
    v, u = np.meshgrid(point[1] + offsets, point[0] + offsets, indexing="ij")
    return map_coordinates(image.astype(float), [v, u], order=1, mode="nearest")


def some_points(num=60, seed=1, margin=7.5):
    rng = np.random.default_rng(seed)
    return rng.uniform(margin, np.array([COLS, ROWS]) - 1 - margin, (num, 2))


def test_correlation_is_that_of_numpy(x64):
    a, b = np.random.default_rng(0).normal(100, 20, (2, 16, 16))
    assert ncc(jnp.asarray(a), jnp.asarray(b)) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1], abs=1e-12)


@pytest.mark.parametrize(("gain", "offset"), [(0.7, 0.0), (1.3, -40.0), (0.01, 200.0)])
def test_gain_and_offset_of_a_patch_do_not_matter(x64, gain, offset):
    a, b = (jnp.asarray(p) for p in np.random.default_rng(1).uniform(0, 255, (2, 16, 16)))
    assert ncc(gain * a + offset, b) == pytest.approx(float(ncc(a, b)), abs=1e-6)
    assert ncc(a, gain * a + offset) == pytest.approx(1, abs=1e-12)
    assert ncc(a, -gain * a + offset) == pytest.approx(-1, abs=1e-12)


@pytest.mark.parametrize("level", [0.0, 0.1, 255.0])
def test_a_flat_patch_correlates_with_nothing(level):
    flat, patch = jnp.full((16, 16), level), jnp.asarray(picture()[:16, :16], float)
    assert ncc(flat, patch) == 0
    assert ncc(patch, flat) == 0
    assert np.all(np.isfinite(jax.jit(jax.grad(ncc))(flat, patch)))


def test_windows_are_interpolated_as_by_scipy(x64):
    image = picture()
    points = np.concatenate([some_points(), [(7.5, 7.5), (COLS - 8.5, ROWS - 8.5), (40.0, 40.5)]])
    expected = [sampled(image, point) for point in points]
    np.testing.assert_allclose(cut(jnp.asarray(image), jnp.asarray(points)), expected, atol=1e-9)


def test_beyond_the_border_the_image_goes_on_as_at_the_border(x64):
    image = picture()
    points = np.array([(0.0, 0.0), (-3.3, 50.2), (COLS + 4.1, -7.0), (500.0, -1e4), (60.5, ROWS + 30.0)])
    expected = [sampled(image, point) for point in points]
    np.testing.assert_allclose(cut(jnp.asarray(image), jnp.asarray(points)), expected, atol=1e-9)


def test_windows_about_no_point_are_finite():
    points = jnp.array([[jnp.nan, 10.0], [jnp.inf, -jnp.inf]])
    assert np.all(np.isfinite(cut(jnp.asarray(picture()), points)))
    assert not np.any(inside((ROWS, COLS), points, 16))


def test_the_top_left_pixel_of_the_first_window_is_that_of_the_image(x64):
    image = picture()
    windows = cut(jnp.asarray(image), jnp.array([[7.5, 7.5], [COLS - 8.5, ROWS - 8.5]]))
    np.testing.assert_array_equal(windows, [image[:16, :16], image[-16:, -16:]])
    points = np.array(
        [(7.5, 7.5), (7.4, 7.5), (7.5, 7.4), (COLS - 8.5, ROWS - 8.5), (COLS - 8.4, 50), (50, ROWS - 8.4)]
    )
    np.testing.assert_array_equal(
        inside((ROWS, COLS), jnp.asarray(points), 16), [True, False, False, True, False, False]
    )


def test_windows_move_with_their_point(x64):
    """The derivative of an interpolated window, against central differences within one cell."""
    image, point = jnp.asarray(picture()), jnp.array([50.3, 40.6])
    slope = jax.jit(jax.jacfwd(lambda p: cut(image, p[None])[0]))(point)
    for axis in range(2):
        step = 1e-4 * np.eye(2)[axis]
        difference = (sampled(picture(), point + step) - sampled(picture(), point - step)) / 2e-4
        np.testing.assert_allclose(slope[..., axis], difference, atol=1e-6)


def test_point_scores_are_correlations_with_the_windows_about_them(x64):
    image, points = picture(), some_points()
    template = sampled(image, (50.3, 44.8))
    expected = [np.corrcoef(template.ravel(), sampled(image, point).ravel())[0, 1] for point in points]
    found = score_points(jnp.asarray(image), jnp.asarray(template), jnp.asarray(points))
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_a_template_fits_where_it_was_cut_also_between_pixels():
    image, points = jnp.asarray(picture()), jnp.asarray(some_points(5), jnp.float32)
    for template, point in zip(cut(image, points), points, strict=True):
        assert score_points(image, template, point[None])[0] == pytest.approx(1, abs=1e-6)


def test_windows_that_leave_the_image_score_minus_one():
    points = jnp.array([[7.0, 40.0], [40.0, ROWS - 8.0], [jnp.nan, 40.0]])
    image = jnp.asarray(picture())
    np.testing.assert_array_equal(score_points(image, image[:16, :16], points), -1)


@pytest.mark.parametrize("size", [16, 11])
def test_score_maps_are_those_of_opencv(x64, size):
    image = picture()
    template = image[30 : 30 + size, 50 : 50 + size]
    expected = cv2.matchTemplate(image, template, cv2.TM_CCOEFF_NORMED)
    found = score_map(jnp.asarray(image), jnp.asarray(template), jnp.zeros(2), expected.shape)
    # OpenCV computes in single precision.
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert np.unravel_index(np.argmax(found), found.shape) == (30, 50)


def test_a_score_map_may_reach_over_the_border():
    image, template = picture(), picture(3)[:16, :16]
    whole = cv2.matchTemplate(image, template, cv2.TM_CCOEFF_NORMED)
    found = score_map(jnp.asarray(image), jnp.asarray(template), jnp.array([-5, ROWS - 16 - 8]), (20, 30))
    np.testing.assert_allclose(found[:9, 5:], whole[-9:, :25], atol=2e-5)
    np.testing.assert_array_equal(found[9:], -1)
    np.testing.assert_array_equal(found[:, :5], -1)


def test_flat_places_of_a_map_score_zero():
    """A bright patch in a flat image: only windows that touch it have any variance."""
    image = np.full((ROWS, COLS), 37, np.uint8)
    image[20:30, 20:30] = 250
    template = jnp.asarray(picture()[:16, :16])
    found = np.asarray(score_map(jnp.asarray(image), template, jnp.zeros(2), (ROWS - 15, COLS - 15)))
    touched = np.zeros_like(found, dtype=bool)
    touched[5:30, 5:30] = True
    assert np.all(found[~touched] == 0)
    assert np.abs(found[touched]).max() > 0.1
    assert not score_map(jnp.asarray(picture()), jnp.full((16, 16), 9), jnp.zeros(2), (20, 20)).any()


@pytest.mark.system
@pytest.mark.parametrize("precise", [False, True])
def test_scores_from_sums_are_those_of_cut_windows(precise):
    """The sums of interpolated windows are exact; 1e-4 bounds the rounding of sums in single precision."""
    with jax.enable_x64(precise):
        dtype = jnp.float64 if precise else jnp.float32
        image, points = picture(), jnp.asarray(some_points(300, seed=4, margin=8.5), dtype)
        template = cut(jnp.asarray(image), jnp.array([[50.3, 44.8]], dtype))[0]
        by_sums = jax.jit(lambda box, template, p: score_sums(window_sums(box, template), p.T - 7.5, 16))
        found = by_sums(jnp.asarray(image, dtype), template, points)
        expected = score_points(jnp.asarray(image), template, points)
        assert found.dtype == dtype
        np.testing.assert_allclose(found, expected, atol=1e-10 if precise else 1e-4)


def test_scores_from_sums_have_the_derivatives_of_cut_windows(x64):
    image, points = picture(), jnp.asarray(some_points(20, seed=5))
    template = cut(jnp.asarray(image), jnp.array([[50.3, 44.8]]))[0]
    by_sums = lambda p: jnp.sum(score_sums(window_sums(jnp.asarray(image, float), template), p.T - 7.5, 16) ** 2)
    by_windows = lambda p: jnp.sum(score_points(jnp.asarray(image), template, p) ** 2)
    np.testing.assert_allclose(jax.jit(jax.grad(by_sums))(points), jax.jit(jax.grad(by_windows))(points), atol=1e-9)
