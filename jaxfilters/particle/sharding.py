r"""Particles distributed over devices: by placement of arrays alone, or as islands that rarely exchange particles.

There are two ways, for one machine or for the processes of `jax.distributed`:

- **Placement.** `placement` returns the device layout of each array of a filter's state. A run that starts from a state
  with this layout is the same program, partitioned by XLA: same key, same ancestors, same numbers up to rounding. Every
  resampling gathers the whole ensemble on every device.
- **Islands.** `sharded` makes a filter in which each of D devices keeps N / D particles and resamples among them. An
  island keeps its share of the weight when it resamples, so that all expectations and the evidence stay unbiased
  (C. Vergé, C. Dubarry, P. Del Moral, E. Moulines, "On parallel implementation of sequential Monte Carlo methods: the
  island particle model", 2015; N. Whiteley, A. Lee, K. Heine, "On the role of interaction in sequential Monte Carlo
  algorithms", 2016, for when to let them interact). A step communicates five numbers of each device. Only when the
  shares of the islands have become uneven, as measured by the effective number of islands, every island sends an equal
  part of its particles to every other one. That is a permutation of weighted particles: it changes no estimate, and the
  islands then have equal shares.

`spread_sequences` is for batches of sequences: `jax.vmap` of a run then filters each on the device of its observations.
"""

import math
from dataclasses import field, fields, is_dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Int32, PyTree, Shaped

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.particle import checks
from jaxfilters.particle.tempering import no_tempering
from jaxfilters.particle.weighting import ParticleInfo, resample
from jaxfilters.typing import AnyKey

AXIS = "particles"
"""Default name of the axis of the mesh."""


@pytree_dataclass
class Sharded:
    """Parameters of a filter whose particles are distributed over the devices of a mesh."""

    island: Filter
    """The filter that runs on each of D devices, with N / D particles."""
    island_threshold: float
    mesh: Mesh = field(metadata={"static": True})
    axis: str = field(metadata={"static": True})
    specs: tuple[P, ...] = field(metadata={"static": True})
    """How each leaf of the state is partitioned."""


def placement(filter: Filter, mesh: Mesh, *, axis: str = AXIS) -> PyTree[NamedSharding]:
    """Return the device layout of the state of a particle filter, as a pytree like the state.

    `run(filter, key, observations, state=jax.device_put(state, placement(filter, mesh)))` computes the same numbers as
    one device, up to rounding, and returns a state with this layout.

    Args:
        filter: Made by `bootstrap`, `rao_blackwell` or `rao_blackwell_shared`.
        mesh: The devices.
        axis: The axis of `mesh` along which the particles are distributed; along other axes they are replicated.

    Raises:
        TypeError: If `filter` is not a `Filter` or `mesh` is not a `jax.sharding.Mesh`.
        ValueError: If the filter is of another kind, the mesh has no such axis, or the length of that axis does not
            divide the number of particles.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior, move = lambda key: jnp.zeros(1), lambda key, x: x + jax.random.normal(key, (1,))
        >>> pf = jf.bootstrap(prior, move, lambda x, y: -jnp.sum((x - y) ** 2), num_particles=100)
        >>> mesh = jax.sharding.Mesh(jax.devices(), ("particles",))
        >>> state = jax.device_put(jf.init(pf, jax.random.key(0)), jf.sharding.placement(pf, mesh))
    """
    _share(filter, mesh, axis)
    structure, specs = _specs(filter, axis)
    return jax.tree.unflatten(structure, [NamedSharding(_automatic(mesh), spec) for spec in specs])


