"""What every system of the registry keeps: killed at any moment it goes on, and it shares no folder."""

import csv
import json
import os
import random
import re
import shutil

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
HAND_FRAMES = 24
"""Of the depth recording, which no option shortens."""


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
