"""Fingertips beside marks: what counts as found, missed and false."""

import numpy as np

from jaxfilters.benchmarks.scenarios import _marked_tips as marked_tips
from jaxfilters.benchmarks.scenarios._marked_tips import Tips

FAR = (300.0, 300.0)


def marked(tips, cut=None):
    return {"half_width_px": 10, "frames": {"7": {"tips": tips, "cut": cut or {}}}}


def counted(own, positions, identities):
    tips = Tips(np.array(positions, float).reshape(-1, 2), np.array(identities, int))
    return marked_tips.counted(own, {7: tips})


def test_a_tip_near_a_mark_is_found_and_one_near_none_is_false():
    found = counted(marked({"thumb": [50, 50], "index": [90, 20]}), [(53, 46), FAR], [0, 1])
    assert found[:4] == (2, 1, 2, 1)
    assert found.names["thumb"] == {0}
    assert found.metrics == {"found_pct": 50.0, "false_pct": 50.0, "names_per_finger": 1.0}


def test_what_the_border_cuts_is_neither_missed_nor_false():
    own = marked({"index": [90, 20]}, {"thumb": [0, 50]})
    assert counted(own, [(90, 22)], [1])[:4] == (1, 1, 1, 0)
    assert counted(own, [(90, 22), (3, 52)], [1, 0])[:4] == (1, 1, 2, 0)


def test_one_tip_is_not_two_fingers():
    assert counted(marked({"index": [50, 50], "middle": [58, 50]}), [(54, 50)], [2])[:4] == (2, 1, 1, 0)


def test_frames_without_fingers_count_what_is_reported_as_false():
    assert counted(marked({}), [FAR], [3])[:4] == (0, 0, 1, 1)
    assert counted(marked({}), [], []).metrics["false_pct"] == 0


def test_twenty_frames_of_each_video_are_marked():
    for name in marked_tips.VIDEOS:
        frames = marked_tips.marks(name)["frames"].values()
        assert len(frames) == 20
        assert all(finger in marked_tips.NAMES for own in frames for finger in (*own["tips"], *own["cut"]))
