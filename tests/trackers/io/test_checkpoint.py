import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.io.errors import CheckpointError


def make_state(seed):
    key = jax.random.key(seed)
    rest = {"frames": jnp.asarray(seed, jnp.int32), "seen": jnp.asarray([True, False]), "host": np.arange(3.0)}
    return {"key": key, "particles": jax.random.normal(key, (3, 5)), "rest": rest}


def assert_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    np.testing.assert_array_equal(jax.random.key_data(a["key"]), jax.random.key_data(b["key"]))
    assert a["key"].dtype == b["key"].dtype
    assert jax.tree.map(type, a) == jax.tree.map(type, b)
    for x, y in zip(*(jax.tree.leaves(x | {"key": 0}) for x in (a, b)), strict=True):
        np.testing.assert_array_equal(x, y)


def test_what_was_saved_comes_back_bit_for_bit(tmp_path):
    state, meta = make_state(7), {"frames": 3, "run": {"seed": 7}}
    checkpoint.save(tmp_path / "c.npz", state, meta)
    restored, restored_meta = checkpoint.load(tmp_path / "c.npz")
    assert_equal(restored, state)
    assert restored_meta == meta == checkpoint.load_meta(tmp_path / "c.npz")
    np.testing.assert_array_equal(jax.random.normal(restored["key"], (4,)), jax.random.normal(state["key"], (4,)))


def test_keys_of_another_generator_keep_their_kind(tmp_path):
    key = jax.random.key(3, impl="rbg")
    checkpoint.save(tmp_path / "c.npz", [key], {})
    ((restored,), _) = checkpoint.load(tmp_path / "c.npz")
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
    restored, meta = checkpoint.load(path)
    assert_equal(restored, make_state(1))
    assert meta == {"frames": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["c.npz"]


def test_trees_of_plain_values_come_back_with_their_types(tmp_path):
    belief = Gaussian(jnp.zeros(2), jnp.eye(2))
    tree = {"a": [1, 2.5, "x", None, True, np.float64(np.nan), -np.inf], "b": (belief, MonoConfig(seed=3)), "c": ()}
    checkpoint.save(tmp_path / "c.npz", tree, {})
    found, _ = checkpoint.load(tmp_path / "c.npz")
    assert jax.tree.structure(found) == jax.tree.structure(tree)
    assert repr(found) == repr(tree)
    assert [type(value) for value in found["a"]] == [type(value) for value in tree["a"]]


@pytest.mark.parametrize("tree", [{"f": print}, [{1, 2}], {1: 2}], ids=lambda tree: type(tree).__name__)
def test_what_cannot_be_saved_is_refused_before_anything_is_written(tree, tmp_path):
    with pytest.raises(TypeError):
        checkpoint.save(tmp_path / "c.npz", tree, {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "structure",
    [
        None,
        {},
        {"call": "print"},
        {"fields": ["os:stat_result", {}]},
        {"fields": ["jaxfilters.trackers.io.checkpoint:save", {}]},
        {"fields": ["jaxfilters.gaussian.belief:Gaussian", {"mean": {"value": 1}}]},
        {"jax": "tree.absent"},
        {"key": ["tree", "no generator"]},
        {"list": 3},
    ],
)
def test_a_structure_that_was_never_saved_is_refused(structure, tmp_path):
    """No code is run, no module imported, whatever a file says."""
    header = json.dumps({"schema": checkpoint.SCHEMA, "meta": {}, "structure": structure})
    np.savez(path := tmp_path / "c.npz", header=header, tree=np.zeros(2, np.uint32))
    with pytest.raises(CheckpointError, match="not a complete checkpoint"):
        checkpoint.load(path)


def test_files_that_are_no_checkpoint_are_refused(tmp_path):
    path = tmp_path / "c.npz"
    checkpoint.save(path, make_state(1), {})
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="not a complete checkpoint"):
        checkpoint.load_meta(path)
    np.savez(path, header=json.dumps({"schema": 99, "meta": {}}))
    with pytest.raises(CheckpointError, match=f"schema 99, but this version reads {checkpoint.SCHEMA}"):
        checkpoint.load_meta(path)
    np.savez(path, header=np.asarray([{"schema": 1}], object))
    with pytest.raises(CheckpointError, match="objects, not numbers"):
        checkpoint.load_meta(path)
