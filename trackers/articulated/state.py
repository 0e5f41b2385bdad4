"""What the tracker of an articulated hand says of each frame, and what it keeps between them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfilters.gaussian.gaussian_sum import GaussianSumState

SEARCHING, TRACKING, LOST = range(3)


class ArticulatedTrack(NamedTuple):
    """What is known of the hand in each of `b` frames, by its likeliest hypothesis; NaN while it is searched for."""

    mean: Float[Array | np.ndarray, "b n"]
    """States, in the order of the layout."""
    std: Float[Array | np.ndarray, "b n"]
    points: Float[Array | np.ndarray, "b fingers 4 3"]
    """Joints from base to tip in the camera frame: pixels, with depth counted from the wrist's; metres with `focal`."""
    points_std: Float[Array | np.ndarray, "b fingers 4 3"]
    """Standard deviations of `points`; with `focal`, most of that of the depth is the unknown distance of the hand."""
    points_from_wrist_std: Float[Array | np.ndarray, "b fingers 4 3"]
    """Standard deviations of the vectors from the wrist to `points`."""
    image_points: Float[Array | np.ndarray, "b fingers 4 2"]
    """Pixels."""
    scale: Float[Array | np.ndarray, " b"]
    """The quaternion's squared length: pixels of the image for one of a length; 1 with `focal`."""
    weight: Float[Array | np.ndarray, " b"]
    """Weight of this hypothesis."""
    num_hypotheses: Int[Array | np.ndarray, " b"]
    is_new_view: Bool[Array | np.ndarray, " b"]
    """Whether lengths were estimated from this frame."""
    nis_per_row: Float[Array | np.ndarray, " b"]
    """Normalised innovation squared over the number of rows that count; about 1 where all is well."""
    innovations: Int[Array | np.ndarray, "b 2"]
    """How many rows were compared with their prediction, and how many of these lie within its 95 % band."""
    least_distance: Float[Array | np.ndarray, " b"]
    """Standard deviations to the nearest limit before truncation, negative outside; infinite without limits."""
    log_evidence: Float[Array | np.ndarray, " b"]
    length_observed: Bool[Array | np.ndarray, "b lengths"]
    """Whether a link has lain near the image plane since the hand was found; until then its length is that of the
    prior, of the limits and of what the model says of foreshortened links."""
    status: Int[Array | np.ndarray, " b"]


class TrackState(NamedTuple):
    """Everything the next frame needs."""

    bank: GaussianSumState
    time: Float[Array, ""]
    """Of the last frame, seconds."""
    misses: Array
    """Frames in a row in which the hand was not visible; above `PATIENCE` until keypoints of a hand are found."""
    length_observed: Bool[Array, " lengths"]
    """As in the track."""
    key: Array
