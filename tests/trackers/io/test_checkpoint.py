import json
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.io.errors import CheckpointError


class State(NamedTuple):
    key: jax.Array
    particles: jax.Array
    rest: dict


def make_state(seed):
    key = jax.random.key(seed)
    rest = {"frames": jnp.asarray(seed, jnp.int32), "seen": jnp.asarray([True, False]), "host": np.arange(3.0)}
    return State(key, jax.random.normal(key, (3, 5)), rest)


def assert_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    np.testing.assert_array_equal(jax.random.key_data(a.key), jax.random.key_data(b.key))
    assert a.key.dtype == b.key.dtype
    assert jax.tree.map(type, a) == jax.tree.map(type, b)
    for x, y in zip(jax.tree.leaves(a[1:]), jax.tree.leaves(b[1:]), strict=True):
        np.testing.assert_array_equal(x, y)


def test_what_was_saved_comes_back_bit_for_bit(tmp_path):
    state, meta = make_state(7), {"frames": 3, "run": {"seed": 7}}
    checkpoint.save(tmp_path / "c.npz", state, meta)
    restored, restored_meta = checkpoint.load(tmp_path / "c.npz", make_state(0))
    assert_equal(restored, state)
    assert restored_meta == meta == checkpoint.load_meta(tmp_path / "c.npz")
    np.testing.assert_array_equal(jax.random.normal(restored.key, (4,)), jax.random.normal(state.key, (4,)))


def test_keys_of_another_generator_keep_their_kind(tmp_path):
    key = jax.random.key(3, impl="rbg")
    checkpoint.save(tmp_path / "c.npz", [key], {})
    ((restored,), _) = checkpoint.load(tmp_path / "c.npz", [jax.random.key(0, impl="rbg")])
    np.testing.assert_array_equal(jax.random.bits(restored, (3,)), jax.random.bits(key, (3,)))


def test_a_failure_while_writing_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "c.npz"
    checkpoint.save(path, make_state(1), {"frames": 1})

    def fail_half_way(file, **arrays):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", fail_half_way)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(path, make_state(2), {"frames": 2})
    restored, meta = checkpoint.load(path, make_state(0))
    assert_equal(restored, make_state(1))
    assert meta == {"frames": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["c.npz"]


def test_a_state_of_another_shape_or_structure_is_refused(tmp_path):
    path = tmp_path / "c.npz"
    checkpoint.save(path, make_state(1), {})
    other = make_state(1)._replace(particles=jnp.zeros((3, 6)))
    with pytest.raises(CheckpointError, match=r"tree.particles is \(3, 5\) float32; expected \(3, 6\) float32"):
        checkpoint.load(path, other)
    with pytest.raises(CheckpointError, match=r"its arrays differ from the expected ones in \[.tree.rest\['more'\].\]"):
        checkpoint.load(path, make_state(1)._replace(rest=make_state(1).rest | {"more": jnp.zeros(2)}))


def test_files_that_are_no_checkpoint_are_refused(tmp_path):
    path = tmp_path / "c.npz"
    checkpoint.save(path, make_state(1), {})
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="not a complete checkpoint"):
        checkpoint.load_meta(path)
    np.savez(path, header=json.dumps({"schema": 99, "meta": {}}))
    with pytest.raises(CheckpointError, match="schema 99, but this version reads 1"):
        checkpoint.load_meta(path)
    np.savez(path, header=np.asarray([{"schema": 1}], object))
    with pytest.raises(CheckpointError, match="allow_pickle=False"):
        checkpoint.load_meta(path)
