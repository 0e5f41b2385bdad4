"""The one run of sessions over images, by a session of a few lines: resumed, interrupted, with gaps, without images."""

import argparse
import errno
import os
import tracemalloc
from contextlib import closing
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import pytest

from jaxfilters.trackers.app import results, stream
from jaxfilters.trackers.app.output_folder import OutputFolder
from jaxfilters.trackers.app.results import Columns, TrackTable
from jaxfilters.trackers.app.stream import StreamRun, StreamSpec
from jaxfilters.trackers.io.errors import CheckpointError, InputError, OutputError
from jaxfilters.trackers.io.video_input import FrameSet

FRAMES = 40


class Track(NamedTuple):
    """Two objects from the third frame on."""

    frame: np.ndarray
    times_s: np.ndarray
    identity: np.ndarray
    total: np.ndarray
    status: np.ndarray


TABLE = TrackTable(Track, (Columns(("id",), attrgetter("identity")), Columns(("total_m",), attrgetter("total"))))


class Source:
    """Images that are numbers."""

    name, fps, image_size = "numbers", 10.0, (64, 48)

    def sample(self, most):
        return []

    def images(self):
        return iter(())

    def trouble(self):
        return None

    def __init__(self, frames=FRAMES, broken=None):
        self.frames, self._broken = frames, broken

    def moments(self):
        for i in range(self.frames):
            if i == self._broken:
                raise InputError("numbers: image cannot be read.")
            yield FrameSet(i / self.fps, (None if i == 7 else np.array(i),))


class LiveSource(Source):
    """The same, and none of them comes twice."""

    is_live = True


class Sums:
    """Adds what it is shown up; the second object comes with its frame before, like a person who is confirmed late."""

    status = "adding"

    def __init__(self, chunk=2):
        self.frames, self.sum, self.stop_at, self._chunk = 0, 0.0, None, chunk

    def is_due(self, waiting):
        return len(waiting) == self._chunk

    def process(self, moments):
        if self.stop_at is not None and self.frames >= self.stop_at[0]:
            raise self.stop_at[1]
        rows = []
        for moment in moments:
            (image,) = moment.images
            self.sum += 0.1 * (0.0 if image is None else float(image))
            if self.frames >= 3:
                rows += [
                    (self.frames, moment.time_s, 0, self.sum, 1),
                    (self.frames - 1, moment.time_s, 1, -self.sum, 2),
                ]
            self.frames += 1
        columns = np.asarray(rows, float).reshape(-1, 5).T
        return Track(*(c.astype(int) if i in (0, 2, 4) else c for i, c in enumerate(columns)))

    def pictures(self, moments, rows):
        return [np.full((48, 64, 3), self.frames % 255, np.uint8) for _ in moments]

    def saved(self):
        return {"frames": self.frames, "sum": self.sum}

    def restore(self, saved, rows):
        self.frames, self.sum = saved["frames"], saved["sum"]
        self.restored = rows


def options(out, **changes):
    given = {"out": out, "resume": False, "overwrite": False, "video": False, "seconds": None, "rerun": None}
    return argparse.Namespace(**given | changes)


def follow(out, source=None, session=None, **changes):
    source, session = source or Source(), session or Sums()
    spec = StreamSpec([source], source.moments(), list, session, TABLE, {"input": "numbers"}, source.frames)
    with closing(StreamRun(options(out, **changes), spec)) as run:
        result = run.follow()
        run.writer.finish({"frames": run.writer.frames})
        run.conclude(result, "The summary")
    return result


def table(out):
    return (out / "track.csv").read_bytes()


@pytest.fixture
def often(monkeypatch):
    """A checkpoint whenever something was processed."""
    monkeypatch.setattr(stream, "CHECKPOINT_EVERY_S", 0.0)


@pytest.fixture
def whole(tmp_path):
    follow(tmp_path / "whole")
    return tmp_path / "whole"


def test_rows_of_several_objects_are_in_the_table_and_the_arrays(whole):
    lines = table(whole).decode().splitlines()
    assert lines[:3] == ["frame,time_s,id,total_m,status", "3,0.300000,0,0.6,tracking", "2,0.300000,1,-0.6,lost"]
    assert len(lines) == 1 + 2 * (FRAMES - 3)
    with np.load(whole / "track.npz") as arrays:
        assert set(arrays) == set(Track._fields)
        expected = 0.1 * (sum(range(FRAMES)) - 7)
        np.testing.assert_allclose(arrays["total"][-2:], [expected, -expected])


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("stop", [0, 2, 20, 38])
def test_a_run_that_an_error_ended_goes_on_bit_for_bit(stop, whole, tmp_path):
    session = Sums()
    session.stop_at = stop, RuntimeError("killed")
    with pytest.raises(RuntimeError, match="killed"):
        follow(tmp_path / "out", session=session)
    again = Sums()
    follow(tmp_path / "out", session=again, resume=True)
    assert table(tmp_path / "out") == table(whole)
    if stop:
        assert len(again.restored.frame) == 2 * max(stop - 3, 0)
    with pytest.raises(OutputError, match="holds the track of another run"):
        follow(tmp_path / "out")


