from dataclasses import replace

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.models.articulated.features import KEYPOINTS
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.layout import five_fingers
from jaxfilters.models.synthetic.articulated import paper_hand
from jaxfilters.trackers.articulated import drawing as articulated_draw
from jaxfilters.trackers.articulated.drawing import Canvas, draw_frame, scene, write_overlay
from jaxfilters.trackers.articulated.recording import from_keypoints
from jaxfilters.trackers.hand_depth.drawing import FINGER_COLORS
from jaxfilters.trackers.io.errors import OutputError

HAND = paper_hand()


def without_estimates(track):
    nothing = {name: np.full_like(getattr(track, name), np.nan) for name in ("mean", "std", "points", "image_points")}
    return track._replace(**nothing)


def pixel(image, canvas, point):
    u, v = canvas.place(np.asarray(point, float)).round().astype(int)
    return image[v, u]


def painted(image, without, canvas):
    """(points, 2) of the image plane that differ between two pictures."""
    v, u = np.nonzero((image != without).any(axis=-1))
    return (np.stack([u, v], axis=-1) + 0.5) / canvas.scale - 0.5 + np.asarray(canvas.corner)


def test_a_small_image_is_enlarged_in_whole_pixels(features, perfect_track):
    canvas = scene(replace(features, image_shape=(100, 160)), HAND, perfect_track).canvas
    assert canvas == Canvas((500, 800), (0.0, 0.0), 5.0)
    # The middle of image pixel 0 is the middle of a block of 5 pixels.
    np.testing.assert_array_equal(canvas.place(np.asarray([[0.0, 0.0], [159.0, 99.0]])), [[2, 2], [797, 497]])
    assert scene(replace(features, image_shape=(720, 1280)), HAND, perfect_track).canvas.shape == (720, 1280)


def test_without_an_image_the_picture_holds_the_hand(features, perfect_track):
    drawn = scene(features, HAND, perfect_track)
    rows, columns = drawn.canvas.shape
    assert rows >= 480
    assert columns % 2 == 0
    places = drawn.canvas.place(drawn.joints)
    assert (places > 0).all()
    assert (places < [columns, rows]).all()
    assert np.ptp(places[..., 0]) > 0.5 * columns or np.ptp(places[..., 1]) > 0.5 * rows


def test_links_have_the_colours_of_their_fingers_where_the_hand_is(features, perfect_track):
    drawn = scene(replace(features, truth=None), HAND, perfect_track)
    image = draw_frame(drawn, 0)
    for finger in range(2):
        for link in range(3):
            middle = drawn.joints[0, finger, link : link + 2].mean(axis=0)
            np.testing.assert_array_equal(pixel(image, drawn.canvas, middle), FINGER_COLORS[finger])
        np.testing.assert_array_equal(pixel(image, drawn.canvas, drawn.joints[0, finger, 3]), (255, 255, 255))


def test_the_truth_is_white_under_the_estimate(features, perfect_track):
    apart = perfect_track._replace(image_points=perfect_track.image_points + np.float32([40, 0]))
    drawn = scene(features, HAND, apart)
    image = draw_frame(drawn, 0)
    middle = perfect_track.image_points[0, 0, 1:3].mean(axis=0)
    without = draw_frame(drawn._replace(true_joints=None), 0)
    assert pixel(image, drawn.canvas, middle).min() > 150
    assert pixel(without, drawn.canvas, middle).min() < 100


def test_measured_lines_lie_where_they_were_measured(features, perfect_track):
    """What one line adds to a picture lies on it, n . p = rho, and beside its link."""
    names, moved = features.features.names(2), 12.0
    rows = [names.index("alpha_12"), names.index("rho_12")]
    y = np.full_like(features.y, np.nan)
    y[:, rows] = features.y[0, rows] + [0.0, moved]
    drawn = scene(replace(features, y=y, truth=None), HAND, perfect_track)
    nothing = drawn.measured._replace(lines=np.full_like(drawn.measured.lines, np.nan))
    points = painted(draw_frame(drawn, 0), draw_frame(drawn._replace(measured=nothing), 0), drawn.canvas)
    alpha, rho = y[0, rows]
    distances = points @ [-np.sin(alpha), np.cos(alpha)] - rho
    assert len(points) > 20
    assert abs(distances.mean()) < 0.3
    assert np.abs(distances).max() < 1.5
    link = drawn.joints[0, 0, 1:3]
    assert np.linalg.norm(points.mean(axis=0) - link.mean(axis=0)) < moved + 6
    assert np.ptp(points, axis=0).max() < 1.5 * np.linalg.norm(link[1] - link[0])


