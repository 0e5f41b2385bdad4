from dataclasses import replace

import cv2
import numpy as np
import pytest

from jaxfilters.models.articulated.features import KEYPOINTS
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.models.synthetic.articulated import paper_hand
from jaxfilters.trackers.articulated import summary as articulated_summary
from jaxfilters.trackers.articulated.drawing import scene
from jaxfilters.trackers.articulated.recording import from_keypoints
from jaxfilters.trackers.articulated.summary import LAST_FRAMES, draw_summary, errors_of, write_summary
from jaxfilters.trackers.io.errors import OutputError

HAND, LAYOUT = paper_hand(), Layout(2)
MONTAGE, CHART = 240, 180


def test_errors_are_those_of_the_last_frames(features, perfect_track):
    mean = perfect_track.mean.astype(float)
    mean[:, LAYOUT.angles] += np.deg2rad(50)
    mean[-LAST_FRAMES:, LAYOUT.angles] -= np.deg2rad(50)
    mean[-LAST_FRAMES:, LAYOUT.angles] += np.deg2rad([1, -2, 3, -4, 1, -2, 3, -4])
    mean[:-1, LAYOUT.lengths] += 100
    mean[-1, LAYOUT.lengths] += [0.1, -0.15, 0.3, 0.1, -0.5, 0.05]
    errors = errors_of(features, LAYOUT, perfect_track._replace(mean=mean))
    assert errors.angle_deg == pytest.approx(2.5, rel=1e-4)
    assert errors.length_px == pytest.approx(0.2, rel=1e-4)
    # The standard deviation is 0.1 everywhere: two of six are farther off than twice that.
    assert errors.within_2_sigma == pytest.approx(4 / 6)


def test_a_whole_turn_is_no_error(features, perfect_track):
    mean = perfect_track.mean.astype(float)
    mean[:, LAYOUT.angles] += 2 * np.pi * np.arange(-4, 4)
    assert errors_of(features, LAYOUT, perfect_track._replace(mean=mean)).angle_deg < 1e-3


def test_frames_without_estimate_or_truth_do_not_count(features, perfect_track):
    truth, mean = features.truth.copy(), perfect_track.mean.astype(float)
    mean[-1], truth[-2] = np.nan, np.nan
    mean[-3, LAYOUT.lengths] += 0.5
    errors = errors_of(replace(features, truth=truth), LAYOUT, perfect_track._replace(mean=mean))
    assert errors.length_px == pytest.approx(0.5, rel=1e-4)
    nothing = perfect_track._replace(mean=np.full_like(mean, np.nan))
    assert errors_of(features, LAYOUT, nothing) is None
    assert errors_of(replace(features, truth=None), LAYOUT, perfect_track) is None


def blanked(track, gaps):
    fields = {name: getattr(track, name).copy() for name in ("mean", "std", "points", "image_points", "scale")}
    for array in fields.values():
        array[gaps] = np.nan
    return track._replace(**fields)


@pytest.mark.parametrize("gaps", [slice(0), slice(0, None, 2), slice(None)])
def test_the_picture_has_frames_and_charts(tmp_path, features, perfect_track, gaps):
    track = blanked(perfect_track, gaps)
    write_summary(tmp_path / "s.png", features, LAYOUT, scene(features, HAND, track), track)
    picture = cv2.imread(str(tmp_path / "s.png"))
    assert picture.shape == (MONTAGE + 3 * CHART, 960, 3)
    # Every tile shows something, every chart its paper.
    tiles = picture[:MONTAGE].reshape(240, 4, 240, 3)
    assert (tiles.max(axis=(0, 2, 3)) > 100).all()
    assert (picture[MONTAGE:] == 255).mean() > 0.5
    with pytest.raises(OutputError, match="cannot write"):
        write_summary(tmp_path / "missing" / "s.png", features, LAYOUT, scene(features, HAND, track), track)


@pytest.fixture
def curves(monkeypatch):
    """What is drawn, as `(title, curves)` of every chart."""
    drawn = []

    def draw_chart(size, title, x, curves, x_label="", *, from_zero=False):
        drawn.append((title, curves))
        return np.full((*size, 3), 255, np.uint8)

    monkeypatch.setattr(articulated_summary, "draw_chart", draw_chart)
    return drawn


def test_charts_show_the_truth_and_bands_of_two_sigma(features, perfect_track, curves):
    # The same rotation as the truth, with the other sign.
    mean = perfect_track.mean.copy()
    mean[:, LAYOUT.quaternion] *= -1
    track = perfect_track._replace(mean=mean)
    draw_summary(features, LAYOUT, scene(features, HAND, track), track)
    titles = [title for title, _ in curves]
    assert titles == [
        "scale",
        "q_x, with 2 sigma",
        "theta_13, degrees, with 2 sigma",
        "hypotheses",
        *["px"] * 3,
    ]
    for title, pair in curves[:3]:
        truth, estimate = pair
        assert truth.label == "truth"
        np.testing.assert_allclose(estimate.values, truth.values, rtol=1e-4, atol=1e-4, err_msg=title)
    np.testing.assert_allclose(curves[1][1][1].half_width, 0.2)
    np.testing.assert_allclose(curves[2][1][1].half_width, np.rad2deg(0.2), rtol=1e-6)
    np.testing.assert_array_equal(curves[3][1][0].values, track.num_hypotheses)
    labels = [[curve.label for curve in drawn if curve.label] for _, drawn in curves[4:]]
    assert labels == [["r_11", "r_12", "r_13"], ["r_21", "r_22", "r_23"], ["r_w", "r_h", "r_d"]]
    estimate = curves[4][1][5]
    np.testing.assert_array_equal(estimate.values, track.mean[:, LAYOUT.names.index("r_13")])
    np.testing.assert_allclose(estimate.half_width, 0.2)


def test_without_truth_there_is_none_in_the_charts(features, perfect_track, curves):
    unknown = replace(features, truth=None)
    draw_summary(unknown, LAYOUT, scene(unknown, HAND, perfect_track), perfect_track)
    assert [len(drawn) for _, drawn in curves] == [1, 1, 1, 1, 3, 3, 3]


def test_five_fingers_have_six_charts_of_lengths(perfect_track):
    hand = articulated_hand(five_fingers(), features=KEYPOINTS)
    points = np.random.default_rng(0).uniform(0, 300, (3, 21, 2))
    sequence = from_keypoints(np.arange(3.0), points, "a")
    first = type(perfect_track)(*(field[:3] for field in perfect_track))
    mean = np.ones((3, hand.layout.size), np.float32)
    joints = np.zeros((3, 5, 4, 3), np.float32)
    of_five = {"mean": mean, "std": 0 * mean, "points": joints, "image_points": joints[..., :2]}
    track = first._replace(times_s=sequence.times_s, **of_five)
    assert draw_summary(sequence, hand.layout, scene(sequence, hand, track), track).shape == (
        MONTAGE + 4 * CHART,
        960,
        3,
    )


def test_one_frame_is_enough(features, perfect_track):
    names = ("times_s", "y", "std", "truth")
    one = replace(features, **{name: getattr(features, name)[:1] for name in names})
    first = type(perfect_track)(*(field[:1] for field in perfect_track))
    assert draw_summary(one, LAYOUT, scene(one, HAND, first), first).shape[1] == 960
