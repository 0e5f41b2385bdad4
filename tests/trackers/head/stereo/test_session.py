"""Whole sessions on a drawn face before two cameras: starting, following, losing, finding again, and refusing."""

import time
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.rig import nominal
from jaxfilters.models.synthetic.face_sequence import sequence
from jaxfilters.trackers.head.common import following, mesh
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.detect import STABLE_FRAMES, Detection
from jaxfilters.trackers.head.common.state import DEFORMABLE, DOUBTFUL, INITIALISING, LOST, NUM_MODES, RIGID
from jaxfilters.trackers.head.stereo import session as module
from jaxfilters.trackers.head.stereo.session import HeadSession
from jaxfilters.trackers.head.stereo.tracking import PATIENCE
from jaxfilters.trackers.io import checkpoint

MIDDLE, EYES_APART, DISPARITY = (394.0, 200.0), 77.5, 150
"""Of the drawn face, pixels: 62 mm between the eyes, 640 mm away."""


@pytest.fixture(scope="module")
def drawn(draw_face):
    """Frames of a flat face that holds still before two cameras, and its landmarks in the first."""

    def frames(count, middle=MIDDLE, eyes_apart=EYES_APART, seed=0):
        left, points = draw_face(middle, eyes_apart)
        right = np.full_like(left, 40)
        right[:, :-DISPARITY] = left[:, DISPARITY:]
        return with_noise(np.stack([left, right]), count, seed), points

    return frames


def with_noise(images, count, seed):
    noise = np.random.default_rng(seed).normal(0, 2, (count, *images.shape))
    return np.clip(np.round(images + noise), 0, 255).astype(np.uint8)


def snow(count, seed=1):
    return np.random.default_rng(seed).integers(0, 256, (count, 2, 480, 640), np.uint8)


def times(count, start=0):
    return np.arange(start, start + count) / 30


def said(session):
    return [what for _, what in session.events]


@pytest.mark.system
def test_a_face_that_holds_still_is_detected_registered_and_followed(drawn):
    images, _ = drawn(STABLE_FRAMES + 8)
    session = HeadSession(nominal())
    assert session.model is None
    assert session.contribution == 0
    track = session.process(images, times(len(images)))
    waited = np.arange(len(images)) < STABLE_FRAMES
    np.testing.assert_array_equal(track.status, np.where(waited, INITIALISING, RIGID))
    assert np.all(np.isnan(track.pose[waited]))
    assert np.all(np.isnan(track.score[waited]))
    # 0.2 px off in one image are 0.9 mm of depth.
    np.testing.assert_allclose(track.pose[~waited][:, :3], np.tile([0.0596, -0.0119, 0.64], (8, 1)), atol=0.002)
    np.testing.assert_allclose(track.pose[~waited][:, 3:], 0, atol=np.radians(1))
    assert track.score[~waited].min() > 0.9
    assert session.events == [(STABLE_FRAMES - 1, "registered")]
    assert session.model.mean.shape == (NUM_LANDMARKS, 3)


@pytest.fixture(scope="module")
def moving():
    video = sequence(jax.random.key(2), "slow", 21, 2)
    return video, video.frames(0, 21)


@pytest.fixture(scope="module")
def whole(moving):
    video, images = moving
    return HeadSession(video.rig, points=video.uv[0, 0].astype(float)).process(images, video.times)


@pytest.mark.system
def test_given_points_register_the_first_frame(moving, whole):
    video, _ = moving
    np.testing.assert_array_equal(whole.status, [INITIALISING] + [RIGID] * 20)
    error = (whole.pose - video.poses * [1e-3, 1e-3, 1e-3, 1, 1, 1])[1:]
    assert np.abs(error[:, :2]).max() < 0.0002
    assert np.abs(error[:, 2]).max() < 0.001
    assert np.abs(error[:, 3:]).max() < np.radians(0.5)
    shapes = whole.pose, whole.deformation, whole.shape, whole.image_points
    assert [a.shape for a in shapes] == [(21, 6), (21, NUM_MODES), (21, 10, 3), (21, 2, 10, 2)]
    np.testing.assert_allclose(whole.image_points[1:], video.uv[1:], atol=0.5)


