"""What a run of a head must share with an interrupted one to continue it."""

import cv2
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.trackers.head.common.input import Places, setup_of_one
from jaxfilters.trackers.head.common.run import HeadStream, RowsOf, stream_spec
from jaxfilters.trackers.head.common.table import HEAD_TABLE
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.stereo.session import HeadSession
from jaxfilters.trackers.io.cameras import write_camera

ROWS, COLS = 48, 64


@pytest.fixture
def identity(tmp_path):
    """Of a run whose files lie at the same places, whatever is in them."""
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), np.zeros((ROWS, COLS, 3), np.uint8))
    places = Places(camera=tmp_path / "camera.json", points=tmp_path / "points.csv")

    def of(focal=80.0, lens=0.0, u=10.0, model=1.0):
        K = np.array([[focal, 0, 31.5], [0, focal, 23.5], [0, 0, 1]])
        write_camera(places.camera, (COLS, ROWS), K=K, distortion=np.array([lens, 0, 0, 0, 0]))
        places.points.write_text("\n".join(["name,u,v", *(f"{name},{u},20" for name in NAMES)]))
        place = setup_of_one(str(tmp_path / "images"), places, 0)
        rows = RowsOf(HEAD_TABLE, lambda frames: None)
        contents = {"model": {"mean": np.full(3, model)}}
        return stream_spec(
            HeadStream(place, HeadSession(place.rig), rows, 8), rows, MonoConfig(), {}, contents
        ).identity

    return of


def test_other_contents_of_the_same_files_are_another_run(identity):
    first = identity()
    assert identity() == first
    for other in (dict(focal=160.0), dict(lens=0.1), dict(u=11.0), dict(model=2.0)):
        assert identity(**other) != first
