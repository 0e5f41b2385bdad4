"""Bad input: Linear inequality constraints reject it at trace time or before, and name the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
Q, R = 0.1 * jnp.eye(2), jnp.eye(1)


def extended(transition=lambda x, u: x, Q=Q, observe=lambda x: x[:1], R=R, prior=PRIOR, **options):
    return jf.extended_kalman(prior, transition, Q, observe, R, **options)


ROWS = jf.constraints.linear_constraints(jnp.eye(2), -1.0, 2.0, ["left", "right"])
STILL = jnp.zeros((2, 2))


def rows_with(**fields):
    return replace(ROWS, **{name: jnp.asarray(value) for name, value in fields.items()})


def lasting(inner, rows=ROWS, flags=(False, True)):
    return jf.constrained(inner, jf.EPConstraints(rows, jnp.asarray(flags)))


def each_step(rows):
    return jf.constrained(extended(), jf.TruncateEachStep(rows, jf.constraints.cut.sequential_intervals))


EYE = jnp.eye(2)


def linear(F=EYE, Q=STILL, prior=PRIOR, **options):
    return jf.kalman(prior, F, Q, jnp.eye(1, 2), R, **options)


def walk_root():
    root = jf.GaussianRoot(jnp.zeros(2), jnp.eye(2))
    return linear(Q=jnp.diag(jnp.array([0.0, 0.3])), prior=root, arithmetic=jf.arithmetic.square_root)


def bootstrap():
    from jaxfilters import bootstrap

    draw, move = lambda key: jax.random.normal(key, (2,)), lambda key, x, u: x
    return bootstrap(draw, move, lambda x, y: -jnp.sum(x**2), num_particles=8)


TURN = jnp.array([[1.0, 0.0], [0.1, 1.0]])
linear_constraints, EP = jf.constraints.linear_constraints, jf.constraints.expectation_propagation.truncate
CUT = jf.constraints.cut
CONSTRAINTS = [
    Case("lasting, noise", lambda: lasting(extended()), ("lasting", "right", "process_noise", "0.316", "False")),
    Case("lasting, noise by root", lambda: lasting(walk_root()), ("lasting", "right", "process_noise", "0.3")),
    Case("lasting, transition", lambda: lasting(linear(F=TURN)), ("lasting", "right", "transition")),
    Case("lasting, drift", lambda: lasting(extended(lambda x, u: x + 1, STILL)), ("lasting", "right", "transition")),
    Case("lasting, one flag", lambda: lasting(linear(), flags=True), ("lasting", "(2,)", "()")),
    Case("lasting, three flags", lambda: lasting(linear(), flags=[True] * 3), ("lasting", "(2,)", "(3,)")),
    Case("lasting, numbers", lambda: lasting(linear(), flags=[0, 1]), ("lasting", "Booleans", "int32")),
    Case("constrained, particles", lambda: lasting(bootstrap()), ("inner", "Gaussian")),
    Case("constrained, no filter", lambda: lasting(PRIOR), ("inner", "Filter", "Gaussian")),
    Case("constrained, bare rows", lambda: jf.constrained(linear(), ROWS), ("constrain", "LinearConstraints")),
    Case("constrained, wide normals", lambda: each_step(rows_with(normals=jnp.ones((2, 3)))), ("(k, 2)", "(2, 3)")),
    Case("constrained, flat normals", lambda: each_step(rows_with(normals=jnp.ones(2))), ("normals", "(2, n)", "(2,)")),
    Case("constrained, short bound", lambda: each_step(rows_with(lower=[0.0])), ("lower", "(2,)", "(1,)")),
    Case("constrained, reversed", lambda: each_step(rows_with(upper=[3.0, -4.0])), ("lower, upper", "right", "-4")),
    Case("constrained, NaN", lambda: each_step(rows_with(lower=[jnp.nan, 0.0])), ("lower", "left", "nan")),
    Case("constrained, no rows", lambda: each_step([[1.0, 0.0]]), ("constraints", "LinearConstraints")),
    Case("rows, reversed", lambda: linear_constraints(jnp.eye(2), 1.0, 0.0), ("lower, upper", "row 0", "[1. 0.]")),
    Case("rows, NaN", lambda: linear_constraints(jnp.eye(2), 0.0, jnp.nan), ("upper", "row 0", "nan")),
    Case("rows, empty", lambda: linear_constraints(jnp.zeros((0, 2)), 0.0, 1.0), ("normals", "(k, n)", "(0, 2)")),
    Case("EP, wide normals", lambda: EP(PRIOR, rows_with(normals=jnp.ones((2, 3)))), ("(k, 2)", "(2, 3)")),
    Case("EP, array", lambda: EP(jnp.zeros(2), ROWS), ("belief",)),
    Case("EP, damping", lambda: EP(PRIOR, ROWS, damping=0.0), ("damping", "(0, 1]", "0.0")),
    Case("EP, sweeps", lambda: EP(PRIOR, ROWS, max_sweeps=0), ("max_sweeps", "1", "0")),
    Case("interval, normal", lambda: CUT.interval(PRIOR, jnp.ones(3), 0.0, 1.0), ("normal", "(2,)", "(3,)")),
    Case("interval, reversed", lambda: CUT.interval(PRIOR, jnp.ones(2), 1.0, 0.0), ("lower <= upper", "1.0", "0.0")),
    Case("half-space, normal", lambda: CUT.halfspace(PRIOR, jnp.ones(1), 0.0), ("normal", "(2,)", "(1,)")),
]


@pytest.mark.parametrize("case", CONSTRAINTS, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)
