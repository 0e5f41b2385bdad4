import csv
import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxfilters.trackers.app import results
from jaxfilters.trackers.app.chunks import track_recording
from jaxfilters.trackers.app.results import begin, resume
from jaxfilters.trackers.hand_depth.table import HAND_TABLE
from jaxfilters.trackers.io.errors import CheckpointError, InputError, OutputError
from jaxfilters.trackers.tracker import CHUNK, STATUS_NAMES

COLUMNS = ("frame", "time_s", *HAND_TABLE.columns, "status")
RUN = {"input": "abc", "config.seed": 3}


def track(recording, tracker, folder, *, resumed=False, stop_after=None, on_progress=lambda progress: None):
    """Follow the recording into `folder`; `stop_after` presses Ctrl-C when that many frames are done."""
    if resumed:
        writer, state = resume(folder, RUN, HAND_TABLE)
    else:
        writer, state = begin(folder, RUN, HAND_TABLE), tracker.init(jax.random.key(3), recording[0])

    def report(progress):
        on_progress(progress)
        if stop_after is not None and progress.done >= stop_after:
            raise KeyboardInterrupt

    with closing(writer):
        track_recording(recording, tracker, state, writer, report)
        writer.finish({"frames": writer.frames})
    return writer


@pytest.mark.system
def test_rows_are_those_of_the_tracker_over_the_whole_recording(recording, fake_tracker, tmp_path):
    track(recording, fake_tracker, tmp_path)
    state = fake_tracker.init(jax.random.key(3), recording[0])
    times_s = (recording.times_s - recording.times_s[0]).astype(np.float32)
    _, expected = fake_tracker.step(state, np.stack(list(recording)), times_s)
    with np.load(tmp_path / "track.npz") as saved:
        for name, array in expected._asdict().items():
            np.testing.assert_array_equal(saved[name], array)
        np.testing.assert_array_equal(saved["times_s"], recording.times_s)


