import jax
import numpy as np
import pytest

from jaxfilters.models.face.gallery import remember
from jaxfilters.models.face.landmarks import EYES, FROM_68, NAMES, NOSTRILS
from jaxfilters.models.face.mirroring import PAIRS
from jaxfilters.models.face.multilinear import learn, shape, shape_tensor
from jaxfilters.models.face.people_alignment import aligned_people
from jaxfilters.models.synthetic.face_training import NOISE_MM, generator_shapes, people_of
from jaxfilters.trackers.app.cli import FAILURE, main
from jaxfilters.trackers.head.mono.dense import tracked
from jaxfilters.trackers.io.enrolled_people import read_people
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.face_models import default_face_model, load_face_model
from jaxfilters.trackers.io.landmark_sets import NAMES_68, read_landmark_sets, ten_of

FEW = ("--identities", 4, "--expressions", 3)


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


@pytest.fixture(scope="module")
def shapes():
    """(5, 10, 10, 3) millimetres."""
    return np.asarray(generator_shapes(jax.random.key(1), people_of(jax.random.key(0), 5)), float)


@pytest.fixture(scope="module")
def spread():
    """(68, 10) weights: each of 68 landmarks is a mean of the ten, the ten themselves where iBUG has them."""
    weights = np.full((68, 10), 0.1)
    weights[list(FROM_68)] = np.eye(10)
    return weights


def fit(*arguments):
    return main(["fit", "face-model", *map(str, arguments)])


@pytest.mark.optimised
@pytest.mark.system
def test_without_data_it_makes_the_model_of_the_package(tmp_path, capsys):
    assert fit("--out", tmp_path / "model.npz") == 0
    told = capsys.readouterr().out
    assert "generator of synthetic faces: 200 people, 10 expressions, 10 landmarks" in told
    assert "12 people, each left out in turn" in told
    with jax.enable_x64(True):
        made, shipped = load_face_model(tmp_path / "model.npz"), default_face_model()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), made.model, shipped.model)
    assert made[1:4] == shipped[1:4]
    assert made.parameters == pytest.approx(shipped.parameters, abs=1e-6)


@pytest.mark.system
def test_a_file_of_landmarks_with_holes(tmp_path, capsys, shapes):
    holes = shapes.copy()
    holes[1, 3] = holes[4, 9] = np.nan
    np.savez(tmp_path / "faces.npz", shapes=holes)
    assert fit(tmp_path / "faces.npz", "--out", tmp_path / "model.npz", *FEW) == 0
    told = capsys.readouterr().out
    assert "landmark sets faces.npz: 5 people, 10 expressions, 10 landmarks, 2 faces missing" in told
    assert "4 parameters of identity and 3 of expression capture 9" in told
    assert "5 people, each left out in turn" in told
    assert "faces are taken to be aligned" in told
    read = load_face_model(tmp_path / "model.npz")
    assert (read.names, read.pairs) == (NAMES, PAIRS)
    assert read.parameters["people"] == 5
    assert NOISE_MM / 3 < read.parameters["rms_mm"] < 2
    whole = learn(jax.numpy.asarray(shapes, float), identities=4, expressions=3)
    np.testing.assert_allclose(read.model.mean, whole.mean, atol=0.5)


@pytest.mark.system
def test_people_are_remembered_for_the_tracker(tmp_path, capsys, shapes):
    np.savez(tmp_path / "faces.npz", shapes=shapes)
    asked = ("--out", tmp_path / "model.npz", "--remember", tmp_path / "people.npz", *FEW)
    assert fit(tmp_path / "faces.npz", *asked) == 0
    assert "people in " in capsys.readouterr().out
    model = load_face_model(tmp_path / "model.npz").model
    known = read_people([tmp_path / "people.npz"], model)
    assert known.names == tuple(f"landmark sets faces.npz, {i}" for i in range(1, 6))
    expected = remember(model, jax.numpy.asarray(shapes, float))
    # Written from double precision, and compared with single.
    np.testing.assert_allclose(known.gallery.identity, expected.identity, atol=2e-3)
    np.testing.assert_allclose(known.gallery.offset, expected.offset, atol=2e-2)


