"""Programs that a second process would find: here a second object, with nothing in memory but the folder."""

import os
import subprocess
import sys
import time
from functools import partial
from types import ModuleType
from typing import NamedTuple
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import _sources
from jaxfilters._xla import kept_traces, trace_key
from jaxfilters._xla.compiled_quickly import compiled_fully
from jaxfilters._xla.kept_traces import KeptPrograms, keep_traces
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math.lie import quaternion_to_matrix
from jaxfilters.trackers.people.state import PeopleConfig, nobody

SOURCES = trace_key._sources
Q = np.array([0.5, 0.1, -0.3, 0.8], np.float32)


class Foreign(NamedTuple):
    """A structure of another package."""

    q: jax.Array


def double(q):
    return 2 * q


def repeated(q, times=1):
    return jnp.concatenate([q] * times) * jnp.ones((), jnp.float16)  # of the type of q unless that is weak


def drawn(key, belief, count):
    next_key, key = jax.random.split(key)
    samples = jax.random.multivariate_normal(key, belief.mean, belief.covariance, (count,))
    return next_key, Gaussian(jnp.mean(samples, axis=0), belief.covariance / count), {"samples": samples}


def weak(q):
    return jnp.where(q[0] > 0, 1.0, 2.0)


def printed(q):
    jax.debug.callback(lambda q: None, q)
    return 2 * q


def precise(q):
    return jnp.float32(1e-9) + (q.astype(float) + 1e-9 - q.astype(float)).astype(jnp.float32)


def local_structure(q):
    class Local(NamedTuple):
        q: jax.Array

    return Local(2 * q)


IMAGINED = ModuleType("jaxfilters.imagined")
for function in (repeated, drawn, weak, printed, precise, local_structure):
    function.__module__ = IMAGINED.__name__
    setattr(IMAGINED, function.__name__, function)


@pytest.fixture(autouse=True)
def imagined(monkeypatch):
    """A module of the package, whose sources were there before it was imported."""
    monkeypatch.setitem(sys.modules, IMAGINED.__name__, IMAGINED)
    monkeypatch.setattr(trace_key, "_sources", lambda: b"of today")


@pytest.fixture
def folder(tmp_path):
    keep_traces(tmp_path / "traced")
    yield tmp_path / "traced"
    keep_traces(None)


@pytest.fixture
def traced(monkeypatch):
    """The names of the functions that were traced, in turn."""
    names = []
    trace = KeptPrograms._traced

    def counted(self, *args):
        names.append(self._function.__name__)
        return trace(self, *args)

    monkeypatch.setattr(KeptPrograms, "_traced", counted)
    return names


def found(function, *args, **settings):
    return KeptPrograms(function, {}, settings).find(args, {})


def test_what_one_process_has_traced_another_finds(folder, traced):
    expected = np.asarray(jax.jit(quaternion_to_matrix)(Q))
    for _ in range(2):
        np.testing.assert_array_equal(np.asarray(found(quaternion_to_matrix, Q)()), expected)
    assert traced == ["quaternion_to_matrix"]
    assert len(list(folder.iterdir())) == 1


def test_structures_keys_and_static_arguments_come_back(folder, traced):
    belief, key = Gaussian(jnp.zeros(2), jnp.eye(2)), jax.random.key(1)
    settings = {"static_argnames": ("count",)}
    expected = jax.jit(drawn, **settings)(key, belief, count=3)
    for _ in range(2):
        result = KeptPrograms(drawn, {}, settings).find((key, belief), {"count": 3})()
        assert jax.tree.structure(result) == jax.tree.structure(expected)
        assert result[0].dtype == key.dtype
        np.testing.assert_array_equal(jax.random.key_data(result[0]), jax.random.key_data(expected[0]))
        jax.tree.map(np.testing.assert_array_equal, result[1:], expected[1:])
    assert traced == ["drawn"]


