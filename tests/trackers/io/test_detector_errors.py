"""Errors of detectors on disk: what is written is read, what is wrong is refused, and what comes with the package."""

import json

import numpy as np
import pytest

from jaxfilters.models.face.landmarks import MIRROR
from jaxfilters.trackers.io.detector_errors import (
    DetectorErrors,
    default_detector_errors,
    load_detector_errors,
    save_detector_errors,
)
from jaxfilters.trackers.io.errors import InputError, OutputError


@pytest.fixture
def saved(tmp_path):
    root = np.random.default_rng(0).normal(0, 1, (30, 30))
    errors = DetectorErrors(np.ones((10, 3)), root @ root.T, np.full(10, 0.5), np.eye(6)[:, :3])
    save_detector_errors(tmp_path / "new" / "errors.npz", {"own": errors}, {"people": 3})
    return tmp_path / "new" / "errors.npz", errors


def test_what_is_written_is_read(saved):
    path, errors = saved
    (name, read), *others = load_detector_errors(path).items()
    assert name == "own"
    assert not others
    for value, expected in zip(read, errors, strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-12)
    with pytest.raises(OutputError, match="cannot write"):
        save_detector_errors(path / "below.npz", {"own": errors}, {})


def changed(**arrays):
    return lambda old: old | {name: np.asarray(array) for name, array in arrays.items()}


def with_header(**entries):
    return lambda old: old | {"header": np.asarray(json.dumps(json.loads(str(old["header"])) | entries))}


WRONG = {
    "no mean": (lambda old: {k: v for k, v in old.items() if k != "own_mean"}, r"own_mean must be .*; got none"),
    "sizes": (changed(own_white=np.ones(9)), r"own_white must be finite numbers \(10,\)"),
    "nan": (changed(own_mean=np.full((10, 3), np.nan)), "own_mean must be finite"),
    "asymmetric": (changed(own_covariance=np.triu(np.ones((30, 30)))), "own_covariance must be symmetric"),
    "negative": (changed(own_covariance=-np.eye(30)), "own_covariance must be symmetric and positive"),
    "noiseless": (changed(own_white=np.zeros(10)), "own_white must be positive"),
    "flat mesh": (changed(own_vertices=np.ones((6, 2))), r"own_vertices must be finite numbers \(6, 3\)"),
    "small mesh": (changed(own_vertices=np.ones((3, 3))), r"own_vertices must be finite numbers \(4, 3\)"),
    "no mesh": (changed(own_vertices=np.float64(1)), r"own_vertices must be finite numbers \(4, 3\)"),
    "nobody": (with_header(detectors=[]), "detectors must be one name or more"),
    "foreign": (with_header(format="a face"), 'header must say format "jaxfilters detector errors"'),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_wrong_files_are_refused(saved, change, message):
    path, _ = saved
    with np.load(path) as content:
        old = {name: content[name] for name in content.files}
    np.savez(path, **change(old))
    with pytest.raises(InputError, match=f"errors.npz: .*{message}"):
        load_detector_errors(path)


def test_those_of_the_package_are_alike_on_both_sides():
    errors = default_detector_errors()
    assert set(errors) == {"cascades", "mediapipe"}
    for one in errors.values():
        np.testing.assert_allclose(one.mean[list(MIRROR)] * (-1, 1, 1), one.mean, atol=1e-6)
        assert np.all(np.linalg.eigvalsh(one.covariance) > -1e-6)
        assert np.abs(one.mean).max() < 6  # millimetres: a nostril is not an eye
