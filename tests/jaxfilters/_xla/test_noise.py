"""Random numbers and keys are those of JAX, whatever the key, the shape and the type."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erfinv

from jaxfilters._xla.noise import split, standard_normal, uniform

KEYS = {"typed": jax.random.key(5), "old": jax.random.PRNGKey(7), "other": jax.random.key(1, impl="rbg")}


@pytest.mark.system
@pytest.mark.parametrize("kind", KEYS)
@pytest.mark.parametrize("shape", [(), (3,), (10, 101), (2, 3, 5), (0, 4)])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float16])
def test_numbers_are_those_of_jax(kind, shape, dtype):
    found = standard_normal(KEYS[kind], shape, dtype)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, jax.random.normal(KEYS[kind], shape, dtype), rtol=1e-5)


def test_float32_numbers_are_the_quantiles_of_uniform_ones_to_rounding():
    # Those of `jax.random.normal` are up to 5e-6 away.
    count = 200_000
    lowest = np.nextafter(np.float32(-1), np.float32(0))
    between = np.asarray(jax.random.uniform(KEYS["typed"], (count,), minval=lowest), np.float64)
    exact = np.sqrt(2) * erfinv(between)
    np.testing.assert_allclose(standard_normal(KEYS["typed"], (count,)), exact, rtol=5e-7)


@pytest.mark.parametrize("kind", KEYS)
def test_two_keys_and_single_uniform_numbers_are_those_of_jax(kind):
    key = KEYS[kind]
    assert split(key).dtype == key.dtype
    for ours, of_jax in zip(split(key), jax.random.split(key), strict=True):
        np.testing.assert_array_equal(jax.random.key_data(ours), jax.random.key_data(of_jax))
    np.testing.assert_array_equal(uniform(key), jax.random.uniform(key))


def test_numbers_are_those_of_jax_in_float64(x64):
    found = standard_normal(KEYS["typed"], (7, 11))
    assert found.dtype == jnp.float64
    np.testing.assert_array_equal(found, jax.random.normal(KEYS["typed"], (7, 11)))


def test_numbers_are_those_of_jax_under_vmap_and_without_a_counter_for_each_number():
    keys = jax.random.split(KEYS["typed"], 4)
    found = jax.vmap(lambda key: standard_normal(key, (3, 5)))(keys)
    np.testing.assert_allclose(found, jax.vmap(lambda key: jax.random.normal(key, (3, 5)))(keys), rtol=1e-5)
    with jax.threefry_partitionable(False):
        np.testing.assert_array_equal(standard_normal(keys[0], (3, 5)), jax.random.normal(keys[0], (3, 5)))
