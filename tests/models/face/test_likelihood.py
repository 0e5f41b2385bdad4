"""Scores of ensembles, and the weights that follow (oracles 3 and 4 of the specification)."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face import likelihood
from jaxfilters.models.face.correlation import cut, score_points
from jaxfilters.models.face.likelihood import BOXES, log_weights

ROWS, COLS, C, K = 240, 320, 2, 3
CENTERS = np.random.default_rng(0).uniform([120, 100], [200, 140], (C, K, 2))


scores = jax.jit(likelihood.scores)


def pictures():
    noise = np.random.default_rng(1).normal(0, 1, (C, ROWS, COLS))
    smooth = np.stack([cv2.GaussianBlur(plane, (0, 0), 2.0) for plane in noise])
    return jnp.asarray(np.clip(120 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8))


def scene(spread, num=50, dtype=jnp.float32):
    """Images, templates cut at the landmarks, and candidates at most `spread` pixels from them."""
    images, centers = pictures(), jnp.asarray(CENTERS, dtype)
    offsets = np.random.default_rng(2).uniform(-spread, spread, (C, K, 2, num))
    return images, jax.jit(jax.vmap(cut))(images, centers), centers[..., None] + jnp.asarray(offsets, dtype)


@jax.jit
def one_by_one(images, templates, uv):
    each = jax.vmap(score_points, (None, 0, 0))
    return jax.vmap(each)(images, templates, jnp.swapaxes(uv, -1, -2))


@pytest.mark.system
@pytest.mark.parametrize("spread", [10.0, 22.0, 30.0, 50.0, 70.0, 90.0])
def test_scores_do_not_depend_on_how_far_the_candidates_spread(spread):
    """In boxes of either size and without one: 1e-4 bounds the rounding of sums in single precision."""
    images, templates, uv = scene(spread)
    np.testing.assert_allclose(scores(images, templates, uv), one_by_one(images, templates, uv), atol=1e-4)
    assert {np.sum(2 * spread + 16 > np.array(BOXES)) for spread in (10.0, 50.0, 90.0)} == {0, 1, 2}


def test_scores_are_one_where_the_templates_were_cut_and_less_elsewhere():
    images, templates, uv = scene(0.0)
    shifts = jnp.stack([jnp.linspace(-3, 3, 51)[:50], jnp.zeros(50)])
    found = scores(images, templates, uv + shifts)
    np.testing.assert_allclose(found[..., 25], 1, atol=1e-5)
    assert np.all(np.delete(found, [24, 25, 26], axis=-1) < 0.999)


def test_candidates_without_an_image_score_minus_one_and_do_not_disturb_the_others():
    images, templates, uv = scene(10.0)
    wrong = uv.at[0, 1, :, 4].set(jnp.nan).at[1, 2, 0, 7].set(-20.0).at[1, 2, 1, 8].set(1e6)
    found, expected = scores(images, templates, wrong), np.array(one_by_one(images, templates, uv))
    expected[0, 1, 4] = expected[1, 2, 7] = expected[1, 2, 8] = -1
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert np.all(scores(images, templates, jnp.full_like(uv, jnp.nan)) == -1)


@pytest.mark.parametrize("corner", [(0.0, 0.0), (COLS - 1.0, ROWS - 1.0)])
def test_boxes_end_at_the_border(corner):
    """Candidates about the corners of the image, those inside to the last pixel."""
    images, templates, uv = scene(15.0)
    inwards = np.array([7.5, 7.5]) * (1 if corner[0] == 0 else -1)
    uv = (
        (uv - jnp.asarray(CENTERS, jnp.float32)[..., None] + (np.array(corner) + inwards)[:, None])
        .at[..., 0]
        .set(jnp.asarray(np.array(corner) + inwards))
    )
    found, expected = scores(images, templates, uv), one_by_one(images, templates, uv)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert np.all(expected[..., 0] > -1)
    assert np.any(expected == -1)


@pytest.mark.system
def test_images_smaller_than_a_box_are_one_box():
    images, templates, uv = scene(12.0)
    small, offset = images[:, 90:140, 110:200], jnp.array([[110.0], [90.0]])
    assert small.shape[1] < BOXES[0] < small.shape[2] < BOXES[1]
    found = scores(small, templates, uv - offset)
    np.testing.assert_allclose(found, one_by_one(small, templates, uv - offset), atol=1e-4)


@jax.jit
def slopes(images, templates, uv):
    return jax.grad(lambda uv: jnp.sum(likelihood.scores(images, templates, uv)))(uv)


@pytest.mark.system
@pytest.mark.parametrize("spread", [10.0, 90.0])
def test_scores_can_be_differentiated(x64, spread):
    images, templates, uv = scene(spread, num=6, dtype=jnp.float64)
    found = slopes(images, templates, uv.at[0, 0, :, 2].set(jnp.nan))
    expected = jax.jit(jax.grad(lambda uv: jnp.sum(one_by_one(images, templates, uv))))(uv)
    assert not found[0, 0, :, 2].any()
    np.testing.assert_allclose(found, expected.at[0, 0, :, 2].set(0), atol=1e-9)


DEVIATION = np.array([6.0, 4.0, 2.5, 1.6, 1.0])


def normalised(score_sum, deformation, **options):
    log = log_weights(
        jnp.asarray(score_sum), jnp.asarray(deformation), jnp.asarray(DEVIATION), num_scores=20, **options
    )
    return np.exp(log - jax.scipy.special.logsumexp(log))


@pytest.mark.system
def test_weights_are_the_formula_of_the_paper(x64):
    rng = np.random.default_rng(0)
    c, a = rng.uniform(-20, 20, 100), rng.normal(0, 3, (5, 100))
    expected = np.exp(-((20 - c) ** 2) / (2 * 3.0**2)) * np.exp(-0.5 * ((a / DEVIATION[:, None]) ** 2).sum(axis=0))
    np.testing.assert_allclose(normalised(c, a), expected / expected.sum(), rtol=1e-9)
    assert normalised(c, a).sum() == pytest.approx(1, abs=1e-12)


def test_a_perfect_undeformed_face_weighs_most(x64):
    rng = np.random.default_rng(1)
    c, a = rng.uniform(-20, 20, 100), rng.normal(0, 3, (5, 100))
    c[17], a[:, 17] = 20, 0
    w = normalised(c, a)
    assert np.argmax(w) == 17
    assert w[17] > 1.5 * np.sort(w)[-2]


def test_a_deformation_of_one_deviation_costs_half_a_nat(x64):
    deformations = np.concatenate([np.zeros((5, 1)), np.diag(DEVIATION)], axis=1)
    w = normalised(np.full(6, 20.0), deformations)
    np.testing.assert_allclose(w[1:] / w[0], np.exp(-0.5), rtol=1e-12)


@pytest.mark.system
def test_modes_that_are_not_learnt_do_not_count(x64):
    deviation = jnp.array([2.0, 0.0])
    deformation = jnp.array([[1.0, 3.0], [0.0, 5.0]])
    weigh = lambda a, mu: log_weights(jnp.zeros(2), a, mu, num_scores=20)
    np.testing.assert_array_equal(weigh(deformation, deviation), weigh(deformation[:1], deviation[:1]))
    slope = jax.grad(lambda mu: jnp.sum(weigh(deformation, mu)))(deviation)
    assert np.all(np.isfinite(slope))
    np.testing.assert_array_equal(weigh(jnp.zeros((0, 2)), jnp.zeros(0)), weigh(deformation * 0, deviation))


@pytest.mark.parametrize("wrong", [{"sigma": 0.0}, {"sigma": -1.0}, {"num_scores": 0}])
def test_no_spread_and_no_scores_are_named(wrong):
    with pytest.raises(ValueError, match="num_scores and sigma must be positive"):
        log_weights(jnp.zeros(3), jnp.zeros((1, 3)), jnp.ones(1), **{"num_scores": 20, **wrong})
