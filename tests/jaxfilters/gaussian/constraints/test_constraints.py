import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.constraints import LinearConstraints, check_feasible, feasible, linear_constraints


def test_constraints_are_a_pytree_with_static_names(x64):
    constraints = linear_constraints([[1, 0], [0, 2]], -1, [2, np.inf], names=["x", "y"])
    assert constraints.names == ("x", "y")
    assert len(jax.tree.leaves(constraints)) == 3
    np.testing.assert_array_equal(constraints.lower, [-1, -1])
    doubled = jax.tree.map(lambda leaf: 2 * leaf, constraints)
    assert isinstance(doubled, LinearConstraints)
    np.testing.assert_array_equal(doubled.normals, [[2, 0], [0, 4]])


@pytest.mark.parametrize(
    ("normals", "lower", "upper", "names", "message"),
    [
        ([1.0, 2.0], 0, 1, None, r"normals: expected \(k, n\).*\(2,\)"),
        (np.zeros((0, 2)), 0, 1, None, r"normals: expected \(k, n\).*\(0, 2\)"),
        ([[1.0, 2.0]], [0, 1], 1, None, r"lower: expected a number or \(1,\).*\(2,\)"),
        ([[1.0, 2.0]], 0, [[1]], None, r"upper: expected a number or \(1,\).*\(1, 1\)"),
        ([[1.0], [2.0]], 0, 1, ["knee"], "names: expected 2.*got 1"),
        ([[1.0], [np.nan]], 0, 1, None, "normals: row 1: expected finite numbers; got"),
        ([[1.0], [0.0]], 0, 1, ["knee", "hip"], "normals: hip: expected a direction; got zeros"),
        ([[1.0], [1.0]], [0, 2], [1, 1], ["knee", "hip"], r"lower, upper: hip: expected lower <= upper; got \[2. 1.\]"),
        ([[1.0]], np.nan, 1, None, "lower: row 0: expected a number or -inf; got nan"),
        ([[1.0]], np.inf, np.inf, None, "lower: row 0: expected a number or -inf; got inf"),
        ([[1.0]], -np.inf, -np.inf, None, "upper: row 0: expected a number or inf; got -inf"),
    ],
)
def test_bad_constraints_are_refused_by_argument_and_row(normals, lower, upper, names, message):
    with pytest.raises(ValueError, match=message):
        linear_constraints(normals, lower, upper, names)


def test_feasible_sets_pass():
    box = linear_constraints(np.eye(3), [0, -np.inf, 1], [1, 2, 1])
    assert feasible(box)
    assert check_feasible(box) is None
    unbounded = linear_constraints([[1.0, 1.0]], -np.inf, np.inf)
    assert feasible(unbounded)
    touching = linear_constraints([[1.0], [3.0]], [-np.inf, 3.0], [1.0, np.inf])
    assert feasible(touching)


def test_rows_that_contradict_each_other_are_named_and_no_others():
    # a >= b + 1, b >= c + 1, c >= a: only all three together are impossible.
    normals = [[1, -1, 0], [1, 0, 0], [0, 1, -1], [0, 1, 0], [-1, 0, 1]]
    names = ["a above b", "a bounded", "b above c", "b bounded", "c above a"]
    circle = linear_constraints(normals, [1, -9, 1, -9, 0], [np.inf, 9, np.inf, 9, np.inf], names)
    assert not feasible(circle)
    with pytest.raises(ValueError, match="contradict each other: ") as error:
        check_feasible(circle)
    message = str(error.value)
    assert all(name in message for name in ("a above b", "b above c", "c above a"))
    assert "bounded" not in message
    assert "[1, inf]" in message


def test_the_lengths_of_normals_do_not_matter():
    for scale in (1e-6, 1.0, 1e6):
        normals = jnp.array([[1.0], [scale]])
        apart = linear_constraints(normals, [-np.inf, 1.001 * scale], [1.0, np.inf])
        assert not feasible(apart)
