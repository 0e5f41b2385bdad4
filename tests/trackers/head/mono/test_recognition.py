"""Who it is: people of the gallery, strangers, and somebody who comes back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.gallery import Gallery, remember
from jaxfilters.models.face.multilinear import learn
from jaxfilters.models.synthetic.face import make_identity
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of
from jaxfilters.trackers.head.mono.config import PUBLISHED, MonoConfig
from jaxfilters.trackers.head.mono.recognition import people, recognised
from jaxfilters.trackers.head.mono.session import MonoSession

START, IDENTITIES = 17, 15


@pytest.fixture(scope="module")
def taught():
    """Faces of eleven people, of whom the fourth is the one before the camera; with a model of all.

    Of as many parameters as the model of the package: their programs are the same.
    """
    user = make_identity(jax.random.split(jax.random.key(33), 3)[0])
    others = people_of(jax.random.key(0), 10)
    everybody = jax.tree.map(lambda own, rest: jnp.concatenate([rest[:3], own[None], rest[3:]]), user, others)
    shapes = generator_shapes(jax.random.key(1), everybody)
    return learn(shapes, identities=IDENTITIES), shapes


def process(session, images, times, size=16):
    parts = [session.process(images[i : i + size], times[i : i + size]) for i in range(0, len(images), size)]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


@pytest.mark.system
def test_somebody_who_is_remembered_is_recognised_and_as_far_away_as_he_is(rig, taught, talking, detected):
    face, shapes = taught
    made, images = talking
    session = MonoSession(rig, face, detections=detected, gallery=remember(face, shapes[:10]))
    track = process(session, images, made.times)
    assert set(track.person_index[START:]) <= {-1, 3}
    assert np.all(track.person_index[-20:] == 3)
    assert np.all(track.person_index[:START] == -1)
    errors = track.pose[-20:] - made.poses[-20:] * [1e-3, 1e-3, 1e-3, 1, 1, 1]
    # A hundredth of 650 mm, where a unknown's size is known to 3 %.
    assert np.abs(errors[:, 2]).mean() < 0.0065
    assert np.all(np.abs(errors) < 3 * track.pose_std[-20:] + 1e-6)
    centred = lambda shapes: shapes - shapes.mean(axis=1, keepdims=True)
    apart = np.linalg.norm(centred(track.shape[-20:]) - centred(1e-3 * made.shapes[-20:]), axis=-1)
    assert apart.mean() < 0.001


@pytest.mark.system
def test_a_stranger_is_taken_for_nobody(rig, taught, talking, detected):
    """The ten others are remembered."""
    _, shapes = taught
    made, images = talking
    others = jnp.concatenate([shapes[:3], shapes[4:]])
    face = learn(others, identities=IDENTITIES)
    session = MonoSession(rig, face, detections=detected, gallery=remember(face, others))
    track = process(session, images, made.times)
    assert np.all(track.person_index == -1)
    assert session.gallery is not None


def test_the_index_of_a_person_is_one_of_the_gallery(rig, face):
    """Who was followed before a loss is known by the number after those of the gallery, which is nobody's there."""
    one = Gallery(face.identity_mean[None], face.identity_covariance[None], jnp.zeros((1, 10, 3)))
    for gallery, expected in ((one, [-1, 0, -1]), (None, [-1, -1, -1])):
        tracker = MonoSession(rig, face, gallery=gallery)._tracker
        rows = tracker.empty(3)._replace(person_index=np.array([-1, 0, 1], np.int32))
        np.testing.assert_array_equal(tracker.reported(rows, np.arange(3) / 30).person_index, expected)


@pytest.mark.system
def test_somebody_who_was_followed_is_recognised_by_a_later_session(rig, face, talking, detected):
    """With what the first session learnt, its size included."""
    made, images = talking
    first = MonoSession(rig, face, detections=detected)
    before = process(first, images, made.times)
    known = first.gallery
    second = MonoSession(rig, face, detections=detected, gallery=known)
    after = process(second, images, made.times)
    assert after.person_index[-1] == 0
    assert np.abs(after.pose[-1, 2] - before.pose[-1, 2]) < 0.003
    assert after.pose_std[-1, 2] < 1.1 * before.pose_std[-1, 2]
    np.testing.assert_allclose(known.offset[0], 1e3 * before.offset[-1], atol=1e-5)


@pytest.mark.system
def test_somebody_who_was_lost_is_known_when_found_elsewhere(rig, face, talking, detected):
    """By the next detections, as in a session that searches for itself."""
    made, images = talking
    session = MonoSession(rig, face, detections=detected)
    process(session, images[:40], made.times[:40])
    tracker, state = session._tracker, session._following.state
    found, _ = tracker._checked(detected)
    beginning = tracker.begin(found, state, 60)
    assert beginning.what == "registered, a face that is known"
    apart = np.asarray(beginning.state.person.identity - state.person.identity) / np.asarray(face.identity_std)
    assert np.abs(apart).max() < 0.3


@pytest.mark.system
def test_frames_of_a_camera_need_not_wait_for_a_face_that_comes_back(rig, face, talking, detected):
    """What asks whether it is the same one is compiled by then."""
    made, images = talking
    recognised.clear_cache()
    session = MonoSession(rig, face, MonoConfig(live=True), detections=detected)
    process(session, images[:32], made.times[:32])
    tracker, state = session._tracker, session._following.state
    tracker._ready.result()
    assert recognised._cache_size() == 1
    found, _ = tracker._checked(detected)
    assert tracker.begin(found, state, 60).what == "registered, a face that is known"
    assert recognised._cache_size() == 1


@pytest.mark.system
def test_shares_of_the_prior(taught):
    face, shapes = taught
    alone, with_two = people(face, None), people(face, remember(face, shapes[:2]))
    np.testing.assert_allclose(np.exp(alone.log_prior), [1.0])
    np.testing.assert_allclose(np.exp(with_two.log_prior), [0.5, 0.25, 0.25], rtol=1e-6)


@pytest.mark.system
def test_people_of_another_model_are_refused(rig, face, taught):
    other, _ = taught
    fewer = Gallery(*(jnp.zeros(shape) for shape in ((1, 10), (1, 10, 10), (1, 10, 3))))
    with pytest.raises(ValueError, match="gallery must be of the model, with shapes"):
        MonoSession(rig, face, gallery=fewer)
    fits = Gallery(*(jnp.zeros(shape) for shape in ((1, 15), (1, 15, 15), (1, 10, 3))))
    with pytest.raises(ValueError, match="that tracker knows nobody"):
        MonoSession(rig, other, PUBLISHED, gallery=fits)