def sharded(filter: Filter, mesh: Mesh, *, axis: str = AXIS, island_threshold: float = 0.5) -> Filter:
    """Distribute the particles of a filter over the devices of a mesh, as islands.

    The result is used like any other filter. Its state is that of `filter`, with the ensemble axis of each leaf
    distributed. An island resamples by the scheme and the `ess_threshold` of `filter`, applied to its own particles.

    Args:
        filter: Made by `bootstrap`, `rao_blackwell` or `rao_blackwell_shared`, without tempering, which would
            choose another power on every island.
        mesh: The devices, of one process or of several.
        axis: The axis of `mesh` along which the particles are distributed; along other axes they are replicated.
        island_threshold: Exchange particles before a prediction if the effective number of islands,
            `1 / sum(share**2)`, is below this fraction of D; 1 or more exchanges always, 0 never.

    Raises:
        TypeError: If `filter` is not a `Filter` or `mesh` is not a `jax.sharding.Mesh`.
        ValueError: If the mesh has no such axis, its length does not divide the number of particles, the filter is
            tempered or no particle filter, or `island_threshold < 0`.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior, move = lambda key: jnp.zeros(1), lambda key, x: x + jax.random.normal(key, (1,))
        >>> pf = jf.bootstrap(prior, move, lambda x, y: -jnp.sum((x - y) ** 2), num_particles=100)
        >>> islands = jf.sharding.sharded(pf, jax.sharding.Mesh(jax.devices()[:1], ("particles",)))
        >>> jf.init(islands, jax.random.key(0)).particles.shape
        (1, 100)
    """
    condition = "a fraction of the number of devices, at least 0"
    checks.check_scalar("island_threshold", island_threshold, condition, lambda value: value >= 0)
    share = _share(filter, mesh, axis)
    temper = filter.params.temper
    if getattr(temper, "func", temper) is not no_tempering:
        raise ValueError("filter must not be tempered: each island would raise likelihoods to a power of its own.")
    island = _with_particles(filter, share)
    _, specs = _specs(filter, axis)
    return Filter(Sharded(island, float(island_threshold), _automatic(mesh), axis, specs), _init, _predict, _update)


def spread_sequences(sequences: PyTree, mesh: Mesh, *, axis: str) -> PyTree:
    """Place an equal part of a batch of sequences on every device.

    `jax.jit(jax.vmap(log_evidence, (None, None, 0)))(filter, key, spread)` then runs without communication.

    Args:
        sequences: Pytree whose leaves have the sequences along their first axis.
        mesh: The devices.
        axis: The axis of `mesh` along which the sequences are distributed.

    Returns:
        The same arrays, on the devices of the mesh.

    Raises:
        TypeError: If `mesh` is not a `jax.sharding.Mesh`.
        ValueError: If the mesh has no such axis, or its length does not divide the number of sequences.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> mesh = jax.sharding.Mesh(jax.devices()[:1], ("sequences",))
        >>> jf.sharding.spread_sequences(jnp.zeros((8, 50, 2)), mesh, axis="sequences").sharding.spec[0]
        'sequences'
    """
    num_devices = _length(mesh, axis)
    for path, leaf in jax.tree_util.tree_leaves_with_path(sequences):
        length = jnp.shape(leaf)[:1]
        if length == () or length[0] % num_devices:
            raise ValueError(
                f"sequences{jax.tree_util.keystr(path)} must have a first axis that is a multiple of the {num_devices} "
                f"devices along {axis!r}; got the shape {jnp.shape(leaf)}."
            )
    return jax.device_put(sequences, NamedSharding(_automatic(mesh), P(axis)))


def _share(filter: Filter, mesh: Mesh, axis: str) -> int:
    """Number of particles of each device."""
    if not isinstance(filter, Filter):
        raise TypeError(f"filter must be a Filter; got {filter!r}.")
    names = {one.name for one in fields(filter.params)} if is_dataclass(filter.params) else set()
    if not {"num_particles", "scheme", "temper"} <= names:
        raise ValueError(
            "filter must be made by bootstrap, rao_blackwell or rao_blackwell_shared; "
            f"its parameters are {type(filter.params).__name__}."
        )
    count, num_devices = filter.params.num_particles, _length(mesh, axis)
    if count % num_devices:
        raise ValueError(f"num_particles must be a multiple of the {num_devices} devices along {axis!r}; got {count}.")
    return count // num_devices


