"""Likelihood of foreground given people: against the probabilities it is derived from, and numpy's least squares."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person import foreground
from jaxfilters.models.person.foreground import (
    LEAST,
    MOST,
    contrast,
    lattice,
    log_likelihood_ratio,
    lowered,
    presence,
    quadratic_fit,
    window,
)
from jaxfilters.models.synthetic.walkers import LEG_SWING, Walker, body

SHAPE = (120, 160)


def camera_1():
    pitch = np.deg2rad(37)
    R = np.array([[1, 0, 0], [0, -np.sin(pitch), -np.cos(pitch)], [0, np.cos(pitch), -np.sin(pitch)]])
    K = np.array([[139.0, 0, 79.5], [0, 139, 59.5], [0, 0, 1]])
    return FloorCamera.from_matrix(K @ np.column_stack([R, -R @ [-1, -1.74, 2.64]]), SHAPE)


@pytest.mark.usefixtures("x64")
def test_the_ratio_is_that_of_the_probabilities_of_what_was_observed():
    """A pixel observed as foreground with probability p (even prior) has likelihood p f + (1 - p) (1 - f)."""
    rng = np.random.default_rng(0)
    p, T, q = rng.random(300), rng.uniform(0.01, 1, 300), rng.random(300)
    observed = np.clip(p, LEAST, MOST)
    with_nobody, with_somebody = 1 - T, 1 - T * (1 - q)
    ratio = [observed * f + (1 - observed) * (1 - f) for f in (with_somebody, with_nobody)]
    expected = np.log(ratio[0] / ratio[1]).sum()
    found = log_likelihood_ratio(jnp.asarray(q), contrast(jnp.asarray(p), jnp.asarray(T)))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_contrast_speaks_for_somebody_where_foreground_is_unexplained():
    values = np.asarray(contrast(jnp.array([1.0, 1.0, 0.5, 0.0]), jnp.array([0.98, 0.0, 0.98, 0.98])))
    assert values[0] < -5
    np.testing.assert_allclose(values[1:3], 0, atol=1e-6)
    assert 0 < values[3] < 1


def test_a_large_window_of_clear_evidence_stays_finite():
    b = contrast(jnp.ones(4096), jnp.full(4096, 0.98))
    value = log_likelihood_ratio(jnp.full(4096, 0.98), b)
    np.testing.assert_allclose(value, 4096 * np.log(1 - 0.98 * float(b[0])), rtol=1e-4)


@pytest.mark.system
def test_somebody_who_is_not_there_changes_nothing():
    b = contrast(jnp.linspace(0, 1, 50), jnp.full(50, 0.9))
    assert log_likelihood_ratio(jnp.zeros(50), b) == 0


def test_presence_is_that_of_a_person_at_a_place():
    """High in the middle of the body, none far away, and mirrored where the scene is: camera 1 looks along x = -1."""
    camera = camera_1()
    body, _ = camera.project(jnp.array([[-1.0, 1.0, 0.9], [-1, 1, 1.2], [-1.4, 1, 1.2], [-0.6, 1, 1.2], [-1, 1, 2.2]]))
    q = np.asarray(jax.jit(presence)(camera.P, jnp.array([-1.0, 1.0]), 1.7, 0.45, body))
    assert np.all((q >= 0) & (q <= 1))
    assert q[:2].min() > 0.6
    assert q[2:].max() < 0.1
    np.testing.assert_allclose(q[2], q[3], rtol=1e-3)


def test_feet_of_a_stride_are_where_they_stand_and_not_between():
    """Both soles, the middle between them, and the hips, which sink as legs of 0.9 m do; camera 1 looks along Y."""
    camera, stride = camera_1(), jnp.array([0.36, 0.0])
    points = jnp.array([[-0.69, 1.0, 0.12], [-1.31, 1, 0.12], [-1, 1, 0.12], [-1, 1, 0.85]])
    xy, (uv, _) = jnp.array([-1.0, 1.0]), camera.project(points)
    at = jax.jit(lambda stride: presence(camera.P, xy, 1.7, 0.45, uv, stride=stride))
    apart, together = np.asarray(at(stride)), np.asarray(at(jnp.zeros(2)))
    assert apart[[0, 1, 3]].min() > 0.5 > 0.2 > apart[2]
    assert together[:2].max() < 0.1 < 0.5 < together[2]


def test_walkers_sink_as_much_as_their_strides_say():
    """The middle of the head at every moment of a stride, whose foot is 0.9 m below the hip of a body of 1.66 m."""
    phases = jnp.linspace(0, 2 * jnp.pi, 16)

    def head(phase):
        still = jnp.zeros(())
        return body(Walker(jnp.zeros(2), still, phase, jnp.ones(()), jnp.array(1.66), jnp.array(0.42))).center[0, 2]

    strides = 0.9 * jnp.sin(LEG_SWING * jnp.sin(phases))[:, None] * jnp.array([0.6, 0.8])
    sunk = 1.54 - np.asarray(jax.jit(jax.vmap(head))(phases))
    found = jax.jit(jax.vmap(lambda stride: lowered(jnp.array(1.66), stride)))(strides)
    np.testing.assert_allclose(1.66 - np.asarray(found), sunk, atol=0.005)


@pytest.mark.system
def test_the_truth_is_likelier_than_its_neighbours():
    camera, xy = camera_1(), jnp.array([-0.6, 1.2])
    grid = jnp.stack(jnp.meshgrid(jnp.arange(160.0), jnp.arange(120.0)), axis=-1).reshape(-1, 2)
    at = jax.jit(lambda place, height: presence(camera.P, place, height, 0.45, grid))
    b = contrast(at(xy, 1.7), jnp.full(len(grid), 0.98))
    best = log_likelihood_ratio(at(xy, 1.7), b)
    for step in ((0.15, 0), (-0.15, 0), (0, 0.25), (0, -0.25)):
        assert log_likelihood_ratio(at(xy + jnp.array(step), 1.7), b) < best


@pytest.mark.system
def test_a_window_is_an_even_grid_of_pixels():
    observed = window(jnp.array([-4.0, 10.0, 12.0, 50.0]), (40, 60), (10, 8))
    uv, index, inside = (np.asarray(leaf) for leaf in observed[:3])
    np.testing.assert_array_equal(uv, np.round(uv))
    np.testing.assert_allclose(np.unique(uv[:, 0]), np.arange(-3, 12, 2))
    np.testing.assert_allclose(np.unique(uv[:, 1]), np.arange(12, 50, 4))
    np.testing.assert_array_equal(inside, (uv[:, 0] >= 0) & (uv[:, 1] < 40))
    within = inside > 0
    np.testing.assert_array_equal(index[within], (uv[:, 1] * 60 + uv[:, 0])[within])
    assert np.all((index >= 0) & (index < 40 * 60))
    np.testing.assert_allclose(observed.area, 16 * 40 / 80)


@pytest.mark.parametrize(("dimensions", "reach"), [(1, 2), (2, 1), (3, 1), (2, 2)])
def test_lattice_points_are_all_combinations_with_the_unmoved_one_in_the_middle(dimensions, reach):
    expected = list(itertools.product(range(-reach, reach + 1), repeat=dimensions))
    found = np.asarray(lattice(dimensions, reach))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(found[len(found) // 2], np.zeros(dimensions))


@pytest.mark.system
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_value_and_curvature_of_quadratic_fit_are_numpys_least_squares(n):
    rng = np.random.default_rng(n)
    values, steps = rng.normal(size=3**n), rng.uniform(0.05, 0.3, n)
    x = np.asarray(lattice(n)) * steps
    pairs = [(i, j) for i in range(n) for j in range(i, n)]
    columns = [np.ones(3**n), *x.T, *(x[:, i] * x[:, j] for i, j in pairs)]
    solution = np.linalg.lstsq(np.column_stack(columns), values, rcond=None)[0]
    curvature = np.zeros((n, n))
    for (i, j), coefficient in zip(pairs, solution[1 + n :], strict=True):
        curvature[i, j] = curvature[j, i] = -coefficient * (2 if i == j else 1)
    fit = quadratic_fit(jnp.asarray(values), jnp.asarray(steps))
    np.testing.assert_allclose(fit.value, solution[0], rtol=1e-9)
    np.testing.assert_allclose(fit.curvature, curvature, rtol=1e-8)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("n", [1, 2, 3])
def test_slope_of_quadratic_fit_is_the_mean_of_the_gradient_over_a_gaussian(n):
    """Of random polynomials up to the fourth power of each coordinate, by NumPy's rule with seven nodes."""
    rng = np.random.default_rng(n)
    coefficients, steps = rng.normal(size=[5] * n), rng.uniform(0.5, 1.5, n)

    def at(points, coefficients):
        values = np.broadcast_to(coefficients[..., None], (*coefficients.shape, len(points)))
        for column in points.T:
            values = sum(power * column**k for k, power in enumerate(values))
        return values

    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    points = np.array(list(itertools.product(nodes, repeat=n))) * steps / np.sqrt(3)
    mass = np.prod(np.array(list(itertools.product(weights / weights.sum(), repeat=n))), axis=1)
    expected = [mass @ at(points, np.polynomial.polynomial.polyder(coefficients, axis=i)) for i in range(n)]
    fit = quadratic_fit(jnp.asarray(at(np.asarray(lattice(n)) * steps, coefficients)), jnp.asarray(steps))
    np.testing.assert_allclose(fit.gradient, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("x64")
def test_the_reading_of_a_skew_score_is_half_as_far_towards_its_tail_as_that_of_least_squares():
    """Depth and width as in silhouettes: narrow bodies are found as well farther away, wide ones not as well nearer."""
    steps = np.array([0.09, 0.04])
    depth, width = (np.asarray(lattice(2)) * steps).T
    scores = 1000 * depth * width**2 - 30 * depth**2 - 300 * width**2
    fit = quadratic_fit(jnp.asarray(scores), jnp.asarray(steps))
    columns = np.column_stack([np.ones(9), depth, width, depth**2, depth * width, width**2])
    _, slope, _, bend, _, _ = np.linalg.lstsq(columns, scores, rcond=None)[0]
    np.testing.assert_allclose(np.linalg.solve(fit.curvature, fit.gradient), [-slope / bend / 4, 0], atol=1e-9)


def test_values_off_the_lattice_are_named():
    with pytest.raises(ValueError, match=r"values must be those on lattice\(2\), 9 of them; got 8"):
        quadratic_fit(jnp.zeros(8), jnp.ones(2))


def test_bounds_leave_room_for_mistakes():
    assert 0 < foreground.CLUTTER < LEAST < 0.5 < MOST < 1
