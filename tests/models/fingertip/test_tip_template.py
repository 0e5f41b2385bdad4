"""Correlation against its definition in numpy; peaks of a parabola, whose vertex is known."""

import numpy as np
import pytest

from jaxfilters.models.fingertip.tip_template import best_apart, correlation, peaks, tip_template


def test_the_template_is_a_disc_of_the_radius():
    disc = tip_template(6.5, 9)
    assert disc.shape == (19, 19)
    assert disc.sum() / 255 == pytest.approx(np.pi * 6.5**2, rel=0.02)
    assert disc[9, 9] == 255
    assert not disc[0].any()


def test_correlation_is_that_of_the_definition():
    rng = np.random.default_rng(0)
    image = (255 * (rng.uniform(size=(30, 40)) < 0.6)).astype(np.uint8)
    disc = tip_template(3.0, 5)
    response, padded = correlation(image, disc), np.pad(image.astype(float), 5)
    centred = disc - disc.mean()
    for y, x in [(0, 0), (12, 20), (29, 39), (15, 3), (7, 33)]:
        window = padded[y : y + 11, x : x + 11]
        window = window - window.mean()
        expected = np.sum(window * centred) / np.sqrt(np.sum(window**2) * np.sum(centred**2))
        assert response[y, x] == pytest.approx(expected if image[y, x] else 0.0, abs=1e-4)


def test_flat_images_have_no_correlation():
    for level in (0, 255):
        response = correlation(np.full((40, 40), level, np.uint8), tip_template(3.0, 5))
        assert np.isfinite(response).all()
        assert np.abs(response[10:30, 10:30]).max() == 0


def test_peaks_are_found_between_pixels():
    y, x = np.meshgrid(np.arange(20.0), np.arange(30.0), indexing="ij")
    response = np.maximum(1 - 0.01 * (x - 12.3) ** 2 - 0.02 * (y - 8.6) ** 2, 0).astype(np.float32)
    response += np.maximum(0.8 - 0.05 * (x - 25) ** 2 - 0.05 * (y - 3) ** 2, 0).astype(np.float32)
    found = peaks(response, 0.3)
    np.testing.assert_allclose(found.points[:2], [(12.3, 8.6), (25, 3)], atol=0.05)
    assert found.scores[0] > found.scores[1]
    assert len(peaks(response, 1.5).points) == 0


def test_what_is_near_a_better_point_is_left_out():
    points = np.array([(0.0, 0.0), (3.0, 0.0), (6.0, 0.0), (20.0, 0.0), (40.0, 0.0)])
    scores = np.array([0.5, 0.9, 0.6, 0.7, 0.0])
    assert best_apart(points, scores, 4.0, 5).tolist() == [1, 3]
    assert best_apart(points, scores, 2.0, 3).tolist() == [1, 3, 2]
    assert best_apart(points[:0], scores[:0], 2.0, 3).tolist() == []
