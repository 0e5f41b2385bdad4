"""What every system of the registry keeps: it goes on after any end, and names what it cannot follow in one line."""

import csv
import json
import os
import random
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from jaxfilters.models.synthetic.hand import MOTIONS
from jaxfilters.trackers.app import stream
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.registry import SYSTEMS
from jaxfilters.trackers.tracker import STATUS_WORDS

OPTIONS = {
    **dict.fromkeys(("head-stereo", "head-mono", "fingertips"), ("--seconds", "1.5")),
    "people": ("--seconds", "3"),
    "hand-depth": ("--particles", "64"),
}
"""That shorten the synthetic recordings, or have the programs of other tests serve here."""
FILES = {"track.csv", "track.npz", "report.json", "summary.png", "checkpoint"}
"""Of every run; `overlay.mp4` is drawn unless `--no-video` is given."""
HAND_FRAMES, CHILD_HAND_FRAMES = 24, 64
"""Of the depth recording, which no option shortens: two chunks, and one for each end of a run and the last."""
CHILD = """
import os, resource, signal, sys, threading
from jaxfilters.models.synthetic.hand import MOTIONS
from jaxfilters.trackers.app import results, stream
from jaxfilters.trackers.app.cli import command

how, writes, seconds, frames = sys.argv.pop(1), int(sys.argv.pop(1)), float(sys.argv.pop(1)), int(sys.argv.pop(1))
MOTIONS["B"] = MOTIONS["B"]._replace(num_frames=frames)
stream.CHECKPOINT_EVERY_S = 0.0
append, done = results.TrackWriter.append_rows, []

def limit():
    size = os.path.getsize(os.path.join(sys.argv[sys.argv.index("--out") + 1], "track.csv"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 10, resource.RLIM_INFINITY))

ends = {
    "kill": lambda: threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start(),
    "interrupt": lambda: os.kill(os.getpid(), signal.SIGINT),
    "full": limit,
}

def append_and_end(self, *rows):
    append(self, *rows)
    done.append(rows)
    if len(done) == writes and how in ends:
        ends[how]()

results.TrackWriter.append_rows = append_and_end
sys.exit(command())
"""
"""A run that ends as its first argument says after so many writes of rows: killed some seconds later, interrupted, or
by files that may not grow any more, which is a full disk but for the word."""


def arguments(name, out):
    return ["track", name, "--out", str(out), "--no-video", *OPTIONS.get(name, ())]


def table(folder):
    return (folder / "track.csv").read_bytes()


class KilledRuns:
    """Copies of a folder of results as a killed process would leave it: around every file that is put in its place."""

    def __init__(self, folder, copies):
        self.folder, self.copies, self.taken = folder, copies, []

    def replace(self, source, target):
        self.copy()
        os.rename(source, target)
        self.copy()

    def copy(self):
        if checkpoint.state_path(self.folder).exists():
            self.taken.append(self.copies / str(len(self.taken)))
            shutil.copytree(self.folder, self.taken[-1])


def check_results(folder):
    """The same files for all systems, numbers with units and standard deviations, and the words of `status`."""
    assert {file.name for file in folder.iterdir()} >= FILES
    with (folder / "track.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:2] == ["frame", "time_s"]
    assert {row["status"] for row in rows} <= set(STATUS_WORDS)
    places = [name for name in rows[0] if re.search(r"(^|_)[xyz]_(m|px)$", name)]
    assert places
    for name in places:
        stem, _, unit = name.rpartition("_")
        assert f"{stem}_std_{unit}" in rows[0], name
    with np.load(folder / "track.npz") as arrays:
        assert len(arrays["times_s"]) == len(arrays["status"]) == len(rows)
        np.testing.assert_allclose(arrays["times_s"], [float(row["time_s"]) for row in rows], atol=1e-6)
    report = json.loads((folder / "report.json").read_text())
    assert {"input", "frames", "frames_per_second", "config", "versions"} <= set(report)


@pytest.mark.system
@pytest.mark.parametrize("name", [system.name for system in SYSTEMS])
def test_what_a_killed_run_leaves_gives_the_table_of_a_whole_one(name, tmp_path, monkeypatch, capsys):
    """Its synthetic recording, once; continued from what lay in the folder at a random moment before the end."""
    monkeypatch.setenv("XLA_FLAGS", "")  # `main` sets it
    monkeypatch.setitem(MOTIONS, "B", MOTIONS["B"]._replace(num_frames=HAND_FRAMES))
    monkeypatch.setattr(stream, "CHECKPOINT_EVERY_S", 0.0)
    whole = tmp_path / "whole"
    killed = KilledRuns(whole, tmp_path / "copies")
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.os, "replace", killed.replace)
        assert main(arguments(name, whole)) == 0
    check_results(whole)
    unfinished = [out for out in killed.taken if table(out) != table(whole)]
    out = random.Random(name).choice(unfinished)
    capsys.readouterr()
    assert main([*arguments(name, out), "--resume"]) == 0
    assert "continuing after frame" in capsys.readouterr().err
    assert table(out) == table(whole)


FIRST_ROWS = {"people": 12, "fingertips": 12}
"""Writes after which there are rows; people and fingertips have none until they are confirmed."""


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """Runs a command in a process of its own, with the compiled programs of the others."""
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled")),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }

    def process(arguments, how="", writes=0, seconds=0.0):
        command = [sys.executable, "-c", CHILD, how, str(writes), f"{seconds:.4f}", str(CHILD_HAND_FRAMES), *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True)

    return process


@pytest.mark.system
@pytest.mark.parametrize("name", [system.name for system in SYSTEMS])
def test_ctrl_c_a_full_disk_and_kill_9_in_one_run_leave_the_rows_of_a_whole_one(name, tmp_path, run):
    """Each ends the run that goes on after the one before, the last at a moment drawn with a fixed seed."""
    seconds, out = random.Random(name).uniform(0.0, 0.02), tmp_path / "out"
    assert run(arguments(name, tmp_path / "whole")).returncode == 0

    interrupted = run(arguments(name, out), "interrupt", FIRST_ROWS.get(name, 2))
    assert interrupted.returncode == 130, interrupted.stderr
    assert re.search(r"interrupted; the first \d+ frames are kept in ", interrupted.stderr)
    assert len(table(out).splitlines()) > 1
    resumed = [*arguments(name, out), "--resume"]

    full = run(resumed, "full", 1)
    assert full.returncode == 2, full.stderr
    assert full.stderr.splitlines()[-1].startswith("jaxfilters: error: cannot write ")
    assert "are kept in" in full.stderr
    assert "Traceback" not in full.stderr

    killed = run(resumed, "kill", 1, seconds)
    assert killed.returncode == -9, killed.stderr
    last = run(resumed)
    assert last.returncode == 0, last.stderr
    assert "continuing after frame" in last.stderr
    assert table(out) == table(tmp_path / "whole")
    check_results(out)


EMPTY = {
    "people": ("--camera", "{0}/camera.json", "--scene", "{0}/scene.json"),
    "head-stereo": ("--camera", "{0}/camera.json"),
}
"""Options that a command needs beside its recording."""


@pytest.mark.parametrize("name", [system.name for system in SYSTEMS])
def test_an_empty_recording_ends_in_one_line_and_leaves_no_table(name, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XLA_FLAGS", "")
    (tmp_path / "empty").mkdir()
    given = [one.format(tmp_path) for one in EMPTY.get(name, ())]
    out = tmp_path / "out"
    assert main(["track", name, str(tmp_path / "empty"), *given, "--out", str(out)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("jaxfilters: error: ")
    assert "empty" in lines[0]
    assert not (out / "track.csv").exists()
