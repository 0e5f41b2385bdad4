"""`jaxfilters fit face-detector`: by how much detectors misplace the landmarks of faces, from rendered people.

Every person of the ICT face model is rendered in several poses, lights and expressions, and every detector looks at
each picture. The misplacement of a landmark is a vector on the face that all pictures of the person share, and noise:
`uv_found - uv = J b + noise`, with J the derivative of the pixels by the landmark's place. b is found by robust least
squares (Cauchy weights) for each person and landmark; its mean and covariance are over people. The left and the right
half of a face are one sample each, so that the mean is symmetric. Of a detector that gives a mesh, the mean mesh is
the mean over all pictures, turned back by the true rotations; its two halves are as measured.
"""

import argparse
import sys
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfilters._full_precision import dot
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.landmarks import MIRROR, NUM_LANDMARKS
from jaxfilters.models.face.pose import rotation
from jaxfilters.models.face.rig import CameraRig, jacobian, monocular, project_shape
from jaxfilters.models.synthetic.face_texture import make_background
from jaxfilters.models.synthetic.ict_face import IctModel, deformed, make_ict_person, ten_landmarks
from jaxfilters.models.synthetic.ict_render import make_ict_head, render_ict
from jaxfilters.models.synthetic.ict_skin import paint_skin
from jaxfilters.trackers.head.common.corners import eye_centers
from jaxfilters.trackers.head.mono.detectors import DETECTORS, Detector
from jaxfilters.trackers.head.mono.mesh_rotation import line_of_sight
from jaxfilters.trackers.head.mono.start import is_symmetric
from jaxfilters.trackers.io.detector_errors import DetectorErrors, save_detector_errors
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.ict import open_ict
from jaxfilters.typing import AnyKey

FOCAL, SHAPE = 800.0, (480, 640)
DEPTHS_MM, ASIDE = (400.0, 900.0), (0.08, 0.05)
"""Of the heads, and how far they are from the axis of the camera: standard deviations as shares of the depth."""
ANGLES_DEG, MOST_YAW_DEG = (4.0, 6.0, 8.0), 28.0
"""Standard deviations of roll, yaw and pitch; in every other picture the yaw is anything up to the largest."""
MOST_SPEECH = 0.35
SPEAKING = ("jawOpen", "mouthSmile_L", "mouthSmile_R", "browInnerUp_L", "browInnerUp_R", "mouthPucker")
"""Strength of each expression in half of the pictures, uniform from 0 on."""
GAINS = (0.7, 1.15)
HELD_MM = (4.5, 4.5, 1.0)
"""Standard deviations of a misplacement before the pictures; along the line of sight they tell little."""
OUTLIER_MM, ROUNDS = 4.0, 5
"""Scale of the Cauchy weights; how often they are computed."""
FEWEST = 4
"""Pictures of a person in which the face was detected."""
LEAST_PEOPLE = 3 * NUM_LANDMARKS // 2
"""For a covariance of three coordinates of each landmark; people count twice, as they are and mirrored."""
ELSEWHERE = 0.5
"""Distances between the eyes from which on a detection is of something else."""


class Picture(NamedTuple):
    """What a detector said of one picture, millimetres across the line of sight at the head's depth."""

    apart: Float[np.ndarray, "10 2"]
    """Detected minus true."""
    J: Float[np.ndarray, "10 2 3"]
    """Of the pixels by the places of the landmarks."""
    solid: Float[np.ndarray, "V 3"] | None = None
    """The mesh on the axes of the face about its mean vertex, millimetres, if the detector gives one."""


def fit_detector(options: argparse.Namespace) -> str:
    """Measure the detectors, write `options.out`, and say in a few lines what was found.

    Raises:
        InputError: there would be too few people or images, the model cannot be read, or a detector finds hardly any
            face.
        OutputError: the file cannot be written.
    """
    if options.people < LEAST_PEOPLE:
        raise InputError(f"--people must be {LEAST_PEOPLE} or more, for a covariance; got {options.people}.")
    if options.images < FEWEST:
        raise InputError(
            f"--images must be {FEWEST} or more, for what the images of a person share; got {options.images}."
        )
    model = open_ict(options.data)
    detectors: dict[str, Detector] = {name: kind() for name, kind in DETECTORS.items() if _loads(name)}
    found: dict[str, list[list[Picture]]] = {name: [] for name in detectors}
    key = jax.random.key(options.seed)
    for person in range(options.people):
        pictures = of_person(jax.random.fold_in(key, person), model, detectors, options.images)
        for name, of_one in pictures.items():
            found[name].append(of_one)
        sys.stderr.write(f"\r  {person + 1} of {options.people} people")
    sys.stderr.write("\n")
    errors = {name: measured(of_all, name) for name, of_all in found.items()}
    parameters = {"people": options.people, "images": options.images, "seed": options.seed, "source": "ICT face model"}
    save_detector_errors(options.out, errors, parameters)
    lines = [line for name, one in errors.items() for line in _described(name, one)]
    return "\n".join([*lines, f"errors in {options.out}"])


def of_person(key: AnyKey, model: IctModel, detectors: dict[str, Detector], images: int) -> dict[str, list[Picture]]:
    """All pictures of a random person in which each detector finds the face."""
    rig = monocular(Pinhole.from_intrinsics(FOCAL, ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2), SHAPE))
    found: dict[str, list[Picture]] = {name: [] for name in detectors}
    for image, shape, pose in _rendered(key, model, rig, images):
        uv = np.asarray(project_shape(rig, shape, pose)[0][0])
        J = np.asarray(jacobian(rig, shape, pose)[0][0])
        scale = FOCAL / float(pose[2])
        eyes = float(np.linalg.norm(np.subtract(*eye_centers(uv))))
        for name, detector in detectors.items():
            observed = detector.detect(image, uv.mean(axis=0))
            if isinstance(observed, str) or not is_symmetric(observed.points):
                continue
            if np.linalg.norm(observed.points.mean(axis=0) - uv.mean(axis=0)) < ELSEWHERE * eyes:
                solid = None if observed.solid is None else _on_face(observed.solid, pose, rig) / scale
                found[name].append(Picture((observed.points - uv) / scale, J / scale, solid))
    return found