@pytest.mark.usefixtures("often")
def test_ctrl_c_keeps_what_is_done_and_the_run_can_go_on(whole, tmp_path):
    session = Sums()
    session.stop_at = 10, KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt, match=r"the first 10 frames are kept in [^\n]*\nThe summary"):
        follow(tmp_path / "out", session=session, video=True)
    assert len(table(tmp_path / "out").splitlines()) == 1 + 2 * 7
    assert (tmp_path / "out" / "track.npz").exists()
    assert (tmp_path / "out" / "overlay.mp4").exists()
    follow(tmp_path / "out", resume=True)
    assert table(tmp_path / "out") == table(whole)


def test_an_image_that_cannot_be_read_ends_the_run_with_what_was_done(whole, tmp_path):
    with pytest.raises(InputError, match=r"image cannot be read; the first 25 frames are in .*track.csv"):
        follow(tmp_path / "out", Source(broken=25))
    assert table(whole).startswith(table(tmp_path / "out"))
    assert len(table(tmp_path / "out").splitlines()) == 1 + 2 * 22


def test_without_images_there_are_no_results(tmp_path):
    with pytest.raises(InputError, match="the sources hold no images"):
        follow(tmp_path / "out", Source(0))
    assert not (tmp_path / "out" / "track.csv").exists()
    follow(tmp_path / "out", Source(10))
    session = Sums()
    session.stop_at = 0, KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt, match="nothing was kept"):
        follow(tmp_path / "other", session=session)


@pytest.mark.usefixtures("often")
def test_a_live_source_is_not_skipped_ahead_and_its_time_goes_on(tmp_path):
    session = Sums()
    session.stop_at = 10, RuntimeError("killed")
    with pytest.raises(RuntimeError, match="killed"):
        follow(tmp_path / "out", LiveSource(), session)
    follow(tmp_path / "out", LiveSource(6), resume=True)
    with np.load(tmp_path / "out" / "track.npz") as arrays:
        assert arrays["frame"].max() == 15
        np.testing.assert_allclose(np.unique(arrays["times_s"]), np.arange(3, 16) / 10)


@pytest.mark.usefixtures("often")
def test_a_full_disk_is_named_with_what_is_kept(whole, tmp_path, monkeypatch):
    written = results.checkpoint.write_npz

    def full(path, arrays):
        if path.name == "rows_00000010.npz":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written(path, arrays)

    with monkeypatch.context() as patch:
        patch.setattr(results.checkpoint, "write_npz", full)
        with pytest.raises(
            OutputError, match=r"no space left on the device; the first 10 frames are kept in .*--resume"
        ):
            follow(tmp_path / "out")
    follow(tmp_path / "out", resume=True)
    assert table(tmp_path / "out") == table(whole)


@pytest.mark.usefixtures("often")
def test_a_damaged_or_foreign_checkpoint_is_refused(tmp_path):
    follow(tmp_path / "out", Source(10))
    part = tmp_path / "out" / "checkpoint" / "rows_00000000.npz"
    saved = dict(np.load(part))
    for changes, message in (
        ({"more": np.zeros(3)}, "arrays of another tracker"),
        ({"total": saved["total"][:-1]}, "expected rows of 10 frames in all arrays"),
        ({"num_frames": np.asarray(11)}, "expected at most 10 frames; got 11"),
    ):
        np.savez(part, **saved | changes)
        with pytest.raises(CheckpointError, match=message):
            follow(tmp_path / "out", resume=True)
    np.savez(part, **saved)
    follow(tmp_path / "out", resume=True)


@pytest.mark.usefixtures("often")
def test_neither_memory_nor_checkpoints_grow_with_the_length_of_a_run(tmp_path, monkeypatch):
    """Bytes that a checkpoint writes at frame 5,000 are those at frame 500, and memory does not follow the frames."""
    sizes, peaks, written = [], [], results.checkpoint.write_npz

    def counted(path, arrays):
        written(path, arrays)
        sizes.append(path.stat().st_size)
        peaks.append(tracemalloc.get_traced_memory()[0])

    monkeypatch.setattr(os, "fsync", lambda file: None)
    monkeypatch.setattr(results.checkpoint, "write_npz", counted)
    source, session = Source(5000), Sums(50)
    spec = StreamSpec([source], source.moments(), list, session, TABLE, {}, None)
    tracemalloc.start()
    with closing(StreamRun(options(tmp_path / "out"), spec)) as run:
        run.follow()
    tracemalloc.stop()
    assert len(sizes) == 2 * 100 + 1
    assert max(sizes[-20:]) <= 1.01 * max(sizes[20:40])
    # The rows of the frames between take 400 kB.
    assert peaks[-1] - peaks[30] < 150_000


def test_only_a_new_run_reads_ahead_and_holds_its_folder_meanwhile(tmp_path):
    """Two runs that begin at once would read the same recordings, and one of them for nothing."""

    def prime():
        with pytest.raises(OutputError, match="another run writes into it"):
            OutputFolder(tmp_path)
        raise InputError("numbers: cannot be read ahead.")

    def run(**changes):
        source = Source(10)
        return StreamRun(options(tmp_path, **changes), StreamSpec([source], source.moments(), list, Sums(), *rest))

    rest = (TABLE, {"input": "numbers"}, None, prime)
    with pytest.raises(InputError, match="cannot be read ahead"):
        run()
    assert not (tmp_path / "track.csv").exists()
    follow(tmp_path, Source(10))
    run(resume=True).close()
