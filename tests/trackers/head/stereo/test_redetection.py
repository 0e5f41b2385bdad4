"""A head in a wrong pose, or lost, beside what a detector finds; the detector is the truth with errors of a pixel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.pose import rotation
from jaxfilters.models.synthetic.face_sequence import sequence
from jaxfilters.trackers.head.common.state import DOUBTFUL, LOST, POSE, RIGID, UNITS, HeadTrack
from jaxfilters.trackers.head.stereo import redetection as module
from jaxfilters.trackers.head.stereo import session as session_module
from jaxfilters.trackers.head.stereo.known_face import pose_of_known_face
from jaxfilters.trackers.head.stereo.registration import register
from jaxfilters.trackers.head.stereo.session import HeadSession
from jaxfilters.trackers.head.stereo.tracking import LEAST_SCORE, PATIENCE, REGAINED_SCORE

BEFORE, AFTER = 21, slice(150, 162)
"""Frames until the track is wrong, and those in which it is found: the head has turned by 27 degrees in between."""


class Detector:
    """Finds the landmarks of the video's frames from `AFTER` on, and no others."""

    complaints = ()

    def __init__(self, made, images, is_blind=False):
        self.made, self.images, self.is_blind = made, images, is_blind
        self.error = np.random.default_rng(0).normal(0, 1, (10, 2))

    def glance(self, image, near, apart_px):
        at = [i for i in range(AFTER.start, AFTER.stop) if np.array_equal(self.images[i, 0], image)]
        return self.made.uv[at[0], 0] + self.error if at and not self.is_blind else None

    def find(self, image):
        return None

    def reset(self):
        pass


@pytest.fixture(scope="module")
def video():
    made = sequence(jax.random.key(2), "slow", AFTER.stop, 1)
    return made, made.frames(0, AFTER.stop)


def started(video, monkeypatch, *, detects=False, knows=False):
    """A session that has followed the first frames, with a detector of the last ones, or by the face's own image."""
    made, images = video
    session = HeadSession(made.rig, points=made.uv[0, 0].astype(float))
    session.process(images[:BEFORE], made.times[:BEFORE])
    monkeypatch.setattr(session._following._tracker, "_finder", Detector(made, images, is_blind=not detects))
    monkeypatch.setattr(session_module, "pose_of_known_face", pose_of_known_face if knows else lambda *_: None)
    return session


def gone_on(session, images):
    """Track of the next frames, 30 a second."""
    return session.process(images, session._following._time + np.arange(1, len(images) + 1) / 30)


def worst_errors(track, made):
    """Millimetres and degrees."""
    return np.abs((track.pose[-4:] * [1e3, 1e3, 1e3, 1, 1, 1] - made.poses[AFTER][-4:]) / UNITS).max(axis=0)


def covered(count=PATIENCE):
    return np.random.default_rng(1).integers(0, 256, (count, 2, 480, 640), np.uint8)


@pytest.mark.system
@pytest.mark.parametrize("by", ["detects", "knows"])
def test_a_lost_head_keeps_its_axes_where_it_is_detected(video, monkeypatch, by):
    """Registered anew it would have those of the camera, more than 20 degrees off."""
    made, images = video
    session = started(video, monkeypatch, **{by: True})
    assert gone_on(session, covered()).status[-1] == LOST
    track = gone_on(session, images[AFTER])
    assert session.events[-1][1] == "found again where it is detected"
    assert np.all(track.status[-4:] == RIGID)
    assert np.all(worst_errors(track, made) < [0.3, 0.3, 1.0, 0.5, 0.5, 0.5])
    blind = started(video, monkeypatch)
    gone_on(blind, covered())
    assert np.all(gone_on(blind, images[AFTER]).status == LOST)


