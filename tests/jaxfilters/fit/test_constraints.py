import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters import fit
from jaxfilters.fit.parametrization import check_start, parametrize

RNG = np.random.default_rng(3)
ROOT = RNG.normal(size=(3, 3))
SHARES = RNG.dirichlet(np.ones(4), size=2)
TURN = Rotation.from_rotvec([0.4, -2.0, 1.0]).as_quat(scalar_first=True)
CASES = {
    "free": (fit.free, RNG.normal(size=(2, 3)), 6),
    "positive": (fit.positive, RNG.uniform(0.01, 50, size=5), 5),
    "interval": (fit.interval(-2, 3), np.array([-1.99, 0.3, 2.999]), 3),
    "simplex": (fit.simplex, SHARES, 6),
    "spd": (fit.spd, ROOT @ ROOT.T, 6),
    "rotation": (fit.rotation, TURN, 3),
    "fixed": (fit.fixed, np.array([3, 4]), 0),
}
OUTSIDE = {
    "free": np.array([1.0, np.nan]),
    "positive": np.array(0.0),
    "interval": np.array(3.0),
    "simplex": np.array([0.5, 0.6]),
    "spd": np.array([[1.0, 2.0], [2.0, 1.0]]),
    "rotation": np.array([1.0, 1.0, 0.0, 0.0]),
}


@pytest.mark.system
@pytest.mark.parametrize("name", CASES)
def test_charts_lead_there_and_back_and_every_coordinate_is_allowed(x64, name):
    constraint, value, count = CASES[name]
    chart = parametrize({"p": value}, constraint)
    z = chart.unconstrain(chart.origin)
    assert z.shape == (count,)
    np.testing.assert_allclose(chart.constrain(z)["p"], value, rtol=1e-10, atol=1e-12)
    elsewhere = jnp.asarray(3 * RNG.normal(size=count))
    assert constraint.contains(np.asarray(chart.constrain(elsewhere)["p"]))
    found = chart.unconstrain(chart.constrain(elsewhere))
    if name == "rotation":
        turns = Rotation.from_rotvec(np.array(found)), Rotation.from_rotvec(np.array(elsewhere))
        assert (turns[0].inv() * turns[1]).magnitude() < 1e-10
    else:
        np.testing.assert_allclose(found, elsewhere, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_start_outside_is_named_with_its_value(name):
    constraint, _, _ = CASES[name]
    with pytest.raises(ValueError, match=r"start\['a'\]\[1\] must be .*; got"):
        check_start(parametrize({"a": [1.0, OUTSIDE[name]]}, {"a": [fit.free, constraint]}))


def test_a_branch_may_have_one_constraint_and_coordinates_have_names():
    start = {"noise": {"x": np.ones(2), "y": 3.0}, "rate": 0.5}
    chart = parametrize(start, {"noise": fit.positive, "rate": fit.interval(0, 1)})
    assert chart.names == ["['noise']['x']", "['noise']['x']", "['noise']['y']", "['rate']"]
    np.testing.assert_allclose(chart.unconstrain(chart.origin), [0, 0, np.log(3), 0], atol=1e-6)
    assert jax.tree.structure(chart.constrain(jnp.zeros(4))) == jax.tree.structure(start)


def test_constraints_that_do_not_fit_are_rejected():
    with pytest.raises(ValueError, match="constraints must have the tree structure of start"):
        parametrize({"a": 1.0}, {"b": fit.free})
    with pytest.raises(ValueError, match=r"constraints must hold constraints such as fit\.positive; got 3"):
        parametrize({"a": 1.0}, {"a": 3})
    with pytest.raises(ValueError, match="finite bounds"):
        fit.interval(1, 1)


VOLUMES = {
    "positive": (fit.positive, jnp.array([0.5, 3.0]), lambda v: np.log(v).sum()),
    "interval": (fit.interval(-1.0, 2.0), jnp.array([0.4]), lambda v: np.log((v + 1) * (2 - v) / 3).sum()),
    "simplex": (fit.simplex, jnp.array([0.2, 0.5, 0.3]), lambda v: np.log(v).sum()),
    "spd": (
        fit.spd,
        jnp.array([[2.0, 0.3], [0.3, 0.5]]),
        # Of the lower triangle with respect to the factor L, 2^n prod L_ii^(n - i + 1), and of L_ii to its logarithm.
        lambda v: np.log(np.diag(np.linalg.cholesky(v))) @ [3.0, 2.0],
    ),
    "rotation": (fit.rotation, None, lambda angle: np.log((2 - 2 * np.cos(angle)) / angle**2)),
}
"""Log volumes in closed form, up to a constant: the densities that change variables in textbooks."""


@pytest.mark.parametrize("name", VOLUMES)
def test_the_log_volume_of_coordinates_is_that_of_textbooks(name):
    constraint, value, expected = VOLUMES[name]
    if name == "rotation":
        chart = parametrize(jnp.array([1.0, 0.0, 0.0, 0.0]), constraint)
        coordinates, arguments = [jnp.array([0.0, 0.4, 0.3]), jnp.array([1.0, 2.0, 0.5])], [0.5, np.sqrt(5.25)]
        assert chart.log_volume(jnp.array([0.0, 4.0, 0.0])) == -jnp.inf
    else:
        chart, arguments = parametrize(value, constraint), [np.asarray(value, float)]
        z = chart.unconstrain(value)
        coordinates = [z, z + 0.3 * jnp.arange(1.0, z.size + 1)]
        arguments.append(np.asarray(chart.constrain(coordinates[1]), float))
    difference = chart.log_volume(coordinates[1]) - chart.log_volume(coordinates[0])
    np.testing.assert_allclose(difference, expected(arguments[1]) - expected(arguments[0]), atol=1e-4)
