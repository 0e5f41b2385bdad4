"""Bad input: Fitting of parameters reject it at trace time or before, and name the argument.

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


R = jnp.eye(1)
YS = jnp.ones((6, 1))


def filter_of(noise):
    return jf.extended_kalman(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), lambda x, u: x, noise * jnp.eye(1), lambda x: x, R)


def particle_filter_of(noise):
    return jf.bootstrap(
        lambda key: jax.random.normal(key, (1,)),
        lambda key, x, u: x + noise * jax.random.normal(key, (1,)),
        lambda x, y: -0.5 * jnp.sum((y - x) ** 2),
        num_particles=8,
    )


def maximized(log_density=lambda x: -jnp.sum(x**2), start=1.0, constraints=jf.fit.free, **options):
    return jf.fit.maximize(log_density, start, constraints, **options)


FIT = [
    Case(
        "fit, NaN to a particle filter",
        lambda: maximized(jf.fit.log_evidence(KEY, particle_filter_of, YS.at[2].set(jnp.nan)), 1.0, jf.fit.positive),
        ("log_density", "start", "observations", "NaN", "frame 2", "mask"),
    ),
    Case("fit, infinite at the start", lambda: maximized(lambda x: jnp.log(x), 0.0), ("log_density", "start", "-inf")),
    Case(
        "fit, prior excludes the start",
        lambda: maximized(jf.fit.with_prior(lambda x: -(x**2), lambda x: jnp.log(x)), 0.0),
        ("log_density", "log prior", "-inf"),
    ),
    Case(
        "fit, mask length",
        lambda: jf.fit.log_evidence(KEY, filter_of, YS, mask=jnp.ones(5, bool)),
        ("observations", "mask", "(6, 1)", "(5,)"),
    ),
    Case(
        "fit, inputs length",
        lambda: jf.fit.log_evidence(KEY, filter_of, YS, jnp.ones((4, 1))),
        ("observations", "inputs", "(6, 1)", "(4, 1)"),
    ),
    Case("fit, no observations", lambda: jf.fit.log_evidence(KEY, filter_of, None), ("observations", "none")),
    Case(
        "fit, mask of other sequences",
        lambda: jf.fit.over_sequences(KEY, filter_of, jnp.ones((6, 1, 3)), mask=jnp.ones((6, 2), bool)),
        ("observations", "mask", "(6, 1, 3)", "(6, 2)"),
    ),
    Case(
        "fit, mask without sequences",
        lambda: jf.fit.over_sequences(KEY, filter_of, jnp.ones((6, 1, 6)), mask=jnp.ones(6, bool)),
        ("mask", "last axis", "(6,)"),
    ),
    Case("fit, start outside", lambda: maximized(start={"a": -1.0}, constraints=jf.fit.positive), ("start['a']", "-1")),
    Case("fit, start NaN", lambda: maximized(start=jnp.nan), ("start", "finite", "nan")),
    Case(
        "fit, other constraints",
        lambda: maximized(start={"a": 1.0}, constraints={"b": jf.fit.free}),
        ("constraints", "structure of start"),
    ),
    Case("fit, no constraint", lambda: maximized(constraints=3.0), ("constraints", "fit.positive", "3.0")),
    Case("fit, interval", lambda: jf.fit.interval(2.0, 1.0), ("interval", "2.0", "1.0")),
    Case(
        "fit, fresh keys with bfgs",
        lambda: maximized(jf.fit.fresh_keys(KEY, lambda key, x: -(x**2))),
        ("method", "fresh keys", "Bfgs"),
    ),
    Case("fit, least squares", lambda: maximized(method=jf.fit.least_squares()), ("log_density", "fit.residuals")),
    Case("fit, adam rate", lambda: jf.fit.adam(0.0), ("learning_rate", "0.0")),
    Case("fit, no steps", lambda: jf.fit.bfgs(max_steps=0), ("max_steps", "0")),
    Case("fit, tolerance", lambda: jf.fit.lbfgsb(tolerance=-1.0), ("tolerance", "-1.0")),
    Case("fit, patience", lambda: jf.fit.adam(patience=0), ("patience", "0")),
    Case(
        "check_gradient outside",
        lambda: jf.fit.check_gradient(lambda x: jnp.log(x), -1.0, jf.fit.positive),
        ("theta", "positive", "-1"),
    ),
]


@pytest.mark.parametrize("case", FIT, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)
