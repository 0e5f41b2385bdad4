"""What every system of the registry keeps: killed at any moment it goes on, and it shares no folder."""

import os
import random
import shutil

import pytest

from jaxfilters.models.synthetic.hand import MOTIONS
from jaxfilters.trackers.app import stream
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.registry import SYSTEMS

OPTIONS = dict.fromkeys(("head-stereo", "head-mono", "people", "fingertips"), ("--seconds", "3"))
"""That shorten the synthetic recordings."""
HAND_FRAMES = 40
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
    unfinished = [out for out in killed.taken if table(out) != table(whole)]
    out = random.Random(name).choice(unfinished)
    capsys.readouterr()
    assert main([*arguments(name, out), "--resume"]) == 0
    assert "continuing after frame" in capsys.readouterr().err
    assert table(out) == table(whole)
