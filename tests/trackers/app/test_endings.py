"""How every command of the registry ends before its time: a folder in use, a signal, an interrupted run."""

import os
import signal
from contextlib import closing

import pytest

from jaxfilters.trackers.app import endings
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.output_folder import OutputFolder
from jaxfilters.trackers.app.progress import ProgressLine
from jaxfilters.trackers.io.errors import OutputError
from jaxfilters.trackers.registry import SYSTEMS, system


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


@pytest.mark.parametrize("name", [one.name for one in SYSTEMS])
def test_a_folder_that_another_run_writes_into_is_refused(name, tmp_path, capsys):
    with closing(OutputFolder(tmp_path / "out")):
        assert main(["track", name, "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line == f"jaxfilters: error: {tmp_path / 'out'}: another run writes into it; choose another --out."


def test_a_folder_is_free_once_its_run_is_over(tmp_path):
    with closing(OutputFolder(tmp_path)), pytest.raises(OutputError, match="another run"):
        OutputFolder(tmp_path)
    OutputFolder(tmp_path).close()
    assert not list(tmp_path.iterdir())


@pytest.mark.system
@pytest.mark.usefixtures("fake_hand_depth")
def test_sigterm_keeps_what_is_done_and_the_run_can_be_resumed(tmp_path, monkeypatch, capsys, png_folder):
    show = ProgressLine.show

    def show_and_terminate(self, done, note=""):
        show(self, done, note)
        if done >= 20:
            os.kill(os.getpid(), signal.SIGTERM)

    arguments = ["track", "hand-depth", str(png_folder), "--no-video"]
    with monkeypatch.context() as patch:
        patch.setattr(ProgressLine, "show", show_and_terminate)
        assert main([*arguments, "--out", str(tmp_path / "out")]) == 143
    assert "terminated; the first 16 frames are kept" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert main([*arguments, "--out", str(tmp_path / "out"), "--resume"]) == 0
    assert main([*arguments, "--out", str(tmp_path / "whole")]) == 0
    for name in ("track.csv", "summary.png"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_an_unforeseen_error_is_told_in_one_line_wherever_its_report_can_be_written(tmp_path):
    error = ValueError("first\nsecond" + 1000 * "x")
    beside = endings.unforeseen(error, tmp_path)
    assert beside == f"unforeseen ValueError: first; please report it with {tmp_path / 'error.txt'}."
    assert "second" in (tmp_path / "error.txt").read_text()
    elsewhere = endings.unforeseen(error, tmp_path / "missing" / "out")
    assert elsewhere.startswith("unforeseen ValueError: first; please report it with ")


def test_an_unknown_system_is_named():
    with pytest.raises(ValueError, match=r"name: expected one of hand-depth, .*; got 'feet'"):
        system("feet")
