import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import NAMES, PEOPLE_SHAPE
from jaxfilters.models.face.mirroring import PAIRS, mirrored
from jaxfilters.models.face.multilinear import learn, shape
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of
from jaxfilters.trackers.io.enrolled_people import fingerprint
from jaxfilters.trackers.io.errors import InputError, OutputError
from jaxfilters.trackers.io.face_models import (
    FaceModelFile,
    default_face_model,
    load_face_model,
    people_face_model,
    save_face_model,
    with_sizes,
)


@pytest.fixture(scope="module")
def model():
    people = people_of(jax.random.key(0), 4)
    return learn(generator_shapes(jax.random.key(1), people), identities=3, expressions=2)


@pytest.fixture
def saved(tmp_path, model):
    file = tmp_path / "new" / "model.npz"
    save_face_model(file, FaceModelFile(model, NAMES, PAIRS, 'faces "of" a test', {"people": 4}))
    return file


def arrays_of(file):
    with np.load(file) as content:
        return {name: content[name] for name in content.files}


@pytest.mark.system
def test_what_is_written_is_read(saved, model):
    read = load_face_model(saved)
    jax.tree.map(np.testing.assert_array_equal, read.model, model)
    assert read[1:] == (NAMES, PAIRS, 'faces "of" a test', {"people": 4})
    header = json.loads(str(arrays_of(saved)["header"]))
    assert (header["version"], header["units"]) == (1, "mm")
    with pytest.raises(OutputError, match="cannot write"):
        save_face_model(saved / "below.npz", read)


@pytest.mark.system
def test_the_model_of_the_package_is_a_face():
    model, names, pairs, source, parameters = default_face_model()
    assert (names, pairs) == (NAMES, PAIRS)
    assert source == "generator of synthetic faces"
    assert model.tensor.shape == (10, 3, parameters["identities"], parameters["expressions"])
    face = shape(model, model.identity_mean, model.expression_mean)
    np.testing.assert_allclose(mirrored(face), face, atol=1e-4)
    assert 80 < np.linalg.norm(face[0] - face[3]) < 100
    assert np.all(model.identity_std > 0)
    assert np.all(model.expression_std > 0)


def changed(**arrays):
    return lambda old: old | {name: np.asarray(array) for name, array in arrays.items()}


def with_header(**entries):
    return lambda old: old | {"header": np.asarray(json.dumps(json.loads(str(old["header"])) | entries))}