def _length(mesh: Mesh, axis: str) -> int:
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh must be a jax.sharding.Mesh; got {mesh!r}.")
    if axis not in mesh.shape:
        raise ValueError(f"axis must be one of those of the mesh, {', '.join(mesh.axis_names)}; got {axis!r}.")
    return mesh.shape[axis]


def _automatic(mesh: Mesh) -> Mesh:
    """The same devices, with the layout of intermediate results left to XLA."""
    return Mesh(mesh.devices, mesh.axis_names, axis_types=(AxisType.Auto,) * len(mesh.axis_names))


def _with_particles(filter: Filter, num_particles: int) -> Filter:
    return replace(filter, params=replace(filter.params, num_particles=num_particles))


def _specs(filter: Filter, axis: str) -> tuple[Any, tuple[P, ...]]:
    """Structure of the state, and the partition of each leaf: those that grow with the ensemble have its axis last."""
    leaves, structure = jax.tree.flatten(_state_shapes(filter))
    twice = _state_shapes(_with_particles(filter, 2 * filter.params.num_particles))

    def spec(leaf: jax.ShapeDtypeStruct, grown: jax.ShapeDtypeStruct) -> P:
        return P() if leaf.shape == grown.shape else P(*[None] * (leaf.ndim - 1), axis)

    return structure, tuple(map(spec, leaves, jax.tree.leaves(twice)))


def _state_shapes(filter: Filter) -> PyTree:
    return jax.eval_shape(filter.init, filter.params, jax.eval_shape(jax.random.key, 0))


def _init(model: Sharded, key: AnyKey) -> PyTree:
    structure = jax.tree.structure(_state_shapes(model.island))

    def start(key: AnyKey, island: Filter) -> PyTree:
        state = island.init(island.params, _own(key, model.axis))
        num_particles = state.log_weights.shape[0]
        return state._replace(
            log_weights=state.log_weights - math.log(model.mesh.shape[model.axis]),
            ancestors=state.ancestors + _first(num_particles, model.axis),
        )

    on_devices = jax.shard_map(
        start,
        mesh=model.mesh,
        in_specs=P(),
        out_specs=jax.tree.unflatten(structure, model.specs),
        check_vma=False,
    )
    return on_devices(key, model.island)


def _predict(model: Sharded, key: AnyKey, state: PyTree, inputs: PyTree) -> PyTree:
    def predict(key: AnyKey, island: Filter, threshold: Array, state: PyTree, inputs: PyTree) -> PyTree:
        exchange_key, predict_key = jax.random.split(_own(key, model.axis))
        _, log_share = weights.normalize(state.log_weights)
        log_shares = jax.lax.all_gather(log_share, model.axis)
        few = weights.effective_sample_size(log_shares) < threshold * log_shares.size
        first = _first(state.log_weights.shape[0], model.axis)
        origin = first + jnp.arange(state.log_weights.shape[0], dtype=jnp.int32)
        state, origin = jax.lax.cond(
            few | (threshold >= 1.0),
            lambda state: _exchange(model, island, exchange_key, state, origin),
            lambda state: (state, origin),
            state,
        )
        state = island.predict(island.params, predict_key, state, inputs)
        return state._replace(ancestors=origin[state.ancestors])

    specs = jax.tree.unflatten(jax.tree.structure(state), model.specs)
    on_devices = jax.shard_map(
        predict, mesh=model.mesh, in_specs=(P(), P(), P(), specs, P()), out_specs=specs, check_vma=False
    )
    return on_devices(key, model.island, jnp.asarray(model.island_threshold), state, inputs)


