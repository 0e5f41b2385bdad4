"""Every public builder rejects input that it cannot use: at trace time or before, naming the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
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


# Gaussian filters.
PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
Q, R = 0.1 * jnp.eye(2), jnp.eye(1)


def extended(transition=lambda x, u: x, Q=Q, observe=lambda x: x[:1], R=R, **options):
    return jf.extended_kalman(PRIOR, transition, Q, observe, R, **options)


GAUSSIAN = [
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