@pytest.mark.parametrize("change", ["nothing", "shape", "dtype", "weak", "x64", "version", "sources", "static"])
def test_all_that_tracing_depends_on_tells_programs_apart(folder, traced, change, monkeypatch):
    changed = {"shape": Q[None], "dtype": Q.astype(np.float16), "weak": jnp.broadcast_to(jnp.asarray(0.5), 4)}
    found(repeated, Q, 1, static_argnames="times")()
    if change == "version":
        monkeypatch.setattr(trace_key, "_versions", lambda: ["0"])
    if change == "sources":
        monkeypatch.setattr(trace_key, "_sources", lambda: b"of another day")
    with jax.enable_x64(change == "x64"):
        times = 2 if change == "static" else 1
        result = found(repeated, changed.get(change, Q), times, static_argnames="times")()
    assert len(result) == changed.get(change, Q).shape[0] * times
    assert result.dtype == (jnp.float16 if change in ("dtype", "weak") else jnp.float32)
    assert len(traced) == (1 if change == "nothing" else 2)


@pytest.mark.parametrize("settings", [{}, {"jax_enable_x64": True}])
def test_one_object_tells_settings_and_types_of_static_arguments_apart(folder, traced, settings):
    kept, plain = KeptPrograms(repeated, {}, {"static_argnames": "times"}), jax.jit(repeated, static_argnames="times")
    for times in (1, True):
        assert kept.find((Q, times), {})().shape == plain(Q, times).shape
    assert len(traced) == 2
    kept = KeptPrograms(precise, {}, {})
    for is_wide in (False, True):
        with jax.enable_x64(is_wide):
            np.testing.assert_array_equal(kept.find((Q,), {})(), jax.jit(precise)(Q))
    assert len(traced) == 4


def test_a_changed_file_changes_the_digest(tmp_path):
    digests, file = [], tmp_path / "module.py"
    for text in ("A = 1", "A = 2", "A = 1"):
        file.write_text(text)
        digests.append(_sources.digest_of([tmp_path], time.time() + 60))
    assert digests[0] == digests[2] != digests[1]
    file.rename(tmp_path / "other.py")
    assert _sources.digest_of([tmp_path], time.time() + 60) not in digests
    # Written after the import: not what runs.
    assert _sources.digest_of([tmp_path], time.time() - 60) is None
    assert _sources.digest_of([tmp_path / "missing"], time.time() + 60) is None


def test_the_sources_are_those_of_this_package(monkeypatch):
    folders = []
    monkeypatch.setattr(trace_key, "digest_of", lambda found, before_s: folders.extend(found))
    SOURCES.__wrapped__()
    assert folders == _sources.package_folders()
    assert [folder.name for folder in folders] == ["jaxfilters", "models", "trackers", "benchmarks"]
    assert all((folder / "__init__.py").exists() for folder in folders)


@pytest.mark.parametrize("function", [double, lambda q: q, partial(quaternion_to_matrix)])
def test_functions_that_the_sources_do_not_describe_are_not_kept(folder, function):
    assert found(function, Q) is None
    np.testing.assert_array_equal(compiled_fully(double)(Q), 2 * Q)
    assert not folder.exists()


def test_two_functions_of_one_name_are_not_taken_for_each_other(folder):
    def repeated(q):
        return 3 * q

    repeated.__module__, repeated.__qualname__ = IMAGINED.__name__, "repeated"
    assert found(repeated, Q) is None


@pytest.mark.parametrize("function", [printed, local_structure])
def test_what_cannot_be_exported_runs_without(folder, function):
    assert found(function, Q) is None
    np.testing.assert_array_equal(jax.tree.leaves(compiled_fully(function)(Q))[0], 2 * Q)


@pytest.mark.parametrize(("args", "error"), [(([1, 2],), "repeated"), ((Q, [1]), "hashable"), ((Q, 1, 2), "argument")])
def test_wrong_arguments_get_the_errors_of_jax(folder, args, error):
    with pytest.raises((TypeError, ValueError, AttributeError)) as expected:
        jax.jit(repeated, static_argnames="times")(*args)
    with pytest.raises(expected.type) as got:
        compiled_fully(repeated, static_argnames="times")(*args)
    assert str(got.value) == str(expected.value)


