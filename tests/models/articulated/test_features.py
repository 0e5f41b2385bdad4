"""Lines, outline, rows and their residuals: analytic forms, other notations, lines without length."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.articulated.features import (
    FEATURE_SETS,
    FULL,
    KEYPOINTS,
    PAPER_EXPERIMENT,
    FeatureSet,
    degenerate_links,
    directed_residual,
    line_parameters,
    palm_outline,
    undirected_residual,
    wrap,
)

pytestmark = pytest.mark.usefixtures("x64")


def test_feature_sets_have_the_rows_of_the_specification():
    assert (FULL.size(2), PAPER_EXPERIMENT.size(2), KEYPOINTS.size(5)) == (29, 21, 42)
    names = FULL.names(2)
    assert names[:6] == ("wrist_x", "wrist_y", "p_11_x", "p_11_y", "p_12_x", "p_12_y")
    assert names[14:26] == tuple(f"{kind}_{i}{j}" for kind in ("alpha", "rho") for i in (1, 2) for j in (1, 2, 3))
    assert names[26:] == ("palm_alpha", "palm_rho_min", "palm_rho_max")
    assert set(PAPER_EXPERIMENT.names(2)) < set(names)
    assert all(len(set(f.names(5))) == f.size(5) for f in FEATURE_SETS.values())


@pytest.mark.parametrize("blocks", [(), ("wrist", "elbow"), ("wrist", "wrist"), ("joints", "tips")])
def test_sets_without_meaning_are_refused(blocks):
    with pytest.raises(ValueError, match="blocks must"):
        FeatureSet(blocks)


def test_the_order_of_blocks_does_not_matter():
    assert FeatureSet(("palm", "wrist")) == FeatureSet(("wrist", "palm"))


@pytest.mark.parametrize("seed", range(5))
def test_line_and_its_derivatives_have_the_analytic_form(seed):
    p1, p2 = np.random.default_rng(seed).normal(size=(2, 2)) * 40
    delta = p2 - p1
    length, alpha = np.hypot(*delta), np.arctan2(delta[1], delta[0])
    e, n = delta / length, np.array([-delta[1], delta[0]]) / length
    line = line_parameters(jnp.asarray(p1), jnp.asarray(p2))
    np.testing.assert_allclose(line, (alpha, n @ p2, length), rtol=1e-12, atol=1e-12)
    assert float(line.rho) == pytest.approx((p2[0] * p1[1] - p1[0] * p2[1]) / length, rel=1e-12)
    slopes = jax.jacfwd(line_parameters, argnums=(0, 1))(jnp.asarray(p1), jnp.asarray(p2))
    share = -p1 @ e / length
    np.testing.assert_allclose(np.stack(slopes.alpha), [-n / length, n / length], atol=1e-12)
    np.testing.assert_allclose(np.stack(slopes.rho), [(1 - share) * n, share * n], atol=1e-12)


@pytest.mark.system
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_lines_without_length_have_finite_derivatives(dtype):
    p = jnp.array([3.0, -4.0], dtype)
    for differentiate in (jax.jacfwd, jax.jacrev):
        first = differentiate(line_parameters, argnums=(0, 1))
        second = jax.jacfwd(first, argnums=(0, 1))
        for leaf in jax.tree.leaves((line_parameters(p, p), first(p, p), second(p, p))):
            assert np.all(np.isfinite(leaf))
    assert float(line_parameters(p, p).length) == 0


def test_outline_is_the_outermost_of_the_edges():
    edges = jnp.asarray(np.random.default_rng(0).normal(size=(4, 2)) * 30)
    alpha, low, high = palm_outline(jnp.array([0.0, -2.0]), edges)
    # Lines straight up the image: n is +x.
    np.testing.assert_allclose([alpha, low, high], [-np.pi / 2, edges[:, 0].min(), edges[:, 0].max()], atol=1e-14)


def test_links_below_two_pixels_are_degenerate():
    points = jnp.array([[(0.0, 0.0), (1.9, 0.0), (1.9, 2.1), (1.9, 2.1)]])
    np.testing.assert_array_equal(degenerate_links(points), [[True, False, True]])
    np.testing.assert_array_equal(degenerate_links(points, 1.0), [[False, False, True]])


@pytest.mark.system
def test_wrap_keeps_the_angle_and_is_exact_inside():
    angles = np.random.default_rng(0).uniform(-20, 20, 1000)
    wrapped = np.asarray(wrap(jnp.asarray(angles)))
    assert np.all((wrapped > -np.pi) & (wrapped <= np.pi))
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-14)
    inside = np.abs(angles) < np.pi
    np.testing.assert_array_equal(wrapped[inside], angles[inside])
    np.testing.assert_array_equal(wrap(jnp.array([np.pi, -np.pi])), [np.pi, np.pi])
    assert float(jax.grad(wrap)(2.0)) == 1


def random_rows(seed, num_fingers=2):
    """Rows of a full set whose angles are anywhere and whose outline is in order."""
    rng = np.random.default_rng(seed)
    names = np.array(FULL.names(num_fingers))
    y = rng.normal(size=names.size) * 50
    is_alpha = np.char.find(names, "alpha") >= 0
    y[is_alpha] = rng.uniform(-np.pi, np.pi, is_alpha.sum())
    y[-2:] = np.sort(y[-2:])
    return y, names


def in_other_notation(y, names, links):
    """The rows with chosen lines, e.g. `11` or `palm`, written the other way round."""
    other = y.copy()
    for link in links:
        at = {name: np.flatnonzero(names == name)[0] for name in names if name.startswith(("alpha", "rho", "palm"))}
        if link == "palm":
            other[-3] += np.pi if y[-3] < 0 else -np.pi
            other[-2:] = -y[-1], -y[-2]
        else:
            other[at[f"alpha_{link}"]] += np.pi
            other[at[f"rho_{link}"]] *= -1
    return other


@pytest.mark.system
@pytest.mark.parametrize("seed", range(5))
def test_undirected_residual_does_not_depend_on_the_notation(seed):
    (y, names), (y_hat, _) = random_rows(seed), random_rows(100 + seed)
    expected = undirected_residual(jnp.asarray(y), jnp.asarray(y_hat), FULL, 2)
    other = in_other_notation(y, names, ["11", "23", "palm"])
    np.testing.assert_allclose(
        undirected_residual(jnp.asarray(other), jnp.asarray(y_hat), FULL, 2), expected, atol=1e-12
    )
    is_alpha = np.char.find(names, "alpha") >= 0
    assert np.all(np.abs(np.asarray(expected)[is_alpha]) <= np.pi / 2 + 1e-12)
    points = ~is_alpha & (np.char.find(names, "rho") < 0)
    np.testing.assert_allclose(np.asarray(expected)[points], (y - y_hat)[points], atol=1e-13)


@pytest.mark.parametrize("residual", [directed_residual, undirected_residual])
def test_no_jump_across_the_end_of_the_angles(residual):
    y, names = random_rows(0)
    is_alpha = np.char.find(names, "alpha") >= 0
    y_hat, observed = y.copy(), y.copy()
    y_hat[is_alpha], observed[is_alpha] = np.pi - 0.01, -np.pi + 0.02
    change = np.asarray(residual(jnp.asarray(observed), jnp.asarray(y_hat), FULL, 2))
    np.testing.assert_allclose(change, np.where(is_alpha, 0.03, 0), atol=1e-12)


def test_a_small_error_seen_the_other_way_round_is_small():
    y_hat, names = random_rows(3)
    observed = in_other_notation(y_hat, names, ["12", "palm"])
    change = undirected_residual(jnp.asarray(observed + 1e-3), jnp.asarray(y_hat), FULL, 2)
    np.testing.assert_allclose(np.abs(change), 1e-3, atol=1e-12)


def test_directed_lines_are_not_turned_round():
    y, names = random_rows(4)
    observed = in_other_notation(y, names, ["11"])
    change = np.asarray(directed_residual(jnp.asarray(observed), jnp.asarray(y), FULL, 2))
    assert abs(change[names == "alpha_11"].item()) == pytest.approx(np.pi)
    assert change[names == "rho_11"].item() == pytest.approx(-2 * y[names == "rho_11"].item())


@pytest.mark.system
@pytest.mark.parametrize("residual", [directed_residual, undirected_residual])
def test_residuals_are_exact_differences_in_sets_without_lines(residual):
    y, y_hat = (jnp.asarray(v) for v in np.random.default_rng(0).normal(size=(2, 42)) * 100)
    np.testing.assert_array_equal(residual(y, y_hat, KEYPOINTS, 5), y - y_hat)


@pytest.mark.system
def test_residual_moves_with_the_observation():
    (y, _), (y_hat, _) = random_rows(0), random_rows(100)
    slope = jax.jacfwd(lambda z: undirected_residual(jnp.asarray(y), z, FULL, 2))(jnp.asarray(y_hat))
    np.testing.assert_allclose(slope, -np.eye(29), atol=1e-14)


def test_noise_is_given_by_the_kind_of_row():
    std = FULL.std(2, 1.5, 0.1, 2.5)
    np.testing.assert_allclose(std, [1.5] * 14 + [0.1] * 6 + [2.5] * 6 + [0.1, 2.5, 2.5])
