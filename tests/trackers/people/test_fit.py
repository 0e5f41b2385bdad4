"""The joint search: people in drawn silhouettes, and readings from parabolas against the Gaussians they are of."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.person.foreground import Quadratic
from jaxfilters.trackers.people.fit import MOST_SHIFT_M, Fit, _nearest_first, as_measurement, fit_people
from jaxfilters.trackers.people.state import DETECTABILITY_PRIOR, HEIGHT, STATE, CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import MOST_CROWDING, people_scene, updated

pytestmark = pytest.mark.system

PLACES = ((-0.9, 2.2, 1.75, 0.45), (0.2, 1.0, 1.70, 0.45), (0.45, 0.3, 1.65, 0.42))
"""The second and the third overlap in the image."""
OFF_M = np.array([(0.12, -0.10), (-0.10, 0.15), (0.08, 0.14)])
SLOTS = 5


def parabolas(seed, n):
    """Fits whose log likelihoods are exactly those of Gaussian readings of the place: with their means, precisions."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 4, 4))
    precision = 400 * (root @ np.swapaxes(root, 1, 2) + 2 * np.eye(4))
    place, turned = rng.normal(size=(n, 4)), rng.uniform(0, 6, n)
    axes = np.tile(np.eye(4), (n, 1, 1))
    axes[:, 0, :2] = np.stack([np.cos(turned), np.sin(turned)], axis=-1)
    axes[:, 1, :2] = np.stack([np.sin(turned), -np.cos(turned)], axis=-1)
    mean = place + rng.normal(size=(n, 4)) * 0.01
    gradient = np.einsum("nai,nij,nj->na", axes, precision, mean - place)
    curvature = np.einsum("nai,nij,nbj->nab", axes, precision, axes)
    none = jnp.zeros(n)
    quadratic = Quadratic(none[:, None], jnp.asarray(gradient)[:, None], jnp.asarray(curvature)[:, None])
    steps = jnp.broadcast_to(jnp.array([0.12, 0.06, 0.06, 0.05]), (len(place), 4))
    place, axes, shift = jnp.asarray(place), jnp.asarray(axes), jnp.zeros((n, 1, 2))
    share, slots = none[:, None], jnp.arange(n)
    return (
        Fit(
            place, shift[:, 0], axes, steps, quadratic, none, shift, share, none, slots, none, share, share, none, share
        ),
        mean,
        precision,
    )


@pytest.mark.usefixtures("x64")
def test_readings_of_an_exact_parabola_are_its_gaussian():
    """Information H^T R^-1 H and information times mean, added up over the four readings."""
    fit, mean, precision = parabolas(0, 20)
    y, H, R, observed = (np.asarray(leaf)[:, 0] for leaf in as_measurement(fit, 0.0))
    assert observed.all()
    weighted = np.einsum("nri,nrs->nis", H, np.linalg.inv(R))
    np.testing.assert_allclose(
        np.einsum("nis,nsj->nij", weighted, H), precision, rtol=1e-9, atol=1e-9 * precision.max()
    )
    found = np.linalg.solve(precision, np.einsum("nis,ns->ni", weighted, y)[..., None])[..., 0]
    np.testing.assert_allclose(found, mean, atol=1e-10)


@pytest.mark.usefixtures("x64")
def test_shape_and_gait_add_to_every_reading():
    fit, *_ = parabolas(1, 5)
    plain, rough = (np.asarray(as_measurement(fit, sd)[2]) for sd in (0.0, 0.05))
    np.testing.assert_allclose(rough - plain, np.broadcast_to(0.05**2 * np.eye(4), plain.shape), atol=1e-15)


@pytest.mark.usefixtures("x64")
def test_a_vague_reading_counts():
    """A standard deviation of 1.4 m: what one silhouette tells of somebody far from a low camera."""
    fit, *_ = parabolas(2, 1)
    curvature = jnp.diag(jnp.array([0.5, 500.0, 300.0, 200.0]))[None, None]
    fit = fit._replace(quadratic=Quadratic(jnp.zeros((1, 1)), jnp.zeros((1, 1, 4)), curvature))
    *_, R, observed = (np.asarray(leaf)[0, 0] for leaf in as_measurement(fit, 0.0))
    assert observed.all()
    np.testing.assert_allclose(np.diag(R).max(), 2.0, rtol=1e-6)


