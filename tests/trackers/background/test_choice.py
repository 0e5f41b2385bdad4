import json

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.background.choice import background
from jaxfilters.trackers.background.median import SAMPLES, MedianBackground
from jaxfilters.trackers.io.undistortion import Undistortion

LEARNING = ("median", "mog2", "knn")
SHAPE = (90, 120)


def room(seed=0):
    """A room with texture, as the camera would see it without noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(70, 190, (9, 12, 3)).astype(np.uint8)
    return cv2.resize(coarse, SHAPE[::-1], interpolation=cv2.INTER_CUBIC)


def observed(seed, *, x=None, brightness=1.0):
    """One noisy picture of the room, with somebody in red at column x."""
    image = room().astype(float) * brightness
    if x is not None:
        image[person(x)] = (40, 30, 220)
    return np.clip(image + np.random.default_rng(seed).normal(0, 2, image.shape), 0, 255).round().astype(np.uint8)


def person(x):
    mask = np.zeros(SHAPE, bool)
    mask[20:80, max(0, x - 10) : x + 10] = True
    return mask


def walking(n):
    return [observed(i, x=int(10 + 100 * i / (n - 1))) for i in range(n)]


def made(name, **options):
    return background(name, room(), **options) if name == "reference" else background(name, **options)


@pytest.mark.parametrize("name", ["median", "mog2", "knn", "reference"])
def test_somebody_who_stands_still_is_found_after_priming(name):
    model = made(name)
    model.prime(walking(40))
    probability = model.apply(observed(100, x=60))
    assert (probability.shape, probability.dtype) == (SHAPE, np.float32)
    assert 0 <= probability.min() <= probability.max() <= 1
    wrong = (probability > 0.5) != person(60)
    assert wrong.mean() < 0.02


@pytest.mark.system
@pytest.mark.parametrize("name", LEARNING)
def test_a_camera_that_was_not_primed_is_unsure_and_then_finds_people(name):
    model = made(name)
    first = model.apply(observed(0, x=10))
    assert np.abs(first - 0.5).max() <= 0.5 / SAMPLES + 1e-6
    for i in range(1, 5 * SAMPLES + 1):
        model.apply(observed(i, x=10 + i % 100))
    wrong = (model.apply(observed(300, x=60)) > 0.5) != person(60)
    assert wrong.mean() < 0.03


@pytest.mark.system
@pytest.mark.parametrize("name", LEARNING)
def test_somebody_who_is_kept_is_not_learnt_in_a_minute(name):
    model = made(name, **({"learn_every": 1} if name == "median" else {}))
    model.prime(walking(40))
    keep = cv2.dilate(person(60).astype(np.uint8), np.ones((7, 7), np.uint8))
    for i in range(600):
        probability = model.apply(observed(i, x=60), keep=keep)
    assert (probability[person(60)] > 0.5).mean() > 0.95
    assert (model.apply(observed(700))[person(60)] > 0.5).mean() < 0.05


@pytest.mark.system
@pytest.mark.parametrize("name", LEARNING)
def test_slow_changes_of_light_are_followed(name):
    model = made(name)
    model.prime([observed(i) for i in range(30)])
    for i in range(600):
        probability = model.apply(observed(i, brightness=1 + 0.15 * i / 600))
    assert (probability > 0.5).mean() < 0.02


@pytest.mark.system
def test_a_chair_that_is_left_behind_is_learnt_in_the_end():
    model = MedianBackground(learn_every=1)
    model.prime([observed(i) for i in range(10)])
    assert (model.apply(observed(50, x=60))[person(60)] > 0.5).mean() > 0.9
    later = [observed(i, x=60) for i in range(20)]
    for i in range(2400):
        probability = model.apply(later[i % 20])
    assert (probability[person(60)] > 0.5).mean() < 0.1


@pytest.mark.parametrize("name", ["median", "mog2", "knn"])
def test_shadows_are_less_likely_than_not(name):
    model = made(name)
    model.prime([observed(i) for i in range(30)])
    image = observed(40)
    image[30:60, 30:70] = (image[30:60, 30:70] * 0.7).astype(np.uint8)
    assert (model.apply(image)[32:58, 32:68] < 0.5).mean() > 0.85


@pytest.mark.parametrize("name", ["median", "mog2", "knn", "reference"])
def test_what_was_learnt_can_be_saved(name):
    first, second = made(name), made(name)
    first.prime(walking(40))
    first.apply(observed(1))
    second.restore(first.state())
    difference = np.abs(first.apply(observed(2, x=60)) - second.apply(observed(2, x=60)))
    assert (difference > 0.1).mean() < (0.001 if name in ("median", "reference") else 0.02)


@pytest.mark.parametrize("name", LEARNING)
def test_nothing_learnt_is_nothing_saved(name):
    model = made(name)
    assert model.state() == {}
    model.restore({})
    assert np.abs(model.apply(observed(0)) - 0.5).max() <= 0.5 / SAMPLES + 1e-6


def test_the_median_of_people_who_walk_is_the_empty_room():
    model = MedianBackground()
    model.prime(walking(60))
    assert np.abs(model.image.astype(int) - room()).mean() < 1.5


def test_probabilities_are_the_callers_own():
    model = made("reference")
    first = model.apply(observed(0, x=30))
    before = first.copy()
    model.apply(observed(1, x=90))
    np.testing.assert_array_equal(first, before)


@pytest.mark.parametrize("name", ["median", "mog2", "knn"])
def test_grey_images_work_as_well(name):
    model = made(name)
    model.prime([cv2.cvtColor(observed(i), cv2.COLOR_BGR2GRAY) for i in range(20)])
    image = cv2.cvtColor(observed(30), cv2.COLOR_BGR2GRAY)
    image[person(60)] = 255
    assert ((model.apply(image) > 0.5) != person(60)).mean() < 0.02


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("median", {"difference": 0.0}, "difference must be from 1 to 255; got 0"),
        ("median", {"learn_every": -1}, "learn_every must be from 0"),
        ("mog2", {"shadow_probability": 1.5}, "shadow_probability must be from 0 to 1; got 1.5"),
        ("knn", {"history": 0}, "history must be from 1"),
        ("gauss", {}, "background must be one of knn, median, mog2, reference; got 'gauss'"),
    ],
)
def test_wrong_choices_are_named(name, options, message):
    with pytest.raises(ValueError, match=message):
        background(name, **options)


@pytest.mark.parametrize("name", ["median", "mog2", "knn", "reference"])
def test_images_of_another_shape_are_named(name):
    model = made(name)
    model.apply(observed(0))
    with pytest.raises(ValueError, match=r"image must be uint8 \(90, 120, 3\) like the background; got uint8 \(89,"):
        model.apply(observed(0)[1:])


def test_wrong_images_are_named():
    with pytest.raises(ValueError, match="image must be uint8"):
        background("reference", room().astype(float))
    with pytest.raises(ValueError, match="at least one; got none"):
        background("median").prime([])


@pytest.mark.system
@pytest.mark.data
@pytest.mark.parametrize(("name", "least"), [("median", 0.84), ("mog2", 0.78), ("knn", 0.76)])
def test_real_people_are_found_as_in_the_silhouettes_of_the_recording(data_dir, name, least):
    """Undistorted frames against what a median of the whole recording gives."""
    folder = data_dir / "pets09_s2l1_view001"
    calibration = json.loads((folder / "calibration.json").read_text())
    undistortion = Undistortion(
        (360, 480), np.array(calibration["K_480x360"]), np.array(calibration["opencv_distCoeffs"])
    )
    with np.load(folder / "silhouettes_undistorted_480x360.npz") as arrays:
        expected = np.unpackbits(arrays["bits"], axis=-1)[..., :480].astype(bool)
    video = cv2.VideoCapture(str(folder / "vtest_480x360.avi"))
    images = [undistortion.apply(video.read()[1]) for _ in range(200)]
    model = background(name)
    model.prime(images[::8])
    masks = [model.apply(image) > 0.5 for image in images[100:]]
    ious = [(mask & truth).sum() / (mask | truth).sum() for mask, truth in zip(masks, expected[100:200], strict=True)]
    assert np.median(ious) > least
