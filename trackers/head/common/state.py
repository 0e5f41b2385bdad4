"""The options of the head tracker, its state, and its track."""

import math
from dataclasses import dataclass
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
CHOICES = {
    "mode": ("modern", "paper"),
    "diffusion": ("proportional", "online", "fixed"),
    "detector": ("cascades", "mediapipe"),
}


@dataclass(frozen=True)
class HeadOptions:
    """What a user may set; Python values, read when a session is built."""

    mode: str = "modern"
    """`modern` refines what the particles find; `paper` is Oka, Sato and Sugano's tracker."""
    num_particles: int = 1000
    seed: int = 0
    diffusion: str = "proportional"
    """`proportional`: speed plus one unit, as in the paper's experiments; `online`: that regression is updated while
    tracking; `fixed`: `fixed_diffusion`, whatever the speed."""
    fixed_diffusion: float = 5.0
    """Millimetres and degrees a frame."""
    learn: bool = True
    """Whether the face may deform; with one camera it never does."""
    rigid_frames: int = 120
    """Frames after registration in which deformations are estimated but not yet used."""
    detector: str = "cascades"
    """What finds the landmarks at the start: OpenCV's `cascades` and corners, or the face mesh of `mediapipe`."""
    chunk: int = 8
    """Frames in one compiled call; 1 for live cameras."""
    live: bool = False
    """Whether frames cannot wait: a lost face is then searched for beside the tracking."""

    def __post_init__(self) -> None:
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}; got {getattr(self, name)!r}.")
        for name in ("num_particles", "chunk"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}.")
        if not self.fixed_diffusion > 0:
            raise ValueError(f"fixed_diffusion must be positive; got {self.fixed_diffusion}.")
        if self.rigid_frames < 0:
            raise ValueError(f"rigid_frames must be 0 or more; got {self.rigid_frames}.")


def compiled(options: HeadOptions) -> HeadOptions:
    """What of the options a compiled program knows: those that differ only in numbers share one.

    The diffusion is among the filters and in the state, but for whether it is estimated.
    """
    learns = "online" if options.diffusion == "online" else "proportional"
    return HeadOptions(
        options.mode, options.num_particles, diffusion=learns, learn=options.learn, rigid_frames=options.rigid_frames
    )


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
    """Frames in which hardly any landmark looked as registered, two less for each in which some did."""
    age: Int[Array, ""]
    """Frames since registration."""
    time: Float[Array, ""]
    """Of the last frame, seconds."""
    key: Array


class HeadTrack(NamedTuple):
    """What is known of the head in each of `b` frames; NaN where it is not tracked."""

    pose: Float[Array | np.ndarray, "b 6"]
    """Millimetres and radians: x, y, z, roll, yaw, pitch."""
    pose_std: Float[Array | np.ndarray, "b 6"]
    deformation: Float[Array | np.ndarray, "b B"]
    """Mode coefficients, millimetres."""
    shape: Float[Array | np.ndarray, "b K 3"]
    """Landmarks in the model frame, millimetres."""
    image_points: Float[Array | np.ndarray, "b C K 2"]
    """Pixels."""
    score: Float[Array | np.ndarray, " b"]
    """Mean normalised correlation at the estimate, -1 to 1."""
    effective_sample_size: Float[Array | np.ndarray, " b"]
    status: Int[Array | np.ndarray, " b"]
    """Index into `HEAD_STATUS`."""
