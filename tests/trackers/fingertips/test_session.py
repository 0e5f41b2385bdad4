"""Streams of observations: hands that cross, symbols and manipulation told apart, and bad input."""

import math

import jax
import numpy as np
import pytest

from jaxfilters.models.fingertip import thumb
from jaxfilters.models.fingertip.observation import WHOLE_IMAGE, HandObservation
from jaxfilters.trackers.fingertips.drawing import NOTHING_DRAWN, Drawing, DrawingConfig, finished
from jaxfilters.trackers.fingertips.events import Recognised
from jaxfilters.trackers.fingertips.session import FingertipSession

pytestmark = pytest.mark.system

FRAMES, PIECE, CAPACITY = 240, 60, 5
ANGLES = thumb.usual()
OPEN = np.array([[-75.0, -50.0], [-39.0, -108.0]])
"""Tips of thumb and forefinger relative to the palm, pixels; the arm points up."""


def observed(frames, hands=2):
    """(frames, hands, ...) of lists of (palm, tips relative to it); nothing where there is less."""
    shape = (len(frames), hands)
    tips, is_tip = np.zeros((*shape, CAPACITY, 2), np.float32), np.zeros((*shape, CAPACITY), bool)
    bases, palm, there = tips.copy(), np.zeros((*shape, 2), np.float32), np.zeros(shape, bool)
    for i, visible in enumerate(frames):
        for h, (place, own) in enumerate(visible):
            n = len(own)
            palm[i, h], there[i, h], is_tip[i, h, :n] = place, True, True
            tips[i, h, :n] = np.asarray(place) + own
            bases[i, h, :n] = np.asarray(place) + 0.4 * np.asarray(own)
    axis = np.broadcast_to(np.float32([0, -1]), (*shape, 2))
    radius = np.full(shape, 46, np.float32)
    coverage, cell = np.ones((*shape, 1, 1), np.float32), np.full((*shape, 2), WHOLE_IMAGE, np.float32)
    return HandObservation(tips, is_tip, is_tip * 1.0, bases, is_tip, palm, radius, axis, there, there, coverage, cell)


def follow(frames, **options):
    """Session and reports; in pieces of one length, as a command does, so that all share a compiled program."""
    session = FingertipSession(ANGLES, num_hands=2, **options)
    frames = [*frames, *[[]] * (FRAMES - len(frames))]
    visible = observed(frames)
    times = np.arange(FRAMES) / 30
    reports = [
        session.process(jax.tree.map(lambda leaf, i=i: leaf[i : i + PIECE], visible), times[i : i + PIECE])
        for i in range(0, FRAMES, PIECE)
    ]
    session.finish()
    return session, jax.tree.map(lambda *leaves: np.concatenate(leaves), *reports)


def circle(n):
    """A circle of radius 80, counter-clockwise as seen, that begins to the right."""
    angle = np.linspace(0, 2 * np.pi, n)
    return np.stack([320 + 80 * np.cos(angle), 300 - 80 * np.sin(angle)], axis=1)


def test_a_stroke_with_the_thumb_folded_is_a_symbol_in_its_place():
    strokes = []

    def recognise(stroke):
        strokes.append(stroke)
        return Recognised("circle", 0.9)

    way = circle(60)
    rests = [[(way[0], OPEN[1:])]] * 20
    frames = rests + [[(palm, OPEN[1:])] for palm in way] + [[(way[-1], OPEN[1:])]] * 20
    session, _ = follow(frames, recogniser=recognise)
    (event,) = [event for event in session.events if event.name == "symbol"]
    assert (event.quantities["label"], event.quantities["fingers"]) == ("circle", 1)
    tip = way + OPEN[1]
    np.testing.assert_allclose(event.quantities["box_px"], [*tip.min(axis=0), *tip.max(axis=0)], atol=6)
    np.testing.assert_allclose(event.quantities["last_px"], tip[-1], atol=12)
    assert 18 <= event.quantities["first_frame"] <= 24
    assert 75 <= event.quantities["last_frame"] <= 83
    assert 80 <= event.frame <= 95
    codes = strokes[0].codes
    # Begins to the right of the middle, upwards (code 5), and goes round through 9 (left), 13 (down) and 1 (right).
    assert np.all(np.diff(np.unwrap(codes * (2 * np.pi / 16))) > -0.4)
    assert abs(int(codes[4]) - 5) <= 1
    np.testing.assert_array_equal(strokes[0].counts, 1)