def test_a_folder_of_people_is_the_same_as_a_file(tmp_path, shapes):
    folder = tmp_path / "people"
    folder.mkdir()
    for person, faces in enumerate(shapes):
        rows = ["expression,name,x_mm,y_mm,z_mm"]
        for expression, face in enumerate(faces):
            if (person, expression) != (2, 6):
                rows += [
                    f"e{expression},{name},{x!r},{y!r},{z!r}"
                    for name, (x, y, z) in zip(NAMES, face.tolist(), strict=True)
                ]
        (folder / f"{person}.csv").write_text("\n".join(rows))
    sets = read_landmark_sets(folder)
    expected = shapes.copy()
    expected[2, 6] = np.nan
    np.testing.assert_array_equal(sets.shapes, expected)
    assert sets.neutral is None
    for file in folder.glob("*.csv"):
        file.write_text(file.read_text().replace("e4,", "Neutral,"))
    assert read_landmark_sets(folder).neutral == 4
    assert np.argwhere(~sets.observed).tolist() == [[2, 6]]


@pytest.mark.system
def test_people_of_68_landmarks_are_known_by_the_ten_that_are_followed(tmp_path, shapes, spread):
    """The ten are those of the faces of ten landmarks: what is remembered of each has its shape."""
    np.savez(tmp_path / "faces.npz", shapes=np.einsum("jk,pekc->pejc", spread, shapes))
    asked = ("--points", 68, "--out", tmp_path / "model.npz", "--remember", tmp_path / "people.npz", *FEW)
    assert fit(tmp_path / "faces.npz", *asked) == 0
    model = tracked(load_face_model(tmp_path / "model.npz").model)
    known = read_people([tmp_path / "people.npz"], model).gallery
    fitted = jax.vmap(lambda identity: shape(model, identity, model.expression_mean))(known.identity) + known.offset
    halves = np.asarray(shape_tensor(jax.numpy.asarray(shapes, float)), float)
    expected = np.moveaxis((halves[:, :, :5] + halves[:, :, 5:]).mean(axis=3) / 2, 2, 0)
    centred = lambda faces: faces - np.mean(faces, axis=1, keepdims=True)
    np.testing.assert_allclose(centred(np.asarray(fitted)), centred(expected), atol=1.0)


def test_faces_that_are_not_in_millimetres_are_refused(tmp_path, capsys, shapes):
    np.savez(tmp_path / "metres.npz", shapes=1e-3 * shapes)
    assert fit(tmp_path / "metres.npz", "--out", tmp_path / "model.npz", *FEW) == FAILURE
    assert "metres.npz: eyes are 0.0595 apart" in capsys.readouterr().err


@pytest.mark.system
def test_heads_that_moved_are_aligned(tmp_path, shapes):
    turned = shapes @ np.array([[0.96, -0.28, 0], [0.28, 0.96, 0], [0, 0, 1]]) + (3, 40, 600)
    # The first person's neutral face says which way faces look.
    turned[0, 1] = shapes[0, 1]
    np.savez(tmp_path / "turned.npz", shapes=turned, neutral=1)
    assert fit(tmp_path / "turned.npz", "--out", tmp_path / "model.npz", *FEW) == 0
    skull = np.isin(np.arange(10), [*EYES, *NOSTRILS]).astype(float)
    straight = aligned_people(jax.numpy.asarray(shapes, float), 1, jax.numpy.asarray(skull, float))
    expected = np.mean(shape_tensor(straight), axis=(2, 3))
    np.testing.assert_allclose(load_face_model(tmp_path / "model.npz").model.mean, expected, atol=1e-2)


def test_ten_of_68_landmarks(tmp_path):
    many = np.random.default_rng(0).normal(size=(3, 2, 68, 3))
    np.savez(tmp_path / "many.npz", shapes=many)
    sets = read_landmark_sets(tmp_path / "many.npz")
    assert sets.names == NAMES_68
    ten = ten_of(sets)
    np.testing.assert_array_equal(ten.shapes[:, :, 5], many[:, :, 54])
    assert (ten.names, ten.pairs) == (NAMES, PAIRS)


