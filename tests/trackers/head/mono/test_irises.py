"""The size that irises tell, against Bayes' rule with the covariance of the whole normal matrix."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.bundle import Bundle, all_residuals
from jaxfilters.models.face.landmarks import EYES
from jaxfilters.models.face.multilinear import shape
from jaxfilters.models.face.person_prior import Prior, log_size
from jaxfilters.models.face.pose import place
from jaxfilters.trackers.head.mono.irises import (
    BEFORE_MM,
    IRIS_MM,
    IRIS_STD_MM,
    MEASURED_PX,
    MEASURED_SHARE,
    measured,
    with_irises,
)
from jaxfilters.trackers.head.mono.start import detected, initialise

PRIOR = Prior(1.0, 0.7)
LARGER = 1.05


@pytest.fixture(scope="module")
def begun(face, rig, detected):
    points = jnp.asarray(detected.points, float)
    return points, initialise(face, rig, points, PRIOR)


@pytest.fixture(scope="module")
def iris_px(face, rig, begun):
    """Widths of irises of the usual size, of a face that is by `LARGER` larger and farther away than in the start."""
    _, start = begun
    widths = []
    for pose, a in zip(start.bundle.poses, start.bundle.expressions, strict=True):
        person = start.bundle.person
        corners = np.asarray(place(shape(face, person.identity, a) + person.offset, pose))[list(EYES), 2]
        depths = corners.reshape(2, 2).mean(axis=1) - BEFORE_MM
        widths.append(float(rig.focal[0, 0]) * IRIS_MM / (LARGER * depths))
    return np.array(widths)


@pytest.mark.system
def test_narrow_irises_mean_a_large_face_far_away(face, rig, begun, iris_px):
    _, start = begun
    larger, std = measured(face, rig, start, jnp.asarray(iris_px, float))
    assert float(larger) == pytest.approx(np.log(LARGER), abs=1e-4)
    share = np.hypot(IRIS_STD_MM / IRIS_MM, MEASURED_SHARE)
    assert float(std) == pytest.approx(np.hypot(share, MEASURED_PX / np.median(iris_px)), rel=1e-5)
    one_blinks = iris_px * np.where(np.arange(10).reshape(5, 2) < 3, 0.7, 1.0)
    assert float(measured(face, rig, start, jnp.asarray(one_blinks, float))[0]) == pytest.approx(
        np.log(LARGER), abs=0.01
    )


@pytest.mark.system
def test_the_size_moves_as_far_as_the_irises_are_trusted(face, rig, begun, iris_px):
    points, start = begun
    after, past = with_irises(face, rig, start, detected(points, 1.0), None, iris_px, PRIOR)
    factor = np.asarray(after.bundle.poses[:, 2] / start.bundle.poses[:, 2])
    larger, std = measured(face, rig, start, jnp.asarray(iris_px, float))
    variance = size_variance(face, rig, points, start.bundle)
    expected = float(larger) * variance / (variance + float(std) ** 2)
    assert 0.1 * np.log(LARGER) < expected < 0.9 * np.log(LARGER)
    np.testing.assert_allclose(np.log(factor), expected, rtol=0.15)
    moved = log_size(face, after.bundle.person.identity) - log_size(face, start.bundle.person.identity)
    assert float(moved) == pytest.approx(expected, rel=0.2)
    # The landmarks stay where they are in the image, as far as a face of that size can have the same shape.
    np.testing.assert_allclose(after.uv, start.uv, atol=2.0)
    # Of the size, and of nothing else.
    identity = start.bundle.person.identity
    slope = np.asarray(jax.grad(lambda identity: log_size(face, identity))(identity))
    expected = np.pad(slope / float(std), (0, face.mean.size))
    information = np.outer(expected, expected)
    np.testing.assert_allclose(past.information, information, rtol=1e-4, atol=1e-6 * information.max())


def size_variance(face, rig, points, bundle):
    """Of the logarithm of the size once the landmarks are seen: by the whole normal matrix."""
    views = detected(points, 1.0)
    flat, unravel = jax.flatten_util.ravel_pytree(bundle)
    residuals = lambda y: all_residuals(face, rig, views, Bundle(*unravel(y)), PRIOR)
    J = np.asarray(jax.jit(jax.jacfwd(residuals))(flat), float)
    sizes = lambda y: log_size(face, unravel(y).person.identity)
    slope = np.asarray(jax.grad(sizes)(flat), float)
    # In units of each column's length, for the sake of rounding.
    unit = 1 / np.linalg.norm(J, axis=0)
    return (unit * slope) @ np.linalg.solve((unit[:, None] * (J.T @ J) * unit), unit * slope)