WRONG = {
    "no mean": (lambda old: {k: v for k, v in old.items() if k != "mean"}, "without mean; expected an .npz of"),
    "landmarks": (changed(mean=np.zeros((9, 3))), r"tensor must be numbers .* with \{'K': 9.*got \(10, 3, 3, 2\)"),
    "integers": (changed(mean=np.zeros((10, 3), int)), r"mean must be numbers .*; got \(10, 3\) int64"),
    "nan": (changed(identity_mean=np.full(3, np.nan)), "identity_mean must be finite"),
    "asymmetric": (changed(expression_covariance=[[1.0, 0.5], [0, 1]]), "must be symmetric and positive"),
    "negative": (changed(expression_covariance=[[1.0, 2], [2, 1]]), "must be symmetric and positive"),
    "no variance": (changed(expression_covariance=np.zeros((2, 2))), "must have positive variances"),
    "header": (changed(header="{"), "header: not JSON"),
    "foreign": (with_header(format="a face"), 'header must say format "jaxfilters face model"'),
    "inches": (with_header(units="inch"), "units"),
    "later": (with_header(version=2), "version 2; this program reads version 1"),
    "names": (with_header(names=["nose"]), "names must be of 10 landmarks"),
    "pairs": (with_header(pairs=[[0, 3], [3, 1]]), "pairs must be"),
    "no pairs": (with_header(pairs=None), "pairs must be"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_wrong_files_are_refused(saved, change, message):
    np.savez(saved, **change(arrays_of(saved)))
    with pytest.raises(InputError, match=f"model.npz: .*{message}"):
        load_face_model(saved)


def test_what_is_no_npz_is_refused(saved, tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_face_model(tmp_path / "none.npz")
    saved.write_bytes(saved.read_bytes()[:500])
    with pytest.raises(InputError, match="not a complete"):
        load_face_model(saved)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(InputError, match="a single array"):
        load_face_model(tmp_path / "one.npy")


def test_the_precision_is_that_of_jax(saved):
    assert load_face_model(saved).model.mean.dtype == jnp.zeros(()).dtype
    with jax.enable_x64(True):
        assert load_face_model(saved).model.mean.dtype == jnp.float64


def faces_of(model, count=4000):
    """Spreads across the line of sight of random people of a model, and their shapes of spread one, mean expression."""
    covariance = np.asarray(model.identity_covariance, float)
    identities = np.random.default_rng(0).multivariate_normal(np.asarray(model.identity_mean, float), covariance, count)
    basis = np.asarray(model.tensor, float) @ np.asarray(model.expression_mean, float)
    shapes = np.asarray(model.mean, float) + np.einsum("kds,ns->nkd", basis, identities)
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    spreads = np.linalg.norm(shapes[..., :2], axis=(1, 2))
    return spreads, (shapes / spreads[:, None, None]).reshape(count, -1)


def share_that_follows(spreads, shapes):
    """Of the variance of the logarithm of sizes, what linear regression on the shapes explains in other people."""
    design = np.column_stack([np.ones(len(shapes)), shapes - shapes.mean(axis=0)])
    known, others = slice(None, None, 2), slice(1, None, 2)
    coefficients = np.linalg.lstsq(design[known], np.log(spreads)[known], rcond=1e-6)[0]
    rest = np.log(spreads)[others] - design[others] @ coefficients
    return 1 - np.var(rest) / np.var(np.log(spreads)[others])


@pytest.mark.system
def test_the_model_for_people_is_about_their_mean_face():
    face = people_face_model().model
    mean = shape(face, face.identity_mean, face.expression_mean)
    np.testing.assert_allclose(mean - mean.mean(axis=0), PEOPLE_SHAPE, atol=1e-4)
    np.testing.assert_allclose(mirrored(mean), mean, atol=1e-4)


@pytest.mark.system
def test_the_shape_of_people_does_not_tell_their_size():
    """Random people are the oracle: a regression finds nothing, where synthetic faces tell a part of theirs."""
    plain, face = default_face_model().model, people_face_model().model
    synthetic, spread = faces_of(plain), faces_of(face)
    assert share_that_follows(*synthetic) > 0.2
    assert abs(share_that_follows(*spread)) < 0.05
    assert np.std(np.log(spread[0])) == pytest.approx(0.055, rel=0.03)


@pytest.mark.system
def test_shapes_vary_as_before_whatever_the_sizes():
    """Shapes of spread one have the standard deviations of those of the model that was widened."""
    face = default_face_model().model
    (_, before), (_, after) = faces_of(face), faces_of(with_sizes(face, 0.1))
    np.testing.assert_allclose(after.std(axis=0), before.std(axis=0), rtol=0.06, atol=1e-6)


@pytest.mark.system
def test_a_face_of_another_size_is_that_face_scaled_with_its_expressions():
    face = default_face_model().model
    wider, scale = with_sizes(face, 0.05), 1.1
    draw = np.random.default_rng(1)
    away = face.identity_std * draw.normal(size=face.num_identities)
    grown = jnp.append(face.identity_mean + scale * away, scale - 1)
    for _ in range(4):
        expression = face.expression_mean + face.expression_std * draw.normal(size=face.num_expressions)
        expected = scale * shape(face, face.identity_mean + away, expression)
        np.testing.assert_allclose(shape(wider, grown, expression), expected, atol=0.2)


@pytest.mark.system
def test_people_are_of_the_same_model_in_another_precision():
    expected = fingerprint(people_face_model().model)
    with jax.enable_x64(True):
        assert fingerprint(people_face_model().model) == expected
