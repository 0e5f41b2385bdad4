"""Every public builder rejects input that it cannot use: at trace time or before, naming the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


# Gaussian filters.
PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
Q, R = 0.1 * jnp.eye(2), jnp.eye(1)


def extended(transition=lambda x, u: x, Q=Q, observe=lambda x: x[:1], R=R, **options):
    return jf.extended_kalman(PRIOR, transition, Q, observe, R, **options)


def linear(**changed):
    given = {"F": np.eye(2), "Q": np.eye(2), "H": np.ones((1, 2)), "R": np.eye(1)}
    return jf.kalman(PRIOR, **{**given, **changed})


LINEAR = [
    Case("kalman, narrow F", lambda: linear(F=np.ones((2, 1))), ("F", "(2, 2)", "(2, 1)")),
    Case("kalman, wide H", lambda: linear(H=np.ones((1, 3))), ("H", "(1, 2)", "(1, 3)")),
    Case("kalman, flat H", lambda: linear(H=np.ones(2)), ("H", "(2,)")),
    Case("kalman, other Q", lambda: linear(Q=np.eye(3)), ("Q", "(2, 2)", "(3, 3)")),
    Case("kalman, other R", lambda: linear(R=np.eye(2)), ("R", "(1, 1)", "(2, 2)")),
    Case("kalman, negative R", lambda: linear(R=-np.eye(1)), ("R", "semidefinite", "-1")),
    Case("kalman, asymmetric Q", lambda: linear(Q=np.array([[1.0, 0.5], [0.0, 1.0]])), ("Q", "symmetric")),
    Case("kalman, NaN in Q", lambda: linear(Q=np.full((2, 2), np.nan)), ("Q", "finite")),
    Case("kalman, long b", lambda: linear(b=np.zeros(3)), ("b", "(2,)", "(3,)")),
    Case("kalman, long d", lambda: linear(d=np.zeros(3)), ("d", "(1,)", "(3,)")),
    Case("kalman, arithmetic", lambda: linear(arithmetic=jf.arithmetic.square_root), ("prior", "GaussianRoot")),
    Case("kalman, wide y", lambda: jf.run(linear(), KEY, jnp.zeros((5, 3))), ("observation", "(3,)", "(1,)")),
    Case("kalman, a control", lambda: jf.run(linear(), KEY, jnp.zeros((5, 1)), jnp.zeros(5)), ("control", "None")),
]

GAUSSIAN = [
    *LINEAR,
    Case("extended, wide y", lambda: jf.run(extended(), KEY, jnp.zeros((5, 3))), ("observation", "(3,)", "(1,)")),
]

# Linear inequalities.
CONSTRAINTS: list[Case] = []

# Particle and ensemble filters.
PARTICLE: list[Case] = []

# Hidden Markov models.
HMM: list[Case] = []

# Fitting.
FIT: list[Case] = []

# Optimisation and mathematics.
MATH: list[Case] = []

CASES = [*GAUSSIAN, *CONSTRAINTS, *PARTICLE, *HMM, *FIT, *MATH]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case):
    with pytest.raises((ValueError, TypeError)) as caught:
        case.call()
    missing = [word for word in case.words if word not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"
