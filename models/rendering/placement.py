"""Where the poses of an ensemble are rendered: one after another on each CPU device, all at once on an accelerator."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import PyTree

_BATCH_PIXELS = 1 << 24
_AXIS = "poses"


def poses_in_turn() -> bool:
    """Whether poses are rendered one after another, parts in windows, rather than all at once in whole images."""
    return jax.default_backend() == "cpu"


def map_poses(of_one: Callable, poses: PyTree, shared: PyTree, pixels: int) -> PyTree:
    """`of_one(pose, shared)` for every pose along the leading axis of `poses`.

    On a CPU, one pose at a time, so that its image stays in the cache; where the process has several CPU devices
    (`jax_num_cpu_devices`), they share the poses, because XLA's own threads do not help a loop. Elsewhere many poses
    at once, as many as `pixels` of one image allow in bounded memory.
    """
    count = jax.tree.leaves(poses)[0].shape[0]
    if not poses_in_turn():
        return jax.lax.map(
            lambda pose: of_one(pose, shared), poses, batch_size=max(1, min(count, _BATCH_PIXELS // pixels))
        )
    devices = jax.local_devices(backend="cpu")
    # Within another `shard_map` the poses have their places already.
    if len(devices) == 1 or count < 2 * len(devices) or not jax.sharding.get_abstract_mesh().empty:
        return jax.lax.map(lambda pose: of_one(pose, shared), poses)
    return _map_sharded(of_one, poses, shared, count, Mesh(np.array(devices), (_AXIS,)))


def share_poses(of_many: Callable, poses: PyTree, shared: PyTree) -> PyTree:
    """`of_many(poses, shared)`, whose results have the axis of the poses first, divided over the CPU devices.

    For whole computations about independent poses that end in `map_poses`: where that alone divides the poses, every
    device repeats all that surrounds the rendering. On an accelerator, or with one device, a plain call.
    """
    count = jax.tree.leaves(poses)[0].shape[0]
    devices = jax.local_devices(backend="cpu") if poses_in_turn() else []
    if len(devices) < 2 or count < len(devices) or not jax.sharding.get_abstract_mesh().empty:
        return of_many(poses, shared)
    mesh = Mesh(np.array(devices), (_AXIS,))
    sharded = jax.shard_map(of_many, mesh=mesh, in_specs=(P(_AXIS), P()), out_specs=P(_AXIS), check_vma=False)
    # The last pose is repeated, as one that any computation about a pose is made for.
    missing = -count % len(devices)
    padded = jax.tree.map(
        lambda leaf: jnp.pad(leaf, [(0, missing)] + [(0, 0)] * (leaf.ndim - 1), mode="edge") if missing else leaf, poses
    )
    return jax.tree.map(lambda leaf: leaf[:count], sharded(padded, shared))


def _map_sharded(of_one, poses, shared, count, mesh):
    share = -(-count // mesh.size)
    padded = jax.tree.map(
        lambda leaf: jnp.pad(leaf, [(0, share * mesh.size - count)] + [(0, 0)] * (leaf.ndim - 1)), poses
    )
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), poses)
    _, unravel = ravel_pytree(
        jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(of_one, one, shared))
    )

    # Everything enters and leaves replicated: what surrounds the rendering is small, and stays free of collectives.
    # Results travel in a single collective. Every collective that waits holds a thread of XLA's pool, which has one for
    # each core: several at once on one device leave none for the device that they wait for.
    def body(poses, shared):
        first = jax.lax.axis_index(_AXIS) * share
        mine = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, share), poses)
        vectors = jax.lax.map(lambda pose: ravel_pytree(of_one(pose, shared))[0], mine)
        return jax.lax.all_gather(vectors, _AXIS, tiled=True)

    vectors = jax.shard_map(body, mesh=mesh, in_specs=P(), out_specs=P(), check_vma=False)(padded, shared)
    return jax.vmap(unravel)(vectors[:count])