def test_the_thumb_switches_from_symbols_to_manipulation():
    """Closing and opening is a pinch, with the move between; a turn and a stretch of the open hand are told."""
    palm = np.array([320.0, 300.0])
    gap = np.concatenate([np.ones(20), np.linspace(1, 0.35, 10), np.full(40, 0.35), np.linspace(0.35, 1, 10)])
    shift = np.concatenate([np.zeros(35), np.linspace(0, 90, 25), np.full(20, 90.0)])
    middle = OPEN.mean(axis=0)
    frames = [[(palm + np.array([dx, 0]), middle + g * (OPEN - middle))] for g, dx in zip(gap, shift, strict=True)]
    turn = np.concatenate([np.zeros(20), np.linspace(0, math.radians(40), 20), np.full(25, math.radians(40))])
    stretch = np.concatenate([np.ones(20), np.linspace(1, 1.4, 20), np.full(25, 1.4)])
    for angle, factor in zip(turn, stretch, strict=True):
        c, s = math.cos(angle), math.sin(angle)
        line = factor * (OPEN - middle) @ np.array([[c, -s], [s, c]])
        frames.append([(palm + np.array([90, 0]), middle + line)])
    session, _ = follow(frames)
    names = [(event.name, event.phase) for event in session.events]
    assert ("symbol", "end") not in names
    assert names.count(("pinch", "begin")) == names.count(("pinch", "end")) == 1
    begin, end = (next(e for e in session.events if (e.name, e.phase) == ("pinch", p)) for p in ("begin", "end"))
    assert 22 <= begin.frame <= 32
    assert 70 <= end.frame <= 80
    moves = [e for e in session.events if (e.name, e.phase) == ("move", "end")]
    assert any(abs(e.quantities["dx_px"] - 90) < 8 for e in moves)
    turned = [e for e in session.events if (e.name, e.phase) == ("rotate", "end")]
    np.testing.assert_allclose(np.degrees([e.quantities["angle_rad"] for e in turned]), [40], atol=4)
    resized = [
        e.quantities["ratio"] for e in session.events if (e.name, e.phase) == ("resize", "end") and e.frame > 100
    ]
    np.testing.assert_allclose(resized, [1.4], atol=0.08)


def test_hands_that_cross_keep_their_names_and_sides():
    x = np.linspace(150, 490, 60)
    right, left = OPEN, OPEN * [-1, 1]
    frames = [[((490.0, 250.0), right), ((150.0, 320.0), left)]] * 15
    frames += [sorted([((640 - a, 250.0), right), ((a, 320.0), left)], key=lambda hand: hand[0][0]) for a in x]
    frames += [[((150.0, 250.0), right), ((490.0, 320.0), left)]] * 15
    _, report = follow(frames)
    np.testing.assert_allclose(report.palm[10], [[490, 250], [150, 320]], atol=1e-3)
    np.testing.assert_allclose(report.palm[85], [[150, 250], [490, 320]], atol=1e-3)
    assert np.all(report.num_tips[5:85] == 2)
    assert {tuple(sorted(i[i >= 0])) for i in report.identity[5:85].reshape(-1, 10)} == {(0, 1)}
    thumbs = np.argmax(report.is_thumb[85], axis=-1)
    own = report.position[85][np.arange(2), thumbs]
    np.testing.assert_allclose(own, [np.array([150, 250]) + right[0], np.array([490, 320]) + left[0]], atol=3)


def test_one_hand_alone_is_the_first_and_returns_to_its_place():
    _, report = follow([[((200.0, 300.0), OPEN)]] * 30 + [[]] * 30 + [[((400.0, 300.0), OPEN)]] * 30)
    assert np.all(report.has_palm[:30, 0] & ~report.has_palm[:30, 1])
    assert report.num_tips[80, 0] == 2
    assert set(report.identity[80, 0][report.identity[80, 0] >= 0]) == {0, 1}


def test_a_stream_of_nothing_and_of_nonsense_goes_on():
    """Empty masks, points that are none, and a stroke of no length."""
    session, _ = follow([[((320.0, 300.0), OPEN[1:])]] * 40)
    assert session.events == []
    nonsense = observed([[((np.nan, 300.0), np.full((2, 2), np.inf))]] * 60)
    found = session.process(nonsense, np.arange(60) / 30)
    assert not found.is_tip.any()
    assert all(np.isfinite(leaf).all() for leaf in found)


@pytest.mark.parametrize("codes", [(), (1,), (17,) * 30, (1,) * 30])
def test_strokes_of_no_length_are_none(codes):
    points = tuple(np.zeros(2) for _ in codes)
    state = Drawing(points, codes, tuple(1 for _ in codes), tuple(i / 30 for i, _ in enumerate(codes)))
    assert finished(DrawingConfig(), state) is None
    assert finished(DrawingConfig(), NOTHING_DRAWN) is None


def test_it_does_not_matter_where_a_stream_is_cut_into_pieces():
    """A stroke in the middle of a piece, and one that goes on in the next."""
    frames = [[(palm, OPEN[1:])] for palm in circle(50)]
    (early,), (late,) = (follow([[]] * wait + frames)[0].events for wait in (0, 30))
    assert late.frame == early.frame + 30
    moved = {"first_frame": early.quantities["first_frame"] + 30, "last_frame": early.quantities["last_frame"] + 30}
    assert late.quantities == early.quantities | moved


def test_a_corner_of_a_third_of_a_second_does_not_end_a_stroke_at_60_frames_per_second():
    first, second = np.split(circle(60), 2)
    way = [*[first[0]] * 20, *first, *[first[-1]] * 20, *second, *[second[-1]] * 40]
    session, _ = follow([[(palm, OPEN[1:])] for palm in way], fps=60.0)
    (event,) = session.events
    assert event.quantities["last_frame"] - event.quantities["first_frame"] > 65
