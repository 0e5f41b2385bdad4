"""Whether what is followed can be the face that was registered."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.models.face.pose import rotation
from jaxfilters.trackers.head.stereo.tracking import FEWEST_ANCHORED, LEAST_SCORE

FAMILIAR_TURN = np.radians(45.0)
"""From the view at registration to others in which a face must look as it did there.

Beyond it landmarks are foreshortened or hidden, and correlations fall below `LEAST_SCORE` for seconds where poses are
right within some degrees. Within it they did in none of 29 recordings of people of the ICT face model but one, which
had slipped off the face.
"""


def is_outlier(
    num_anchored: Float[Array, ""],
    score: Float[Array, ""],
    pose: Float[Array, " 6"],
    registered: Float[Array, " 6"],
) -> Bool[Array, ""]:
    """Whether a frame shows hardly anything of the registered face where that should be visible.

    What landmarks looked like in the last frame does not count: it may be what the track has slipped to.

    Args:
        num_anchored: Landmarks that look as registered, and are where the model has them.
        score: Mean correlation with the registered patches at the estimate, -1 to 1.
        pose: Estimated, millimetres and radians.
        registered: Pose at registration.
    """
    # The trace of the rotation from one to the other is 1 + 2 cos(turn).
    cosine = 0.5 * (jnp.sum(rotation(pose[3:]) * rotation(registered[3:])) - 1)
    is_familiar = cosine > np.cos(FAMILIAR_TURN)
    return (num_anchored < FEWEST_ANCHORED) | ((score < LEAST_SCORE) & is_familiar)
