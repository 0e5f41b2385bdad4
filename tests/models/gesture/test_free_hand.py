"""Variations of strokes."""

import numpy as np

from jaxfilters.models.gesture import free_hand
from jaxfilters.models.gesture.free_hand import with_variations

STROKES = [([np.linspace([0, 0, 0], [0, 9, 0], 30)], 1), ([np.eye(3), 5 + np.eye(3)], 2)]


def test_the_strokes_come_first_and_every_copy_has_its_label_and_fingers():
    strokes, labels = with_variations(STROKES, ["bar", "cross"])
    assert strokes[:2] == STROKES
    assert labels == ["bar", "cross"] * (1 + free_hand.COPIES)
    assert [fingers for _, fingers in strokes] == [1, 2] * (1 + free_hand.COPIES)
    assert [len(pieces) for pieces, _ in strokes] == [1, 2] * (1 + free_hand.COPIES)


def test_copies_differ_from_each_other_but_not_from_run_to_run():
    first, again = (with_variations(STROKES, ["bar", "cross"])[0] for _ in range(2))
    for (own, _), (other, _) in zip(first, again, strict=True):
        np.testing.assert_array_equal(np.concatenate(own), np.concatenate(other))
    ends = np.array([pieces[0][-1] for pieces, _ in first[::2]])
    assert len(np.unique(ends.round(6), axis=0)) == len(ends)


def test_a_copy_is_cut_and_continued_no_more_than_said():
    for pieces, _ in with_variations(STROKES[:1] * 20, ["bar"] * 20)[0][20:]:
        samples = len(pieces[0])
        assert 30 - 2 * 3 <= samples <= 30 + 2 * 3
        assert np.isfinite(pieces[0]).all()


def test_strokes_without_samples_stay_as_they_are():
    assert with_variations([([], 1)], ["nothing"]) == ([([], 1)], ["nothing"])
    strokes, _ = with_variations([([], 1), *STROKES], ["nothing", "bar", "cross"])
    assert all(pieces == [] for pieces, _ in strokes[::3])
