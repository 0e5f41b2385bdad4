from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxfilters.models.articulated.features import FEATURE_SETS, FULL, KEYPOINTS, FeatureSet
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.trackers.articulated.recording import (
    NUM_KEYPOINTS,
    FeatureSequence,
    Start,
    features_named,
    from_keypoints,
    keypoint_noise,
    persistence,
)
from jaxfilters.trackers.io.errors import InputError

FRAMES, ROWS = 6, 29
N = Layout(2).size


@pytest.fixture
def sequence():
    rng = np.random.default_rng(0)
    y = rng.normal(size=(FRAMES, ROWS))
    y[2, 3], y[4] = np.nan, np.nan
    mean = np.ones(N)
    return FeatureSequence(
        2, FULL, np.arange(FRAMES) / 30, y, np.full((FRAMES, ROWS), 2.0), "a", start=Start(mean, np.eye(N))
    )


def test_a_frame_says_what_was_measured_and_how_well(sequence):
    frame = sequence[2]
    assert (frame.y.dtype, frame.mask.dtype, frame.std.dtype) == (np.float32, bool, np.float32)
    np.testing.assert_array_equal(frame.mask, np.arange(ROWS) != 3)
    np.testing.assert_array_equal(frame.y, np.where(frame.mask, sequence.y[2], 0).astype(np.float32))
    np.testing.assert_array_equal(frame.std, np.where(frame.mask, 2, 1))
    assert not sequence[4].mask.any()
    with pytest.raises(IndexError, match="frame 6 of 6"):
        sequence[FRAMES]


def test_the_size_of_the_image_is_part_of_a_recording(sequence):
    """With a focal length, its middle is the axis of the camera."""
    same, other = (replace(sequence, image_shape=shape).fingerprint() for shape in ((480, 640), (720, 1280)))
    assert len({sequence.fingerprint(), same, other}) == 3


def test_shares_of_the_image_are_no_pixels():
    points = np.random.default_rng(0).uniform(0, 1, (3, NUM_KEYPOINTS, 2))
    with pytest.raises(InputError, match=r"a: keypoints must be in pixels; got coordinates within .* multiply by"):
        from_keypoints(np.arange(3) / 30, points, "a")
    assert from_keypoints(np.arange(3) / 30, points * (640, 480), "a").noise_px > 1


def changed(array, place, value):
    array = np.array(array, float)
    array[place] = value
    return array


