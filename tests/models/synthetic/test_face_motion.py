"""Courses of motion, expression and light."""

import numpy as np
import pytest

from jaxfilters.models.synthetic.face_motion import (
    deformation_schedule,
    gain_schedule,
    motion,
    occlusion_schedule,
)


def largest_steps(kind):
    """Medians over 20 seeds of the largest step of a coordinate in 600 frames: mm, degrees."""
    steps = [np.abs(np.diff(motion(kind, 600, seed), axis=0)).max(axis=0) for seed in range(20)]
    return np.median([(s[:3].max(), np.degrees(s[3:].max())) for s in steps], axis=0)


@pytest.mark.parametrize(
    ("kind", "millimetres", "degrees"), [("slow", (0.9, 1.9), (0.4, 0.9)), ("fast", (13, 17), (4.8, 7.2))]
)
def test_largest_steps_are_near_those_of_the_specification(kind, millimetres, degrees):
    """Printed: about 1.9 mm and 0.5 degrees for slow, 15 mm and 4.8 degrees for fast, each for one random course."""
    mm, deg = largest_steps(kind)
    assert millimetres[0] < mm < millimetres[1]
    assert degrees[0] < deg < degrees[1]


@pytest.mark.parametrize("kind", ["slow", "fast", "mix"])
def test_motion_begins_at_rest_where_it_is_told_and_stays_within_its_amplitudes(kind):
    amplitude = {"slow": (30, 15, 35, 8, 18, 10), "fast": (70, 35, 80, 15, 35, 18), "mix": (40, 20, 60, 10, 25, 12)}
    poses = motion(kind, 900, 4, place_mm=(0.0, 0.0, 650.0))
    np.testing.assert_array_equal(poses[0], [0, 0, 650, 0, 0, 0])
    assert np.abs(poses[1, :3] - poses[0, :3]).max() < 1.0
    offset = poses - poses[0]
    offset[:, 3:] = np.degrees(offset[:, 3:])
    share = np.abs(offset).max(axis=0) / amplitude[kind]
    assert np.all(share <= 3 / 2.2)
    assert np.all(share > 0.4)


def test_slow_heads_rest_for_two_fifths_of_the_time_and_others_do_not():
    standing = {
        kind: np.mean([np.mean(np.abs(np.diff(motion(kind, 1800, s)[30:], axis=0)).max(axis=1) == 0) for s in range(5)])
        for kind in ("slow", "fast", "mix")
    }
    assert standing["slow"] == pytest.approx(0.4, abs=0.05)
    assert standing["fast"] == standing["mix"] == 0


def test_motion_is_that_of_its_seed():
    np.testing.assert_array_equal(motion("mix", 100, 7), motion("mix", 100, 7))
    assert np.abs(motion("mix", 100, 7) - motion("mix", 100, 8)).max() > 1
    np.testing.assert_array_equal(motion("slow", 300, 7)[:100], motion("slow", 100, 7))


def test_bad_motions_are_refused():
    with pytest.raises(ValueError, match=r"kind must be one of slow, fast, mix; got 'brisk'"):
        motion("brisk", 10, 0)
    with pytest.raises(ValueError, match="num_frames must be 1 or more; got 0"):
        motion("slow", 0, 0)


def test_faces_deform_between_their_ramps_only():
    schedule = deformation_schedule(1800)
    assert np.all(schedule[:121] == 0)
    assert np.all(schedule[1200:] == 0)
    assert np.abs(schedule[150:1170, 0]).max() == pytest.approx(0.9, rel=0.01)
    assert schedule[150:1170, 1].max() == pytest.approx(1.8 * 0.65, rel=0.01)
    assert schedule[:, 1].min() == 0


def test_expressions_follow_the_printed_formula():
    """Frame 500, s = 16.667: sin(2 pi .23 s) = -0.818 and sin(2 pi .31 s + 1) = 0.9985."""
    s = 500 / 30
    e1, e2 = deformation_schedule(600, amp=2.0)[500]
    assert e1 == 0
    assert e2 == pytest.approx(2 * 0.65 * np.sin(2 * np.pi * 0.31 * s + 1))
    s = 400 / 30
    e1, _ = deformation_schedule(600, amp=2.0)[400]
    assert e1 == pytest.approx(2 * 0.5 * np.sin(2 * np.pi * 0.23 * s) * np.sign(np.sin(2 * np.pi * 0.06 * s) + 0.3))
    assert e1 != 0


def test_disturbances_come_when_they_should():
    covered, gain = occlusion_schedule(600), gain_schedule(600)
    assert covered.sum() == 30
    assert np.all(np.diff(np.flatnonzero(covered)) == 1)
    assert np.flatnonzero(covered)[-1] < 300
    np.testing.assert_array_equal(gain[:301], 1)
    np.testing.assert_allclose(gain[340:], 0.7)
    np.testing.assert_allclose(np.diff(gain[300:341]), -0.3 / 40)
