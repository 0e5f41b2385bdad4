"""Variances of a pose that are reported: of the frame, the person, the lens, and landmarks that have changed."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.trackers.head.mono.estimate import FEWEST_SURE
from jaxfilters.trackers.head.stereo.tracking import FEWEST_ANCHORED

CHANGED_STD = np.array([0.9, 2.1, 0.0, *np.radians([3.2, 7.5, 7.5])])
"""Standard deviation of the error of a pose in which no landmark looks as registered, millimetres and radians.

Where all of them do, the errors of a recording are as large as what is not known of the person. Where some do not, they
are followed from the last frame or left out, and the pose is off for a second or two while the head is turned so: an
error of the view, which more frames do not reduce. Each coordinate has the likeliest of some thirty values, by the log
score of the true poses of people 0 to 3 of the ICT face model, with two models of faces (2192 frames); that of the
depth is zero.
"""


def pose_variance(
    of_frame: Float[Array, " 6"],
    of_person: Float[Array, " 6"],
    of_focal: Float[Array, " 6"],
    num_sure: Float[Array, ""],
) -> Float[Array, " 6"]:
    """Variances of the errors of a pose, square millimetres and radians.

    Args:
        of_frame: Of the pose if the person is as believed and landmarks err independently of each other.
        of_person: By what is not known of the person.
        of_focal: By what is not known of the focal length.
        num_sure: Landmarks that look as registered and are where the model has them, 0 to 10; 0 where the face was not
            found.
    """
    wider, of_changed = _by_looks(num_sure, of_frame.dtype)
    return wider * of_frame + of_person + of_focal + of_changed


def frame_covariance(covariance: Float[Array, "n n"], num_sure: Float[Array, ""]) -> Float[Array, "n n"]:
    """Covariance of what one view errs by in pose and mode coefficients, if the person is as believed.

    Args:
        covariance: The same if landmarks err independently of each other.
        num_sure: As in `pose_variance`.
    """
    wider, of_changed = _by_looks(num_sure, covariance.dtype)
    return wider * covariance + jnp.diag(jnp.pad(of_changed, (0, len(covariance) - of_changed.size)))


def _by_looks(num_sure: Float[Array, ""], dtype: Any) -> tuple[Float[Array, ""], Float[Array, " 6"]]:
    """Factor of the variances, and what landmarks that do not look as registered add to those of the pose."""
    is_sure = num_sure >= FEWEST_SURE
    # Landmarks that are followed from frame to frame are wrong together: only those that look as registered count.
    wider = jnp.where(is_sure, 1.0, jnp.square(NUM_LANDMARKS / jnp.maximum(num_sure, FEWEST_ANCHORED)))
    return wider, (1 - num_sure / NUM_LANDMARKS) * jnp.square(jnp.asarray(CHANGED_STD, dtype))
