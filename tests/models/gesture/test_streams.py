"""Gestures found in streams: what features do not depend on, and that nothing later than a report decides it."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.hmm import Segment
from jaxfilters.models.gesture import poses, streams
from jaxfilters.models.gesture.spotting_score import scored
from jaxfilters.models.gesture.streams import Stream, learn_streams, spot

PALM = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.2]], float)
REST = np.concatenate([PALM, [[2, 2, 0], [0, 2, 0]]])
NAMES = ("bend", "wave")


def stream(seed, labels, gap=(15, 30)):
    """A palm that drifts and turns with two tips: bending one is a gesture, as is waving the whole."""
    rng = np.random.default_rng(seed)
    kinds, segments = np.zeros(0, int), []
    for label in labels:
        kinds = np.append(kinds, np.full(rng.integers(*gap), -1))
        segments.append(Segment(label, len(kinds), len(kinds) + int(rng.integers(20, 30)) - 1))
        kinds = np.append(kinds, np.full(segments[-1].end - segments[-1].start + 1, label))
    kinds = np.append(kinds, np.full(25, -1))
    points = np.tile(REST, (len(kinds), 1, 1)) + rng.normal(0, 0.03, (len(kinds), 6, 3))
    points[kinds == 0, 4] += [0, -1.5, 1.0]
    wave = np.where(kinds == 1, 2 * np.sin(np.arange(len(kinds))), 0)
    drift = np.cumsum(rng.normal(0, 0.02, (len(kinds), 3)), axis=0)
    turns = Rotation.from_rotvec(0.3 * np.sin(np.arange(len(kinds))[:, None] / 30) * [[1, 0.5, 0]])
    points = np.einsum("tde,tje->tjd", turns.as_matrix(), points) + drift[:, None]
    points[:, :, 0] += wave[:, None]
    return Stream(points, 20.0, tuple(segments), str(seed))


def test_features_do_not_depend_on_place_unit_and_rate():
    own = stream(0, [0, 1, 0])
    template = poses.fit_template([own.points])
    # What keeps its place decides how a hand is turned, and the speeds of the tip that moves are features.
    assert template.weights[4] < 0.02 < template.weights[[0, 1, 2, 3, 5]].min()
    assert 4 in template.moving
    before = poses.pose_features(template, own.points)
    scaled = poses.pose_features(poses.fit_template([1000 * own.points]), 1000 * own.points + 7)
    np.testing.assert_allclose(scaled, before, atol=2e-3)
    turn = Rotation.from_euler("xyz", (0.3, 1.0, -0.4)).as_matrix()
    turned = poses.pose_features(template, own.points @ turn.T)
    num_own = 6 * 3 + 3 * len(template.moving)
    np.testing.assert_allclose(turned[:, :num_own], before[:, :num_own], atol=1e-3)
    fast = np.repeat(own.points, 2, axis=0)[:-1]
    fast[1::2] = (own.points[1:] + own.points[:-1]) / 2
    again, places, present = poses.resampled(fast, 40.0)
    np.testing.assert_allclose(again, own.points)
    np.testing.assert_array_equal(places, 2 * np.arange(len(again)))
    assert present.all()


def test_missing_frames_are_interpolated_and_said():
    points = np.arange(10.0)[:, None, None] * np.ones((1, 2, 3))
    broken = points.copy()
    broken[[0, 4, 5], 1, 2] = np.nan
    found, _, present = poses.resampled(broken, 20.0)
    np.testing.assert_allclose(found[1:], points[1:])
    np.testing.assert_array_equal(np.flatnonzero(~present), [0, 4, 5])
    with pytest.raises(ValueError, match="without NaN"):
        poses.resampled(np.full((4, 2, 3), np.nan), 20.0)


@pytest.mark.system
def test_gestures_are_found_in_a_stream_and_no_later_frame_decides():
    training = [stream(seed, [seed % 2, 0, 1, (seed + 1) % 2]) for seed in range(1, 6)]
    model = learn_streams(jax.random.key(0), training, NAMES, num_steps=60)
    other = stream(99, [0, 1, 1, 0, 1])
    found = spot(model, other)
    score = scored([one.segment for one in found], other.segments)
    assert (score.detected, score.false_positives, score.total) == (5, 0, 5)
    assert np.mean(score.jaccard) > 0.7
    latency = [one.reported - one.segment.end for one in found[:-1]]
    assert min(latency) >= streams.LATENCY_FRAMES
    # A stream that ends with the frame of a report has it as well, and those before it.
    cut = found[2].reported + 1
    again = spot(model, other._replace(points=other.points[:cut]))
    assert [one.segment for one in again[:3]] == [one.segment for one in found[:3]]
    # Frames that were not observed are no gesture.
    hidden = other.points.copy()
    hidden[other.segments[1].start - 5 : other.segments[1].end + 6] = np.nan
    rest = [one.segment for one in spot(model, other._replace(points=hidden))]
    assert scored(rest, other.segments[:1] + other.segments[2:])[:2] == (4, 0)
    with pytest.raises(ValueError, match=r"points \(6, 3\).*\(2, 3\)"):
        spot(model, other._replace(points=other.points[:, :2]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda own: own._replace(segments=own.segments[:1]), "none shows wave"),
        (lambda own: own._replace(segments=(Segment(0, 5, 10_000),)), "lie in its"),
        (lambda own: own._replace(segments=(Segment(0, 0, 40), Segment(1, 41, len(own.points) - 1))), "outside of the"),
        (lambda own: own._replace(rate_hz=0.0), "rate above 0"),
    ],
)
def test_streams_that_teach_nothing_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        learn_streams(jax.random.key(0), [change(stream(0, [0, 1]))], NAMES)
