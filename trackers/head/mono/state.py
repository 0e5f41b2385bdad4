"""What the one-camera head tracker is told, what it knows, and what it says."""

import math
from dataclasses import dataclass
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
from jaxfilters.trackers.head.mono.person import Modes

NUM_FRAMES = 5
"""That the face is adjusted to (n of the specification)."""
AVERAGED = 15
"""Identities in the running mean of the published tracker (N_s)."""
REACH = Reach(
    pose=np.array([15.0, 15.0, 30.0, *np.radians([5.0, 5.0, 5.0])]), expression=0.5, identity=0.1, deviations=2.0
)
"""Of one adjustment, as published or, where the thesis is silent, as the specification decides (section 3)."""
WIDE_REACH = Reach(pose=REACH.pose, expression=2.0, identity=1.0, deviations=4.0)
"""Of one adjustment that a prior holds."""
EYES_APART_MM, EYES_APART_STD_MM = (40.0, 80.0), 1.0
"""Of people of any age; how well a known one is known, that between the middles of the corners included."""
CHOICES = {
    "landmarks": ("aligned", "recalculated", "projected"),
    "selection": ("information", "angles", "latest"),
    "past": ("dropped", "marginalised"),
}


@dataclass(frozen=True)
class MonoOptions:
    """What a user may set; Python values, read when a session is built."""

    num_particles: int = 750
    seed: int = 0
    landmarks: str = "aligned"
    """How landmarks are measured: `aligned` patches that turn with the head; `recalculated` as published, then also
    with its estimate from particles, its narrow boxes and its mean identity; or `projected` from the estimate itself
    instead, which only shows what measuring is good for."""
    selection: str = "information"
    """Which frames are adjusted to: those of most `information` about the person, of the largest variance of `angles`,
    as published, or the `latest`."""
    past: str = "dropped"
    """What frames that are replaced leave behind: nothing, or, `marginalised`, what they told of the person. The
    latter forgets nothing, neither the errors that landmarks have in common over many frames."""
    adjust: bool = True
    """Whether the face is adjusted while it is followed; otherwise at the start alone."""
    prior_weight: float = 1.0
    """Of the training set's statistics; 0 as published."""
    offset_std: float = 0.7
    """Millimetres by which a face may differ from what the model can form; 0 as published."""
    eyes_apart_mm: float | None = None
    """Distance between the pupils, as an optician measures it; without it the size of a face is that of people."""
    chunk: int = 8
    """Frames in one compiled call; 1 for live cameras."""
    live: bool = False
    """Whether frames cannot wait: a face is then searched for beside the tracking."""

    def __post_init__(self) -> None:
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}; got {getattr(self, name)!r}.")
        for name in ("num_particles", "chunk"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}.")
        for name in ("prior_weight", "offset_std"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must be finite and at least 0; got {getattr(self, name)}.")

        least, most = EYES_APART_MM
        if self.eyes_apart_mm is not None and not least <= self.eyes_apart_mm <= most:
            raise ValueError(f"eyes_apart_mm must be within {least:g} and {most:g}; got {self.eyes_apart_mm}.")

    @property
    def prior(self) -> Prior:
        """What holds every adjustment."""
        if self.eyes_apart_mm is None:
            return Prior(self.prior_weight, self.offset_std)
        return Prior(self.prior_weight, self.offset_std, self.eyes_apart_mm, EYES_APART_STD_MM)

    @property
    def is_published(self) -> bool:
        """Whether estimates, boxes and the identity's mean are those of the thesis."""
        return self.landmarks != "aligned"

    @property
    def reach(self) -> Reach:
        """Of every adjustment."""
        return REACH if self.is_published else WIDE_REACH


PUBLISHED = MonoOptions(landmarks="recalculated", selection="angles", prior_weight=0.0, offset_std=0.0)
"""The tracker of the thesis."""


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
    who: Int[Array, ""]
    """0 for a stranger, else one of those who are remembered."""
    person: Person
    """About that face."""
    prior: Prior
    """What holds every adjustment; its past, if there ever is one, is about the model's face, that of a stranger."""
    model: FaceModel
    """Of the person: the expressions as orthonormal modes."""
    modes: Modes
    """Between those and the parameters of expressions."""
    response: Float[Array, "6+A d"]
    """How pose and expression change with the person, when the face was last found."""
    registered: Registered
    window: Window
    identities: Float[Array, "m S"]
    """Of the last adjustments, the newest first."""
    num_adjusted: Int[Array, ""]
    """Adjustments so far, the start included."""
    recent: Recent
    windows: Float[Array, "1 K T T"]
    """About the landmarks of the frame before, as recalculated."""
    is_fresh: Bool[Array, ""]
    """Whether they are of the frame before."""
    slopes: Slopes
    looseness: Float[Array, " K"]
    """Variance of each landmark about the model on every axis, mm^2."""
    misfit: Float[Array, ""]
    last_good: Float[Array, " n"]
    """Pose and mode coefficients when the face was last found."""
    misses: Int[Array, ""]
    """Frames in a row in which the face was not found."""
    strange: Int[Array, ""]
    """Frames in which hardly any landmark looked as registered, two less for each in which some did."""
    time: Float[Array, ""]
    """Of the last frame, seconds."""
    key: Array


class MonoTrack(NamedTuple):
    """What is known of the head in each of `b` frames; NaN where it is not tracked.

    It has all fields of the tracker with several cameras.
    """

    pose: Float[Array | np.ndarray, "b 6"]
    """Millimetres and radians: x, y, z, roll, yaw, pitch."""
    pose_std: Float[Array | np.ndarray, "b 6"]
    """What is not known of the person included."""
    deformation: Float[Array | np.ndarray, "b A"]
    """Expression, in standard deviations of the training set's about their mean."""
    shape: Float[Array | np.ndarray, "b K 3"]
    """Landmarks in the model frame, millimetres."""
    image_points: Float[Array | np.ndarray, "b 1 K 2"]
    """Pixels."""
    score: Float[Array | np.ndarray, " b"]
    """Mean normalised correlation at the estimate, -1 to 1."""
    effective_sample_size: Float[Array | np.ndarray, " b"]
    identity: Float[Array | np.ndarray, "b S"]
    """In standard deviations of the training set's about their mean."""
    offset: Float[Array | np.ndarray, "b K 3"]
    """What the model lacks of this face, millimetres."""
    who: Int[Array | np.ndarray, " b"]
    """Whom of the people who are remembered this is taken for, from 0 on; -1 for a stranger."""
    is_adjusted: Bool[Array | np.ndarray, " b"]
    """Whether the face was adjusted in this frame."""
    status: Int[Array | np.ndarray, " b"]
    """Index into `jaxfilters.trackers.head.common.state.HEAD_STATUS`."""
