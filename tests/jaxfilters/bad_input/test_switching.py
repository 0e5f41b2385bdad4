"""Bad input: filters of systems that switch between modes reject it at once, and name the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


KEY = jax.random.key(0)
CHAIN, EVEN = np.array([[0.9, 0.1], [0.3, 0.7]]), np.full(2, 0.5)


def linear(size=2, **options):
    prior = options.pop("prior", jf.Gaussian(jnp.zeros(size), jnp.eye(size)))
    return jf.kalman(prior, jnp.eye(size), jnp.eye(size), jnp.eye(1, size), jnp.eye(1), **options)


def rooted():
    root = jf.GaussianRoot(jnp.zeros(2), jnp.eye(2))
    return linear(prior=root, arithmetic=jf.arithmetic.square_root)


def turning():
    space = jf.manifold.product(jf.manifold.rotation)
    prior = jf.Gaussian(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.eye(3))
    return jf.extended_kalman(prior, lambda x: x, jnp.eye(3), lambda x: x[:1], jnp.eye(1), manifold=space)


TWO = (linear(), linear())


def imm(filters=TWO, chain=CHAIN, initial=EVEN, **options):
    return jf.imm(list(filters), chain, initial, **options)


def switching(filters=TWO, chain=CHAIN, initial=EVEN, **options):
    return jf.switching(list(filters), chain, initial, **{"num_particles": 4} | options)


OTHER_SIZES = (linear(), linear(3))
FILL = jf.Gaussian(jnp.zeros(3), jnp.eye(3))
same = lambda belief: belief
shorter = lambda belief: jf.Gaussian(belief.mean[:1], belief.covariance[:1, :1])


def of_each(name, build):
    """Cases that both builders reject."""
    return [
        Case(f"{name}, no filters", lambda: build(()), ("filters", "empty")),
        Case(f"{name}, another kind", lambda: build((linear(), FILL)), ("filters[1]", "Filter", "Gaussian")),
        Case(f"{name}, kinds", lambda: build((linear(), rooted())), ("filters", "Gaussian, GaussianRoot")),
        Case(f"{name}, spaces", lambda: build((linear(4), turning())), ("filters", "manifold")),
        Case(f"{name}, sizes", lambda: build(OTHER_SIZES), ("filters", "one size", "2, 3")),
        Case(f"{name}, columns", lambda: build(chain=CHAIN.T), ("transition_matrix", "rows (axis 1)", "transpose")),
        Case(f"{name}, sum", lambda: build(chain=CHAIN * 0.9), ("transition_matrix", "rows", "row 0", "0.9")),
        Case(f"{name}, negative", lambda: build(chain=[[1.5, -0.5], [0.0, 1.0]]), ("transition_matrix", "-0.5")),
        Case(f"{name}, NaN", lambda: build(chain=CHAIN * np.nan), ("transition_matrix", "finite", "nan")),
        Case(f"{name}, three modes", lambda: build(chain=np.eye(3)), ("transition_matrix", "(2, 2)", "(3, 3)")),
        Case(f"{name}, initial sum", lambda: build(initial=[0.5, 0.4]), ("initial_probabilities", "one", "0.9")),
        Case(f"{name}, initial sign", lambda: build(initial=[1.5, -0.5]), ("initial_probabilities", "-0.5")),
        Case(f"{name}, initial NaN", lambda: build(initial=[np.nan, 1.0]), ("initial_probabilities", "nan")),
        Case(f"{name}, initial size", lambda: build(initial=[1.0]), ("initial_probabilities", "(2,)", "(1,)")),
        Case(
            f"{name}, function of another shape",
            lambda: jf.run(build(chain=lambda inputs: jnp.eye(3)), KEY, jnp.zeros((2, 1))),
            ("transition_matrix", "(2, 2)", "(3, 3)"),
        ),
        Case(
            f"{name}, function of two arguments",
            lambda: build(chain=lambda mode, inputs: jnp.eye(2)),
            ("transition_matrix", "inputs"),
        ),
        Case(f"{name}, observation", lambda: jf.run(build(), KEY, jnp.zeros((2, 3))), ("observation", "(1,)", "(3,)")),
    ]


components = jf.mode_maps.components
common_space, pairwise = jf.mode_maps.common_space, jf.mode_maps.pairwise
CASES = [
    *of_each("imm", imm),
    *of_each("switching", switching),
    Case("imm, one filter", lambda: jf.imm(linear(), [[1.0]], [1.0]), ("filters", "list", "Filter")),
    Case("imm, particles", lambda: imm((switching(),) * 2), ("filters[0]", "Gaussian", "SwitchingState")),
    Case("imm, maps", lambda: imm(maps=[same, same]), ("maps", "jf.mode_maps", "list")),
    Case("imm, map of one", lambda: imm(maps=common_space([same], [same])), ("maps", "2", "1")),
    Case("imm, map too short", lambda: imm(OTHER_SIZES, maps=common_space([same] * 2, [same] * 2)), ("maps", "(3,)")),
    Case("imm, map to shorter", lambda: imm(maps=pairwise(lambda i, j, b: shorter(b))), ("maps.convert(0, 1", "(1,)")),
    Case("imm, map to arrays", lambda: imm(maps=pairwise(lambda i, j, b: b.mean)), ("maps.convert(0, 1", "Gaussian")),
    Case("imm, common mode", lambda: imm(maps=pairwise(lambda i, j, b: b, common=2)), ("maps", "0 to 1", "2")),
    Case("imm, fill by root", lambda: imm((rooted(),) * 2, maps=components([[0, 1]] * 2, FILL)), ("fill", "Root")),
    Case("components, outside", lambda: components([[0, 1], [0, 3]], FILL), ("indices[1]", "0 to 2", "[0, 3]")),
    Case("components, twice", lambda: components([[1, 1]], FILL), ("indices[0]", "different", "[1, 1]")),
    Case("components, fill", lambda: components([[0]], jnp.zeros(3)), ("fill", "Gaussian")),
    Case("common space, lengths", lambda: common_space([same], []), ("to and back", "1", "0")),
    Case("common space, no function", lambda: common_space([same], [3]), ("back[0]", "function")),
    Case("pairwise, no function", lambda: pairwise(3), ("function", "int")),
    Case("pairwise, common", lambda: pairwise(same, common=-1), ("common", "-1")),
    Case("switching, particles", lambda: switching(num_particles=0), ("num_particles", "0")),
    Case("switching, scheme", lambda: switching(scheme=3), ("scheme", "3")),
    Case("moments, kind", lambda: jf.mixture_moments(jnp.zeros((2, 3)), jnp.zeros(3)), ("beliefs", "Gaussian")),
    Case("moments, one belief", lambda: jf.mixture_moments(FILL, jnp.zeros(3)), ("beliefs", "(3, 3)", "last axis")),
    Case(
        "moments, weights",
        lambda: jf.mixture_moments(jf.Gaussian(jnp.zeros((1, 2)), jnp.ones((1, 1, 2))), jnp.zeros(3)),
        ("log_weights", "3", "(1, 2)"),
    ),
    Case("optimal, places", lambda: jf.resampling.optimal(KEY, jnp.zeros(3), 4), ("num_survivors", "3", "4")),
    Case("optimal, none", lambda: jf.resampling.optimal(KEY, jnp.zeros(3), 0), ("num_survivors", "1", "0")),
    Case("optimal, matrix", lambda: jf.resampling.optimal(KEY, jnp.zeros((3, 1)), 2), ("log_weights", "(3, 1)")),
    Case("optimal, integers", lambda: jf.resampling.optimal(KEY, jnp.zeros(3, int), 2), ("log_weights", "int32")),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)
