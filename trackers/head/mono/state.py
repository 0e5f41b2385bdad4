"""The options of the one-camera head tracker, its state, and its track."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.bundle import Bundle, Reach, Views
from jaxfilters.models.face.patches import Patches, Slopes
from jaxfilters.models.face.person_prior import Person, Prior
from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.particle.adaptive import AdaptiveDiffusionState
from jaxfilters.trackers.head.common.state import Recent
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.person import Modes

NUM_FRAMES = 5
"""That the face is adjusted to."""
AVERAGED = 15
"""Identities in the running mean of the published tracker (N_s)."""
REACH = Reach(
    pose=np.array([15.0, 15.0, 30.0, *np.radians([5.0, 5.0, 5.0])]), expression=0.5, identity=0.1, deviations=2.0
)
"""Of one adjustment, as published or, where the thesis is silent, as chosen here."""
WIDE_REACH = Reach(pose=REACH.pose, expression=2.0, identity=1.0, deviations=4.0)
"""Of one adjustment that a prior holds."""
EYES_APART_STD_MM = 1.0
"""How well a known distance between the pupils is known, that between the middles of the corners included."""


def prior_of(config: MonoConfig) -> Prior:
    """What holds every adjustment."""
    if config.eyes_apart_mm is None:
        return Prior(config.prior_weight, config.offset_std_mm)
    return Prior(config.prior_weight, config.offset_std_mm, config.eyes_apart_mm, EYES_APART_STD_MM)


def reach_of(config: MonoConfig) -> Reach:
    """How far an adjustment may go."""
    return REACH if config.is_published else WIDE_REACH


class Window(NamedTuple):
    """The frames that the face is adjusted to.

    Where landmarks are aligned the first is that of registration, and stays: its picture is what others are compared
    with.
    """

    views: Views
    poses: Float[Array, "n 6"]
    """Millimetres and radians."""
    expressions: Float[Array, "n A"]
    ages: Int[Array, " n"]
    """Frames since each; of those of the start only the order."""
    information: Float[Array, "n d d"]
    """Of each frame about identity and offset, in standard deviations."""
    gradient: Float[Array, "n d"]
    """Of each frame's energy by them, at the person as believed."""

    def bundle(self, person: Person) -> Bundle:
        """All that is adjusted."""
        return Bundle(self.poses, self.expressions, person)


class Registered(NamedTuple):
    """What the start leaves behind for good."""

    wide: Float[Array, "1 K W W"]
    """Grey levels about the landmarks in the frame of registration."""
    templates: Float[Array, "1 K T T"]
    """Their middle."""
    patches: Patches
    """On the skin of the face as adjusted last."""


class MonoState(NamedTuple):
    """Everything the next frame needs."""

    search: AdaptiveDiffusionState
    """Particles of pose and mode coefficients."""
    belief: Gaussian
    """Of the last estimate, for the person as believed."""
    face_index: Int[Array, ""]
    """Of `People.faces`: 0 for an unknown person, else 1 + the index of one of the gallery."""
    person: Person
    """About that face."""
    prior: Prior
    """Of every adjustment; its past, if there ever is one, is about the model's face, that of an unknown person."""
    model: FaceModel
    """Of the person: the expressions as orthonormal modes."""
    modes: Modes
    """Between those and the parameters of expressions."""
    response: Float[Array, "6+A d"]
    """How pose and expression change with the person, when the face was last found."""
    by_focal: Float[Array, " 6+A"]
    """The same with the logarithm of the focal length."""
    registered: Registered
    window: Window
    identities: Float[Array, "m S"]
    """Of the last adjustments, the newest first."""
    num_adjusted: Int[Array, ""]
    """Adjustments so far, the start included."""
    recent: Recent
    is_unsure: Bool[Array, " K"]
    """Landmarks that do not look as registered, or did not before and have not done so beyond doubt since."""
    windows: Float[Array, "1 K T T"]
    """About the landmarks of the frame before, as recalculated."""
    is_fresh: Bool[Array, ""]
    """Whether they are of the frame before."""
    slopes: Slopes
    model_variance: Float[Array, " K"]
    """Variance of each landmark about the model on every axis, mm^2."""
    residual_scale: Float[Array, ""]
    last_good: Float[Array, " n"]
    """Pose and mode coefficients when the face was last found."""
    misses: Int[Array, ""]
    """Frames in a row in which the face was not found."""
    num_outliers: Int[Array, ""]
    """Frames in which hardly any landmark looked as registered, two less for each in which some did."""
    time: Float[Array, ""]
    """Of the last frame, seconds."""
    key: Array


class MonoTrack(NamedTuple):
    """What is known of the head in each of `b` frames; NaN where it is not tracked.

    It has all fields of the tracker with several cameras. Lengths are metres in what a session and `track` return, and
    millimetres, those of the face, within the tracker.
    """

    pose: Float[Array | np.ndarray, "b 6"]
    """x, y, z, and roll, yaw, pitch in radians."""
    pose_std: Float[Array | np.ndarray, "b 6"]
    """What is not known of the person included."""
    deformation: Float[Array | np.ndarray, "b A"]
    """Expression, in standard deviations of the training set's about their mean."""
    shape: Float[Array | np.ndarray, "b K 3"]
    """Landmarks in the model frame. With a detector of meshes they are turned with the axes of `pose`;
    identity and offset are about the axes of the tracker alone."""
    image_points: Float[Array | np.ndarray, "b 1 K 2"]
    """Pixels."""
    score: Float[Array | np.ndarray, " b"]
    """Mean normalised correlation at the estimate, -1 to 1."""
    effective_sample_size: Float[Array | np.ndarray, " b"]
    innovations: Int[Array | np.ndarray, "b 2"]
    """How many coordinates of the pose the frame has corrected, and how many of these by less than 1.96 of the standard
    deviations that the filter claims for a correction: 95 % if it is right."""
    identity: Float[Array | np.ndarray, "b S"]
    """In standard deviations of the training set's about their mean."""
    offset: Float[Array | np.ndarray, "b K 3"]
    """What the model lacks of this face, a length."""
    person_index: Int[Array | np.ndarray, " b"]
    """Index of the recognised person among those of the gallery, or -1 for an unknown person."""
    is_adjusted: Bool[Array | np.ndarray, " b"]
    """Whether the face was adjusted in this frame."""
    status: Int[Array | np.ndarray, " b"]
    """Index into `jaxfilters.trackers.head.common.state.HEAD_STATUS`."""
