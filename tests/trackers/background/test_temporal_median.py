import numpy as np
import pytest

from jaxfilters.trackers.background.temporal_median import temporal_median


@pytest.mark.parametrize("n", [1, 3, 5, 9, 25])
@pytest.mark.parametrize("shape", [(7, 5), (301, 400, 3)])
def test_it_is_the_median_of_numpy(n, shape):
    images = np.random.default_rng(n).integers(0, 256, (n, *shape), np.uint8)
    before = images.copy()
    np.testing.assert_array_equal(temporal_median(list(images)), np.median(images, axis=0).astype(np.uint8))
    np.testing.assert_array_equal(images, before)


def test_of_an_even_number_the_last_is_left_out():
    images = list(np.random.default_rng(0).integers(0, 256, (6, 4, 4), np.uint8))
    np.testing.assert_array_equal(temporal_median(images), temporal_median(images[:5]))


@pytest.mark.parametrize(
    ("images", "message"),
    [
        ([], "at least one; got none"),
        ([np.zeros((2, 2))], r"uint8 of one shape; got \(2, 2\) float64"),
        ([np.zeros((2, 2), np.uint8), np.zeros((2, 3), np.uint8)], r"\(2, 2\) uint8, \(2, 3\) uint8"),
    ],
)
def test_images_of_other_kinds_are_named(images, message):
    with pytest.raises(ValueError, match=message):
        temporal_median(images)
