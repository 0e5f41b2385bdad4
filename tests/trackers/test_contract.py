"""What every system of the registry keeps as a process: killed at any moment it goes on, and it shares no folder."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest

from jaxfilters.trackers.registry import SYSTEMS

TABLES = {"people": "tracks.csv", "fingertips": "tips.csv"}
"""Of the systems whose table is not `track.csv`."""
OPTIONS = {"head-stereo": ("--seconds", "6"), "head-mono": ("--seconds", "8"), "people": ("--seconds", "6")}
"""That shorten the synthetic recordings, in seconds of the recording."""


def started(name, out, *options):
    command = [sys.executable, "-m", "jaxfilters.trackers.app.cli", "track", name, "--out", str(out), "--no-video"]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(
        [*command, *OPTIONS.get(name, ()), *options], env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    )


def finished(name, out, *options):
    with started(name, out, *options) as process:
        _, error = process.communicate(timeout=600)
    assert process.returncode == 0, error.decode()
    return error.decode()


def wait_for(path, process):
    while process.poll() is None and not path.exists():
        time.sleep(0.02)


@pytest.mark.system
@pytest.mark.parametrize("name", [system.name for system in SYSTEMS])
def test_a_run_that_was_killed_at_any_moment_gives_the_table_of_one_that_was_not(name, tmp_path):
    """Its synthetic recording, SIGKILL up to a second after the first checkpoint; meanwhile nobody else may write."""
    whole, out = tmp_path / "whole", tmp_path / "out"
    finished(name, whole)
    process = started(name, out)
    wait_for(out / ".lock", process)
    with started(name, out) as other:
        _, error = other.communicate(timeout=600)
    assert other.returncode == 2
    assert b"another run" in error
    wait_for(out / "checkpoint" / "state.npz", process)
    time.sleep(random.Random(name).random())
    assert process.poll() is None, "It was over before it could be killed."
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert "continuing after frame" in finished(name, out, "--resume")
    table = TABLES.get(name, "track.csv")
    assert (out / table).read_bytes() == (whole / table).read_bytes()
