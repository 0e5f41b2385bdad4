"""A start from landmarks of a detector that is known to misplace them: people of the model, drawn at random."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.misplacement import misplacement
from jaxfilters.models.face.person_prior import Person, posed_shape
from jaxfilters.models.face.rig import project_shape
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.start import initialise
from jaxfilters.trackers.head.mono.state import prior_of
from jaxfilters.trackers.io.detector_errors import default_detector_errors

PEOPLE, FRAMES, NOISE_PX = 12, 5, 0.5
POSE = np.array([10.0, -20.0, 600.0, 0.05, 0.1, -0.05])


@pytest.mark.system
@pytest.mark.optimised
def test_what_a_detector_misplaces_does_not_turn_the_head(rig, face):
    """The cascades' errors turn it up by some degrees, whoever it is; with their mean known, that is gone.

    The mean over twelve people of a pitch that differs by three degrees between them has a standard error below one.
    """
    errors, rng = default_detector_errors()["cascades"], np.random.default_rng(0)
    prior = prior_of(MonoConfig())
    known = prior._replace(misplaced=misplacement(errors.mean, errors.covariance, prior.offset_std))
    root = np.linalg.cholesky(np.asarray(face.identity_covariance, float) + 1e-9 * np.eye(face.num_identities))
    own = np.linalg.cholesky(errors.covariance + 1e-6 * np.eye(30))
    pitch = {"plain": [], "known": []}
    for _ in range(PEOPLE):
        identity = face.identity_mean + jnp.asarray(root @ rng.normal(0, 0.7, len(root)), face.mean.dtype)
        offset = errors.mean + (own @ rng.normal(0, 1, 30)).reshape(10, 3)
        person = Person(identity, jnp.asarray(offset, face.mean.dtype))
        poses = POSE + np.column_stack([np.zeros((FRAMES, 4)), np.linspace(-0.15, 0.15, FRAMES), np.zeros(FRAMES)])
        uv = [
            project_shape(rig, posed_shape(face, person, face.expression_mean), pose)[0][0]
            for pose in jnp.asarray(poses)
        ]
        points = jnp.stack(uv) + rng.normal(0, NOISE_PX, (FRAMES, 10, 2))
        for name, one in (("plain", prior), ("known", known)):
            found = initialise(face, rig, points, one).bundle
            pitch[name].append(np.degrees(np.mean(np.asarray(found.poses[:, 5]) - POSE[5])))
    assert abs(np.mean(pitch["plain"])) > 3.0
    assert abs(np.mean(pitch["known"])) < 1.5
    assert jax.tree.all(jax.tree.map(lambda leaf: bool(jnp.all(jnp.isfinite(leaf))), found))
