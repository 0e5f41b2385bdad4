"""Poses divided over CPU devices."""

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
def test_each_of_two_devices_computes_half_of_the_poses(on_two_devices):
    done = on_two_devices(_ON_TWO_DEVICES)
    assert done.returncode == 0, done.stderr
