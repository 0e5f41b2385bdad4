"""The same seed gives the same track in another process on the same cores, whatever else these do."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxfilters.models.hand.skeleton import anatomical_hand
from jaxfilters.models.synthetic.hand import simulate_sequence
from jaxfilters.trackers.hand_depth.tracker import LOST, TRACKING
from jaxfilters.trackers.tracker import CHUNK

TRACK = """
import sys

import numpy as np

from jaxfilters.models.synthetic.hand import kinect_v2
from jaxfilters.trackers import hand_depth

depth = np.load(sys.argv[1])
config = hand_depth.HandDepthConfig(num_particles=64)
found = hand_depth.track(depth, np.arange(len(depth)) / 30, kinect_v2(), config)
np.savez(sys.argv[2], **found._asdict())
"""
JUMP_FRAME, JUMP_PX = 5, 150


def tracked(folder, name, **settings):
    """The track that a process of its own finds, with environment variables of its own."""
    arguments = [sys.executable, "-c", TRACK, str(folder / "depth.npy"), str(folder / f"{name}.npz")]
    environment = os.environ | settings
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=600, env=environment)
    assert done.returncode == 0, done.stderr
    with np.load(folder / f"{name}.npz") as track:
        return {field: track[field] for field in track.files}


@pytest.mark.system
@pytest.mark.optimised
def test_a_busy_core_threads_of_openblas_and_the_hash_seed_change_no_bit(tmp_path):
    made = simulate_sequence(jax.random.key(1), "B", num_frames=CHUNK, geometry=anatomical_hand())
    depth = np.asarray(made.depth_mm, np.float32) / 1000
    # Lost and found again, so that the search of a lost hand is included.
    depth[JUMP_FRAME:] = np.roll(depth[JUMP_FRAME:], JUMP_PX, axis=2)
    np.save(tmp_path / "depth.npy", depth)
    usual = tracked(tmp_path, "usual", OPENBLAS_NUM_THREADS="1", PYTHONHASHSEED="0")
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        other = tracked(tmp_path, "other", OPENBLAS_NUM_THREADS="2", PYTHONHASHSEED="1")
    finally:
        busy.kill()
        busy.wait()
    assert usual["status"][JUMP_FRAME] == LOST
    assert usual["status"][-1] == TRACKING
    assert usual.keys() == other.keys()
    for field, values in usual.items():
        np.testing.assert_array_equal(other[field], values, err_msg=field)