@pytest.mark.system
@pytest.mark.parametrize("sizes", [(1, 3, 9, 8), (0, 21), (10, 0, 11)])
def test_pieces_of_any_size_give_the_same_rows(moving, whole, sizes):
    """But for the rounding of intervals, which the fit to the images forgets."""
    video, images = moving
    session, done, rows = HeadSession(video.rig, points=video.uv[0, 0].astype(float)), 0, []
    for size in sizes:
        rows.append(session.process(images[done : done + size], video.times[done : done + size]))
        assert len(rows[-1].pose) == size
        done += size
    pieces = jax.tree.map(lambda *parts: np.concatenate(parts), *rows)
    np.testing.assert_array_equal(pieces.status, whole.status)
    np.testing.assert_allclose(pieces.pose[:, :3], whole.pose[:, :3], atol=2e-6)
    np.testing.assert_allclose(pieces.pose[:, 3:], whole.pose[:, 3:], atol=2e-3)
    np.testing.assert_allclose(pieces.image_points, whole.image_points, atol=0.01)


@pytest.mark.system
def test_a_session_goes_on_from_a_file_bit_for_bit(moving, tmp_path):
    video, images = moving
    points = video.uv[0, 0].astype(float)
    first, second = HeadSession(video.rig, points=points), HeadSession(video.rig, points=points)
    assert first.saved() is None
    first.process(images[:9], video.times[:9])
    checkpoint.save(tmp_path / "c.npz", first.saved(), {})
    second.restore(checkpoint.load(tmp_path / "c.npz")[0])
    expected, rows = (session.process(images[9:], video.times[9:]) for session in (first, second))
    jax.tree.map(np.testing.assert_array_equal, rows, expected)
    assert second.events == first.events


@pytest.mark.system
def test_a_clock_that_counts_from_long_ago_does_not_matter(moving, whole):
    """Single precision has steps of 128 s at this time."""
    video, images = moving
    late = HeadSession(video.rig, points=video.uv[0, 0].astype(float)).process(images, video.times + 1.7e9)
    np.testing.assert_allclose(late.pose[:, :3], whole.pose[:, :3], atol=2e-6)
    np.testing.assert_allclose(late.pose[:, 3:], whole.pose[:, 3:], atol=2e-3)


@pytest.mark.system
def test_a_lost_face_is_reported_and_found_again(drawn):
    """Where it was lost it is found by the search; elsewhere where it is detected; another one is registered anew."""
    start, points = drawn(6)
    gone = PATIENCE + 6
    same_place, _ = drawn(7, seed=2)
    elsewhere, _ = drawn(10, (MIDDLE[0] - 60, MIDDLE[1] + 90), seed=3)
    other, _ = drawn(10, (MIDDLE[0] + 30, MIDDLE[1] - 20), 1.2 * EYES_APART, seed=4)
    pieces = [start, np.full_like(snow(gone), 90), same_place, snow(gone, 5), elsewhere, snow(gone, 6), other]
    session = HeadSession(nominal(), points=points)
    images = np.concatenate(pieces)
    track = session.process(images, times(len(images)))
    ends = np.cumsum([len(piece) for piece in pieces])
    for begin in ends[[0, 2, 4]]:
        status = track.status[begin : begin + gone]
        assert np.all(status[: PATIENCE - 1] == DOUBTFUL)
        assert np.all(status[PATIENCE - 1 :] == LOST)
        for rows in (track.pose, track.pose_std, track.shape, track.image_points):
            assert np.all(np.isnan(rows[begin + PATIENCE - 1 : begin + gone]))
    for end, middle in zip(ends[[2, 4]], (MIDDLE, (MIDDLE[0] - 60, MIDDLE[1] + 90)), strict=True):
        assert track.status[end - 1] == RIGID
        np.testing.assert_allclose(track.image_points[end - 1, 0, :4].mean(axis=0), middle, atol=2)
    found = ["found again near where it was lost", "found again where it is detected", "registered"]
    events = [(i, what) for i, what in session.events if what == "lost" or what in found]
    assert [what for _, what in events] == ["registered", "lost", found[0], "lost", found[1], "lost", found[2]]
    assert [i for i, what in events if what == "lost"] == [e + PATIENCE - 1 for e in ends[[0, 2, 4]]]
    assert events[2][0] in range(ends[1], ends[2])
    # A tenth of a second is the longest that a face which is seen well waits for a comparison.
    assert events[4][0] in range(ends[3], ends[3] + 4)


