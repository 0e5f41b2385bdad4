import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.hand.cost import count_observed, gate, gibbs_abs, gibbs_sq, rendered_cost, union_cost
from jaxfilters.models.hand.skeleton import forward_kinematics, hand_geometry, open_palm
from jaxfilters.models.rendering.comparison import DepthTerms, compare_capsules
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.models.synthetic.hand import kinect_v2

MAX_ERROR = 0.1
# Sums of some thousands of float32 terms below 0.1.
ROUNDING = 1e-6


def terms_of(rendered, observed):
    """The sums, pixel by pixel in numpy."""
    rendered, observed = np.asarray(rendered, float), np.asarray(observed, float)
    use = np.isfinite(rendered) & ~np.isnan(observed)
    errors = [min(abs(d - y), MAX_ERROR) for d, y in zip(rendered[use], observed[use], strict=True)]
    overlap = use & np.isfinite(observed)
    return DepthTerms(*(jnp.asarray(float(n)) for n in (sum(errors), use.sum(), overlap.sum())))


def union_cost_by_sets(rendered, observed):
    """Section 5.1 with explicit sets of pixels."""
    rendered, observed = np.asarray(rendered, float), np.asarray(observed, float)
    M = {tuple(p) for p in np.argwhere(np.isfinite(rendered) & ~np.isnan(observed))}
    O = {tuple(p) for p in np.argwhere(np.isfinite(observed))}
    if not M | O:
        return MAX_ERROR
    both = sum(min(abs(rendered[p] - observed[p]), MAX_ERROR) for p in M & O)
    return (both + MAX_ERROR * len(M ^ O)) / len(M | O)


def costs(rendered, observed):
    terms, observed = terms_of(rendered, observed), jnp.asarray(observed)
    return float(rendered_cost(terms, MAX_ERROR)), float(union_cost(terms, count_observed(observed), MAX_ERROR))


def rectangle(rows, cols, depth, shape=(20, 24)):
    image = np.full(shape, np.inf)
    image[rows, cols] = depth
    return image


SQUARE = rectangle(slice(5, 11), slice(6, 12), 0.7)


def test_identical_images_cost_nothing():
    assert costs(SQUARE, SQUARE) == (0, 0)


def test_disjoint_images_cost_the_maximum():
    assert costs(SQUARE, rectangle(slice(12, 18), slice(14, 20), 0.7)) == pytest.approx((MAX_ERROR, MAX_ERROR))


@pytest.mark.parametrize("observed", [SQUARE, np.full((20, 24), np.inf), np.full((20, 24), np.nan)])
def test_an_empty_rendering_costs_the_maximum(observed):
    assert costs(np.full((20, 24), np.inf), observed) == pytest.approx((MAX_ERROR, MAX_ERROR))


def test_pixels_without_a_reading_are_dropped_from_sum_and_count():
    observed = SQUARE + 0.01
    observed[5:8] = np.nan
    assert costs(SQUARE, observed) == pytest.approx((0.01, 0.01))


def test_observed_background_under_the_rendering_counts_as_a_mismatch():
    half = rectangle(slice(5, 11), slice(6, 9), 0.7)
    assert costs(SQUARE, half) == pytest.approx((MAX_ERROR / 2, MAX_ERROR / 2))


def test_only_the_union_cost_sees_observed_pixels_that_are_not_covered():
    half = rectangle(slice(5, 11), slice(6, 9), 0.7)
    assert costs(half, SQUARE) == pytest.approx((0, MAX_ERROR / 2))


@pytest.mark.parametrize("seed", range(5))
def test_union_cost_is_that_of_the_sets(seed):
    rng = np.random.default_rng(seed)
    rendered = rng.choice([np.inf, 0.7, 0.75, 0.9], (9, 11))
    observed = rng.choice([np.inf, np.nan, 0.71, 0.8], (9, 11))
    by_rendering, by_union = costs(rendered, observed)
    assert by_union == pytest.approx(union_cost_by_sets(rendered, observed), abs=ROUNDING)
    assert by_union >= by_rendering


def test_rendered_cost_ignores_everything_outside_the_rendering():
    rng = np.random.default_rng(1)
    observed = SQUARE + 0.02
    changed = np.where(np.isfinite(SQUARE), observed, rng.choice([np.inf, np.nan, 0.5], SQUARE.shape))
    assert costs(SQUARE, changed)[0] == costs(SQUARE, observed)[0]


