"""The paper's score: the oracles 9 and 10 of the specification, section 7."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.person.score import dilated, match_score, overlap, ternary_mask


def blobs(seed):
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.random((60, 80)).astype(np.float32), (0, 0), 3) > 0.52


def disc(center, radius, shape=(60, 80)):
    v, u = np.mgrid[: shape[0], : shape[1]]
    return (u - center[0]) ** 2 + (v - center[1]) ** 2 <= radius**2


@pytest.mark.parametrize("ring", [0, 1, 5])
def test_dilation_is_that_of_opencv(ring):
    for mask in (blobs(0), np.zeros((60, 80), bool), np.ones((60, 80), bool), disc((1, 58), 4)):
        kernel = np.ones((2 * ring + 1, 2 * ring + 1), np.uint8)
        expected = cv2.dilate(mask.astype(np.uint8), kernel) > 0
        np.testing.assert_array_equal(dilated(jnp.asarray(mask), ring), expected)


def test_ternary_images_have_three_values():
    mask = blobs(1)
    ternary = np.asarray(ternary_mask(jnp.asarray(mask)))
    assert set(np.unique(ternary)) == {-1, 0, 1}
    np.testing.assert_array_equal(ternary == 1, mask)
    np.testing.assert_array_equal(ternary != 0, cv2.dilate(mask.astype(np.uint8), np.ones((11, 11), np.uint8)) > 0)


def test_a_negative_ring_is_named():
    with pytest.raises(ValueError, match="ring must be 0 or more pixels; got -1"):
        ternary_mask(jnp.zeros((4, 5), bool), -1)


def test_score_is_the_ratio_of_sums():
    sim, real = (np.asarray(ternary_mask(jnp.asarray(blobs(seed)))).astype(float) for seed in (2, 3))
    np.testing.assert_allclose(
        match_score(jnp.asarray(sim), jnp.asarray(real)), (sim * real).sum() / np.abs(sim).sum(), rtol=1e-6
    )


def test_scores_of_known_pairs():
    ternary = jax.jit(lambda mask: ternary_mask(jnp.asarray(mask)))
    left, right, small = disc((20, 30), 9), disc((60, 30), 9), disc((20, 30), 4)
    assert match_score(ternary(left), ternary(left)) == 1
    assert match_score(ternary(left), ternary(right)) == 0
    assert match_score(jnp.asarray(small), jnp.asarray(left)) == 1
    assert -1 <= float(match_score(ternary(small), ternary(left))) < 1
    assert match_score(ternary(np.zeros((60, 80), bool)), ternary(left)) == -jnp.inf
    opposite = match_score(ternary(left), -ternary(left))
    assert opposite == -1


def test_scores_are_bounded():
    score = jax.jit(lambda a, b: match_score(ternary_mask(a), ternary_mask(b)))
    values = [float(score(jnp.asarray(blobs(i)), jnp.asarray(blobs(i + 50)))) for i in range(20)]
    assert -1 <= min(values) < max(values) <= 1


def test_overlap_is_intersection_over_union():
    a, b = blobs(4), blobs(5)
    np.testing.assert_allclose(overlap(jnp.asarray(a), jnp.asarray(b)), (a & b).sum() / (a | b).sum(), rtol=1e-6)
    assert overlap(jnp.zeros((3, 3)), jnp.zeros((3, 3))) == 0
    assert overlap(jnp.full((3, 3), 0.5), jnp.ones((3, 3))) == 0.5
