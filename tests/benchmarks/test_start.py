"""First and second runs of the commands: which share a folder of compiled programs."""

import subprocess
import sys
from pathlib import Path

import pytest

from jaxfilters.benchmarks.scenarios import start
from jaxfilters.trackers.registry import SYSTEMS


def test_the_second_run_finds_what_the_first_one_compiled_and_no_other_round_does(monkeypatch):
    seconds = [30.0, 5.0, 50.0, 9.0, 40.0, 7.0]
    runs = []

    def spent(command, cache):
        assert not Path(command[-1]).exists()
        Path(cache).mkdir(exist_ok=True)
        # The first run of a round finds nothing, and leaves something for the second one.
        is_second = (Path(cache) / "program").exists()
        (Path(cache) / "program").touch()
        runs.append((command[-3], is_second))
        return seconds[(len(runs) - 1) % len(seconds)]

    monkeypatch.setattr(start, "_seconds", spent)
    found = start.run(quick=False, seed=0, out=None)
    names = [one.name for one in SYSTEMS]
    assert runs == [(name, is_second) for name in names for _ in range(start.ROUNDS) for is_second in (False, True)]
    expected = {"first": 40.0, "second": 7.0}
    assert {name: metric.value for name, metric in found.items()} == {
        f"{which}_run_s_{name.replace('-', '_')}": value for name in names for which, value in expected.items()
    }


def test_a_command_that_fails_is_named(monkeypatch):
    monkeypatch.setattr(start, "COMMAND", (sys.executable, "-S", "-c", "import sys; sys.exit('no disk')"))
    with pytest.raises(RuntimeError, match=r"articulated --out .*: no disk"):
        start.run(quick=True, seed=0, out=None)


def test_the_command_is_that_of_the_trackers():
    said = subprocess.run([*start.COMMAND, "articulated", "--help"], capture_output=True, text=True, check=True)
    assert said.stdout.startswith("usage: jaxfilters track articulated")