WRONG = {
    "a row too few": (lambda s: {"y": s.y[:, 1:]}, r"y must be \(6, 29\); got \(6, 28\)"),
    "a frame too few": (lambda s: {"std": s.std[1:]}, r"std must be \(6, 29\); got \(5, 29\)"),
    "times that go back": (lambda s: {"times_s": s.times_s[::-1]}, "times must increase strictly; frame 0"),
    "nothing measured": (lambda s: {"y": np.full_like(s.y, np.nan)}, "no feature was measured in any frame"),
    "an infinite feature": (
        lambda s: {"y": changed(s.y, (1, 2), np.inf)},
        "features must be finite or NaN; frame 1, p_11_x is not",
    ),
    "noise that is NaN": (lambda s: {"std": changed(s.std, (3, 0), np.nan)}, "noise .* frame 3, wrist_x: nan"),
    "negative noise": (lambda s: {"std": changed(s.std, (3, 1), -1)}, "noise .* frame 3, wrist_y: -1.0"),
    "no noise": (lambda s: {"std": 0 * s.std}, "noise must be positive .* frame 0, wrist_x: 0.0"),
    "a start of one finger": (
        lambda s: {"start": Start(np.ones(26), np.eye(26))},
        r"start must be a mean \(37,\) and a covariance \(37, 37\) for 2 fingers; got \(26,\) and \(26, 26\)",
    ),
    "a start that is NaN": (lambda s: {"start": Start(np.full(N, np.nan), np.eye(N))}, "start mean must be finite"),
    "a start without rotation": (lambda s: {"start": Start(np.zeros(N), np.eye(N))}, "the quaternion of the start"),
    "variances instead": (
        lambda s: {"start": Start(np.ones(N), np.tile(np.arange(N), (N, 1)))},
        "start covariance must be symmetric",
    ),
    "negative variances": (
        lambda s: {"start": Start(np.ones(N), -np.eye(N))},
        "start covariance must have no negative eigenvalue; got -1",
    ),
    "truth of another hand": (
        lambda s: {"truth": np.zeros((FRAMES, 35))},
        r"truth must be \(6, 37\) for 2 fingers; got \(6, 35\)",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_cannot_be_is_named(sequence, what):
    change, message = WRONG[what]
    with pytest.raises(InputError, match=rf"^a: {message}"):
        replace(sequence, **change(sequence))


def test_noise_may_be_anything_where_nothing_was_measured(sequence):
    with_gap = replace(sequence, std=changed(sequence.std, (4, 0), np.nan))
    np.testing.assert_array_equal(with_gap[4].std, 1)


def test_a_start_may_be_certain_of_something(sequence):
    direction = np.zeros(N)
    direction[2:6] = 0.5
    covariance = (np.eye(N) - np.outer(direction, direction)).astype(np.float32)
    assert replace(sequence, start=Start(np.ones(N), covariance)).start is not None


def test_the_fingerprint_is_of_what_was_measured_and_believed(sequence):
    same = replace(sequence, name="b", truth=np.zeros((FRAMES, N)))
    assert same.fingerprint() == sequence.fingerprint()
    others = [
        replace(sequence, y=changed(sequence.y, (0, 0), 1)),
        replace(sequence, std=2 * sequence.std),
        replace(sequence, times_s=2 * sequence.times_s),
        replace(sequence, start=None),
        replace(sequence, start=Start(2 * sequence.start.mean, sequence.start.covariance)),
    ]
    assert len({sequence.fingerprint(), *(other.fingerprint() for other in others)}) == 1 + len(others)


@pytest.mark.parametrize("num_fingers", [1, 2, 5, 11])
@pytest.mark.parametrize("features", [*FEATURE_SETS.values(), FeatureSet(("lines",)), FeatureSet(("tips",))])
def test_names_in_any_order_say_what_is_what(num_fingers, features):
    names = list(features.names(num_fingers))
    shuffled = [names[i] for i in np.random.default_rng(1).permutation(len(names))]
    found, blocks, places = features_named(shuffled, "a")
    assert (found, blocks) == (num_fingers, features)
    assert [shuffled[place] for place in places] == names


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda names: [*names, "thumb"], "names that are no feature: thumb; expected those of whole blocks"),
        (lambda names: ["x", "y"], "names that are no feature: x, y; expected .*, such as wrist_x, wrist_y, p_11_x"),
        (lambda names: [f"{name}!" for name in names], r"no feature: wrist_x!, wrist_y!, p_11_x!, p_11_y! and 25 more"),
        (lambda names: names[:-1], "names lack palm_rho_max: blocks"),
        (lambda names: [*names, "wrist_x"], "names must differ; wrist_x is there more than once"),
        (lambda names: names[1:], "names lack wrist_x: blocks"),
        (lambda names: [*names, "p_31_x"], "names lack p_31_y, p_32_x, p_32_y, p_33_x and 7 more: blocks"),
        (lambda names: [*names, "p_12345678901_x"], "names lack p_31_x, p_31_y"),
        (lambda names: [], "names are empty"),
    ],
)
def test_names_that_are_none_are_named(change, message):
    with pytest.raises(InputError, match=message):
        features_named(change(list(FULL.names(2))), "a")


@pytest.fixture(scope="module")
def hand():
    return articulated_hand(five_fingers(), features=KEYPOINTS)


@pytest.fixture(scope="module")
def keypoints(hand):
    """Features of a made-up state, and the same points in the order of detectors."""
    x = jax.random.normal(jax.random.key(0), (hand.layout.size,))
    points = np.concatenate([x[hand.layout.position][None], hand.image_points(x).reshape(20, 2)])
    return np.asarray(hand.observe(x)), points