def measured(people: list[list[Picture]], name: str) -> DetectorErrors:
    """Mean and covariance among people, and the noise, of one detector's misplacements.

    Args:
        people: Pictures of each.
        name: Of the detector, for messages.

    Raises:
        InputError: if too few people were detected for a covariance.
    """
    enough = [pictures for pictures in people if len(pictures) >= FEWEST]
    if len(enough) < LEAST_PEOPLE:
        raise InputError(
            f"{name}: found {len(enough)} of {len(people)} people in {FEWEST} images or more; a covariance needs "
            f"{LEAST_PEOPLE} (--people, --images)."
        )
    each = [_misplaced(pictures) for pictures in enough]
    offsets, rest = np.stack([one for one, _ in each]), np.concatenate([left for _, left in each])
    mirrored = offsets[:, list(MIRROR)] * (-1.0, 1.0, 1.0)
    both = np.concatenate([offsets, mirrored]).reshape(2 * len(offsets), -1)
    mean = both.mean(axis=0)
    covariance = (both - mean).T @ (both - mean) / len(both)
    # Robust: what is far off is no noise but a mistake, which the tracker's losses are for.
    white = 1.4826 * np.median(np.abs(np.concatenate([rest, rest[:, list(MIRROR)]])), axis=0).max(axis=-1)
    solids = [one.solid for pictures in enough for one in pictures if one.solid is not None]
    vertices = np.mean(solids, axis=0) if solids else None
    return DetectorErrors(mean.reshape(-1, 3), covariance, white, vertices)


def _on_face(solid: Float[np.ndarray, "V 3"], pose: jax.Array, rig: CameraRig) -> Float[np.ndarray, "V 3"]:
    """A mesh in pixels about its mean vertex, on the axes of a face of that pose."""
    sight = line_of_sight(rig, jnp.asarray(solid[:, :2].mean(axis=0)))
    back = dot(sight.T, rotation(pose[3:]))
    return np.asarray(dot(jnp.asarray(solid - solid.mean(axis=0)), back), float)


def _misplaced(pictures: list[Picture]) -> tuple[Float[np.ndarray, "10 3"], Float[np.ndarray, "n 10 2"]]:
    """What the pictures of one person share, and what is left of each."""
    apart, J = np.stack([one.apart for one in pictures]), np.stack([one.J for one in pictures])
    held = np.diag(1 / np.square(HELD_MM))
    weights = np.ones(apart.shape)
    offset = np.zeros((NUM_LANDMARKS, 3))
    for _ in range(ROUNDS):
        normal = np.einsum("nki,nkia,nkib->kab", weights, J, J) + held
        offset = np.linalg.solve(normal, np.einsum("nki,nkia,nki->ka", weights, J, apart)[..., None])[..., 0]
        left = apart - np.einsum("nkia,ka->nki", J, offset)
        weights = 1 / (1 + np.square(left / OUTLIER_MM))
    return offset, left


def _rendered(
    key: AnyKey, model: IctModel, rig: CameraRig, images: int
) -> Iterator[tuple[np.ndarray, jax.Array, jax.Array]]:
    """Grey pictures of a person, with the landmarks in the model frame and the pose."""
    person_key, looks, wall, noise, numbers = jax.random.split(key, 5)
    person = make_ict_person(person_key, model)
    head, skin, background = make_ict_head(model, person), paint_skin(looks, model), make_background(wall, rig.shape)
    rng = np.random.default_rng(np.asarray(jax.random.bits(numbers, (4,))))
    moving = np.isin(model.names, SPEAKING)
    for index in range(images):
        roll, yaw, pitch = np.radians(rng.normal(0, ANGLES_DEG))
        yaw = np.radians(rng.uniform(-MOST_YAW_DEG, MOST_YAW_DEG)) if index % 2 else yaw
        depth = rng.uniform(*DEPTHS_MM)
        pose = jnp.asarray([*rng.normal(0, ASIDE) * depth, depth, roll, yaw, pitch], float)
        strengths = jnp.asarray(moving * rng.uniform(0, MOST_SPEECH, moving.shape) * (index % 4 < 2), float)
        light = jnp.asarray([rng.normal(0, 0.6), -rng.uniform(0, 1.1), -rng.uniform(0.3, 1)], float)
        image = render_ict(
            jax.random.fold_in(noise, index),
            model,
            person,
            head,
            skin,
            background[None],
            rig,
            pose,
            strengths,
            gain=rng.uniform(*GAINS),
            light=light,
        )
        yield np.asarray(image)[0], ten_landmarks(model, deformed(model, person, strengths)), pose


def _loads(name: str) -> bool:
    try:
        DETECTORS[name]()
    except ImportError as error:
        sys.stderr.write(f"  left out: detector {name} ({error})\n")
        return False
    return True


def _described(name: str, errors: DetectorErrors) -> list[str]:
    std = np.sqrt(np.diagonal(errors.covariance))
    size = lambda values: float(np.sqrt(np.mean(np.square(values))))
    return [
        f"{name}: landmarks lie {size(errors.mean):.1f} mm off in all images (root mean square), differ "
        f"by {size(std):.1f} mm from person to person and by {size(errors.white):.1f} mm from image to image"
    ]