@pytest.mark.usefixtures("x64")
def test_a_direction_without_curvature_says_nothing_and_a_slope_without_bottom_moves_nobody_far():
    fit, *_ = parabolas(2, 1)
    curvature = jnp.diag(jnp.array([0.0, 500.0, -20.0, 2.0]))[None, None]
    fit = fit._replace(quadratic=Quadratic(jnp.zeros((1, 1)), jnp.full((1, 1, 4), 1e6), curvature))
    y, H, R, observed = (np.asarray(leaf)[0, 0] for leaf in as_measurement(fit, 0.0))
    assert observed.sum() == 2
    assert np.isfinite(R).all()
    assert np.abs(y - H @ np.asarray(fit.place)[0]).max() <= 1.001 * MOST_SHIFT_M


@pytest.fixture(scope="module")
def found(camera, draw, floor):
    """Three people and two free slots, searched for from places that are off."""
    scene = people_scene([camera], floor, config=PeopleConfig(capacity=SLOTS, spread_px=0.0))
    mask, who = draw(camera, PLACES)
    frame = CameraFrame(mask, np.zeros((*mask.shape, 3), np.uint8), np.bool_(True))
    search = jax.jit(fit_people)

    def run(order, shown=frame):
        mean = np.zeros((SLOTS, STATE), np.float32)
        for slot, k in order.items():
            at = PLACES[k][:2] + OFF_M[k] if isinstance(k, int) else k
            mean[slot, :6] = [*at, 0, 0, 1.72, 0.45]
        sd = np.array([0.15, 0.15, 0.5, 0.5, 0.05, 0.05, 0.1, 0.1, 0.1], np.float32)
        belief = Gaussian(jnp.asarray(mean), jnp.broadcast_to(jnp.diag(sd**2), (SLOTS, STATE, STATE)))
        active = jnp.array([slot in order for slot in range(SLOTS)])
        no_shift, seniority = jnp.zeros((SLOTS, 1, 2)), -jnp.arange(SLOTS, dtype=float)
        prior = jnp.tile(jnp.array(DETECTABILITY_PRIOR), (SLOTS, 1))
        fit = search(scene, belief, no_shift, prior, active, seniority, (shown,))
        return jax.tree.map(np.asarray, fit)

    return run, frame, np.bincount(who[who >= 0], minlength=3)


def test_everybody_is_found_where_drawn_though_two_overlap(found):
    """A pixel at the farthest is 0.12 m in depth, 150 px * 3 m / (7.2 m)^2 to the metre, and 0.05 m sideways."""
    run, _, pixels = found
    assert pixels.min() > 150
    fit = run({0: 0, 1: 1, 2: 2})
    away = np.einsum("kai,ki->ka", fit.axes[:3, :2, :2], fit.place[:3, :2] - np.array(PLACES)[:, :2])
    assert np.all(np.abs(away) < (0.12, 0.05))
    off = np.linalg.norm(away, axis=-1)
    assert np.all(off < np.linalg.norm(OFF_M, axis=-1))
    assert fit.score[:3].min() > 0.5
    assert fit.flatness[:3].min() > 0
    assert fit.share_seen[0] > 0.9 > fit.share_seen[1]
    assert fit.share_in_view[:3].min() > 0.9


def test_heights_are_measured_of_whole_silhouettes_only(found, camera, floor):
    """Of 1.72 m as predicted and 1.75 m as drawn; who touches another person keeps the height, and is still placed."""
    run, *_ = found
    fit = jax.tree.map(jnp.asarray, run({0: 0}))
    scene = people_scene([camera], floor, config=PeopleConfig(capacity=SLOTS, spread_px=0.0))
    mean = jnp.zeros((SLOTS, STATE)).at[0, :6].set(jnp.array([*(PLACES[0][:2] + OFF_M[0]), 0, 0, 1.72, 0.45]))
    before = Gaussian(mean, jnp.broadcast_to(0.01 * jnp.eye(STATE), (SLOTS, STATE, STATE)))
    full = lambda value: jnp.full((SLOTS, 1), value)
    for share, crowding, is_measured in ((0.93, 0.2, False), (0.97, 0.2, True), (0.97, 0.4, False)):
        given = fit._replace(shares_seen=full(share), crowding=full(crowding))
        after, *_ = updated(scene, before, given, jnp.array(0.1))
        moved = np.abs(np.asarray(after.mean - mean))[0]
        assert (moved[HEIGHT] > 0.005) == is_measured
        assert np.linalg.norm(moved[:2]) > 0.02


def test_a_silhouette_is_crowded_by_a_person_who_is_not_tracked(found):
    """The third stands before the second and explains what is drawn there; the first is alone."""
    run, *_ = found
    assert run({0: 0}).crowding[0] < MOST_CROWDING
    assert run({1: 1}).crowding[1] > MOST_CROWDING
    assert run({1: 1, 2: 2}).crowding[1] < MOST_CROWDING


