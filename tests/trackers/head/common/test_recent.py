"""Landmarks that no longer look as registered: a new picture is pasted over one, and moved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.alignment import align
from jaxfilters.models.face.patches import SKIN_NORMALS, patches, unknown_slopes
from jaxfilters.models.synthetic.face_sequence import sequence
from jaxfilters.trackers.head.common import recent

CHANGED, MOVED = 4, np.array([3, 2])


@pytest.fixture(scope="module")
def scene():
    """Registered patches, and two images of the same pose in which one landmark has another, moving picture."""
    made = sequence(jax.random.key(0), "slow", 1, 0)
    images = made.frames(0, 1)[0].astype(np.float32)
    shape, pose = jnp.asarray(made.shapes[0], jnp.float32), jnp.asarray(made.poses[0], jnp.float32)
    u, v = np.indices((40, 40))
    picture = 120 + 40 * np.sin(0.5 * u + 0.2 * v) * np.cos(0.45 * v - 0.1 * u)
    changed = []
    for shift in (np.zeros(2, int), MOVED):
        copy = images.copy()
        for c in range(2):
            col, row = np.round(made.uv[0, c, CHANGED]).astype(int) + shift - 20
            copy[c, row : row + 40, col : col + 40] = picture
        changed.append(jnp.asarray(copy))
    registered = patches(jnp.asarray(images), shape, pose, made.rig, jnp.asarray(SKIN_NORMALS, jnp.float32))
    return made.rig, registered, shape, pose, jnp.asarray(made.uv[0], jnp.float32), changed


@pytest.mark.system
def test_a_changed_landmark_is_followed_and_the_others_stay_registered(scene):
    rig, registered, shape, pose, uv, (before, after) = scene
    slopes = unknown_slopes(len(shape))
    found = jax.jit(align)(registered, slopes, after, uv, shape, pose, rig)
    anchored = np.asarray(recent.is_anchored(found))
    others = np.arange(len(shape)) != CHANGED
    assert not anchored[:, CHANGED].any()
    assert anchored[:, others].all()

    last = recent.nothing_changed(before, shape, pose, rig)
    again, is_followed = jax.jit(recent.followed)(last, found, slopes, after, uv, shape, pose, rig)
    assert np.asarray(is_followed)[:, CHANGED].all()
    assert not np.asarray(is_followed)[:, others].any()
    np.testing.assert_allclose(again.uv[:, CHANGED] - uv[:, CHANGED], np.tile(MOVED, (2, 1)), atol=0.1)
    np.testing.assert_array_equal(again.uv[:, others], found.uv[:, others])

    # What the next frame is told: this landmark has changed, and where it was found beside the model's.
    observed = recent.as_observed(again, jnp.asarray(anchored), shape, pose, after, rig)
    np.testing.assert_array_equal(np.asarray(observed.has_changed)[0], ~others)
    np.testing.assert_allclose(observed.apart[:, CHANGED], np.tile(MOVED, (2, 1)), atol=0.1)


@pytest.mark.system
def test_templates_are_renewed_only_where_the_looks_have_changed(scene):
    rig, registered, shape, pose, _, (before, _) = scene
    slopes = unknown_slopes(len(shape))
    templates = registered.template.reshape(*registered.template.shape[:2], 16, 16)
    last = recent.nothing_changed(before, shape, pose, rig)
    same = recent.latest_templates(last, slopes, templates, shape, pose, rig)
    np.testing.assert_array_equal(same, templates)
    changed = last._replace(has_changed=last.has_changed.at[:, CHANGED].set(True))
    new = recent.latest_templates(changed, slopes, templates, shape, pose, rig)
    others = np.arange(len(shape)) != CHANGED
    np.testing.assert_array_equal(new[:, others], templates[:, others])
    window = np.asarray(last.expected)[:, CHANGED, 4:-4, 4:-4]
    np.testing.assert_allclose(new[:, CHANGED], window, atol=1.0)


@pytest.mark.system
def test_a_landmark_drifts_with_every_frame_until_it_is_anchored_again(scene):
    rig, registered, shape, pose, uv, (before, after) = scene
    slopes = unknown_slopes(len(shape))
    found = jax.jit(align)(registered, slopes, after, uv, shape, pose, rig)
    anchored, last = recent.is_anchored(found), recent.nothing_changed(before, shape, pose, rig)
    again, is_followed = jax.jit(recent.followed)(last, found, slopes, after, uv, shape, pose, rig)
    variances = []
    for _ in range(3):
        drift = recent.drifted(last, is_followed)
        last = recent.as_observed(again, anchored, shape, pose, after, rig, drift)
        variances.append(np.asarray(last.drift))
        np.testing.assert_array_equal(drift, last.drift)
    step = recent.DRIFT_PX.each**2
    np.testing.assert_allclose(np.array(variances)[:, :, CHANGED], np.outer([1, 2, 3], [step, step]), rtol=1e-5)
    assert not np.delete(variances[-1], CHANGED, axis=1).any()
    grown = last._replace(drift=jnp.full_like(last.drift, 1e3))
    np.testing.assert_allclose(recent.drifted(grown, is_followed)[:, CHANGED], recent.MOST_DRIFT_PX**2)
    # Where nothing is found the model alone says where the landmark is; as registered again, it is known.
    hidden = again._replace(score=jnp.zeros_like(again.score))
    nowhere = recent.as_observed(
        hidden, jnp.zeros_like(anchored), shape, pose, after, rig, recent.drifted(last, is_followed)
    )
    np.testing.assert_array_equal(nowhere.drift, recent.MOST_DRIFT_PX**2)
    back = recent.as_observed(again, jnp.ones_like(anchored), shape, pose, after, rig, jnp.zeros_like(last.drift))
    np.testing.assert_array_equal(back.drift, 0.0)
