"""Poses divided over CPU devices."""

import os
import subprocess
import sys

import pytest

_ON_TWO_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from jaxfilters.models.rendering.placement import share_poses

counts = []
def of_many(poses, shared):
    counts.append(len(poses[0]))
    return poses[0] + shared, jnp.sum(poses[1] * shared, axis=1)

rng = np.random.default_rng(0)
for count, of_a_device in ((8, 4), (7, 4), (1, 1)):
    poses, shared = tuple(jnp.asarray(rng.normal(size=(count, 3)), float) for _ in range(2)), jnp.arange(3.0)
    results = jax.jit(lambda poses, shared: share_poses(of_many, poses, shared))(poses, shared)
    assert set(counts) == {of_a_device}, counts
    np.testing.assert_allclose(results[0], np.asarray(poses[0]) + np.arange(3), rtol=1e-6)
    np.testing.assert_allclose(results[1], (np.asarray(poses[1]) * np.arange(3)).sum(1), rtol=1e-5)
    counts.clear()
"""


@pytest.mark.system
def test_each_of_two_devices_computes_half_of_the_poses():
    """In a process of its own, because the number of devices is fixed when JAX starts."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", _ON_TWO_DEVICES]
    done = subprocess.run(command, check=False, env=environment, timeout=300, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
