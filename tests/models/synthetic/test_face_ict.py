"""Modelled faces: units, order of landmarks, recorded courses; on small files made here, and on the real ones."""

import csv

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.landmarks import FROM_68, MEAN_SHAPE
from jaxfilters.models.face.rig import monocular, project_shape
from jaxfilters.models.rendering.depth import render_mesh
from jaxfilters.models.rendering.geometry import Mesh
from jaxfilters.models.synthetic import ict_render
from jaxfilters.models.synthetic.face_motion import MONOCULAR_PLACE_MM
from jaxfilters.models.synthetic.ict_course import (
    NECK_MM,
    biwi_course,
    livelink_course,
    read_biwi,
    read_livelink,
)
from jaxfilters.models.synthetic.ict_face import deformed, make_ict_person, read_ict, ten_landmarks
from jaxfilters.models.synthetic.ict_sequence import ict_sequence

NAMES = ("browInnerUp_L", "browInnerUp_R", "jawLeft", "jawOpen", "mouthLeft", "mouthSmile_L", "mouthSmile_R")


@pytest.fixture
def model_folder(tmp_path):
    """90 vertices, of which the last 68 are landmarks; numbers in centimetres, y up, z out of the face."""
    draw = np.random.default_rng(0)
    neutral = draw.normal(size=(90, 3)).astype(np.float32)
    ids = np.arange(22, 90)
    np.savez(tmp_path / "ict_landmarks68.npz", vertex_ids=ids)
    np.savez(
        tmp_path / "ict_face9409.npz",
        neutral=neutral,
        quads=np.array([[0, 1, 2, 3]], np.int32),
        identity=draw.normal(size=(100, 90, 3)).astype(np.float16),
        expression=draw.normal(size=(len(NAMES), 90, 3)).astype(np.float16),
        expression_names=np.array(NAMES),
    )
    return tmp_path


def test_the_model_is_read_in_millimetres_with_y_down_and_z_away(model_folder):
    model = read_ict(model_folder)
    raw = np.load(model_folder / "ict_face9409.npz")
    np.testing.assert_allclose(model.neutral, raw["neutral"] * [10, -10, -10], rtol=1e-6)
    np.testing.assert_allclose(model.expression[3], raw["expression"][3].astype(float) * [10, -10, -10], rtol=1e-6)
    assert model.names == NAMES
    assert model.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.system
def test_people_and_expressions_add_up_about_the_neutral_landmarks(model_folder):
    model = read_ict(model_folder)
    person = make_ict_person(jax.random.key(1), model)
    np.testing.assert_allclose(ten_landmarks(model, person.neutral).mean(axis=0), 0, atol=1e-4)
    step = deformed(model, person, jnp.zeros(7).at[3].set(0.5)) - person.neutral
    np.testing.assert_allclose(step, 0.5 * model.expression[3], atol=1e-4)
    np.testing.assert_array_equal(ten_landmarks(model, person.neutral), person.neutral[22 + np.array(FROM_68)])


def test_missing_files_and_arrays_are_named(model_folder, tmp_path_factory):
    empty = tmp_path_factory.mktemp("empty")
    for read in (read_ict, read_biwi, lambda folder: read_livelink(folder, NAMES)):
        with pytest.raises(ValueError, match="folder must hold"):
            read(empty)
    np.savez(model_folder / "ict_landmarks68.npz", other=np.zeros(3))
    with pytest.raises(ValueError, match="lacks vertex_ids"):
        read_ict(model_folder)
    np.savez(model_folder / "ict_landmarks68.npz", vertex_ids=np.arange(68) + 40)
    with pytest.raises(ValueError, match=r"must name .* of 90 vertices"):
        read_ict(model_folder)


