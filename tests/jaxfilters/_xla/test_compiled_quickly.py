import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters._xla import compiled_quickly as options
from jaxfilters._xla.compiled_quickly import compiled_lightly, compiled_quickly


def solved(A, b, power=1):
    return jnp.linalg.solve(A, jnp.sin(b) ** power)


PROBLEM = np.array([[2.0, 1.0], [0.0, 4.0]], np.float32), np.array([0.5, 0.25], np.float32)


@pytest.mark.parametrize("compiled", [compiled_quickly, compiled_lightly])
@pytest.mark.parametrize("power", [1, 2])
def test_the_results_are_those_of_the_function(power, compiled):
    A, b = PROBLEM
    quick = compiled(solved, static_argnames="power")
    expected = np.linalg.solve(A.astype(float), np.sin(b.astype(float)) ** power)
    np.testing.assert_allclose(quick(A, b, power=power), expected, rtol=1e-5)
    assert quick.__name__ == "solved"


def test_it_may_be_called_from_a_program_and_be_differentiated():
    A, b = PROBLEM
    quick = compiled_quickly(solved)
    inside = jax.jit(lambda b: quick(A, b))(b)
    np.testing.assert_allclose(inside, quick(A, b), rtol=1e-6)
    J = jax.jacfwd(lambda b: quick(A, b))(jnp.asarray(b))
    np.testing.assert_allclose(J, np.linalg.inv(A.astype(float)) * np.cos(b.astype(float)), rtol=1e-5)


@pytest.mark.parametrize("compiled", [compiled_quickly, compiled_lightly])
def test_a_program_may_call_it_with_what_is_known(compiled):
    """XLA takes options for whole programs alone."""
    A, b = (jnp.asarray(a) for a in PROBLEM)
    quick = compiled(solved)
    np.testing.assert_allclose(jax.jit(lambda x: x + quick(A, b))(b), b + quick(A, b), rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(lambda x: x + quick(A, b))(b[None])[0], b + quick(A, b), rtol=1e-6)
    np.testing.assert_allclose(jax.grad(lambda x: jnp.sum(x * quick(A, b)))(b), quick(A, b), rtol=1e-6)


@pytest.mark.parametrize("name", ["_UNOPTIMISED", "_LIGHTLY"])
def test_xla_knows_the_options(name):
    # XLA refuses names that it does not know.
    compiled = jax.jit(solved).lower(*PROBLEM).compile(compiler_options=getattr(options, name))
    np.testing.assert_allclose(compiled(*PROBLEM), solved(*PROBLEM), rtol=1e-6)
