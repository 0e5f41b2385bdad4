"""Arrays of the host on the device: the values and types of `jnp.asarray`, without its programs."""

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters._xla.from_host import from_host

VALUES = {
    "float64": np.linspace(-1, 1, 7) / 3,
    "float32": np.linspace(-1, 1, 7, dtype=np.float32),
    "integers": np.arange(5),
    "list": [0.1, 2, -3.5],
    "number": 0.1,
    "on the device": jnp.arange(4) / 7,
}


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize("dtype", [float, jnp.float32, jnp.int32])
def test_values_and_types_are_those_of_asarray(name, dtype):
    found, expected = from_host(VALUES[name], dtype), jnp.asarray(VALUES[name], dtype)
    assert found.dtype == expected.dtype
    assert found.weak_type == expected.weak_type
    np.testing.assert_array_equal(found, expected)


def test_double_precision_stays_double(x64):
    found = from_host(VALUES["float64"])
    assert found.dtype == jnp.float64
    np.testing.assert_array_equal(found, VALUES["float64"])


def test_traced_arrays_stay_traced():
    np.testing.assert_array_equal(jax.jit(from_host)(jnp.arange(3)), [0.0, 1, 2])
    assert jax.grad(lambda x: from_host([x, 2.0]).sum())(1.0) == 1


def test_nothing_is_compiled():
    """Of shapes that no other test has."""
    programs = []
    count = lambda name, seconds, **more: programs.append(more) if name.endswith("backend_compile_duration") else None
    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        jnp.asarray(np.ones((3, 41)), float)
        assert len(programs) == 1
        from_host(np.ones((3, 43)))
        from_host([1.0] * 47)
        assert len(programs) == 1
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