@pytest.mark.system
@pytest.mark.parametrize("by", ["detects", "knows"])
def test_a_head_in_a_wrong_pose_is_put_where_it_is_detected(video, monkeypatch, by):
    made, images = video

    def misplaced(session):
        """Followed in a pose that is off by 80 mm and 50 degrees."""
        state = session._following.state
        x = state.belief.mean.at[:POSE].set(made.poses[AFTER.start] + UNITS * [40.0, -40.0, 60.0, 20.0, 45.0, -20.0])
        search = state.search._replace(particles=jnp.broadcast_to(x[:, None], state.search.particles.shape), estimate=x)
        belief = Gaussian(x, state.belief.covariance)
        session._following.state = state._replace(belief=belief, search=search, last_good=x)
        return gone_on(session, images[AFTER])

    session = started(video, monkeypatch, **{by: True})
    track = misplaced(session)
    assert session.events[-1][1] == "put where it is detected"
    assert np.all(worst_errors(track, made) < [0.3, 0.3, 1.0, 0.5, 0.5, 0.5])
    blind = misplaced(started(video, monkeypatch))
    assert np.all(np.isin(blind.status, (DOUBTFUL, LOST)))


@pytest.mark.system
def test_a_known_face_is_laid_over_a_detected_one(video):
    made, images = video
    found = register(images[0], made.uv[0, 0].astype(float), made.rig)
    session = HeadSession(made.rig, points=made.uv[0, 0].astype(float))
    session.process(images[:2], made.times[:2])
    state = session._following.state
    R, t = Rotation.from_euler("xyz", [20, -30, 10], degrees=True).as_matrix(), np.array([3.0, -5.0, 8.0])
    shape = np.asarray(state.registered.shape)
    pose, apart = module._laid_over(state, jnp.asarray(shape @ R.T + t, jnp.float32), found.pose)
    turn = np.asarray(rotation(found.pose[3:]))
    assert float(apart) < 1e-3
    np.testing.assert_allclose(rotation(pose[3:]), turn @ R, atol=1e-5)
    np.testing.assert_allclose(pose[:3], np.asarray(found.pose[:3]) + turn @ t, atol=1e-3)
    other = found._replace(model=found.model.__class__(1.2 * found.model.mean, *list(vars(found.model).values())[1:]))
    assert module.located(state, found, images[0], made.rig) is not None
    assert module.located(state, other, images[0], made.rig) is None


@pytest.mark.system
def test_a_known_face_is_found_by_its_image(video):
    """Nearer and farther than at registration, turned by up to 21 degrees: within a third of the eyes' distance."""
    made, images = video
    session = HeadSession(made.rig, points=made.uv[0, 0].astype(float))
    session.process(images[:2], made.times[:2])
    state = session._following.state
    for i in range(0, AFTER.stop, 10):
        pose = pose_of_known_face(state, images[i], made.rig)
        assert np.all(np.abs(pose - made.poses[i])[:3] < [25, 25, 80]), i
        np.testing.assert_array_equal(pose[3:], np.asarray(state.registered.pose)[3:])
    assert np.abs(made.poses[:, 2] - made.poses[0, 2]).max() > 30
    assert pose_of_known_face(state, covered(1)[0], made.rig) is None


def test_which_of_two_poses_is_believed():
    row = lambda status, score, pose=0.0: HeadTrack(
        *[np.full(POSE, pose)] * 5, score=score, effective_sample_size=1.0, innovations=np.zeros(2), status=status
    )
    better = lambda other, status, score: module.is_better(row(RIGID, other), row(status, score))
    assert better(LEAST_SCORE, DOUBTFUL, 0.1)
    assert not better(LEAST_SCORE - 0.01, DOUBTFUL, 0.1)
    assert better(0.4, DOUBTFUL, 0.39 - module.CLEARLY_BETTER)
    assert not better(0.4, DOUBTFUL, 0.41 - module.CLEARLY_BETTER)
    assert better(REGAINED_SCORE, LOST, 0.9)
    assert not better(REGAINED_SCORE - 0.01, LOST, 0.1)
    assert not module.is_better(row(RIGID, 1.0, np.nan), row(LOST, 0.0))
