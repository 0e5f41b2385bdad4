"""Pictures by the Agg backend: drawn to files, with the artists and the words that they promise."""

import sys

import numpy as np
import pytest

import jaxfilters as jf

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")
from matplotlib import pyplot  # noqa: E402

RNG = np.random.default_rng(0)
TRUTH = np.cumsum(RNG.normal(size=(30, 2)), axis=0)


@pytest.fixture
def saved(tmp_path):
    """Saves the picture of axes, and closes it."""

    def save(ax, name):
        path = tmp_path / f"{name}.png"
        ax.figure.savefig(path)
        pyplot.close(ax.figure)
        assert path.stat().st_size > 5000
        return [text.get_text() for text in ax.get_legend().get_texts()]

    return save


def test_a_track_has_an_ellipse_for_every_fifth_place(saved):
    covariances = np.broadcast_to(np.array([[0.5, 0.3], [0.3, 0.4]]), (30, 2, 2))
    noisy = TRUTH + RNG.normal(size=TRUTH.shape)
    ax = jf.plot.track(TRUTH + 0.2, covariances, truth=TRUTH, observations=noisy, every=5)
    assert len(ax.patches) == 6
    assert len(ax.lines) == 3
    # The outline of the first ellipse lies at two standard deviations.
    offsets = ax.patches[0].get_xy() - TRUTH[0] - 0.2
    lengths = np.einsum("ki,ij,kj->k", offsets, np.linalg.inv(covariances[0]), offsets)
    np.testing.assert_allclose(lengths, 4, rtol=1e-9)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x", "y")
    assert saved(ax, "track") == ["truth", "observations", "estimate", "2 standard deviations"]


def test_innovations_have_their_band_and_their_share(saved):
    std = np.linspace(2, 1, 50)
    e = std * RNG.normal(size=50)
    e[7] = 5.0
    ax = jf.plot.innovations(e, std, times=0.1 * np.arange(50))
    assert len(ax.collections) == 1
    assert np.mean(abs(e) <= 2 * std) == pytest.approx(float(ax.get_title().split()[0]) / 100, abs=0.006)
    assert "95 % expected" in ax.get_title()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time", "innovation")
    assert saved(ax, "innovations") == ["2 standard deviations", "innovation"]


def test_the_ancestry_joins_every_particle_with_its_ancestor(saved):
    x = RNG.normal(size=(6, 20)) + 0.5 * np.arange(6)[:, None]
    ancestors = np.sort(RNG.integers(0, 20, size=(6, 20)), axis=1)
    ax = jf.plot.ancestry(x, ancestors, RNG.normal(size=(6, 20)))
    dead, alive, points = ax.collections
    segments = len(dead.get_segments()) + len(alive.get_segments())
    assert segments == 100
    survivors = set(range(20))
    total = 20
    for row in ancestors[:0:-1]:
        survivors = {int(row[i]) for i in survivors}
        total += len(survivors)
    assert len(alive.get_segments()) == total - len(survivors)
    np.testing.assert_allclose(points.get_sizes().reshape(6, 20).sum(1), 200)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("step", "value")
    assert saved(ax, "ancestry") == ["died out", "ancestors of the last step", "weight"]


def test_a_calibration_curve_lies_in_its_band_or_not(saved):
    u = RNG.uniform(size=200)
    ax = jf.plot.calibration(u)
    curve = ax.lines[1].get_xydata()
    np.testing.assert_allclose(curve[1:-1, 0], np.sort(u))
    assert curve[-1].tolist() == [1.0, 1.0]
    assert ax.get_title().startswith("200 predictions, p = 0.")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("predicted probability", "observed share")
    assert saved(ax, "calibration") == ["95 % if calibrated", "observed"]


def test_pictures_are_drawn_into_given_axes():
    figure, ax = pyplot.subplots()
    assert jf.plot.calibration(np.array([0.1, 0.9]), ax=ax) is ax
    pyplot.close(figure)


def test_without_matplotlib_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(jf.plot, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"jaxfilters\[viz\]"):
        jf.plot.track(TRUTH)
    assert "jaxfilters.plot" in sys.modules


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: jf.plot.track(np.zeros((3, 3))), "means"),
        (lambda: jf.plot.track(TRUTH, np.zeros((2, 2))), "covariances"),
        (lambda: jf.plot.track(TRUTH, truth=TRUTH[:5]), "truth"),
        (lambda: jf.plot.track(TRUTH, sigmas=0.0), "sigmas"),
        (lambda: jf.plot.innovations(np.zeros(3), np.ones(4)), "std"),
        (lambda: jf.plot.ancestry(np.zeros((2, 3)), np.full((2, 3), 3), np.zeros((2, 3))), "ancestors"),
        (lambda: jf.plot.ancestry(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3))), "ancestors"),
        (lambda: jf.plot.calibration(np.array([0.5, 1.5])), "transforms"),
        (lambda: jf.plot.calibration(np.array([0.5]), probability=1.0), "probability"),
    ],
)
def test_bad_input_is_named(call, named):
    with pytest.raises(ValueError, match=named):
        call()
