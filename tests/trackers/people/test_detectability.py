"""How much of a person is detected: against the likelihood pixel by pixel, and in silhouettes with holes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.person import foreground
from jaxfilters.trackers.people import detectability
from jaxfilters.trackers.people.detectability import evidence_of, most_probable, predicted, prior_log_weights
from jaxfilters.trackers.people.fit import fit_people
from jaxfilters.trackers.people.lifecycle import MOST_LOG_ODDS
from jaxfilters.trackers.people.silhouettes import contrasts_of, presence_of, shape_of, unexplained_of, views_of
from jaxfilters.trackers.people.state import DETECTABILITIES, STATE, CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene

AT, SIZE = (0.2, 1.0), (1.70, 0.45)
OFF_M = (0.1, 0.12)
HOLE_PX = 4
CONFIG = PeopleConfig(capacity=2, spread_px=0.0)
SLOTS = 2


@pytest.fixture(scope="module")
def scene(camera, floor):
    return people_scene([camera], floor, config=CONFIG)


def frame_of(mask):
    return CameraFrame(mask, np.zeros((*mask.shape, 3), np.uint8), np.bool_(True))


def with_holes(mask, share, seed):
    """A share of the blocks of a mask missing at random."""
    rows, cols = mask.shape
    blocks = np.random.default_rng(seed).random((-(-rows // HOLE_PX), -(-cols // HOLE_PX))) < share
    return mask * ~np.kron(blocks, np.ones((HOLE_PX, HOLE_PX), bool))[:rows, :cols]


def evidence(scene, mask):
    """Of a person who stands alone where drawn, and the window that it was compared in."""
    place = jnp.array([*AT, *SIZE])
    views = views_of(scene, (frame_of(mask),), place, jnp.eye(4), jnp.array([0.3, 0.2]))
    unexplained = unexplained_of(scene, jnp.zeros((SLOTS, 7)), jnp.zeros(SLOTS, bool), views)
    return evidence_of(scene, shape_of(place, 1.0), views, contrasts_of(views, unexplained)), views


def test_without_an_image_all_of_a_person_is_expected():
    assert float(most_probable(prior_log_weights())) == 1.0
    far = predicted(jnp.array([[-500.0, 0, -300, -300, -300, -300]]), jnp.array(100.0))
    np.testing.assert_allclose(far[0], prior_log_weights(), atol=1e-6)


def test_the_evidence_is_the_likelihood_of_all_pixels(scene, camera, draw):
    """Each pixel is foreground by clutter or by the body, and observed with a bounded error: the product in NumPy."""
    mask, _ = draw(camera, [(*AT, *SIZE)])
    found, views = evidence(scene, with_holes(mask, 0.5, 0))
    q = np.asarray(presence_of(CONFIG, camera.P, jnp.array([*AT, *SIZE]), views.window.uv[0]))
    p = np.clip(np.asarray(views.foreground[0]), foreground.LEAST, foreground.MOST)
    log_likelihoods = []
    for a in DETECTABILITIES:
        makes = 1 - (1 - foreground.CLUTTER) * (1 - a * q)
        log_likelihoods.append(np.sum(np.log(p * makes + (1 - p) * (1 - makes)) * np.asarray(views.visible[0])))
    scale = CONFIG.independent_patches * float(views.window.area[0] / views.area[0])
    expected = scale * (np.array(log_likelihoods) - log_likelihoods[0])
    np.testing.assert_allclose(found - found[0], expected, rtol=1e-4, atol=0.01)


@pytest.mark.parametrize(("missing", "least", "most"), [(0.0, 1.0, 1.0), (0.5, 0.4, 0.7), (0.75, 0.25, 0.55)])
def test_the_share_that_is_missing_is_found(scene, camera, draw, missing, least, most):
    """Some 30 blocks of a body are drawn or not, so that the share of a silhouette has a standard deviation of .09."""
    mask, _ = draw(camera, [(*AT, *SIZE)])
    for seed in range(5):
        found, _ = evidence(scene, with_holes(mask, missing, seed))
        assert least - 1e-6 < float(most_probable(found + prior_log_weights())) < most + 1e-6


@pytest.mark.parametrize("fps", [7.0, 25.0])
def test_who_is_gone_is_given_up_all_the_same(scene, camera, draw, fps):
    """At most a frame later than where all of everybody is expected."""
    mask, _ = draw(camera, [(*AT, *SIZE)])
    (whole, _), (gone, _) = evidence(scene, mask), evidence(scene, np.zeros_like(mask))
    log_weights, dt = prior_log_weights()[None], jnp.array(1 / fps)
    for _ in range(int(10 * fps)):
        log_weights = detectability.updated(predicted(log_weights, dt), whole[None])
    lost_in_one = np.clip(gone[0] / CONFIG.independent_patches, -2.0, 1.0)
    frames, log_odds = 0, MOST_LOG_ODDS
    while log_odds > CONFIG.dropped:
        log_weights = predicted(log_weights, dt)
        score = gone[np.argmax(log_weights[0] + gone)] / CONFIG.independent_patches
        log_odds += np.clip(score, -2.0, 1.0)
        log_weights = detectability.updated(log_weights, gone[None])
        frames += 1
    assert frames <= np.ceil((CONFIG.dropped - MOST_LOG_ODDS) / lost_in_one) + 1


@pytest.fixture(scope="module")
def search(scene):
    """The search from a place that is off, with an image: places of both slots and how much is detected."""
    run = jax.jit(fit_people)

    def found(mask, places):
        mean = np.zeros((SLOTS, STATE), np.float32)
        mean[: len(places), :6] = [[x + OFF_M[0], y + OFF_M[1], 0, 0, *SIZE] for x, y in places]
        sd = np.array([0.2, 0.2, 0.5, 0.5, 0.03, 0.03, 0.1, 0.1, 0.1], np.float32)
        belief = Gaussian(jnp.asarray(mean), jnp.broadcast_to(jnp.diag(sd**2), (SLOTS, STATE, STATE)))
        prior = jnp.tile(prior_log_weights(), (SLOTS, 1))
        active, seniority = jnp.arange(SLOTS) < len(places), -jnp.arange(SLOTS, dtype=float)
        return run(scene, belief, jnp.zeros((SLOTS, 1, 2)), prior, active, seniority, (frame_of(mask),))

    return found


@pytest.mark.system
def test_people_of_whom_a_third_is_detected_are_found(search, camera, draw, monkeypatch):
    """In the first image, to .13 m on average, and .32 m where all of everybody is expected, which moves people."""
    mask, _ = draw(camera, [(*AT, *SIZE)])
    off = lambda fit: float(jnp.linalg.norm(fit.place[0, :2] - jnp.array(AT)))
    images = [with_holes(mask, 0.67, seed) for seed in range(8)]
    fits = [search(image, [AT]) for image in images]
    errors = [off(fit) for fit in fits]
    assert max(float(fit.detectability[0]) for fit in fits) < 0.6
    whole = lambda log_weights: jnp.ones(log_weights.shape[:-1])
    monkeypatch.setattr("jaxfilters.trackers.people.fit.most_probable", whole)
    jax.clear_caches()
    without = [off(search(image, [AT])) for image in images]
    assert np.mean(errors) < 0.18
    assert np.mean(without) > 1.5 * np.mean(errors)


@pytest.mark.system
def test_beside_others_nothing_is_said_of_it(search, camera, draw):
    """Of two tracks on one person, and of one alone."""
    mask, _ = draw(camera, [(*AT, *SIZE)])
    two, one = search(mask, [AT, AT]), search(mask, [AT])
    np.testing.assert_array_equal(two.detection_evidence, 0.0)
    assert float(one.detection_evidence[0, 0]) > float(one.detection_evidence[0, 1]) > 0
