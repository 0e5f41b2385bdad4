"""The options of the head tracker, its state, and its track."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math.incremental_pca import IncrementalPCA
from jaxfilters.models.face.patches import Patches, Slopes
from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.particle.adaptive import AdaptiveDiffusionState

HEAD_STATUS = ("initialising", "rigid", "deformable", "lost", "doubtful")
"""Words for the integers in `HeadTrack.status`."""
INITIALISING, RIGID, DEFORMABLE, LOST, DOUBTFUL = range(5)
FRAME_S = 1 / 30
"""Seconds: the step of time in which velocities and diffusion are counted."""
PATIENCE = 10
"""Frames in a row in which the face is not found before it counts as lost."""
NUM_MODES = 5
POSE = 6
DEGREE = math.radians(1.0)
UNITS = np.array([1.0, 1.0, 1.0, DEGREE, DEGREE, DEGREE])
"""Of pose, in which the paper counts velocity and diffusion: a millimetre, a degree."""


class Learner(NamedTuple):
    """The deformation model while it is estimated."""

    subspace: IncrementalPCA
    num_shapes: Int[Array, ""]
    """Shapes in the mean."""
    shape: Float[Array, "K 3"]
    """The last one that was measured, model frame, millimetres."""
    windows: Float[Array, "C K T T"]
    """Grey levels about its images."""
    is_fresh: Bool[Array, ""]
    """Whether it is of the frame before."""


class Registered(NamedTuple):
    """What a start leaves behind for good."""

    shape: Float[Array, "K 3"]
    """Neutral, model frame, millimetres."""
    covariance: Float[Array, "K 3 3"]
    """Of each landmark's place, model frame, mm^2."""
    alike: Float[Array, "3 3"]
    """Of what all of them are off alike beside that, model frame, mm^2."""
    patches: Patches
    pose: Float[Array, " 6"]
    """Of the head at registration, millimetres and radians."""
    images: Num[Array, "C rows cols"]
    """In which it was registered."""


class Recent(NamedTuple):
    """The face as the last frame showed it in which it was found."""

    found: Float[Array, "C K W W"]
    """Grey levels about where the landmarks were found."""
    apart: Float[Array, "C K 2"]
    """From the model's landmarks to there, pixels."""
    expected: Float[Array, "C K W W"]
    """Grey levels about the model's landmarks."""
    drift: Float[Array, "C K"]
    """Variance of where landmarks were found about those that were registered, pixels squared, from following."""
    has_changed: Bool[Array, "C K"]
    """Which landmarks do not look as registered, or are not where the model has them."""
    shape: Float[Array, "K 3"]
    """Of the model, millimetres."""
    pose: Float[Array, " 6"]
    """Millimetres and radians."""


class KeyFrames(NamedTuple):
    """Patches of a face that was turned; V frames, those from `num_kept` on not taken yet."""

    patches: Patches
    """Every field with V first."""
    is_valid: Bool[Array, "V C K"]
    """Which of them show a landmark."""
    outward: Float[Array, "V 3"]
    """Where the face looked, in the world."""
    covariance: Float[Array, "V 6 6"]
    """Of its pose, which is wrong in the same way wherever the patches are found again; millimetres and radians."""
    num_kept: Int[Array, ""]


class HeadState(NamedTuple):
    """Everything the next frame needs."""

    search: AdaptiveDiffusionState
    """Particles of pose and mode coefficients."""
    belief: Gaussian
    """Of the last estimate."""
    model: FaceModel
    """As estimated so far."""
    registered: Registered
    recent: Recent
    key_frames: KeyFrames
    slopes: Slopes
    model_variance: Float[Array, " K"]
    """Variance of each landmark about the model on every axis, mm^2."""
    residual_scale: Float[Array, ""]
    """Squared error of the alignments over what they claim."""
    learner: Learner
    last_good: Float[Array, " d"]
    """The estimate of the last frame in which the face was found."""
    misses: Int[Array, ""]
    """Frames in a row in which the face was not found."""
    num_outliers: Int[Array, ""]
    """Frames in which hardly any landmark looked as registered, or nothing like a face; two less for each other."""
    age: Int[Array, ""]
    """Frames since registration."""
    time: Float[Array, ""]
    """Of the last frame, seconds."""
    key: Array


class HeadTrack(NamedTuple):
    """What is known of the head in each of `b` frames; NaN where it is not tracked.

    Lengths are metres in what a session and `track` return, and millimetres, those of the face, within the tracker.
    """

    pose: Float[Array | np.ndarray, "b 6"]
    """x, y, z, and roll, yaw, pitch in radians."""
    pose_std: Float[Array | np.ndarray, "b 6"]
    deformation: Float[Array | np.ndarray, "b B"]
    """Mode coefficients, lengths."""
    shape: Float[Array | np.ndarray, "b K 3"]
    """Landmarks in the model frame."""
    image_points: Float[Array | np.ndarray, "b C K 2"]
    """Pixels."""
    score: Float[Array | np.ndarray, " b"]
    """Mean normalised correlation at the estimate, -1 to 1."""
    effective_sample_size: Float[Array | np.ndarray, " b"]
    innovations: Int[Array | np.ndarray, "b 2"]
    """How many coordinates of the pose the frame has corrected, and how many of these by less than 1.96 of the standard
    deviations that the filter claims for a correction: 95 % if it is right."""
    status: Int[Array | np.ndarray, " b"]
    """Index into `HEAD_STATUS`."""