@pytest.mark.system
def test_what_was_learnt_is_kept_for_a_known_face(drawn):
    images, points = drawn(2)
    session = HeadSession(nominal(), points=points)
    session.process(images, times(2))
    state = session._following.state
    modes = np.linalg.qr(np.random.default_rng(0).normal(size=(30, NUM_MODES)))[0].astype(np.float32)
    subspace = state.learner.subspace._replace(vectors=jax.numpy.asarray(9 * modes.T))
    model = type(state.model)(state.model.mean, jax.numpy.asarray(modes), 3 * jax.numpy.ones(5), state.model.templates)
    session._following.state = state._replace(
        model=model, learner=state.learner._replace(subspace=subspace), age=state.age + 500
    )
    assert session.contribution == 1
    lost = session.process(np.concatenate([snow(16), drawn(10, (MIDDLE[0] - 60, MIDDLE[1] + 90))[0]]), times(26, 2))
    assert said(session)[-1] == "found again where it is detected"
    assert session.contribution > 0.99
    # The same five directions, whichever of them comes first.
    np.testing.assert_allclose(np.linalg.svd(session.model.basis.T @ modes)[1], 1, atol=1e-3)
    assert lost.status[-1] == DEFORMABLE


@pytest.mark.system
def test_two_faces_and_no_face_are_told_apart(draw_face):
    both = np.maximum(draw_face((180, 220), 62)[0], draw_face((440, 220), 75)[0])
    empty = np.full((480, 640), 40, np.uint8)
    for image, words in ((both, "2 faces; the largest is taken"), (empty, "no face")):
        session = HeadSession(nominal())
        track = session.process(with_noise(np.stack([image, empty]), 6, 7), times(6))
        assert np.all(track.status == INITIALISING)
        assert np.all(np.isnan(track.pose))
        assert words in said(session)
        assert len(said(session)) <= 2
        assert session.model is None


def test_a_rig_that_contradicts_the_images_is_an_event(drawn):
    images, points = drawn(3)
    images[:, 1] = np.roll(images[:, 1], 8, axis=1)
    session = HeadSession(nominal(), points=points)
    track = session.process(images, times(3))
    assert np.all(track.status == INITIALISING)
    assert session.events[0][0] == 0
    assert "epipolar" in session.events[0][1]


@pytest.mark.system
def test_a_track_that_the_detector_contradicts_is_given_up(drawn, monkeypatch):
    """Looks once a second: elsewhere twice, once where the track is, then elsewhere three times in a row."""
    images, points = drawn(9)
    away = np.array([0.0, 2 * EYES_APART])
    elsewhere, same = (
        Detection(p, np.zeros(4), np.zeros((2, 4)), np.zeros(4), 1) for p in (points[:6] + away, points[:6])
    )
    answers = [elsewhere, elsewhere, same, None, elsewhere, None, elsewhere, elsewhere]
    asked = []

    def look(image, near):
        asked.append(near)
        return answers[len(asked) - 1] if len(asked) <= len(answers) else None

    monkeypatch.setattr(following, "detect", look)
    session = HeadSession(nominal(), points=points)
    # A frame every half second, so that every other one is looked at.
    statuses = [session.process(images[:1], np.array([0.0])).status[0]]
    for i in range(1, 17):
        statuses.append(session.process(images[i % 9][None], np.array([0.5 * i])).status[0])
    assert statuses[:17] == [INITIALISING] + [RIGID] * 16
    np.testing.assert_allclose(asked, np.tile(points.mean(axis=0), (8, 1)), atol=1)
    assert session.events[-1] == (16, "lost: the face is detected elsewhere")
    # It is not the old place that counts now, but what the detector sees.
    again = [session.process(images[i][None], np.array([9.0 + i])).status[0] for i in range(6)]
    assert again == [LOST] * STABLE_FRAMES + [RIGID]
    assert said(session)[-1].startswith("registered")


@pytest.mark.system
def test_a_live_session_follows_and_registers_anew_beside_the_frames(drawn):
    """Frame by frame: lost behind noise, found elsewhere by a search whose answer comes some frames later."""
    start, points = drawn(4)
    session = HeadSession(nominal(), HeadConfig(live=True), points=points)
    rows = [session.process(start[i : i + 1], times(1, i)) for i in range(4)]
    assert [row.status[0] for row in rows] == [INITIALISING] + [RIGID] * 3
    np.testing.assert_allclose(rows[-1].image_points[0, 0, :4].mean(axis=0), MIDDLE, atol=1)
    for i in range(4, 4 + PATIENCE):
        rows.append(session.process(snow(1, i), times(1, i)))
    assert rows[-1].status[0] == LOST
    place = (MIDDLE[0] - 60, MIDDLE[1] + 90)
    moved, _ = drawn(9, place, seed=3)
    for i in range(14, 1000):
        rows.append(session.process(moved[i % 9][None], times(1, i)))
        if rows[-1].status[0] == RIGID:
            break
        assert rows[-1].status[0] == LOST
        assert np.all(np.isnan(rows[-1].pose))
        time.sleep(0.01)
    np.testing.assert_allclose(rows[-1].image_points[0, 0, :4].mean(axis=0), place, atol=2)
    assert said(session)[-1] == "found again where it is detected"


