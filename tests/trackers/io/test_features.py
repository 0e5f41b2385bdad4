import numpy as np
import pytest

from jaxfilters.models.articulated.features import FULL, KEYPOINTS
from jaxfilters.models.articulated.layout import Layout
from jaxfilters.trackers.articulated.recording import NOISE_SHARE, persistence
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.features import open_features

FRAMES, ROWS, N = 4, 29, Layout(2).size
NAMES = np.asarray(FULL.names(2))
RNG = np.random.default_rng(0)
FEATURES = {
    "features": RNG.normal(size=(FRAMES, ROWS)),
    "names": NAMES,
    "noise_std": np.linspace(1, 2, ROWS),
    "t_s": np.asarray([1.0, 1.5, 1.75, 3.0]),
    "image_shape": np.asarray([480, 640]),
    "start_mean": np.ones(N),
    "start_covariance": np.eye(N),
    "truth_states": RNG.normal(size=(FRAMES, N)),
}
KEYPOINT_ARRAYS = {"keypoints": RNG.uniform(0, 500, (FRAMES, 21, 2)), "noise_px": np.asarray(3.0)}
RAISED = persistence(np.arange(FRAMES) / 30)


@pytest.fixture
def npz(tmp_path):
    """Writes a good recording with some arrays replaced, or left out where None."""

    def write(arrays, **changes):
        kept = {name: array for name, array in (arrays | changes).items() if array is not None}
        np.savez(tmp_path / "a.npz", **kept)
        return tmp_path / "a.npz"

    return write


def test_features_come_back_as_they_were_written(npz):
    sequence = open_features(npz(FEATURES))
    assert (sequence.num_fingers, sequence.features, sequence.image_shape) == (2, FULL, (480, 640))
    np.testing.assert_array_equal(sequence.y, FEATURES["features"])
    np.testing.assert_array_equal(sequence.std, np.tile(FEATURES["noise_std"], (FRAMES, 1)))
    np.testing.assert_array_equal(sequence.times_s, FEATURES["t_s"])
    np.testing.assert_array_equal(sequence.start.mean, FEATURES["start_mean"])
    np.testing.assert_array_equal(sequence.start.covariance, FEATURES["start_covariance"])
    np.testing.assert_array_equal(sequence.truth, FEATURES["truth_states"])


def test_columns_are_found_by_their_names(npz):
    order = np.random.default_rng(1).permutation(ROWS)
    std = np.random.default_rng(2).uniform(1, 2, (FRAMES, ROWS))
    shuffled = {"features": FEATURES["features"][:, order], "names": NAMES[order], "noise_std": std[:, order]}
    sequence = open_features(npz(FEATURES, **shuffled))
    np.testing.assert_array_equal(sequence.y, FEATURES["features"])
    np.testing.assert_array_equal(sequence.std, std)


def test_a_mask_and_nan_both_mean_missing(npz):
    mask, y = np.ones((FRAMES, ROWS), bool), FEATURES["features"].copy()
    mask[1, 2], y[2, 7] = False, np.nan
    sequence = open_features(npz(FEATURES, mask=mask, features=y))
    np.testing.assert_array_equal(np.argwhere(np.isnan(sequence.y)), [[1, 2], [2, 7]])
    assert sequence[1].mask.sum() == ROWS - 1


@pytest.mark.parametrize(
    ("arrays", "fps", "times_s"),
    [
        ({}, None, np.arange(4) / 30),
        ({}, 10.0, np.arange(4) / 10),
        ({"fps": 25.0}, 10.0, np.arange(4) / 25),
        ({"t_us": np.asarray([0, 10, 30, 40])}, 10.0, np.asarray([0, 1, 3, 4]) * 1e-5),
    ],
)
def test_times_come_from_the_file_or_the_frame_rate(npz, arrays, fps, times_s):
    sequence = open_features(npz(FEATURES, t_s=None, **arrays), fps=fps)
    np.testing.assert_allclose(sequence.times_s, times_s, atol=1e-15)


def test_keypoints_have_the_noise_of_the_option_of_the_file_or_of_their_size(npz):
    file = npz(KEYPOINT_ARRAYS, image_shape=np.asarray([480, 640]))
    sequence = open_features(file)
    assert (sequence.num_fingers, sequence.features, sequence.image_shape) == (5, KEYPOINTS, (480, 640))
    assert sequence.start is None
    np.testing.assert_allclose(sequence.std, 3.0 * RAISED)
    np.testing.assert_allclose(open_features(file, noise_px=5.0).std, 5.0 * RAISED)
    assert open_features(file, image_size=(320, 240)).image_shape == (240, 320)
    extents = np.ptp(KEYPOINT_ARRAYS["keypoints"], axis=1)
    expected = NOISE_SHARE * np.median(np.hypot(*extents.T))
    np.testing.assert_allclose(open_features(npz(KEYPOINT_ARRAYS, noise_px=None)).std, expected * RAISED)


def test_keypoints_may_have_confidences_a_start_and_a_truth(npz):
    n = Layout(5).size
    confidence = np.full((FRAMES, 21), 0.6)
    confidence[:, 0] = 0
    start = {"start_mean": np.ones(n), "start_covariance": np.eye(n), "truth_states": np.zeros((FRAMES, n))}
    sequence = open_features(npz(KEYPOINT_ARRAYS, confidence=confidence, **start))
    assert not sequence[0].mask[:2].any()
    np.testing.assert_allclose(sequence.std[:, 2:], 5.0 * RAISED)
    assert sequence.start.mean.shape == (n,)
    assert sequence.truth.shape == (FRAMES, n)