def _exchange(
    model: Sharded, island: Filter, key: AnyKey, state: PyTree, origin: Int32[Array, " n"]
) -> tuple[PyTree, Int32[Array, " n"]]:
    """Resample on every island, then send an equal part of its particles to every island."""
    specs = jax.tree.unflatten(jax.tree.structure(state), model.specs)
    # The noise of the next prediction is independent of the particles and need not be exchanged.
    which = jax.tree.leaves(specs._replace(log_weights=None, ancestors=None, noise=None))
    leaves, structure = jax.tree.flatten(state._replace(log_weights=None, ancestors=None, noise=None))
    moving = [i for i, spec in enumerate(which) if spec != P()]
    chosen, log_weights, ancestors = resample(
        key, [leaves[i] for i in moving], state.log_weights, island.params.scheme, 1.0
    )
    mix = partial(_mix, axis=model.axis, num_devices=model.mesh.shape[model.axis])
    for i, leaf in zip(moving, chosen, strict=True):
        leaves[i] = mix(leaf)
    mixed = jax.tree.unflatten(structure, leaves)
    mixed = mixed._replace(log_weights=mix(log_weights), ancestors=state.ancestors, noise=state.noise)
    return mixed, mix(origin[ancestors])


def _mix(leaf: Shaped[Array, "... n"], *, axis: str, num_devices: int) -> Shaped[Array, "... n"]:
    """Send particles 0, D, 2 D, ... of every island to the first, 1, D + 1, ... to the second; the remainder stays."""
    *shape, count = leaf.shape
    part = count // num_devices
    if part == 0:
        return leaf
    dealt = leaf[..., : part * num_devices].reshape(*shape, part, num_devices).swapaxes(-1, -2)
    received = jax.lax.all_to_all(dealt, axis, split_axis=len(shape), concat_axis=len(shape), tiled=True)
    return jnp.concatenate([received.reshape(*shape, part * num_devices), leaf[..., part * num_devices :]], axis=-1)


def _update(
    model: Sharded, key: AnyKey, state: PyTree, observation: PyTree, inputs: PyTree
) -> tuple[PyTree, ParticleInfo]:
    def update(
        key: AnyKey, island: Filter, state: PyTree, observation: PyTree, inputs: PyTree
    ) -> tuple[PyTree, ParticleInfo]:
        ancestors = state.ancestors
        # The filter of an island numbers its own particles from 0.
        state = state._replace(ancestors=ancestors - _first(ancestors.shape[0], model.axis))
        state, info = island.update(island.params, _own(key, model.axis), state, observation, inputs)
        infos = jax.lax.all_gather(jnp.stack([jnp.asarray(one, info.log_evidence.dtype) for one in info]), model.axis)
        of_islands = ParticleInfo(*infos.T)
        log_shares, log_evidence = weights.normalize(of_islands.log_evidence)
        share = log_shares[jax.lax.axis_index(model.axis)]
        info = ParticleInfo(
            log_evidence=log_evidence,
            effective_sample_size=1 / jnp.sum(jnp.exp(2 * log_shares) / of_islands.effective_sample_size),
            resampled=jnp.any(of_islands.resampled > 0),
            num_invalid=jnp.sum(of_islands.num_invalid).astype(jnp.int32),
        )
        return state._replace(log_weights=state.log_weights + share, ancestors=ancestors), info

    specs = jax.tree.unflatten(jax.tree.structure(state), model.specs)
    on_devices = jax.shard_map(
        update, mesh=model.mesh, in_specs=(P(), P(), specs, P(), P()), out_specs=(specs, P()), check_vma=False
    )
    return on_devices(key, model.island, state, observation, inputs)


def _own(key: AnyKey, axis: str) -> AnyKey:
    """A random key for this device."""
    return jax.random.fold_in(key, jax.lax.axis_index(axis))


def _first(share: int, axis: str) -> Int32[Array, ""]:
    """Index of this device's first particle in the whole ensemble."""
    return jnp.asarray(jax.lax.axis_index(axis) * share, jnp.int32)
