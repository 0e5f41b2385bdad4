import os
import subprocess
import sys

import jax
import pytest

from jaxfilters.trackers.app import cli, compiled, devices

RUN = """
from pathlib import Path

import jax
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters._xla.kept_traces import traces_are_kept
from jaxfilters.math.lie import quaternion_to_matrix
from jaxfilters.trackers.app import compiled

found = []
jax.monitoring.register_event_listener(lambda event, **_: found.append(event))
compiled.SECONDS_TO_COMPILE = 0
compiled.keep_compiled_programs()
jax.jit(lambda x: x + 1)(1.0)
compiled_quickly(quaternion_to_matrix)(jax.numpy.ones(4))
folder = Path(str(jax.config.jax_compilation_cache_dir)) / "traced"
assert len(list(folder.glob("quaternion_to_matrix-*"))) == traces_are_kept(), folder
print("/jax/compilation_cache/cache_hits" in found, jax.config.jax_compilation_cache_dir)
"""

SETTINGS = ("compilation_cache_dir", "persistent_cache_min_compile_time_secs", "compilation_cache_max_size")


@pytest.fixture
def no_folder(monkeypatch):
    """JAX as it is without a folder for programs, and as it was before afterwards."""
    before = {f"jax_{name}": getattr(jax.config, f"jax_{name}") for name in SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def no_look(path):
    if "compiled" in path.parts:
        raise PermissionError(13, "Permission denied", str(path))
    return os.path.exists(path)


def run_with(cache, **more):
    inherited = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    environment = {**inherited, "XDG_CACHE_HOME": str(cache), "HOME": str(cache), **more}
    done = subprocess.run([sys.executable, "-c", RUN], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    hit, folder = done.stdout.split()
    return hit == "True", folder


@pytest.mark.system
def test_the_second_run_finds_what_the_first_has_compiled(tmp_path):
    hit, folder = run_with(tmp_path)
    assert not hit
    assert folder.startswith(str(tmp_path))
    assert run_with(tmp_path) == (True, folder)


@pytest.mark.system
def test_a_folder_that_the_user_chose_is_left_alone(tmp_path):
    mine = str(tmp_path / "mine")
    for hit in (False, True):
        assert run_with(tmp_path / "cache", JAX_COMPILATION_CACHE_DIR=mine) == (hit, mine)
    assert run_with(tmp_path / "cache", JAX_ENABLE_COMPILATION_CACHE="0") == (False, "None")
    assert not (tmp_path / "cache").exists()


@pytest.mark.system
def test_the_user_may_choose_which_programs_are_kept(tmp_path):
    for _ in range(2):
        assert not run_with(tmp_path, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="100")[0]


def test_a_folder_that_cannot_be_written_is_said(no_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(compiled.platformdirs, "user_cache_path", lambda _: tmp_path)
    # Root may write everywhere; whoever has another user's home may not even look.
    monkeypatch.setattr(compiled.os, "access", lambda *_: False)
    monkeypatch.setattr(type(tmp_path), "exists", no_look)
    assert str(tmp_path / "compiled") in compiled.keep_compiled_programs()
    assert jax.config.jax_compilation_cache_dir is None


def test_machines_that_cannot_run_each_others_programs_have_folders_of_their_own(tmp_path, monkeypatch):
    files = []
    for flags in ("fpu avx2", "fpu avx2 avx512f"):
        (tmp_path / "cpuinfo").write_text(f"model name\t: Same\nflags\t\t: {flags}\n")
        monkeypatch.setattr(devices, "Path", lambda _: tmp_path / "cpuinfo")
        files.append(compiled._instruction_set())
    assert files[0] != files[1]


@pytest.mark.parametrize(("arguments", "kept"), [(["demo"], True), (["bench", "render"], False)])
def test_the_command_keeps_programs_but_where_speed_is_measured(arguments, kept, monkeypatch, capsys):
    monkeypatch.setattr(cli, "keep_compiled_programs", lambda: "no room")
    monkeypatch.setattr(cli, "keep_freed_memory", lambda: None)
    monkeypatch.setattr(cli, "collect_rarely", lambda: None)
    monkeypatch.setattr(cli, "main", lambda: 7)
    monkeypatch.setattr(sys, "argv", ["jaxfilters", *arguments])
    assert cli.command() == 7
    assert capsys.readouterr().err == "jaxfilters: no room.\n" * kept


@pytest.mark.system
def test_the_large_program_of_a_tracker_is_kept_and_found(tmp_path):
    """Programs that cannot be kept run as well: without this nobody would notice."""
    run = [sys.executable, "-c", "from jaxfilters.trackers.app.cli import command; command()", "track", "articulated"]
    environment = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    environment |= {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"), "JAX_ENABLE_COMPILATION_CACHE": "1"}
    kept = []
    for i in range(2):
        command = [*run, "--no-video", "--out", str(tmp_path / str(i))]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        kept.append({file.name: file.stat().st_size for file in (tmp_path / "cache" / "traced").iterdir()})
    assert kept[0] == kept[1]
    assert [size > 10_000 for name, size in kept[0].items() if name.startswith("_scan-")] == [True]
