"""People on disk: what is written is read, and only for the model that they are of."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.gallery import remember
from jaxfilters.models.face.multilinear import learn
from jaxfilters.models.synthetic.face_training import generator_shapes, people_of
from jaxfilters.trackers.io.enrolled_people import People, fingerprint, read_people, write_people
from jaxfilters.trackers.io.errors import InputError, OutputError


@pytest.fixture(scope="module")
def taught():
    shapes = generator_shapes(jax.random.key(1), people_of(jax.random.key(0), 4))
    face = learn(shapes, identities=3, expressions=2)
    return face, remember(face, shapes[:2])


@pytest.fixture
def saved(tmp_path, taught):
    face, known = taught
    write_people(tmp_path / "new" / "two.npz", People(("Ann", "Ben"), known), face)
    return tmp_path / "new" / "two.npz"


@pytest.mark.system
def test_what_is_written_is_read_from_several_files(saved, taught, tmp_path):
    face, known = taught
    one = jax.tree.map(lambda leaf: leaf[1:], known)
    write_people(tmp_path / "one.npz", People(("Ben again",), one), face)
    read = read_people([saved, tmp_path / "one.npz"], face)
    assert read.names == ("Ann", "Ben", "Ben again")
    symmetric = 0.5 * (known.covariance + known.covariance.swapaxes(1, 2))
    for leaf, expected in zip(read.gallery, known._replace(covariance=symmetric), strict=True):
        np.testing.assert_array_equal(leaf, expected[np.array([0, 1, 1])])
        assert leaf.dtype == jnp.zeros(()).dtype
    with pytest.raises(OutputError, match="cannot write"):
        write_people(saved / "below.npz", read, face)


def test_a_model_is_the_same_in_another_precision(taught):
    face, _ = taught
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), face)
        assert fingerprint(wide) == fingerprint(face)
    other = jax.tree.map(lambda leaf: 1.001 * leaf, face)
    assert fingerprint(other) != fingerprint(face)


def test_a_covariance_may_be_as_asymmetric_as_single_precision_makes_it(saved, taught):
    """Recordings of hundreds of frames left 1e-5 to 7e-5 of the largest element; what is written is symmetric."""
    face, known = taught
    rng = np.random.default_rng(0)
    exact = np.asarray(known.covariance, np.float64)
    rounded = exact * (1 + 7e-5 * rng.uniform(-1, 1, exact.shape))
    with np.load(saved) as content:
        np.savez(saved, **{**content, "covariance": rounded})
    read = read_people([saved], face)
    covariance = np.asarray(read.gallery.covariance)
    np.testing.assert_array_equal(covariance, covariance.swapaxes(1, 2))
    scale = np.abs(exact).max()
    np.testing.assert_allclose(covariance, exact, atol=1e-4 * scale)
    write_people(saved, People(("Ann", "Ben"), known._replace(covariance=jnp.asarray(rounded))), face)
    with np.load(saved) as content:
        np.testing.assert_array_equal(content["covariance"], content["covariance"].swapaxes(1, 2))


def changed(**arrays):
    return lambda old: old | {name: np.asarray(array) for name, array in arrays.items()}


def with_header(**entries):
    return lambda old: old | {"header": np.asarray(json.dumps(json.loads(str(old["header"])) | entries))}


WRONG = {
    "no offset": (lambda old: {k: v for k, v in old.items() if k != "offset"}, "without offset; expected an .npz"),
    "sizes": (changed(identity=np.zeros((2, 4))), r"identity must be numbers \(2, 3\); got \(2, 4\) float64"),
    "integers": (changed(identity=np.zeros((2, 3), int)), r"identity must be numbers \(2, 3\); got \(2, 3\) int64"),
    "nan": (changed(offset=np.full((2, 10, 3), np.nan)), "offset must be finite"),
    "asymmetric": (changed(covariance=np.tile(np.triu(np.ones((3, 3))), (2, 1, 1))), "covariance must be symmetric"),
    "none": (changed(covariance=np.zeros((2, 3, 3))), "covariance must be symmetric and positive definite"),
    "header": (changed(header="{"), "header: not JSON"),
    "foreign": (with_header(format="a face"), 'header must say format "jaxfilters people"'),
    "later": (with_header(version=2), "version 2; this program reads version 1"),
    "other model": (with_header(model="0" * 16), "people of another model of the face"),
    "nobody": (with_header(names=[]), "names must be of one person or more"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_wrong_files_are_refused(saved, taught, change, message):
    with np.load(saved) as content:
        old = {name: content[name] for name in content.files}
    np.savez(saved, **change(old))
    with pytest.raises(InputError, match=f"two.npz: .*{message}"):
        read_people([saved], taught[0])
