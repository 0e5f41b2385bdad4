"""Misplacements of a detector from pictures: draws with known mean and covariance are found again."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.landmarks import MIRROR
from jaxfilters.models.face.rig import monocular
from jaxfilters.trackers.app.cli import FAILURE, main
from jaxfilters.trackers.fitting.face_detector import Picture, _on_face, measured
from jaxfilters.trackers.io.errors import InputError

PEOPLE, PICTURES, NOISE_MM = 200, 16, 0.5


def pictures_of(rng, offset):
    """Heads that turn up to half a radian, far away: what is misplaced turns along."""
    found = []
    for angles in rng.uniform(-0.5, 0.5, (PICTURES, 3)):
        J = np.tile(Rotation.from_euler("ZYX", angles).as_matrix()[:2], (10, 1, 1))
        apart = np.einsum("kia,ka->ki", J, offset) + rng.normal(0, NOISE_MM, (10, 2))
        apart[rng.integers(10)] += rng.normal(0, 20, 2) * (rng.random() < 0.3)
        found.append(Picture(apart, J))
    return found


def test_mean_covariance_and_noise_are_found_again():
    """Of 200 people, that count twice: .3 mm and 20 % are three of the standard errors at the least."""
    rng = np.random.default_rng(0)
    mean = rng.normal(0, 2, (10, 3)) * (1, 1, 0.3)
    mean = (mean + mean[list(MIRROR)] * (-1, 1, 1)) / 2
    offsets = mean + rng.normal(0, (1.0, 1.5, 0.5), (PEOPLE, 10, 3))
    errors = measured([pictures_of(rng, offset) for offset in offsets], "own")
    np.testing.assert_allclose(errors.mean[:, :2], mean[:, :2], atol=0.3)
    std = np.sqrt(np.diagonal(errors.covariance)).reshape(10, 3)
    np.testing.assert_allclose(std[:, :2], np.tile((1.0, 1.5), (10, 1)), rtol=0.2)
    np.testing.assert_allclose(errors.white, NOISE_MM, rtol=0.2)


def test_the_mean_mesh_is_that_of_faces_turned_back():
    """Far from the axis of the camera, too: a mesh is as it looks along the line of sight."""
    rng = np.random.default_rng(0)
    rig = monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))
    vertices = rng.normal(0, 40.0, (30, 3))
    vertices -= vertices.mean(axis=0)
    for angles in rng.uniform(-0.5, 0.5, (3, 3)):
        uv = np.append(rng.uniform((0, 0), (640, 480)), 0.0)
        ray = np.append((uv[:2] - (319.5, 239.5)) / 800.0, 1.0)
        sight, _ = Rotation.align_vectors(ray[None], [[0.0, 0.0, 1.0]])
        solid = (sight.inv() * Rotation.from_euler("ZYX", angles)).apply(vertices) + uv
        pose = jnp.asarray([0.0, 0.0, 600.0, *angles])
        np.testing.assert_allclose(_on_face(solid, pose, rig), vertices, atol=1e-3)
    pictures = [[one._replace(solid=vertices + 1.0) for one in pictures_of(rng, np.zeros((10, 3)))] for _ in range(15)]
    pictures[0] = [one._replace(solid=vertices - 14.0) for one in pictures[0]]
    np.testing.assert_allclose(measured(pictures, "own").vertices, vertices, atol=1e-9)


@pytest.mark.parametrize(
    ("option", "message"),
    [("--people=14", "--people must be 15 or more"), ("--images=3", "--images must be 4 or more")],
)
def test_too_few_to_draw_are_refused_before_anything_is_rendered(tmp_path, capsys, option, message):
    assert main(["fit", "face-detector", str(tmp_path), "--out", str(tmp_path / "errors.npz"), option]) == FAILURE
    assert message in capsys.readouterr().err


def test_too_few_people_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="own: found 3 of 4 people"):
        measured([[], *(pictures_of(rng, np.zeros((10, 3))) for _ in range(3))], "own")