def test_keypoints_become_what_the_model_observes(hand, keypoints):
    y, points = keypoints
    sequence = from_keypoints(np.arange(2.0), np.stack([points, points + 1]), "a", noise_px=2.0, image_shape=(48, 64))
    assert sequence.features.names(sequence.num_fingers) == hand.feature_names
    np.testing.assert_allclose(sequence.y, [y, y + 1], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(sequence.std, 2.0 * persistence(np.arange(2.0)))
    assert sequence.image_shape == (48, 64)


def test_noise_grows_as_confidence_falls_and_doubtful_keypoints_are_missing(keypoints):
    _, points = keypoints
    points, confidence = np.stack([points, points]), np.full((2, NUM_KEYPOINTS), 0.5)
    confidence[0, :5] = [0.0, 0.19, 0.2, 1.0, 1.7]
    points[1, 20, 1] = np.nan
    sequence = from_keypoints(np.arange(2.0), points, "a", confidence=confidence, noise_px=3.0)
    names = list(sequence.features.names(5))
    thumb = [names.index(f"p_1{joint}_x") for joint in range(4)]
    assert not sequence[0].mask[names.index("wrist_x")]
    np.testing.assert_array_equal(sequence[0].mask[thumb], [False, True, True, True])
    raised = persistence(np.arange(2.0))
    np.testing.assert_allclose(sequence[0].std[thumb][1:], np.array([15.0, 3.0, 3.0]) * raised, rtol=1e-6)
    little = [names.index("p_53_x"), names.index("p_53_y")]
    assert not sequence[1].mask[little].any()
    assert sequence[1].mask.sum() == 40
    np.testing.assert_allclose(sequence[1].std[sequence[1].mask], 6.0 * raised, rtol=1e-6)


def test_default_noise_is_a_share_of_the_hand_in_the_image():
    rng = np.random.default_rng(3)
    points = rng.uniform((100, 50), (400, 450), (5, NUM_KEYPOINTS, 2))
    points[:, 3], points[:, 4] = (100, 50), (400, 450)  # opposite corners of 300 x 400 pixels: a diagonal of 500
    points[0] *= 3
    points[1, 5:] = np.nan
    points[1, 4] = 110, 60  # a fingertip and the wrist alone say little of the size
    points[2] = np.nan
    assert keypoint_noise(points) == pytest.approx(0.03 * 500)
    assert keypoint_noise(np.where(np.arange(NUM_KEYPOINTS)[None, :, None] == 3, points, np.nan)) == 1.0


@pytest.mark.parametrize("interval", [1 / 120, 1 / 30, 0.2, 1.0])
def test_errors_that_last_are_raised_to_what_their_mean_is_off_by(interval):
    # The variance of a mean with weights exp(-3 k dt) of errors with correlation exp(-3 |i - j| dt), from the sum over
    # all pairs, over that of the same mean of white errors.
    times = interval * np.arange(round(10 / interval))
    weights = np.exp(-3 * times)
    correlation = np.exp(-3 * np.abs(times[:, None] - times))
    ratio = weights @ correlation @ weights / (weights @ weights)
    assert persistence(interval * np.arange(50.0)) == pytest.approx(np.sqrt(ratio), rel=1e-6)


def test_persistence_is_that_of_most_steps_and_nothing_for_one_frame():
    steady = np.arange(40) / 30
    assert persistence(steady) == pytest.approx(3.17, abs=0.01)
    assert persistence(np.delete(steady, slice(10, 19))) == pytest.approx(persistence(steady))
    assert persistence(np.zeros(1)) == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": np.zeros((2, 20, 2))}, r"keypoints must be \(2, 21, 2\); got \(2, 20, 2\)"),
        ({"points": np.full((2, 21, 2), np.inf)}, "keypoints must be finite or NaN; frame 0, keypoint 0"),
        ({"points": np.full((2, 21, 2), np.nan)}, "no keypoint has a confidence of 0.2 or more"),
        ({"confidence": np.zeros((2, 21))}, "no keypoint has a confidence of 0.2 or more"),
        ({"confidence": np.ones((2, 20))}, r"confidence must be \(2, 21\); got \(2, 20\)"),
        ({"confidence": np.full((2, 21), np.nan)}, "confidence must be 0 or more; frame 0, keypoint 0: nan"),
        ({"confidence": np.full((2, 21), -0.5)}, "confidence must be 0 or more; frame 0, keypoint 0: -0.5"),
        ({"noise_px": 0.0}, "noise must be positive, in pixels; got 0.0"),
        ({"noise_px": float("nan")}, "noise must be positive, in pixels; got nan"),
        ({"times_s": np.zeros(2)}, "times must increase strictly"),
    ],
)
def test_keypoints_that_cannot_be_are_named(arguments, message):
    good = {"times_s": np.arange(2.0), "points": np.full((2, 21, 2), 50.0), "name": "a"}
    with pytest.raises(InputError, match=f"^a: {message}"):
        from_keypoints(**(good | arguments))
