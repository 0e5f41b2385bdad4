"""Who is there: confirmed by evidence, lost without it, remembered for a while, known again by clothes and place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.person.foreground import Quadratic
from jaxfilters.trackers.people import lifecycle
from jaxfilters.trackers.people.appearance import BINS, dissimilarity
from jaxfilters.trackers.people.fit import Fit
from jaxfilters.trackers.people.lifecycle import Birth, stride
from jaxfilters.trackers.people.state import (
    DETECTABILITIES,
    DORMANT,
    FREE,
    TENTATIVE,
    TRACKED,
    CameraFrame,
    PeopleConfig,
    nobody,
)
from jaxfilters.trackers.people.tracker import people_scene, step

SLOTS = 4
CONFIG = PeopleConfig(capacity=SLOTS, cell_m=2.0)
RED, BLUE = (jnp.tile(jax.nn.one_hot(i, BINS), 2) for i in (3, 48))
judge, name, confirm = (jax.jit(one) for one in (lifecycle.existence, lifecycle.named, lifecycle.confirm))


@pytest.fixture(scope="module")
def scene(camera, floor):
    return people_scene([camera], floor, config=CONFIG)


def people_of(*modes, **fields):
    """Slots of some modes at known places on the floor, 0.5 m apart."""
    people = nobody(CONFIG)
    mode = jnp.array([*modes, *[FREE] * (SLOTS - len(modes))], jnp.int32)
    mean = jnp.zeros_like(people.belief.mean).at[:, 0].set(0.5 * jnp.arange(SLOTS)).at[:, 4].set(1.7)
    people = people._replace(belief=Gaussian(mean, 0.01 * people.belief.covariance), mode=mode)
    return people._replace(**{key: jnp.asarray(value) for key, value in fields.items()})


def fit_of(score=1.0, share_seen=1.0, surplus=np.inf, share_in_view=1.0, superfluous=range(SLOTS)):
    full = lambda value: jnp.broadcast_to(jnp.asarray(value, float), (SLOTS,))
    blank = Quadratic(full(0)[:, None], jnp.zeros((SLOTS, 1, 4)), jnp.zeros((SLOTS, 1, 4, 4)))
    axes = jnp.zeros((SLOTS, 4, 4))
    return Fit(
        jnp.zeros((SLOTS, 4)),
        jnp.zeros((SLOTS, 2)),
        axes,
        jnp.full((SLOTS, 4), 0.1),
        blank,
        full(score),
        jnp.zeros((SLOTS, 1, 2)),
        full(share_seen)[:, None],
        full(0),
        jnp.asarray(superfluous, jnp.int32),
        full(surplus),
        full(share_in_view)[:, None],
        full(0)[:, None],
        full(1),
        jnp.zeros((SLOTS, len(DETECTABILITIES))),
    )


def evaluated(scene, people, fit, *, dt=0.1, looked=True, frames=1):
    for _ in range(frames):
        people = judge(scene, people, fit, jnp.asarray(dt), jnp.asarray(looked))
    return people


@pytest.mark.system
def test_evidence_confirms_somebody(scene):
    """Four units of log odds, at most one a frame however good the score."""
    people = people_of(TENTATIVE)
    assert evaluated(scene, people, fit_of(3.0), frames=4).mode[0] == TENTATIVE
    assert evaluated(scene, people, fit_of(3.0), frames=5).mode[0] == TRACKED
    assert evaluated(scene, people, fit_of(0.1), frames=30).mode[0] == TENTATIVE


def test_what_is_nobody_is_given_up_and_somebody_is_remembered(scene):
    people = people_of(TENTATIVE, TRACKED, log_odds=[0.0, 0.0, 0.0, 0.0])
    after = evaluated(scene, people, fit_of(-1.5))
    assert after.mode.tolist() == [FREE, DORMANT, FREE, FREE]
    long_known = people_of(TENTATIVE, TRACKED, log_odds=[0.0, 8.0, 0.0, 0.0])
    assert evaluated(scene, long_known, fit_of(-1.5)).mode[1] == TRACKED


def test_somebody_hidden_is_believed_in_for_a_while_then_remembered_then_forgotten(scene):
    """Seconds: 3 hidden, 5 more remembered."""
    people, hidden = people_of(TRACKED, log_odds=[8.0, 0, 0, 0]), fit_of(0.0, share_seen=0.05)
    assert evaluated(scene, people, hidden, frames=29).mode[0] == TRACKED
    assert evaluated(scene, people, hidden, frames=31).mode[0] == DORMANT
    assert evaluated(scene, people, hidden, frames=79).mode[0] == DORMANT
    assert evaluated(scene, people, hidden, frames=81).mode[0] == FREE


@pytest.mark.parametrize(
    ("gap_s", "modes"),
    [(2.9, [TRACKED, TENTATIVE]), (3.1, [DORMANT, FREE]), (7.9, [DORMANT, FREE]), (8.1, [FREE, FREE])],
)
def test_nobody_is_followed_across_a_gap_though_an_image_shows_somebody_at_its_end(scene, gap_s, modes):
    """Seconds as for people who are hidden: 3, and 5 more remembered."""
    people, dt = people_of(TRACKED, TENTATIVE, log_odds=[8.0, 2.0, 0, 0]), jnp.asarray(gap_s)
    after = judge(scene, lifecycle.after_gap(CONFIG, people, dt), fit_of(1.0), dt, jnp.asarray(True))
    assert after.mode[:2].tolist() == modes
    np.testing.assert_allclose(after.unseen_s[0], 0.0 if modes[0] == TRACKED else gap_s, rtol=1e-6)


@pytest.mark.system
@pytest.mark.parametrize("neighbour", [False, True], ids=["alone", "beside somebody"])
def test_whoever_shows_a_little_over_a_wall_is_followed_for_as_long_as_it_shows(camera, draw, floor, neighbour):
    """A sixth of the pixels of a silhouette shows, for twice as long as hidden people are believed to be there."""
    places = [(0.0, 1.0, 1.7, 0.45), (0.8, 1.0, 1.7, 0.45)][: 1 + neighbour]
    mask, _ = draw(camera, places)
    shown = np.cumsum((mask > 0).sum(axis=1)) / (mask > 0).sum()
    over = np.arange(len(mask)) < np.searchsorted(shown, 1 / 6)
    wall = np.where(over, np.inf, 0.5)[:, None] * np.ones(mask.shape[1])
    scene = people_scene([camera], floor, furniture=[wall], config=CONFIG)
    modes = [TRACKED] * len(places)
    people = people_of(*modes, log_odds=[8.0, 8.0, 0, 0], identity=[7, 3, -1, -1], next_identity=8)
    of_places = jnp.ix_(jnp.arange(len(places)), jnp.array([0, 1, 4, 5]))
    mean = people.belief.mean.at[of_places].set(jnp.array(places))
    people = people._replace(belief=Gaussian(mean, people.belief.covariance))
    shows = np.where(over[:, None], mask, 0).astype(np.uint8)
    frame = CameraFrame(shows, np.zeros((*mask.shape, 3), np.uint8), np.bool_(True))
    for _ in range(60):
        people, report = step(scene, people, (frame,), np.float32(0.1))
    assert report.mode.tolist() == [*modes, *[FREE] * (SLOTS - len(modes))]
    assert report.identity[0] == 7
    assert np.linalg.norm(report.xy[0] - np.array([0.0, 1.0])) < 0.5


def test_without_an_image_nothing_is_learnt_but_time_passes(scene):
    people = people_of(TENTATIVE, TRACKED, log_odds=[2.0, 5.0, 0, 0])
    after = evaluated(scene, people, fit_of(-2.0), looked=False)
    assert after.log_odds.tolist() == [2, 5, 0, 0]
    assert after.mode.tolist()[:2] == [TENTATIVE, TRACKED]
    np.testing.assert_allclose(after.unseen_s[:2], 0.1, rtol=1e-6)


def test_whom_another_explains_as_well_is_given_up(scene):
    people = people_of(TRACKED, TRACKED, TENTATIVE, log_odds=[8.0, 8.0, 1.0, 0])
    fit = fit_of(1.0, surplus=[np.inf, 0.2, 0.2, np.inf])
    after = evaluated(scene, people, fit)
    np.testing.assert_allclose(after.log_odds[:3], [8.0, 7.7, 0.7], rtol=1e-5)


def test_a_candidate_takes_the_evidence_of_a_senior_at_a_wrong_place(scene):
    """The third explains 1.3 a pixel more than the first from where it is; then it is tracked, and costs time only."""
    people = people_of(TRACKED, TRACKED, TENTATIVE, log_odds=[8.0, 8.0, 1.0, 0])
    fit = fit_of([0.1, 1.0, 1.5, 0.0], surplus=[np.inf, np.inf, 0.2, np.inf], superfluous=[0, 1, 0, 3])
    np.testing.assert_allclose(evaluated(scene, people, fit).log_odds[:3], [8.0 - 1.3, 8.0, 2.0], rtol=1e-5)
    people = people._replace(mode=people.mode.at[2].set(TRACKED))
    np.testing.assert_allclose(evaluated(scene, people, fit).log_odds[:3], [8.0 - 0.3, 8.0, 2.0], rtol=1e-5)
    enough = fit._replace(surplus=fit.surplus.at[2].set(0.6))
    np.testing.assert_allclose(evaluated(scene, people, enough).log_odds[:3], [8.0, 8.0, 2.0], rtol=1e-5)


def test_what_furniture_hides_does_not_speak_for_nobody(scene):
    """Of a fifth of a silhouette: a fifth of the least surplus, and of the cost beyond that of hiding."""
    people = people_of(TRACKED, TRACKED, TENTATIVE, log_odds=[8.0, 7.0, 1.0, 0])

    def after(surplus, share_in_view):
        fit = fit_of(0.1, surplus=[np.inf, surplus, surplus, np.inf], share_in_view=share_in_view)
        return evaluated(scene, people, fit).log_odds[1:3].tolist()

    # Who is tentative must show all the same.
    np.testing.assert_allclose(after(0.02, 0.2), [7.0 - 0.1 * (0.5 + 0.2 * 2.5), 1.0 - 0.48], atol=1e-5)
    np.testing.assert_allclose(after(0.12, 0.2), [7.1, 1.0 - 0.38], atol=1e-5)
    np.testing.assert_allclose(after(0.12, 1.0), [7.0 - 0.1 * 3.0, 1.0 - 0.38], atol=1e-5)


def test_nobody_is_followed_off_the_floor_or_without_a_place(scene):
    off = people_of(TRACKED, TRACKED, log_odds=[8.0, 8.0, 0, 0])
    off = off._replace(belief=Gaussian(off.belief.mean.at[0, 1].set(9.0), off.belief.covariance.at[1, 0, 0].set(2.0)))
    assert evaluated(scene, off, fit_of(1.0)).mode.tolist()[:2] == [DORMANT, DORMANT]


@pytest.mark.system
@pytest.mark.parametrize(("sd_m", "mode"), [(0.1, DORMANT), (0.2, TRACKED)])
def test_the_border_of_the_floor_is_crossed_by_two_standard_deviations(scene, sd_m, mode):
    """The floor ends at Y = 4; a place 0.3 m beyond is off it only where it is known well."""
    people = people_of(TRACKED, log_odds=[8.0, 0, 0, 0])
    mean = people.belief.mean.at[0, 1].set(4.3)
    people = people._replace(belief=Gaussian(mean, people.belief.covariance.at[0, 1, 1].set(sd_m**2)))
    assert evaluated(scene, people, fit_of(1.0)).mode[0] == mode


def test_time_that_stands_still_changes_nothing_of_the_hidden(scene):
    people = people_of(TRACKED, log_odds=[8.0, 0, 0, 0])
    after = evaluated(scene, people, fit_of(0.0, share_seen=0.0), dt=0.0)
    assert after.log_odds[0] == 8
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))


def test_the_tracked_are_senior_by_identity_and_to_all_who_are_not():
    people = people_of(TRACKED, TENTATIVE, TRACKED, TENTATIVE, identity=[7, -1, 3, -1], log_odds=[1.0, 3.0, 0.0, 3.0])
    assert np.argsort(-np.asarray(lifecycle.seniority(people))).tolist() == [2, 0, 1, 3]


@pytest.mark.parametrize("first", [9_999, 10_500, 2**24, 2**31 - 3])
def test_seniority_does_not_end_with_many_identities(first):
    """Identities that a float32 does not distinguish, and one who is tentative with all the evidence there can be."""
    identity = [first + 1, -1, first, first + 2]
    people = people_of(TRACKED, TENTATIVE, TRACKED, TRACKED, identity=identity, log_odds=[0.0, 8.0, 0.0, 0.0])
    assert np.argsort(-np.asarray(lifecycle.seniority(people))).tolist() == [2, 0, 3, 1]


def test_new_identities_differ_and_are_never_used_again():
    people = name(people_of(TRACKED, TRACKED, TENTATIVE, next_identity=5))
    assert people.identity.tolist() == [5, 6, -1, -1]
    assert name(people._replace(mode=people.mode.at[2].set(TRACKED))).identity.tolist() == [5, 6, 7, -1]
    freed = name(people._replace(mode=people.mode.at[0].set(FREE)))
    assert freed.identity.tolist() == [-1, 6, -1, -1]


@pytest.mark.parametrize(
    ("clothes", "at", "unseen_s", "expected"),
    [(RED, 0.8, 0.0, 2), (RED, 3.0, 0.0, 9), (RED, 3.0, 2.0, 2), (BLUE, 0.8, 0.0, 9)],
    ids=["same clothes near by", "too far", "far after a while", "other clothes"],
)
def test_somebody_who_comes_back_is_known_by_clothes_and_place(clothes, at, unseen_s, expected):
    people = people_of(TRACKED, DORMANT, identity=[-1, 2, -1, -1], unseen_s=[0, unseen_s, 0, 0], next_identity=9)
    people = people._replace(
        appearance=people.appearance.at[0].set(clothes).at[1].set(RED),
        belief=Gaussian(people.belief.mean.at[0, 0].set(0.5 + at), people.belief.covariance),
    )
    after = name(people)
    back = expected == 2
    assert after.identity[0] == expected
    assert after.mode[1] == (FREE if back else DORMANT)
    assert after.identity[1] == (-1 if back else 2)
    assert after.next_identity == (9 if back else 10)


def test_two_who_come_at_once_are_not_the_same_old_one():
    people = people_of(TRACKED, DORMANT, TRACKED, identity=[-1, 2, -1, -1], next_identity=9)
    people = people._replace(appearance=jnp.tile(RED, (SLOTS, 1)))
    assert name(people).identity.tolist() == [2, -1, 9, -1]


def test_of_two_who_left_in_the_same_clothes_neither_comes_back():
    unseen_s = [0, 3, 3, 0]
    people = people_of(TRACKED, DORMANT, DORMANT, identity=[-1, 2, 3, -1], unseen_s=unseen_s, next_identity=9)
    alike = people._replace(appearance=jnp.tile(RED, (SLOTS, 1)))
    assert name(alike).identity.tolist() == [9, 2, 3, -1]
    for share, identity in ((0.002, [9, 2, 3, -1]), (0.01, [2, -1, 3, -1])):
        clothes = (1 - share) * RED + share * BLUE
        unlike = float(dissimilarity(RED, clothes))
        assert 0.02 < unlike < lifecycle.LIKENESS
        assert (unlike < lifecycle.LIKENESS_MARGIN) == (identity[0] == 9)
        assert name(alike._replace(appearance=alike.appearance.at[2].set(clothes))).identity.tolist() == identity


@pytest.mark.system
def test_clothes_are_the_mean_of_the_first_ten_frames_and_then_followed_slowly():
    people, good = people_of(TRACKED, TRACKED), jnp.array([True, False, False, False])
    first = lifecycle.with_appearances(people, jnp.tile(RED, (SLOTS, 1)), good)
    np.testing.assert_array_equal(first.appearance[0], RED)
    np.testing.assert_array_equal(first.appearance[1], people.appearance[1])
    later = first
    for _ in range(9):
        later = lifecycle.with_appearances(later, jnp.tile(BLUE, (SLOTS, 1)), good)
    np.testing.assert_allclose(later.appearance[0], 0.1 * RED + 0.9 * BLUE, atol=1e-6)
    assert later.appearance_frames.tolist() == [10, 0, 0, 0]
    eleventh = lifecycle.with_appearances(later, jnp.tile(RED, (SLOTS, 1)), good)
    np.testing.assert_allclose(eleventh.appearance[0], 0.19 * RED + 0.81 * BLUE, atol=1e-6)
    open_ = first.meetings._replace(is_open=first.meetings.is_open.at[0, 1].set(True).at[1, 0].set(True))
    during = lifecycle.with_appearances(first._replace(meetings=open_), jnp.tile(BLUE, (SLOTS, 1)), good)
    np.testing.assert_array_equal(during.appearance[0], RED)
    assert during.appearance_frames[0] == 1


def test_a_newcomer_gets_the_first_free_slot_and_nothing_of_who_had_it(scene):
    people = people_of(TRACKED, FREE, TRACKED, FREE, identity=[4, -1, 5, -1], log_odds=[8.0, 3.0, 8.0, 0.0])
    people = people._replace(appearance=jnp.tile(RED, (SLOTS, 1)), appearance_frames=jnp.full(SLOTS, 20))
    found = Birth(jnp.array([1.5, 2.5]), jnp.array(True))
    after = confirm(scene, people, found)
    assert after.mode.tolist() == [TRACKED, TENTATIVE, TRACKED, FREE]
    np.testing.assert_allclose(after.belief.mean[1], [1.5, 2.5, 0, 0, CONFIG.height_m, CONFIG.width_m, 0, 0, 0])
    assert after.log_odds.tolist() == [8, 0, 8, 0]
    np.testing.assert_allclose(after.appearance[1], 1 / BINS)
    assert after.appearance_frames.tolist() == [20, 0, 20, 20]
    np.testing.assert_array_equal(after.belief.mean[2], people.belief.mean[2])
    unchanged = confirm(scene, people, found._replace(found=jnp.array(False)))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(unchanged), jax.tree.leaves(people), strict=True))


def test_where_everybody_is_followed_nobody_is_added(scene):
    full = people_of(TRACKED, TENTATIVE, TRACKED, TRACKED)
    after = confirm(scene, full, Birth(jnp.array([1.5, 2.5]), jnp.array(True)))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(full), strict=True))


def test_without_a_free_slot_whoever_left_first_is_forgotten(scene):
    full = people_of(DORMANT, DORMANT, TRACKED, TENTATIVE, identity=[4, 5, 6, -1])
    full = full._replace(unseen_s=jnp.array([3.0, 4.0, 9.0, 0.0]))
    after = confirm(scene, full, Birth(jnp.array([1.5, 2.5]), jnp.array(True)))
    assert after.mode.tolist() == [DORMANT, TENTATIVE, TRACKED, TENTATIVE]
    assert after.identity.tolist() == [4, -1, 6, -1]
    assert after.unseen_s.tolist() == [3, 0, 9, 0]


@pytest.mark.system
def test_a_newcomer_is_as_uncertain_as_edges_of_the_reduced_image(low_camera, monkeypatch):
    """By rows of feet and head that are off by so many pixels, differentiated numerically, and the grid of cells."""
    config = PeopleConfig(capacity=SLOTS, cell_m=2.0, silhouette_bias_m=1e-3)
    far = people_scene([low_camera], [(-4, -10), (4, -10), (4, 10), (-4, 10)], config=config)

    def rows(y, height):
        return np.array([float(low_camera.project(jnp.array([0.0, y, z]))[0][1]) for z in (0.0, height)])

    slopes = [(rows(d[0], 1.72 + d[1]) - rows(-d[0], 1.72 - d[1])) / 1.0 for d in np.diag([0.5, 0.5])]
    information = slopes @ np.transpose(slopes) / stride(low_camera.shape) ** 2 + np.diag([0.0, 0.08**-2])
    variance = np.linalg.inv(information)[0, 0] + lifecycle.BIRTH_SD_M**2
    found = np.asarray(lifecycle.birth_covariance(far, jnp.zeros(2)))
    np.testing.assert_allclose(found[1, 1], variance, rtol=0.1)
    assert found[0, 0] < 0.11
    born = confirm(far, nobody(config), Birth(jnp.zeros(2), jnp.bool_(True)))
    np.testing.assert_allclose(born.belief.covariance[0, :2, :2], found, rtol=1e-5)
    # Where that is more than a place may be uncertain elsewhere, a newcomer is kept, and lost when vaguer than it.
    monkeypatch.setattr(lifecycle, "LOST_SD_M", 0.5 * np.sqrt(variance))
    vague = born._replace(belief=Gaussian(born.belief.mean, 5.0 * born.belief.covariance))
    modes = [lifecycle.existence(far, of, fit_of(), jnp.asarray(0.1), jnp.bool_(True)).mode[0] for of in (born, vague)]
    assert modes == [TENTATIVE, FREE]
