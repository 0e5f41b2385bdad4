import numpy as np
import pytest

from jaxfilters.trackers.io.errors import CheckpointError
from jaxfilters.trackers.people.checkpoints import load, save
from jaxfilters.trackers.people.recorded import Sighting
from jaxfilters.trackers.people.session import PeopleSession
from jaxfilters.trackers.people.state import STATE, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene


def test_a_checkpoint_of_people_is_read_as_it_was_written(camera, floor, tmp_path):
    """State, backgrounds and tracks; another run, and a damaged file, are refused."""
    scene = people_scene([camera], floor, config=PeopleConfig(capacity=2, cell_m=2.0))
    session, run = PeopleSession(scene), {"seed": 1}
    session.prime([[np.full((*camera.shape, 3), 90 + i, np.uint8) for i in range(3)]])
    one = Sighting(3, 0.1, np.arange(float(STATE)), np.eye(STATE), 0.5, 1, "hidden")
    save(tmp_path, run, session.state(), [(7, one)], 0)
    save(tmp_path, run, session.state(), [(8, one._replace(frame=4))], 1)
    saved = load(tmp_path, run)
    assert [(who, seen.frame, seen.mode) for who, seen in saved.tracks] == [(7, 3, "hidden"), (8, 4, "hidden")]
    assert saved.num_parts == 2
    state = session.state()
    for name, array in state["backgrounds"][0].items():
        np.testing.assert_array_equal(saved.state["backgrounds"][0][name], array)
    np.testing.assert_array_equal(saved.state["people"].mode, state["people"].mode)
    with pytest.raises(CheckpointError, match="cannot be resumed: seed was 1 and is 2"):
        load(tmp_path, {"seed": 2})
    (tmp_path / "checkpoint" / "tracks_000001.npz").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match=r"tracks_000001.npz: not a complete checkpoint"):
        load(tmp_path, run)