def test_the_table_has_a_row_a_frame_and_keeps_all_digits(recording, fake_tracker, tmp_path):
    writer = track(recording, fake_tracker, tmp_path)
    with (tmp_path / "track.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == COLUMNS
    assert len(COLUMNS) == len(set(COLUMNS)) == 2 + 22 + 21 + 3
    pose = np.asarray([[float(x) for x in row[2:24]] for row in rows], np.float32)
    np.testing.assert_array_equal(pose, writer.results.pose)
    assert [int(row[0]) for row in rows] == list(range(len(recording)))
    assert [row[-1] for row in rows] == [STATUS_NAMES[i] for i in writer.results.status]
    assert rows[5][2:] == ["nan"] * (len(COLUMNS) - 3) + ["searching"]
    np.testing.assert_allclose([float(row[1]) for row in rows], recording.times_s, atol=5e-7)


@pytest.mark.system
@pytest.mark.parametrize("stop_after", [1, CHUNK + 1, 2 * CHUNK + 1])
def test_interrupted_and_resumed_equals_uninterrupted(recording, fake_tracker, tmp_path, stop_after):
    track(recording, fake_tracker, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        track(recording, fake_tracker, tmp_path / "parts", stop_after=stop_after)
    resumed = results.can_resume(tmp_path / "parts")
    assert resumed == (stop_after > CHUNK)
    track(recording, fake_tracker, tmp_path / "parts", resumed=resumed)
    for name in ("track.csv", "report.json"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    with np.load(tmp_path / "parts" / "track.npz") as parts, np.load(tmp_path / "whole" / "track.npz") as whole:
        assert sorted(parts.files) == sorted(whole.files)
        for name in whole.files:
            np.testing.assert_array_equal(parts[name], whole[name])


def test_resuming_a_finished_run_computes_nothing(recording, fake_tracker, tmp_path):
    track(recording, fake_tracker, tmp_path)
    unused = fake_tracker._replace(step=lambda *_: pytest.fail("nothing was left to do"))
    assert track(recording, unused, tmp_path, resumed=True).frames == len(recording)


def test_a_finished_run_may_be_replaced(recording, fake_tracker, tmp_path):
    track(recording, fake_tracker, tmp_path)
    with closing(begin(tmp_path, RUN | {"config.seed": 4}, HAND_TABLE)) as writer:
        assert writer.frames == 0
    assert (tmp_path / "track.csv").read_text().count("\n") == 1


def test_another_run_cannot_be_resumed_or_overwritten(recording, fake_tracker, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        track(recording, fake_tracker, tmp_path, stop_after=CHUNK + 1)
    with pytest.raises(CheckpointError, match=r"cannot be resumed: config.seed was 3 and is 4\."):
        resume(tmp_path, RUN | {"config.seed": 4}, HAND_TABLE)
    with pytest.raises(CheckpointError, match=r"holds an unfinished run of 16 frames: continue it with --resume"):
        begin(tmp_path, RUN, HAND_TABLE)
    with closing(begin(tmp_path, RUN, HAND_TABLE, overwrite=True)) as writer:
        assert writer.frames == 0


def unreadable_at(recording, bad):
    def read(index):
        if index == bad:
            raise InputError(f"{index}.png: truncated.")
        return recording.read(index)

    return replace(recording, read=read)


@pytest.mark.system
@pytest.mark.parametrize(("bad", "saved"), [(5, 0), (CHUNK, CHUNK), (CHUNK + 5, CHUNK)])
def test_frames_before_an_unreadable_one_are_kept(recording, fake_tracker, tmp_path, bad, saved):
    track(recording, fake_tracker, tmp_path / "whole")
    writer = begin(tmp_path / "parts", RUN, HAND_TABLE)
    state = fake_tracker.init(jax.random.key(3), recording[0])
    with pytest.raises(InputError, match=rf"{bad}.png: truncated"):
        track_recording(unreadable_at(recording, bad), fake_tracker, state, writer, lambda progress: None)
    lines = (tmp_path / "parts" / "track.csv").read_text().splitlines()
    assert lines == (tmp_path / "whole" / "track.csv").read_text().splitlines()[: bad + 1]
    assert writer.frames_saved == saved
    assert str(saved or bad) in writer.kept()
    writer.close()
    if saved:
        track(recording, fake_tracker, tmp_path / "parts", resumed=True)
        assert (tmp_path / "parts" / "track.csv").read_bytes() == (tmp_path / "whole" / "track.csv").read_bytes()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_says_what_is_kept(recording, fake_tracker, tmp_path):
    def fill(progress):
        if progress.done == CHUNK:
            (tmp_path / "track.csv").unlink()
            (tmp_path / "track.csv").symlink_to("/dev/full")

    with pytest.raises(OutputError, match=r"track.csv: no space left on the device; the first 16 frames are kept in"):
        track(recording, fake_tracker, tmp_path, on_progress=fill)
    (tmp_path / "track.csv").unlink()
    assert track(recording, fake_tracker, tmp_path, resumed=True).frames == len(recording)


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"cannot write into .*file/out"):
        begin(tmp_path / "file" / "out", RUN, HAND_TABLE)


def test_progress_counts_up_and_measures_from_the_second_chunk(recording, fake_tracker, tmp_path):
    observed = []
    track(recording, fake_tracker, tmp_path, on_progress=observed.append)
    assert [progress.done for progress in observed] == [16, 32, 40]
    assert {progress.total for progress in observed} == {40}
    assert np.isnan(observed[0].frames_per_second)
    assert observed[1].frames_per_second > 0
    assert json.loads((tmp_path / "report.json").read_text()) == {"frames": 40}


def test_compiles_once_though_the_last_chunk_is_short(recording, fake_tracker, tmp_path):
    shapes = set()

    def step(state, frames, times):
        shapes.add((frames.shape, frames.dtype, times.shape, times.dtype))
        assert (np.diff(times) > 0).all()
        return fake_tracker.step(state, frames, times)

    track(recording, fake_tracker._replace(step=step), tmp_path)
    assert shapes == {((CHUNK, 24, 32), np.dtype(np.float32), (CHUNK,), np.dtype(np.float32))}