def test_structures_of_other_packages_are_not_kept(folder):
    assert found(quaternion_to_matrix, Foreign(Q)) is None
    assert not folder.exists()


def test_results_of_no_definite_type_are_not_kept(folder, traced):
    """Exported programs forget that a type is weak, and the next program would compute in another one."""
    assert [found(weak, Q) for _ in range(2)] == [None, None]
    assert traced == ["weak"]
    assert compiled_fully(weak)(Q).weak_type


@pytest.mark.parametrize("damage", [slice(0), slice(-9), slice(9, None)])
def test_a_damaged_file_is_traced_anew(folder, traced, damage):
    expected = np.asarray(found(quaternion_to_matrix, Q)())
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[damage])
    np.testing.assert_array_equal(np.asarray(found(quaternion_to_matrix, Q)()), expected)
    assert len(traced) == 2
    assert list(folder.iterdir()) == [file]
    assert len(file.read_bytes()) == len(whole)


def test_where_nothing_can_be_written_one_warning_says_so_and_the_run_goes_on(tmp_path):
    (tmp_path / "file").write_text("")
    keep_traces(tmp_path / "file" / "traced")
    try:
        with pytest.warns(UserWarning, match="traced programs are not kept from here on"):
            assert found(quaternion_to_matrix, Q)().shape == (3, 3)
        assert found(repeated, Q, 1, static_argnames="times") is None
    finally:
        keep_traces(None)


def test_what_may_be_read_but_not_touched_is_used(folder, traced, monkeypatch):
    found(quaternion_to_matrix, Q)()
    monkeypatch.setattr(kept_traces.os, "utime", Mock(side_effect=PermissionError))
    found(quaternion_to_matrix, Q)()
    assert len(traced) == 1


def test_what_was_not_read_for_longest_makes_room(folder, monkeypatch):
    for count in (1, 2, 3):
        found(repeated, np.stack([Q] * count))()
        for age, file in enumerate(sorted(folder.iterdir(), key=lambda file: -file.stat().st_mtime_ns)):
            os.utime(file, (1e9 - age, 1e9 - age))
    oldest = min(folder.iterdir(), key=lambda file: file.stat().st_mtime)
    monkeypatch.setattr(kept_traces, "MEGABYTES", 2.5 * oldest.stat().st_size / 1e6)
    found(repeated, Q[None])()  # of the oldest file, which is the newest now
    found(repeated, Q)()
    assert oldest in list(folder.iterdir())
    assert len(list(folder.iterdir())) == 2


def test_the_empty_state_of_people_has_definite_types():
    """Or the first frame's program would be compiled for itself."""
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(nobody(PeopleConfig())))


TWO_DEVICES = """
import sys
from pathlib import Path
from types import ModuleType

import jax
import numpy as np

jax.config.update("jax_num_cpu_devices", 2)
from jaxfilters._xla.compiled_quickly import compiled_fully
from jaxfilters._xla.kept_traces import keep_traces
from jaxfilters.models.rendering.placement import share_poses

def squared(poses, factor):
    return share_poses(lambda poses, factor: factor * poses**2, poses, factor)

imagined = sys.modules["jaxfilters.imagined"] = ModuleType("jaxfilters.imagined")
squared.__module__, imagined.squared = imagined.__name__, squared
poses = np.arange(5, dtype=np.float32)
expected = jax.jit(squared)(poses, np.float32(3.0))
keep_traces(Path(sys.argv[1]))
program = compiled_fully(squared)
first = program(poses, np.float32(3.0))
again = program(first, jax.device_put(np.float32(3.0), jax.devices()[1]))
assert first.sharding.device_set == again.sharding.device_set == set(jax.devices())
np.testing.assert_array_equal(first, expected)
np.testing.assert_array_equal(again, 3 * np.square(expected))
print(*[file.name.partition("-")[0] for file in Path(sys.argv[1]).iterdir()])
"""


@pytest.mark.system
def test_programs_for_two_devices_run_on_both(tmp_path):
    for _ in range(2):
        arguments = [sys.executable, "-c", TWO_DEVICES, str(tmp_path / "traced")]
        done = subprocess.run(arguments, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "squared\n"