@pytest.mark.parametrize("count", [0.0, 5.0])
def test_gradient_of_the_costs_is_finite(count):
    def cost(absolute_sum):
        terms = DepthTerms(absolute_sum, jnp.asarray(count), jnp.asarray(count))
        return rendered_cost(terms, MAX_ERROR) + union_cost(terms, jnp.asarray(int(count)), MAX_ERROR)

    assert np.isfinite(jax.grad(cost)(jnp.asarray(0.3)))


def test_likelihood_forms():
    # Specification 2.7: 15 mm at sigma = 20 mm weigh 0.76 in the squared form and 0.47 in the absolute one.
    assert np.exp(gibbs_sq(jnp.array(0.015), 0.02)) == pytest.approx(0.76, abs=0.006)
    assert np.exp(gibbs_abs(jnp.array(0.015), 0.02)) == pytest.approx(0.47, abs=0.006)
    assert gibbs_sq(jnp.array(0.03), 0.02) == pytest.approx(-1.125)
    assert gibbs_abs(jnp.array(0.03), 0.02) == pytest.approx(-1.5)


def test_gate_keeps_the_hand_and_knows_what_lies_behind_and_before_it():
    observed = jnp.array([[0.0, 0.4, 0.55, 0.7], [0.85, 0.9, jnp.inf, jnp.nan]])
    expected = [[np.nan, np.nan, 0.55, 0.7], [0.85, np.inf, np.inf, np.nan]]
    np.testing.assert_allclose(gate(observed, 0.55, 0.85), expected)
    assert count_observed(gate(observed, 0.55, 0.85)) == 3


def moved(**changes):
    pose = open_palm(jnp.array([0.0, 0.09, 0.7]))
    for name, value in changes.items():
        pose = pose.at[int(name[1:])].add(value)
    return pose


@jax.jit
def rendered(pose):
    """The part of the image that the specification's table was made from."""
    camera = kinect_v2().crop(jnp.array([192.0, 148.0]), (64, 64), 2)
    return render_capsules(camera, forward_kinematics(pose, hand_geometry()).capsules)


FOLDED = {f"p{first + i}": np.deg2rad(angle) for first in (10, 13, 16, 19) for i, angle in ((0, 80), (2, 90))}
PRINTED_MM = {
    "wrist x +5 mm": (dict(p0=0.005), 15.0, 25.0),
    "wrist z +5 mm": (dict(p2=0.005), 5.3, 8.3),
    "index MCP flexion +10 deg": (dict(p10=np.deg2rad(10)), 1.5, 1.5),
    "index PIP +10 deg": (dict(p12=np.deg2rad(10)), 0.8, 0.8),
    "little PIP +20 deg": (dict(p21=np.deg2rad(20)), 0.8, 1.1),
    "all four fingers folded (MCP 80, PIP 90 deg)": (FOLDED, 14.7, 43.5),
}


@pytest.mark.system
@pytest.mark.parametrize("error", PRINTED_MM)
def test_costs_of_small_errors_are_those_the_specification_prints(error):
    # The printed digits belong to one grid: every second pixel of the 128 x 128 window at (192, 148). Silhouette pixels
    # make the costs depend on the grid: at full resolution they differ by up to 1.1 mm (wrist x, union).
    changes, rendered_mm, union_mm = PRINTED_MM[error]
    # Half of the last printed digit.
    assert 1000 * np.array(costs(rendered(moved(**changes)), rendered(moved()))) == pytest.approx(
        [rendered_mm, union_mm], abs=0.05
    )


@jax.jit
@jax.grad
def slope_of_log_likelihood(pose_and_scale, camera, observed):
    pose, scale = pose_and_scale
    capsules = forward_kinematics(pose, hand_geometry().scaled(scale)).capsules
    terms = compare_capsules(camera, capsules, observed, MAX_ERROR)
    costs = rendered_cost(terms, MAX_ERROR) + union_cost(terms, count_observed(observed), MAX_ERROR)
    return gibbs_sq(costs, 0.02) + gibbs_abs(costs, 0.02)


@pytest.mark.system
def test_gradient_of_rendering_and_cost_is_finite(random_pose):
    rng = np.random.default_rng(0)
    camera = kinect_v2().crop(jnp.array([192.0, 148.0]), (64, 64), 2)
    observed = jnp.where(jnp.asarray(rng.random(camera.shape) < 0.05), jnp.nan, rendered(moved()))
    anywhere = [jnp.asarray(random_pose(rng), dtype=jnp.float32) for _ in range(20)]
    for pose in (*anywhere, moved(), moved(p0=0.003, p10=0.2), moved(p2=5.0), moved(p0=1.0)):
        slope = slope_of_log_likelihood((pose, jnp.asarray(1.0)), camera, observed)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))
