"""What is claimed of a pose: sums of variances, and what landmarks that have changed their looks add."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.trackers.head.mono.claims import CHANGED_STD, pose_variance

OF_FRAME = np.array([0.3, 0.2, 9.0, 2e-4, 6e-4, 7e-4])
OF_PERSON = np.array([0.5, 0.8, 900.0, 1e-4, 2e-3, 3e-3])
OF_FOCAL = np.array([0.1, 0.0, 400.0, 0.0, 1e-5, 2e-5])


def claimed(num_sure):
    return np.asarray(pose_variance(*map(jnp.asarray, (OF_FRAME, OF_PERSON, OF_FOCAL)), jnp.asarray(float(num_sure))))


@pytest.mark.parametrize("num_sure", [10, 8, 5])
def test_the_claim_is_the_spread_of_errors_to_which_each_changed_landmark_adds_its_share(num_sure):
    """Errors are drawn: of the frame, the person, the lens, and of each landmark that does not look as registered.

    From the mean of as few as five landmarks that say anything the frame's error is twice as large. A variance of
    100,000 draws has a relative standard deviation of 0.45 %.
    """
    draw = np.random.default_rng(num_sure).normal
    size = (100_000, 6)
    frame = draw(size=size) * np.sqrt(OF_FRAME) * (2 if num_sure == 5 else 1)
    errors = frame + draw(size=size) * np.sqrt(OF_PERSON) + draw(size=size) * np.sqrt(OF_FOCAL)
    for _ in range(10 - num_sure):
        errors += draw(size=size) * CHANGED_STD / np.sqrt(10)
    np.testing.assert_allclose(claimed(num_sure), errors.var(axis=0), rtol=0.02)


def test_a_face_that_looks_less_as_registered_is_never_claimed_to_be_better_known():
    variances = np.array([claimed(num_sure) for num_sure in range(10, -1, -1)])
    assert np.all(np.diff(variances, axis=0) >= -1e-6 * variances[1:])
    assert np.all(np.isfinite(variances))
    # Three landmarks that have changed turn the head by some degrees, however well the others are measured.
    assert np.all(np.degrees(np.sqrt(variances[3, 4:])) > 4.0)