def test_slots_mean_nothing_to_the_search(found):
    run, *_ = found
    plain, moved = run({0: 0, 1: 1, 2: 2}), run({3: 0, 0: 1, 4: 2})
    for name in ("place", "score", "share_seen", "flatness"):
        a, b = (np.asarray(getattr(fit, name))[at] for fit, at in ((plain, [0, 1, 2]), (moved, [3, 0, 4])))
        np.testing.assert_allclose(a, b, atol=1e-4, err_msg=name)


def test_depth_is_seen_worse_than_the_side(found):
    """Axes are away from the camera and sideways; the camera looks 25 degrees down."""
    run, *_ = found
    curvature = run({0: 0}).quadratic.curvature[0, 0]
    assert curvature[0, 0] < curvature[1, 1]


def test_two_in_one_silhouette_are_one(found):
    """The junior of two people with one silhouette explains nothing that the senior would not."""
    run, *_ = found
    fit = run({0: 0, 1: 0})
    assert np.isinf(fit.surplus[0])
    assert fit.surplus[1] < 0.5
    assert np.isinf(run({0: 0, 1: 1}).surplus[0])


def test_two_in_line_with_the_camera_are_one_though_metres_apart(found, camera):
    """A junior two metres behind the only person; one who is as far to the side is nobody whom the senior explains."""
    run, *_ = found
    away = np.array(PLACES[0][:2]) - np.asarray(camera.position())[:2]
    away /= np.linalg.norm(away)
    behind, aside = PLACES[0][:2] + 2 * away, PLACES[0][:2] + 2 * away[::-1] * (-1, 1)
    junior, senior = run({0: 0, 1: behind}), run({0: behind, 1: 0})
    for fit, superfluous in ((junior, 1), (senior, 0)):
        assert fit.surplus[1] < 0.5
        assert fit.superfluous[1] == superfluous
    assert np.isinf(run({0: 0, 1: aside}).surplus[1])


def test_without_an_image_nothing_is_said(found):
    run, frame, _ = found
    fit = run({0: 0, 2: 1}, frame._replace(present=np.bool_(False)))
    assert not fit.score.any()
    assert not fit.share_seen.any()
    assert not fit.quadratic.curvature.any()
    expected = np.stack([np.array(PLACES[k][:2]) + OFF_M[k] for k in (0, 1)])
    np.testing.assert_allclose(fit.place[[0, 2], :2], expected, atol=1e-6)


def test_people_are_searched_for_from_the_camera_that_sees_them_outwards():
    """Two cameras, 10 m apart; the second sees nobody but the third person, and the last slot is free."""
    scene = SimpleNamespace(centers=lambda: jnp.array([(0.0, 0.0), (10.0, 0.0)]))
    places = jnp.array(
        [(4.0, 0, 1.7, 0.4), (9.0, 0, 1.7, 0.4), (7.5, 0, 1.7, 0.4), (5.0, 0, 1.7, 0.4), (0, 0, 1.7, 0.4)]
    )
    observed = jnp.array([(1, 0), (1, 0), (1, 1), (0, 0), (1, 1)], float)
    views = SimpleNamespace(visible=observed[..., None] * jnp.array([0.0, 1.0]))
    order = _nearest_first(scene, views, places, jnp.array([True, True, True, True, False]))
    assert order.tolist() == [2, 0, 1, 3, 4]


def test_the_score_is_compared_over_pixels_of_the_feet(low_camera, draw):
    """Along the line of sight, where a few centimetres of floor are less than the image tells apart."""
    floor = [(-4, -10), (4, -10), (4, 10), (-4, 10)]
    scene = people_scene([low_camera], floor, config=PeopleConfig(capacity=1, spread_px=0.0))
    mask, _ = draw(low_camera, [(0.0, 0.0, 1.72, 0.45)])
    mean = jnp.array([[0.0, -1.5, 0, 0, 1.72, 0.45, 0, 0, 0]])
    sd = jnp.array([1.0, 1.0, 0.5, 0.5, 0.08, 0.06, 0.1, 0.1, 0.1])
    frame = CameraFrame(mask, np.zeros((*mask.shape, 3), np.uint8), np.bool_(True))
    belief = Gaussian(mean, jnp.diag(sd**2)[None])
    nothing = jnp.zeros((1, 1, 2)), jnp.array([DETECTABILITY_PRIOR]), jnp.ones(1, bool), jnp.zeros(1)
    fit = jax.jit(fit_people)(scene, belief, *nothing, (frame,))
    x, y = fit.place[0, :2]
    feet, beyond = (low_camera.project(jnp.array([x, y + d, 0.0]))[0] for d in (0.0, fit.steps[0, 0]))
    assert 0.8 < np.linalg.norm(beyond - feet) < 1.3
    assert abs(y) < 0.6, "1.5 m too near at first, farther than people are searched for in a small room"
