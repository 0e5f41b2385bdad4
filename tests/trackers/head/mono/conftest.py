"""A person of the generator who talks, before one camera; rendered once for all tests of a module."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.face_motion import MONOCULAR_PLACE_MM, motion, speech_schedule
from jaxfilters.models.synthetic.face_sequence import face_sequence
from jaxfilters.trackers.io.face_models import default_face_model


@pytest.fixture(scope="session")
def rig():
    return monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))


@pytest.fixture(scope="session")
def face():
    return default_face_model().model


@pytest.fixture(scope="session")
def spread():
    """(68, 10) weights: each of 68 landmarks is a mean of the ten, the ten themselves where iBUG has them."""
    weights = np.random.default_rng(5).dirichlet(np.full(10, 0.3), 68)
    weights[list(FROM_68)] = np.eye(10)
    return weights


@pytest.fixture(scope="session")
def face68(face, spread):
    """A model of 68 landmarks of the same people."""
    W = jnp.asarray(spread, face.mean.dtype)
    product = lambda a: jnp.tensordot(W, a, 1, precision="highest")
    return dataclasses.replace(face, mean=product(face.mean), tensor=product(face.tensor))


@pytest.fixture(scope="session")
def talking(rig):
    """Truth and images of 56 frames."""
    poses = motion("mix", 56, 3, place_mm=MONOCULAR_PLACE_MM)
    made = face_sequence(jax.random.key(33), poses, rig=rig, expressions=speech_schedule(56, start=20))
    return made, made.frames(0, len(made))


@pytest.fixture(scope="session")
def detected(talking):
    """Landmarks of five frames to half a pixel, as a detector would have them."""
    from jaxfilters.trackers.head.mono.detections import Detections

    made, images = talking
    frames = [0, 4, 8, 12, 16]
    noise = np.random.default_rng(0).normal(0, 0.5, (5, 10, 2))
    return Detections(made.uv[frames, 0] + noise, images[frames, 0], float(made.times[16]))