WRONG_FEATURES = {
    "no features": ({"features": None}, "expected features .* or keypoints .*; got names, noise_std, t_s"),
    "no names": ({"names": None}, r"\['names'\] missing; features \(T, rows\) need names"),
    "no noise": ({"noise_std": None}, r"\['noise_std'\] missing"),
    "one frame alone": ({"features": np.zeros(ROWS)}, r"features must be \(T, rows\) .*; got \(29,\) and \(29,\)"),
    "a name too few": ({"names": NAMES[1:]}, r"names \(rows,\); got \(4, 29\) and \(28,\)"),
    "an unknown name": ({"names": np.where(NAMES == "wrist_x", "wirst_x", NAMES)}, "no feature: wirst_x; expected"),
    "names that are objects": ({"names": NAMES.astype(object)}, "not a complete .npz file .*objects, not numbers"),
    "features in words": ({"features": np.full((FRAMES, ROWS), "x")}, "features must be numbers; got <U1"),
    "a mask of another size": ({"mask": np.ones((FRAMES, 2), bool)}, r"mask must be \(4, 29\) bool; got \(4, 2\) bool"),
    "a mask of numbers": ({"mask": np.ones((FRAMES, ROWS))}, r"mask must be \(4, 29\) bool; got \(4, 29\) float64"),
    "noise of another size": ({"noise_std": np.ones(3)}, r"noise_std must be \(29,\) or \(4, 29\); got \(3,\)"),
    "noise that is NaN": ({"noise_std": np.full(ROWS, np.nan)}, "noise must be positive .* frame 0, wrist_x: nan"),
    "negative noise": ({"noise_std": -np.ones(ROWS)}, "noise must be positive .* frame 0, wrist_x: -1.0"),
    "times that go back": ({"t_s": np.asarray([0, 2, 1, 3.0])}, "times must increase strictly; frame 1 is at 2.0"),
    "a time too few": ({"t_s": np.arange(3.0)}, r"t_s: expected 4 times, one a frame; got shape \(3,\)"),
    "a frame rate of zero": ({"t_s": None, "fps": 0.0}, "fps must be positive; got 0.0"),
    "frame rates": ({"t_s": None, "fps": np.ones(4)}, r"fps must be one number; got shape \(4,\)"),
    "an image without rows": ({"image_shape": np.asarray([0, 640])}, "image_shape must be rows and columns, positive"),
    "half a start": ({"start_mean": None}, "belong together; only start_covariance is there"),
    "a start of another hand": ({"start_mean": np.ones(26)}, r"start must be a mean \(37,\)"),
    "truth of another hand": ({"truth_states": np.ones((FRAMES, 26))}, r"truth must be \(4, 37\) .*; got \(4, 26\)"),
}


@pytest.mark.parametrize("what", WRONG_FEATURES)
def test_wrong_features_are_named(npz, what):
    changes, message = WRONG_FEATURES[what]
    with pytest.raises(InputError, match=rf"a\.npz: .*{message}"):
        open_features(npz(FEATURES, **changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keypoints": np.zeros((21, 2))}, r"keypoints must be \(T, 21, 2\); got \(21, 2\)"),
        ({"keypoints": np.zeros((4, 21, 3))}, r"keypoints must be \(4, 21, 2\); got \(4, 21, 3\)"),
        ({"confidence": np.ones((21, 4))}, r"confidence must be \(4, 21\); got \(21, 4\)"),
        ({"noise_px": np.asarray(-1.0)}, "noise must be positive, in pixels; got -1.0"),
        ({"noise_px": np.ones(21)}, r"noise_px must be one number; got shape \(21,\)"),
        ({"keypoints": np.full((4, 21, 2), np.nan)}, "no keypoint has a confidence of 0.2 or more in any frame"),
        ({"keypoints": np.zeros((0, 21, 2))}, "no keypoint|at least one frame"),
    ],
)
def test_wrong_keypoints_are_named(npz, changes, message):
    with pytest.raises(InputError, match=rf"a\.npz: .*({message})"):
        open_features(npz(KEYPOINT_ARRAYS, **changes))


@pytest.mark.parametrize("kept", [0, 10, 300, -200])
def test_a_truncated_file_is_refused(npz, kept):
    file = npz(FEATURES)
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"a\.npz: not a complete \.npz file"):
        open_features(file)


def test_a_damaged_file_is_refused(npz):
    file = npz(FEATURES)
    content = bytearray(file.read_bytes())
    content[200:800] = bytes(600)
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.npz: not a complete \.npz file"):
        open_features(file)


def test_an_array_that_is_no_archive_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    (tmp_path / "a.npy").rename(tmp_path / "a.npz")
    with pytest.raises(InputError, match=r"a\.npz: not a complete \.npz file"):
        open_features(tmp_path / "a.npz")


def test_options_that_do_not_fit_are_named(npz):
    with pytest.raises(InputError, match="--noise is for keypoints; features have their own noise_std"):
        open_features(npz(FEATURES), noise_px=2.0)
    with pytest.raises(InputError, match=r"fps must be positive; got 0\.0"):
        open_features(npz(FEATURES), fps=0.0)
    with pytest.raises(InputError, match="nowhere: no such file or folder"):
        open_features("nowhere")
