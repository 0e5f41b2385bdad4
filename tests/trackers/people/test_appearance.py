"""Clothes: histograms of drawn people against counts by hand, and how unlike two of them are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.trackers.people.appearance import BINS, STEPS, appearances, dissimilarity
from jaxfilters.trackers.people.state import APPEARANCE, CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene

pytestmark = pytest.mark.system

PLACES = ((-0.8, 1.5, 1.75, 0.45), (0.9, 0.5, 1.70, 0.45))
SHIRTS, TROUSERS = ((250, 10, 10), (10, 250, 10)), ((10, 10, 250), (90, 90, 90))


def random_appearances(seed, n):
    counts = np.random.default_rng(seed).gamma(0.3, size=(n, 2, BINS))
    return jnp.asarray((counts / counts.sum(axis=-1, keepdims=True)).reshape(n, APPEARANCE), jnp.float32)


def test_dissimilarity_is_the_mean_hellinger_distance():
    a, b = random_appearances(0, 50), random_appearances(1, 50)
    found = np.asarray(dissimilarity(a, b))
    p, q = (np.asarray(x, np.float64).reshape(50, 2, BINS) for x in (a, b))
    expected = np.sqrt(0.5 * ((np.sqrt(p) - np.sqrt(q)) ** 2).sum(axis=-1)).mean(axis=-1)
    np.testing.assert_allclose(found, expected, atol=1e-3)
    np.testing.assert_allclose(dissimilarity(b, a), found, atol=1e-6)
    assert np.all((found > 0) & (found < 1))


def test_dissimilarity_is_zero_for_the_same_and_one_for_what_has_nothing_in_common():
    a = random_appearances(2, 20)
    np.testing.assert_allclose(dissimilarity(a, a), 0, atol=2e-3)
    low, high = (jnp.tile(jax.nn.one_hot(i, BINS), 2) for i in (0, 7))
    np.testing.assert_allclose(dissimilarity(low, high), 1, atol=1e-6)


def test_dissimilarity_compares_all_pairs():
    a, b = random_appearances(3, 4), random_appearances(4, 3)
    table = dissimilarity(a[:, None], b[None])
    assert table.shape == (4, 3)
    np.testing.assert_allclose(table[2, 1], dissimilarity(a[2], b[1]), atol=1e-6)


@pytest.fixture(scope="module")
def found(camera, draw, floor):
    """Histograms of two people in two cameras that show the same; the first may be absent."""
    scene = people_scene([camera, camera], floor, config=PeopleConfig(capacity=3))
    mask, who = draw(camera, PLACES)
    image = np.full((*mask.shape, 3), 128, np.uint8)
    rows = np.arange(mask.shape[0])[:, None]
    for number, (shirt, trousers) in enumerate(zip(SHIRTS, TROUSERS, strict=True)):
        _, v = np.mean(np.nonzero(who == number)[::-1], axis=1)
        image[(who == number) & (rows < v)] = shirt
        image[(who == number) & (rows >= v)] = trousers
    look = jax.jit(appearances)
    places = jnp.array([PLACES[0], (0.0, 0.0, 1.7, 0.4), PLACES[1]])

    def run(active=(True, False, True), present=(True, True), places=places, observed=mask):
        frames = tuple(CameraFrame(observed, image, np.bool_(here)) for here in present)
        histograms, good = look(scene, places, jnp.array(active), frames)
        return np.asarray(histograms).reshape(-1, 2, STEPS, STEPS, STEPS), np.asarray(good)

    return run, mask


def histogram_of(color):
    """(4, 4, 4) of one colour: each of its values is divided linearly between the two nearest of four steps."""
    middles = (np.arange(STEPS) + 0.5) / STEPS
    shares = [
        [np.interp(np.sqrt(value / 256), middles, np.eye(STEPS)[step]) for step in range(STEPS)] for value in color
    ]
    return np.einsum("i,j,k->ijk", *shares)


def test_shirts_and_trousers_are_told_apart(found):
    """Nearly all of either half has one colour: at the waist the drawn line and the middle of the outline differ."""
    histograms, good = found[0]()
    assert good.tolist() == [True, False, True]
    for slot, number in ((0, 0), (2, 1)):
        for half, colors in enumerate((SHIRTS[number], TROUSERS[number])):
            common = np.minimum(histograms[slot, half], histogram_of(colors)).sum()
            assert common > 0.8
    np.testing.assert_allclose(histograms.sum(axis=(-3, -2, -1)), 1, atol=1e-4)


def test_another_camera_does_where_the_first_delivers_nothing(found):
    run, _ = found
    np.testing.assert_allclose(run(present=(False, True))[0], run()[0], atol=1e-6)
    histograms, good = run(present=(False, False))
    assert not good.any()
    np.testing.assert_allclose(histograms, 1 / BINS)


def test_nothing_is_said_of_whoever_is_hidden_or_no_foreground(found):
    """The first stands right behind the second; then nobody is foreground."""
    run, mask = found
    behind = jnp.array([(0.9, 0.9, 1.6, 0.4), (0.0, 0.0, 1.7, 0.4), PLACES[1]])
    assert run(places=behind)[1].tolist() == [False, False, True]
    assert run(places=behind, active=(True, False, False))[1].tolist() == [True, False, False]
    assert not run(observed=np.zeros_like(mask))[1].any()