def test_measured_points_and_the_outline_of_the_palm_are_drawn(features, perfect_track):
    # The estimate lies elsewhere, so that it hides nothing.
    apart = perfect_track._replace(image_points=perfect_track.image_points + np.float32([200, 0]))
    drawn = scene(replace(features, truth=None), HAND, apart)
    image = draw_frame(drawn, 0)
    names = features.features.names(2)
    tip = features.y[0, [names.index("p_13_x"), names.index("p_13_y")]]
    np.testing.assert_array_equal(pixel(image, drawn.canvas, tip), articulated_draw._MEASURED)
    corner = drawn.palm[0][np.argmin(drawn.palm[0] @ [1, 1])]
    assert (np.abs(pixel(image, drawn.canvas, corner).astype(int) - articulated_draw._PALM) < 90).all()


def test_the_palm_has_the_outline_that_the_features_have(features, perfect_track):
    """rho_min and rho_max of the corners along the palm's axis are what the model observes."""
    drawn = scene(features, HAND, perfect_track)
    exact = np.asarray(jax.jit(jax.vmap(HAND.observe))(features.truth.astype(np.float32)))
    names = features.features.names(2)
    alpha, low, high = (exact[:, names.index(name)] for name in ("palm_alpha", "palm_rho_min", "palm_rho_max"))
    normal = np.stack([-np.sin(alpha), np.cos(alpha)], axis=-1)
    rho = np.einsum("tkd,td->tk", drawn.palm, normal)
    np.testing.assert_allclose(rho.min(axis=1), low, atol=1e-3)
    np.testing.assert_allclose(rho.max(axis=1), high, atol=1e-3)


def test_frames_without_an_estimate_show_what_was_measured(features, perfect_track):
    drawn = scene(replace(features, truth=None), HAND, without_estimates(perfect_track))
    measured, nothing = draw_frame(drawn, 0), draw_frame(drawn, 5)
    assert (measured == articulated_draw._MEASURED).all(axis=-1).any()
    assert (nothing == articulated_draw._PAPER).all()


@pytest.mark.parametrize("far", [np.inf, -np.inf, 1e9])
def test_joints_that_are_nowhere_are_left_out(features, perfect_track, far):
    points = perfect_track.image_points.copy()
    points[0, 0, 3] = far
    drawn = scene(replace(features, image_shape=(240, 320)), HAND, perfect_track._replace(image_points=points))
    assert draw_frame(drawn, 0).any()


def test_five_fingers_from_keypoints_have_five_colours(nothing_tracked):
    hand = articulated_hand(five_fingers(), features=KEYPOINTS)
    x = np.zeros((2, hand.layout.size), np.float32)
    x[:, hand.layout.position], x[:, hand.layout.quaternion] = (200, 200), (0.5, -0.5, 0.5, -0.5)
    x[:, hand.layout.static] = 40
    points = np.asarray(jax.jit(jax.vmap(hand.points))(x))
    keypoints = np.concatenate([x[:, None, :2], points[..., :2].reshape(2, 20, 2)], axis=1)
    sequence = from_keypoints(np.arange(2.0), keypoints, "a")
    track = nothing_tracked(hand.layout, 2)
    track = track._replace(times_s=sequence.times_s, mean=x, points=points, image_points=points[..., :2])
    drawn = scene(sequence, hand, track)
    image = draw_frame(drawn, 0)
    for finger, color in enumerate(FINGER_COLORS):
        middle = points[0, finger, 2:4, :2].mean(axis=0)
        np.testing.assert_array_equal(pixel(image, drawn.canvas, middle), color)


def test_the_video_has_every_frame_at_the_pace_of_the_recording(tmp_path, features, perfect_track):
    done, drawn = [], scene(features, HAND, perfect_track)
    write_overlay(tmp_path / "o.mp4", drawn, perfect_track, 50.0, done.append)
    assert done == list(range(1, len(features) + 1))
    video = cv2.VideoCapture(str(tmp_path / "o.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(features)
    assert abs(video.get(cv2.CAP_PROP_FPS) - 25) < 0.25
    _, image = video.read()
    video.release()
    expected = draw_frame(drawn, 0)
    assert image.shape == expected.shape
    below_the_text = slice(60, None)
    assert np.abs(image[below_the_text].astype(int) - expected[below_the_text]).mean() < 10


def test_status_and_hypotheses_are_said_in_every_frame(features, perfect_track, monkeypatch):
    said = []
    monkeypatch.setattr(articulated_draw, "caption", lambda image, text, line, *color: said.append(text))
    list(articulated_draw._captioned(scene(features, HAND, perfect_track), perfect_track, float("nan")))
    assert said[1:6:2] == ["searching   0 hypotheses", "tracking   1 hypothesis", "lost   2 hypotheses"]
    assert said[2] == "frame 1     0.04 s   "


def test_a_video_that_cannot_be_written_is_named(tmp_path, features, perfect_track):
    with pytest.raises(OutputError, match=r"missing/o.mp4"):
        write_overlay(tmp_path / "missing" / "o.mp4", scene(features, HAND, perfect_track), perfect_track, 1.0, print)
