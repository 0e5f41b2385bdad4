"""How much of a person is detected: against the likelihood pixel by pixel, and in silhouettes with holes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.person import foreground
from jaxfilters.trackers.people import detectability, lifecycle
from jaxfilters.trackers.people.detectability import LEAST_FOR_EXISTENCE, evidence_of, most_probable, predicted
from jaxfilters.trackers.people.fit import fit_people
from jaxfilters.trackers.people.lifecycle import MOST_LOG_ODDS
from jaxfilters.trackers.people.silhouettes import contrasts_of, presence_of, unexplained_of, views_of
from jaxfilters.trackers.people.state import (
    DETECTABILITIES,
    DETECTABILITY_PRIOR,
    STATE,
    TENTATIVE,
    TRACKED,
    CameraFrame,
    PeopleConfig,
    nobody,
)
from jaxfilters.trackers.people.stride import with_stride
from jaxfilters.trackers.people.tracker import people_scene, step

AT, SIZE = (0.2, 1.0), (1.70, 0.45)
OFF_M = (0.1, 0.12)
HOLE_PX = 4
SLOTS = 2
CONFIG = PeopleConfig(capacity=SLOTS, spread_px=0.0)
TRACKED_ONE = jnp.ones(1, bool)
FRAME_S = 0.1


@pytest.fixture(scope="module")
def scene(camera, floor):
    return people_scene([camera], floor, config=CONFIG)


@pytest.fixture(scope="module")
def whole(camera, draw):
    return draw(camera, [(*AT, *SIZE)])[0]


def frame_of(mask):
    return CameraFrame(mask, np.zeros((*mask.shape, 3), np.uint8), np.bool_(True))


def with_holes(mask, share, seed):
    """A share of the blocks of a mask missing at random."""
    rows, cols = mask.shape
    blocks = np.random.default_rng(seed).random((-(-rows // HOLE_PX), -(-cols // HOLE_PX))) < share
    return mask * ~np.kron(blocks, np.ones((HOLE_PX, HOLE_PX), bool))[:rows, :cols]


def evidence(scene, mask, stride=(0.0, 0.0)):
    """Of a person who stands alone where drawn, and the window that it was compared in."""
    place = jnp.array([*AT, *SIZE])
    views = views_of(scene, (frame_of(mask),), place, jnp.eye(4), jnp.array([0.3, 0.2]))
    unexplained = unexplained_of(scene, jnp.zeros((SLOTS, 6)), jnp.zeros(SLOTS, bool), views)
    shape = with_stride(place).at[4:].set(jnp.array(stride))
    return evidence_of(scene, shape, views, unexplained, contrasts_of(views, unexplained)), views


def test_without_images_all_of_a_person_is_expected_again():
    """After three seconds a difference of 500 nats is 1 / e of it; after a minute the prior is what remains."""
    before = jnp.array([[-500.0, 0, -300, -300, -300, -300]])
    prior = np.array(DETECTABILITY_PRIOR)
    soon = np.asarray(predicted(before, jnp.array(3.0), TRACKED_ONE))[0] - (1 - np.exp(-1)) * prior
    np.testing.assert_allclose(soon, np.asarray(before[0]) / np.e, rtol=1e-5, atol=1e-4)
    later = predicted(before, jnp.array(60.0), TRACKED_ONE)
    np.testing.assert_allclose(later[0], prior, atol=1e-5)
    assert float(most_probable(later)[0]) == 1.0 > float(most_probable(before)[0])


def test_who_is_not_tracked_yet_is_expected_whole_whatever_the_image_shows():
    newcomer, seldom = jnp.zeros(1, bool), jnp.array([[0.0, 10, 20, 30, 40, 50]])
    before = predicted(seldom, jnp.array(FRAME_S), newcomer)
    assert float(most_probable(before + seldom)[0]) == 1.0
    np.testing.assert_array_equal(detectability.updated(before, seldom, newcomer)[0], DETECTABILITY_PRIOR)


@pytest.mark.parametrize("stride", [(0.0, 0.0), (0.2, 0.05)])
def test_the_evidence_is_the_likelihood_of_all_pixels(scene, camera, whole, stride):
    """Each pixel is foreground by clutter or by the body, and observed with a bounded error: the product in NumPy."""
    found, views = evidence(scene, with_holes(whole, 0.5, 0), stride)
    q = np.asarray(presence_of(CONFIG, camera.P, jnp.array([*AT, *SIZE, *stride]), views.window.uv[0]))
    p = np.clip(np.asarray(views.foreground[0]), foreground.LEAST, foreground.MOST)
    log_likelihoods = []
    for a in (0.0, *DETECTABILITIES):
        makes = 1 - (1 - foreground.CLUTTER) * (1 - a * q)
        log_likelihoods.append(np.sum(np.log(p * makes + (1 - p) * (1 - makes)) * np.asarray(views.visible[0])))
    scale = CONFIG.independent_patches * float(views.window.area[0] / views.area[0])
    expected = scale * (np.array(log_likelihoods[1:]) - log_likelihoods[0])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=0.01)


@pytest.mark.parametrize(("missing", "least", "most"), [(0.0, 1.0, 1.0), (0.5, 0.4, 0.7), (0.75, 0.25, 0.4)])
def test_the_share_that_is_missing_is_found(scene, whole, missing, least, most):
    """In five images of some 30 blocks each: the share that is drawn has a standard deviation of .04."""
    found = sum(evidence(scene, with_holes(whole, missing, seed))[0] for seed in range(5))
    assert least - 1e-6 < float(most_probable(found + jnp.array(DETECTABILITY_PRIOR))) < most + 1e-6


def frames_until_given_up(scene, first, then, *, fps, values):
    """After ten seconds of images with the first evidence, how many with the second it takes; None beyond 100."""
    log_weights, dt, log_odds = jnp.array([DETECTABILITY_PRIOR]), jnp.array(1 / fps), MOST_LOG_ODDS
    for _ in range(int(10 * fps)):
        log_weights = detectability.updated(predicted(log_weights, dt, TRACKED_ONE), first[None], TRACKED_ONE)
    for frame in range(100):
        log_weights = predicted(log_weights, dt, TRACKED_ONE)
        value = max(float(most_probable(log_weights + then)[0]), LEAST_FOR_EXISTENCE) if values else 1.0
        score = float(then[int(np.argmin(np.abs(np.array(DETECTABILITIES) - value)))]) / CONFIG.independent_patches
        log_odds = min(log_odds + np.clip(score, -2.0, 1.0), MOST_LOG_ODDS)
        if log_odds < CONFIG.dropped:
            return frame + 1
        log_weights = detectability.updated(log_weights, then[None], TRACKED_ONE)
    return None


@pytest.mark.parametrize("fps", [7.0, 25.0])
def test_who_leaves_is_given_up_all_the_same(scene, whole, fps):
    """At most a frame later than where all of everybody is expected, and where a sixth of the body is left as well."""
    (there, _), (gone, _) = evidence(scene, whole), evidence(scene, np.zeros_like(whole))
    sixth = with_holes(whole, 0.84, 4)
    assert 0.1 < np.sum(sixth > 0) / np.sum(whole > 0) < 0.2
    before = frames_until_given_up(scene, there, gone, fps=fps, values=False)
    assert before <= frames_until_given_up(scene, there, gone, fps=fps, values=True) <= before + 1
    assert frames_until_given_up(scene, there, evidence(scene, sixth)[0], fps=fps, values=True) is not None


def believed(places, off=OFF_M):
    mean = np.zeros((SLOTS, STATE), np.float32)
    mean[: len(places), :6] = [[x + off[0], y + off[1], 0, 0, *SIZE] for x, y in places]
    sd = np.array([0.2, 0.2, 0.5, 0.5, 0.03, 0.03, 0.1, 0.1, 0.1], np.float32)
    return Gaussian(jnp.asarray(mean), jnp.broadcast_to(jnp.diag(sd**2), (SLOTS, STATE, STATE)))


@pytest.fixture(scope="module")
def search(scene):
    """The search from places that are off, in an image, with log weights of detectabilities."""
    run = jax.jit(fit_people)

    def found(mask, places, log_weights=DETECTABILITY_PRIOR):
        active, seniority = jnp.arange(SLOTS) < len(places), -jnp.arange(SLOTS, dtype=float)
        known = jnp.tile(jnp.array(log_weights), (SLOTS, 1))
        return run(scene, believed(places), jnp.zeros((SLOTS, 1, 2)), known, active, seniority, (frame_of(mask),))

    return found


@pytest.mark.system
def test_people_of_whom_a_third_is_detected_are_found(search, whole):
    """In the first image, and worse where all of everybody is expected, whatever the image shows."""
    off = lambda fit: float(jnp.linalg.norm(fit.place[0, :2] - jnp.array(AT)))
    images = [with_holes(whole, 0.67, seed) for seed in range(8)]
    fits = [search(image, [AT]) for image in images]
    certain = (0.0, *[-1e6] * (len(DETECTABILITIES) - 1))
    errors, without = [off(fit) for fit in fits], [off(search(image, [AT], certain)) for image in images]
    assert max(float(fit.detectability[0]) for fit in fits) < 0.6
    assert np.mean(errors) < 0.18
    assert np.mean(without) > 1.5 * np.mean(errors)


@pytest.mark.system
@pytest.mark.parametrize("known", [DETECTABILITY_PRIOR, (-900.0, -700.0, -500.0, -300.0, 0.0, -300.0)])
def test_two_tracks_on_one_person_say_nothing_of_what_is_detected(search, whole, known):
    """Nor does the one in front hide less of the other where little of it is detected."""
    two, one = search(whole, [AT, (AT[0], AT[1] + 0.4)], known), search(whole, [AT], known)
    np.testing.assert_array_equal(two.detection_evidence, 0.0)
    np.testing.assert_allclose(two.detectability, most_probable(jnp.array(known)))
    assert float(jnp.min(two.share_seen)) < 0.45
    assert float(one.detection_evidence[0, 0]) > float(one.detection_evidence[0, 1]) > 0


@pytest.mark.system
def test_a_step_keeps_what_is_known_of_the_tracked_and_starts_anew_with_others(scene, whole):
    """A tracked person of whom half is detected; and a candidate in the same place, for whom nothing may change."""
    image = frame_of(with_holes(whole, 0.5, 0))
    people = nobody(CONFIG)
    people = people._replace(belief=believed([AT], off=(0.0, 0.0)), log_odds=people.log_odds.at[0].set(0.5))
    for mode, changes in ((TRACKED, True), (TENTATIVE, False)):
        now = people._replace(mode=people.mode.at[0].set(mode))
        for _ in range(3):
            now, _ = step(scene, now, (image,), np.float32(FRAME_S))
        assert (float(most_probable(now.detectability)[0]) < 0.8) == changes
        np.testing.assert_allclose(now.detectability[1], DETECTABILITY_PRIOR, atol=1e-6)
    born = lifecycle.confirm(scene, now._replace(mode=now.mode.at[0].set(0)), lifecycle.Birth(jnp.array(AT), True))
    np.testing.assert_allclose(born.detectability[0], DETECTABILITY_PRIOR)


@pytest.mark.system
def test_where_nobody_is_the_score_says_so_of_whom_little_was_detected_as_well(search, whole):
    """Under .25 a pixel of an empty silhouette loses some .2 nats on average, under .55 half a nat."""
    little = tuple(0.0 if value == 0.25 else -1e6 for value in DETECTABILITIES)
    fit = search(np.zeros_like(whole), [AT], little)
    assert float(fit.detectability[0]) == 0.25
    assert float(fit.score[0]) < -0.35