def test_options_that_ask_too_much_are_refused(tmp_path, capsys, shapes):
    np.savez(tmp_path / "faces.npz", shapes=shapes)
    out = ("--out", tmp_path / "model.npz")
    for arguments, message in (
        ((tmp_path / "faces.npz", "--identities", 11), "--identities must be 1 to 10, the rank of the faces; got 11"),
        ((tmp_path / "faces.npz", "--identities", 3, "--expressions", 99), "--expressions must be 1 to"),
        ((tmp_path / "faces.npz", "--points", 68), "--points 68 needs faces of 68 landmarks"),
        (("--points", 68), "--points 68 needs DATA"),
        (("--people", 2), "--people must be 3 or more"),
        ((tmp_path / "none",), "no such file or folder"),
    ):
        assert fit(*arguments, *out) == FAILURE
        assert message in capsys.readouterr().err
    assert not (tmp_path / "model.npz").exists()


GOOD = np.random.default_rng(1).normal(size=(2, 3, 10, 3))
PARTLY = np.where(np.arange(10)[:, None] == 4, np.nan, GOOD)
WRONG = {
    "no shapes": ({"faces": GOOD}, r"expected shapes \(people, expressions, landmarks, 3\)"),
    "flat": ({"shapes": GOOD[0]}, r"expected shapes .*; got \(3, 10, 3\)"),
    "partly": ({"shapes": PARTLY}, "must be finite, or NaN throughout"),
    "infinite": ({"shapes": GOOD * np.inf}, "must be finite, or NaN throughout"),
    "no pairs": ({"shapes": GOOD[:, :, :7]}, "of 7 landmarks, pairs"),
    "pairs": ({"shapes": GOOD, "pairs": [[0, 10]]}, "pairs must name each of 10 landmarks at most once"),
    "pairs of floats": ({"shapes": GOOD, "pairs": [[0.5, 1]]}, r"pairs must be integers \(P, 2\)"),
    "names": ({"shapes": GOOD, "names": ["nose"]}, "names must be of 10 landmarks; got 1"),
    "neutral": ({"shapes": GOOD, "neutral": 3}, "neutral must be the index of one of 3 expressions; got 3"),
    "neutral of 7": ({"shapes": GOOD[:, :, :7], "pairs": [[0, 1]], "neutral": 0}, "neutral is for 10 or 68"),
    "no neutral": ({"shapes": np.where(np.arange(3)[:, None, None] == 1, np.nan, GOOD), "neutral": 1}, "everybody"),
}


@pytest.mark.parametrize(("arrays", "message"), WRONG.values(), ids=WRONG)
def test_wrong_files_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "faces.npz", **arrays)
    with pytest.raises(InputError, match=f"faces.npz: .*{message}"):
        read_landmark_sets(tmp_path / "faces.npz")


HEADER = "expression,name,x_mm,y_mm,z_mm\n"
WRONG_TABLES = {
    "header": ("name,x,y,z\n", "expected a header expression,name"),
    "number": (HEADER + "e,left mouth,1,2,far\n", "line 2: z_mm must be a number"),
    "short": (HEADER + "e,left mouth,1,2\n", "line 2 has 4 entries"),
    "twice": (HEADER + "e,left mouth,1,2,3\n" * 2, "line 3: left mouth of e comes twice"),
    "unknown": (HEADER + "e,left ear,1,2,3\n", r"unknown landmarks \['left ear'\]"),
}


@pytest.mark.parametrize(("text", "message"), WRONG_TABLES.values(), ids=WRONG_TABLES)
def test_wrong_tables_are_refused(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_landmark_sets(tmp_path)


def test_other_wrong_paths_are_refused(tmp_path):
    with pytest.raises(InputError, match="no CSV files of people, and no ICT face model"):
        read_landmark_sets(tmp_path)
    (tmp_path / "a.npz").write_bytes(b"no")
    with pytest.raises(InputError, match="not a complete"):
        read_landmark_sets(tmp_path / "a.npz")
    np.save(tmp_path / "a.npy", GOOD)
    with pytest.raises(InputError, match="a single array"):
        read_landmark_sets(tmp_path / "a.npy")


@pytest.mark.system
@pytest.mark.data
def test_the_ict_face_model_is_recognised(tmp_path, capsys, data_dir):
    out = tmp_path / "model.npz"
    assert fit(data_dir / "ict_face_model", "--people", 8, "--points", 68, "--out", out, *FEW) == 0
    told = capsys.readouterr().out
    assert "ICT face model: 8 people, 20 expressions, 68 landmarks" in told
    assert load_face_model(out).model.mean.shape == (68, 3)
