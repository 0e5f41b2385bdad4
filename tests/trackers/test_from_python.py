"""Trackers called from Python: the same track as by the command, and errors. The pages in docs/ run all six."""

from importlib import import_module
from inspect import Parameter, signature

import jax
import numpy as np
import pytest

from jaxfilters.models.synthetic.hand import kinect_v2, simulate_sequence
from jaxfilters.trackers import articulated, hand_depth
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.fingertips.images import estimate_user
from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.registry import SYSTEMS
from jaxfilters.trackers.tracker import step_chunk, track_frames


def test_every_system_is_called_with_frames_times_cameras_and_a_configuration():
    for system in SYSTEMS:
        parameters = list(signature(import_module(system.package).track).parameters.values())[:4]
        assert [parameter.default is Parameter.empty for parameter in parameters[:2]] == [True, True], system.name
        assert parameters[1].name == "times_s", system.name
        assert (parameters[3].name, parameters[3].default) == ("config", None), system.name


@pytest.mark.usefixtures("fake_hand_depth")
def test_the_same_seed_gives_the_same_track_by_command_and_from_python(npz_file, tmp_path, monkeypatch, recording):
    monkeypatch.setenv("XLA_FLAGS", "")
    arguments = ["track", "hand-depth", str(npz_file), "--seed", "3", "--no-video", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    frames, config = list(recording), hand_depth.HandDepthConfig(seed=3)
    found = hand_depth.track(frames, recording.times_s, recording.camera, config)
    with np.load(tmp_path / "out" / "track.npz") as saved:
        for name, array in found._asdict().items():
            np.testing.assert_array_equal(saved[name], array, err_msg=name)


def depth_from_python(folder):
    """Arguments of the command for eight frames of a moving hand, and their track from Python."""
    made = simulate_sequence(jax.random.key(1), "B", num_frames=8)
    file = folder / "hand.npz"
    np.savez(file, depth_mm=made.depth_mm, K=np.asarray(kinect_v2().matrix(), float), t_us=33_333 * np.arange(8))
    recording = open_depth(file)
    config = hand_depth.HandDepthConfig(num_particles=64, seed=3)
    found = hand_depth.track(list(recording), recording.times_s, recording.camera, config)
    return ["hand-depth", str(file), "--particles", "64"], found


def articulated_from_python(folder):
    """Arguments of the command for its synthetic sequence, and the track of it from Python."""
    del folder
    return ["articulated"], articulated.track_sequence(
        articulated.synthetic_sequence(3), articulated.ArticulatedConfig(seed=3)
    )


@pytest.mark.system
@pytest.mark.parametrize("track", [depth_from_python, articulated_from_python])
def test_the_trackers_themselves_give_the_same_track_by_command_and_from_python(track, tmp_path, monkeypatch):
    """Of the trackers as they are, bit for bit: the test above has a stand-in whose rows need no search of the hand."""
    monkeypatch.setenv("XLA_FLAGS", "")  # `main` sets it
    arguments, found = track(tmp_path)
    assert main(["track", *arguments, "--seed", "3", "--no-video", "--out", str(tmp_path / "out")]) == 0
    assert np.isin(found.status, (1, 3)).all()
    with np.load(tmp_path / "out" / "track.npz") as saved:
        for name, array in found._asdict().items():
            np.testing.assert_array_equal(saved[name], array, err_msg=name)


def test_frames_and_times_that_do_not_fit_are_refused(fake_tracker, recording):
    frames, key = list(recording)[:3], jax.random.key(0)
    for times_s in (recording.times_s[:2], recording.times_s[:4], recording.times_s[:0]):
        with pytest.raises(ValueError, match="times_s: expected one for each frame"):
            track_frames(fake_tracker, key, frames, times_s)
    with pytest.raises(ValueError, match=r"times_s: expected one for each frame, at least one; got shape \(0,\)"):
        track_frames(fake_tracker, key, [], np.zeros(0))
    with pytest.raises(ValueError, match="frames: expected 1 to 16, with a time each; got 0"):
        step_chunk(fake_tracker, None, [], np.zeros(0))
    with pytest.raises(ValueError, match="mask: expected one of infrared, depth, colour; got 'red'"):
        estimate_user([np.zeros((4, 4), np.uint8)], "red")
