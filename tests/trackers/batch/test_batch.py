"""The command: a process that is killed loses nothing, and what is wrong is in the report."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.batch import command

TRACKER = """
import json, os, pathlib, signal, sys
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
out.mkdir(exist_ok=True)
starts = out / "starts"
starts.write_text(starts.read_text() + "x" if starts.exists() else "x")
if out.name == "crashes" or out.name == "once" and starts.read_text() == "x":
    os.kill(os.getpid(), signal.SIGKILL)
if out.name == "wrong":
    sys.exit("something\\njaxfilters: error: no such file.\\n")
report = {"frames": 7, "frames_per_second": None, "input": sys.argv[3], "folder": os.getcwd()}
(out / "report.json").write_text(json.dumps(report))
"""
"""In place of a tracker: one that is killed by want of memory, once or always, or has no input."""


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"])


@pytest.fixture
def run(tmp_path, monkeypatch):
    """`run(names, *options)`: the exit code of a batch of recordings with the tracker above, in `tmp_path/out`."""
    script = tmp_path / "tracker.py"
    script.write_text(TRACKER)
    monkeypatch.setattr(command, "CHILD", (sys.executable, str(script)))
    monkeypatch.setattr(command, "POLL_S", 0.01)
    monkeypatch.setattr(command, "LOOK_S", 0.0)

    def started(names, *options, input="x.npz"):
        rows = [{"name": name, "tracker": "hand-depth", "input": input} for name in names]
        (tmp_path / "manifest.json").write_text(json.dumps(rows))
        return main(["batch", str(tmp_path / "manifest.json"), "--out", str(tmp_path / "out"), *options])

    return started


def report(folder):
    with (folder / "out" / "report.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    rows = json.loads((folder / "out" / "report.json").read_text())
    assert [row["name"] for row in table] == [row["name"] for row in rows]
    return {row.pop("name"): row for row in rows}


def starts(folder, name):
    return len((folder / "out" / name / "starts").read_text())


def test_crashes_are_tried_again_and_errors_reported(run, tmp_path, capsys):
    assert run(["good", "once", "crashes", "wrong"], "--processes", "2") == 2
    found = report(tmp_path)
    assert {name: (row["status"], row["attempts"]) for name, row in found.items()} == {
        "good": ("done", 1),
        "once": ("done", 2),
        "crashes": ("failed", 3),
        "wrong": ("failed", 1),
    }
    assert found["good"]["frames"] == 7
    assert found["wrong"]["error"] == "no such file."
    assert "ended 3 times without a result" in found["crashes"]["error"]
    assert "2 of 4 recordings failed, first crashes: its process ended" in capsys.readouterr().err
    inner = json.loads((tmp_path / "out" / "good" / "report.json").read_text())
    assert (inner["input"], inner["folder"]) == ("x.npz", str(tmp_path))


def test_the_same_command_does_nothing_twice_unless_asked(run, tmp_path, capsys):
    assert run(["good"]) == run(["good", "more"]) == 0
    assert [starts(tmp_path, name) for name in ("good", "more")] == [1, 1]
    assert run(["crashes", "good"]) == run(["crashes", "good"]) == 2
    assert [starts(tmp_path, name) for name in ("good", "crashes")] == [1, 3]
    assert run(["crashes", "good"], "--retry") == 2
    assert [starts(tmp_path, name) for name in ("good", "crashes")] == [1, 6]
    capsys.readouterr()
    assert run(["good"], input="y.npz") == 2
    assert "good: " in (error := capsys.readouterr().err)
    assert "another tracker, input or options" in error


def test_a_command_that_does_not_wait_leaves_the_recordings_of_others_to_them(run, tmp_path):
    assert run(["good"]) == 0
    with (tmp_path / "out" / ".batch" / "claims" / "more.0").open("x") as file:
        json.dump({"machine": "another", "pid": 1, "state": "held"}, file)
    assert run(["good", "more"], "--no-wait") == 0
    assert report(tmp_path)["more"]["status"] == "waiting"
    assert run(["good", "more"], "--stale", "0.2") == 0
    assert report(tmp_path)["more"]["attempts"] == 2


def until(condition, process):
    while not (found := condition()):
        assert process.poll() is None
        time.sleep(0.02)
    return found


@pytest.mark.system
def test_a_second_command_finishes_what_a_killed_one_began(tmp_path):
    """Two at once; the first is killed between two frames of a recording, of which the second has the rest."""
    rows = [{"name": name, "tracker": "fingertips", "options": "--no-video --seconds 4"} for name in "ab"]
    (tmp_path / "manifest.json").write_text(json.dumps(rows))
    out, claims = tmp_path / "out", tmp_path / "out" / ".batch" / "claims"
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    cache = {"JAX_COMPILATION_CACHE_DIR": folder, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1"}
    words = [sys.executable, "-m", "jaxfilters.trackers.app.cli", "batch", tmp_path / "manifest.json", "--out", out]
    first, second = (subprocess.Popen(words, env=os.environ | cache) for _ in range(2))

    def half_done():
        held = [
            path.name[0] for path in claims.glob("?.0") if json.loads(path.read_text() or "{}").get("pid") == first.pid
        ]
        begun = [name for name in held if (out / name / "checkpoint" / "state.npz").exists()]
        return next((name for name in begun if not (out / ".batch" / "results" / f"{name}.json").exists()), None)

    try:
        name = until(half_done, first)
        first.send_signal(signal.SIGKILL)
        assert second.wait(300) == 0
    finally:
        for process in (first, second):
            process.kill()
            process.wait()
    rows = json.loads((out / "report.json").read_text())
    assert {row["name"]: (row["status"], row["attempts"]) for row in rows} == {
        other: ("done", 1 + (other == name)) for other in "ab"
    }
    assert len({(out / other / "track.csv").read_bytes() for other in "ab"}) == 1
    assert "continuing after frame" in (out / ".batch" / "logs" / f"{name}.txt").read_text()