def test_recorded_rotations_are_cut_at_gaps_and_turned_into_our_axes(tmp_path):
    """A frame with y up and z towards the camera is ours turned by half about x: C R C with C = diag(1, -1, -1)."""
    degrees = np.random.default_rng(1).uniform(-40, 40, (7, 3))
    np.savez(
        tmp_path / "biwi_1_14.npz",
        seq=np.array([1, 1, 1, 1, 2, 2, 2], np.int8),
        frame=np.array([3, 4, 5, 9, 10, 11, 12], np.int16),
        pyr_deg=degrees,
    )
    stretches = read_biwi(tmp_path)
    assert [len(angles) for angles in stretches] == [3, 1, 3]
    flip = np.diag([1.0, -1.0, -1.0])
    theirs = Rotation.from_euler("ZYX", degrees[:, ::-1], degrees=True).as_matrix()
    ours = Rotation.from_euler("ZYX", np.concatenate(stretches)).as_matrix()
    np.testing.assert_allclose(ours, flip @ theirs @ flip, atol=1e-12)


def write_take(folder, columns, rows):
    with (folder / "livelink_rows_0_199.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["Timecode", "BlendShapeCount", *columns], *[["0", "61", *row] for row in rows]])


def test_recorded_expressions_go_to_the_shapes_of_their_names(tmp_path):
    columns = ["JawOpen", "MouthSmileLeft", "MouthSmileRight", "JawLeft", "BrowInnerUp", "HeadYaw"]
    write_take(tmp_path, columns, [[0.1, 0.2, 0.3, 0.4, 0.5, 9.0], [1, 2, 3, 4, 5, 9]])
    strengths = read_livelink(tmp_path, NAMES)
    np.testing.assert_allclose(strengths[0], [0.5, 0.5, 0.4, 0.1, 0.0, 0.2, 0.3])
    assert strengths.shape == (2, 7)
    write_take(tmp_path, ["Nothing"], [[0.0]])
    with pytest.raises(ValueError, match="must have expressions of the model"):
        read_livelink(tmp_path, NAMES)


def test_heads_face_ahead_and_then_turn_as_recorded_about_their_neck():
    recorded = np.radians(np.random.default_rng(2).uniform(-30, 30, (4, 3)))
    poses = biwi_course(recorded, 200, fps=1.0, place_mm=(0.0, 0.0, 650.0))
    np.testing.assert_allclose(poses[:31], np.tile([0, 0, 650.0, 0, 0, 0], (31, 1)), atol=1e-12)
    np.testing.assert_allclose(poses[90, 3:], recorded[2], atol=1e-9)
    np.testing.assert_allclose(poses[120, 3:], recorded[3], atol=1e-9)
    np.testing.assert_allclose(poses[150, 3:], recorded[2], atol=1e-9)
    neck = Rotation.from_euler("ZYX", poses[:, 3:]).apply(NECK_MM) + poses[:, :3]
    np.testing.assert_allclose(neck, np.tile(np.add(NECK_MM, (0, 0, 650)), (200, 1)), atol=1e-9)
    steps = (Rotation.from_euler("ZYX", poses[:-1, 3:]).inv() * Rotation.from_euler("ZYX", poses[1:, 3:])).magnitude()
    np.testing.assert_allclose(steps[91:119], steps[91], rtol=1e-6)


def test_faces_are_neutral_and_then_move_as_recorded():
    strengths = np.array([[0.0, 1.0], [0.5, 0.0], [1.0, 0.2]])
    course = livelink_course(strengths, 200, fps=1.0)
    np.testing.assert_array_equal(course[:31], 0)
    np.testing.assert_allclose(course[[60, 90, 120]], strengths[[1, 2, 1]])
    np.testing.assert_allclose(course[75], [0.75, 0.1])


@pytest.mark.system
def test_attributes_are_linear_on_every_triangle():
    """An attribute that is linear in space has at each pixel its value at the point that the depth image shows."""
    draw = np.random.default_rng(3)
    middle = draw.uniform(-60, 60, (40, 1, 3)) + np.array([0, 0, 500])
    vertices = jnp.asarray((middle + draw.uniform(-25, 25, (40, 3, 3))).reshape(-1, 3), jnp.float32)
    faces = jnp.arange(120, dtype=jnp.int32).reshape(40, 3)
    camera = Pinhole.from_intrinsics(200.0, (60.0, 45.0), (90, 120))
    slope = jnp.array([[1.0, 0.2], [-0.5, 1.0], [0.3, -0.4]])

    @jax.jit
    def drawn(vertices):
        winner = ict_render._winners(camera, vertices, faces)
        return winner, ict_render._interpolated(camera, vertices, faces, vertices @ slope, winner)

    winner, values = drawn(vertices)
    values = np.stack(values, axis=-1)
    depth = render_mesh(camera, Mesh(vertices, faces))
    hit = np.asarray(winner) >= 0
    assert hit.sum() > 500
    points = np.asarray(camera.rays())[hit] * np.asarray(depth)[hit][:, None]
    np.testing.assert_allclose(values[hit], points @ np.asarray(slope), atol=0.05)


@pytest.fixture(scope="module")
def ict(data_dir):
    return read_ict(data_dir / "ict_face_model")


@pytest.mark.system
@pytest.mark.data
def test_the_landmarks_of_the_mean_face_are_those_of_the_specification(ict):
    """Both are faces of adults: every landmark within 16 mm of the specification's, every eye 20 to 45 mm wide."""
    ten = np.asarray(ten_landmarks(ict, ict.neutral))
    assert np.linalg.norm(ten - ten.mean(axis=0) - MEAN_SHAPE, axis=1).max() < 16
    people = jax.vmap(make_ict_person, in_axes=(0, None))(jax.random.split(jax.random.key(0), 20), ict)
    tens = np.asarray(jax.vmap(ten_landmarks, in_axes=(None, 0))(ict, people.neutral))
    for outer, inner in ((0, 1), (3, 2)):
        width = np.linalg.norm(tens[:, outer] - tens[:, inner], axis=1)
        assert width.min() > 20
        assert width.max() < 45


@pytest.mark.system
@pytest.mark.data
def test_recorded_faces_open_their_mouths_and_turn(ict, data_dir):
    strengths = livelink_course(read_livelink(data_dir / "livelinkface_take", ict.names), 300)
    angles = max(read_biwi(data_dir / "biwi_head_rotation"), key=len)
    assert strengths[:, ict.names.index("jawOpen")].max() > 0.5
    sequence = ict_sequence(jax.random.key(0), ict, biwi_course(angles, 300), expressions=strengths)
    moved = np.linalg.norm(sequence.shapes - sequence.shapes[0], axis=-1).max(axis=0)
    assert moved[4:6].min() > 6
    assert moved[1:3].max() < 2
    assert np.abs(np.degrees(sequence.poses[:, 4])).max() > 30
    assert np.degrees(np.abs(np.diff(sequence.poses[:, 3:], axis=0))).max() < 10
    shape, pose = jnp.asarray(sequence.shapes[200], float), jnp.asarray(sequence.poses[200], float)
    np.testing.assert_allclose(project_shape(sequence.rig, shape, pose)[0], sequence.uv[200], atol=0.01)
    # iBUG's first landmark is at the right ear, to the image's left, its ninth the chin.
    assert np.all(sequence.uv68[0, :, 0, 0] < sequence.uv[0, :, :, 0].min(axis=1))
    assert np.all(sequence.uv68[0, :, 8, 1] > sequence.uv[0, :, :, 1].max(axis=1))


@pytest.mark.system
@pytest.mark.data
def test_a_cascade_for_real_faces_finds_rendered_ones(ict):
    """Eight of ten people or more; the box holds the eyes and the mouth."""
    detector = cv2.CascadeClassifier(cv2.data.haarcascades + "haarcascade_frontalface_alt2.xml")
    rig = monocular(Pinhole.from_intrinsics(400.0, (159.5, 119.5), (240, 320)))
    found = 0
    for person in range(10):
        sequence = ict_sequence(jax.random.key(person), ict, np.array([[*MONOCULAR_PLACE_MM, 0, 0, 0.0]]), rig=rig)
        boxes = detector.detectMultiScale(sequence.frames(0, 1)[0, 0], 1.1, 4)
        uv = sequence.uv[0, 0]
        found += any(np.all((uv > box[:2]) & (uv < box[:2] + box[2:])) for box in np.asarray(boxes))
    assert found >= 8