def test_a_detector_that_is_not_installed_is_refused(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(mesh, "import_module", missing)
    with pytest.raises(ImportError, match=r"mediapipe==0\.10\.14"):
        HeadSession(nominal(), HeadConfig(detector="mediapipe"))


@pytest.mark.system
def test_a_live_session_looks_for_a_face_beside_the_frames(drawn, monkeypatch):
    """It is registered in the images that were searched, of their time, though others have come meanwhile."""
    begun = []

    def begin(key, model, pose, images, time, rig, *, options, diffusion):
        begun.append(images)
        return SimpleNamespace(model=model)

    monkeypatch.setattr(module, "begin", begin)
    monkeypatch.setattr(module.redetection, "prepare", lambda state, images, rig: None)
    images, _ = drawn(1)
    session = HeadSession(nominal(), HeadConfig(live=True, chunk=1))
    for i in range(1000):
        # Frames differ by one grey level in a corner, which tells them apart.
        images[0, 1, 0, 0] = i % 256
        assert session.process(images, times(1, i)).status[0] == INITIALISING
        if begun:
            break
        time.sleep(0.01)
    assert session.events == [(i, "registered")]
    assert begun[0][1, 0, 0] < i % 256
    assert session._following._time == pytest.approx(begun[0][1, 0, 0] / 30)


@pytest.mark.parametrize("points", [np.zeros((9, 2)), np.full((10, 2), np.nan), np.full((10, 2), np.inf)])
def test_points_that_are_no_landmarks_are_refused(points):
    with pytest.raises(ValueError, match=r"points must be \(10, 2\) finite pixels"):
        HeadSession(nominal(), points=points)


def test_images_that_do_not_fit_the_rig_are_refused():
    session = HeadSession(nominal())
    good = np.zeros((2, 2, 480, 640), np.uint8)
    for images in (good[:, :1], good[:, :, :400], good[:1], good.astype(np.float32), good[0]):
        with pytest.raises((ValueError, TypeError), match="images"):
            session.process(images, times(2))
    with pytest.raises(ValueError, match="times must be finite"):
        session.process(good, np.array([0.0, np.nan]))


def test_times_that_do_not_grow_are_refused():
    """Within a piece, and from one piece to the next; what is refused leaves the session as it was."""
    session, images = HeadSession(nominal()), np.zeros((2, 2, 480, 640), np.uint8)
    for seconds in ([1.0, 0.5], [0.0, 0.0]):
        with pytest.raises(ValueError, match="times must grow"):
            session.process(images, np.array(seconds))
    session.process(images, times(2))
    with pytest.raises(ValueError, match="times must grow"):
        session.process(images, times(2))
    assert len(session.process(images, times(2, 2)).status) == 2


def test_rigs_and_focal_lengths_that_cannot_be_used_are_refused():
    rig = nominal()
    for other in (replace(rig, translation=rig.translation + 5), replace(rig, rotation=rig.rotation[..., [1, 0, 2]])):
        with pytest.raises(ValueError, match="rig must have its first camera at the origin"):
            HeadSession(other)
    with pytest.raises(ValueError, match="focal_log_std must be finite and at least 0; got -1"):
        HeadSession(rig, focal_log_std=-1.0)
    with pytest.raises(ValueError, match="focal_log_std is for one camera; got 2 cameras"):
        HeadSession(rig, focal_log_std=0.1)


@pytest.mark.system
def test_given_points_that_cannot_be_used_are_an_event():
    session = HeadSession(nominal(), points=np.full((10, 2), -50.0))
    session.process(np.zeros((1, 2, 480, 640), np.uint8), times(1))
    assert len(said(session)) == 1
    assert said(session)[0].startswith("the landmarks that were given cannot be used: right eye outer is within")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"variant": "fast"}, "variant must be one of recommended, published"),
        ({"diffusion": "none"}, "diffusion must be one of"),
        ({"detector": "eyes"}, "detector must be one of cascades, mediapipe"),
        ({"num_particles": 0}, "num_particles must be at least 1"),
        ({"chunk": 0}, "chunk must be at least 1"),
        ({"fixed_diffusion": 0.0}, "fixed_diffusion must be positive"),
        ({"fixed_diffusion": float("nan")}, "fixed_diffusion must be positive"),
        ({"rigid_frames": -1}, "rigid_frames must be at least 0"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        HeadConfig(**options)
