"""How every command of the registry ends before its time: a folder in use, a signal, an interrupted run."""

import functools
import os
import signal
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import pytest

from jaxfilters.trackers.app import cli, endings
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.output_folder import OutputFolder, check_file, check_free
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


def test_the_report_of_an_error_holds_bytes_that_are_no_text(tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    endings.unforeseen(ValueError("\udcff.png"), path)
    assert "udcff.png" in (path / "error.txt").read_text()


def test_an_unforeseen_error_is_one_line_where_the_folder_has_an_impossible_name(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    line = endings.unforeseen(ValueError("first"), tmp_path / ("n" * 3000))
    assert line == f"unforeseen ValueError: first; please report it with {tmp_path / 'error.txt'}."


NOWHERE = "/proc/nowhere"
"""Where nobody can make a file, also not the superuser, to whom all permissions are granted."""
COMMANDS = {
    "demo": "demo --out {}",
    **{one.name: f"track {one.name} --out {{}}" for one in SYSTEMS},
    "batch": "batch manifest.csv --out {}",
    "recognise": "recognise default --out {}/a.csv",
    "calibrate points": "calibrate points a.csv --image-size 9x9 --out {}/a.json",
    "calibrate stereo": "calibrate stereo a b --squares 7x5 --square-m 0.1 --marker-m 0.05 --out {}/a.json",
    "fit noise": "fit noise --out {}/a.json",
    "fit gestures": "fit gestures --out {}/a.npz",
    "fit face-model": "fit face-model --out {}/a.npz",
    "fit face-model --remember": "fit face-model --out a.npz --remember {}/a.npz",
    "fit face-detector": "fit face-detector a --out {}/a.npz",
    "view": "view a --out {}/a.html",
}


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system without files of one's own")
@pytest.mark.parametrize("name", COMMANDS)
def test_results_that_cannot_be_written_are_refused_before_the_command_is_imported(name, monkeypatch, capsys):
    monkeypatch.setattr(cli, "_command_of", lambda options: pytest.fail("it was started"))
    assert main(COMMANDS[name].format(NOWHERE).split()) == 2
    line = capsys.readouterr().err
    assert line.startswith("jaxfilters: error: cannot write ")
    assert line.endswith(": no files can be made in /proc.\n")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path / ("n" * 3000), "File name too long"),
        (lambda path: path / "file" / "below", "file is not a folder"),
        (lambda path: path / "file", "file is not a folder"),
    ],
)
def test_why_a_folder_cannot_be_made_is_said_and_nothing_is_left(tmp_path, make, message):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(OutputError, match=message):
        check_free(make(tmp_path))
    assert [path.read_text() for path in tmp_path.iterdir()] == ["kept"]


def test_a_file_that_can_be_written_is_neither_made_nor_changed(tmp_path):
    check_file(tmp_path / "new" / "a.json")
    check_free(tmp_path / "new" / "run")
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.json").write_text("kept")
    check_file(tmp_path / "a.json")
    assert (tmp_path / "a.json").read_text() == "kept"
    with pytest.raises(OutputError, match="it is a folder"):
        check_file(tmp_path)
    with pytest.raises(OutputError, match=r"a\.json is not a folder"):
        check_file(tmp_path / "a.json" / "b.json")
    os.mkfifo(tmp_path / "pipe")
    check_file(tmp_path / "pipe")


@pytest.mark.system
def test_decoders_write_nothing_beside_the_one_line_of_a_command(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"\x00\x00\x00\x18ftypmp42" + bytes(40))
    # Without compiled programs of other runs, which are read and written in the user's folders.
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "0"}
    command = [sys.executable, "-m", "jaxfilters.trackers.app.cli"]
    arguments = ["track", "fingertips", "a.mp4", "--out", "out"]
    run = functools.partial(subprocess.run, cwd=tmp_path, env=environment, capture_output=True, text=True)
    found = run([*command, *arguments])
    assert found.returncode == 2
    assert found.stderr.splitlines() == [
        "jaxfilters: error: a.mp4: not a video that can be decoded (damaged, empty, or an unknown codec)."
    ]
    assert len(run([*command, "--debug", *arguments]).stderr.splitlines()) > 1


def test_an_unknown_system_is_named():
    with pytest.raises(ValueError, match=r"name: expected one of hand-depth, .*; got 'feet'"):
        system("feet")
