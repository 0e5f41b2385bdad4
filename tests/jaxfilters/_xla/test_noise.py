"""Normal numbers are those of JAX, whatever the key, the shape and the type."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters._xla.noise import standard_normal

KEYS = {"typed": jax.random.key(5), "old": jax.random.PRNGKey(7), "other": jax.random.key(1, impl="rbg")}


@pytest.mark.system
@pytest.mark.parametrize("kind", KEYS)
@pytest.mark.parametrize("shape", [(), (3,), (10, 101), (2, 3, 5), (0, 4)])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float16])
def test_numbers_are_those_of_jax_to_the_last_bit(kind, shape, dtype):
    found = standard_normal(KEYS[kind], shape, dtype)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, jax.random.normal(KEYS[kind], shape, dtype))


def test_numbers_are_those_of_jax_in_float64(x64):
    found = standard_normal(KEYS["typed"], (7, 11))
    assert found.dtype == jnp.float64
    np.testing.assert_array_equal(found, jax.random.normal(KEYS["typed"], (7, 11)))


def test_numbers_are_those_of_jax_under_vmap_and_without_a_counter_for_each_number():
    keys = jax.random.split(KEYS["typed"], 4)
    found = jax.vmap(lambda key: standard_normal(key, (3, 5)))(keys)
    np.testing.assert_array_equal(found, jax.vmap(lambda key: jax.random.normal(key, (3, 5)))(keys))
    with jax.threefry_partitionable(False):
        np.testing.assert_array_equal(standard_normal(keys[0], (3, 5)), jax.random.normal(keys[0], (3, 5)))
