"""The paper's tracker: against its literal loops in numpy, and what the specification says of its behaviour."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.ellipsoid import ellipse_mask, outline, standing
from jaxfilters.models.person.score import match_score, ternary_mask
from jaxfilters.trackers.published import people
from jaxfilters.trackers.published.people import (
    ACQUIRE,
    LOST,
    OUTSIDE,
    TRACK,
    candidate_positions,
    paper_start,
    paper_step,
    score_profile,
    with_person,
)
from jaxfilters.trackers.published.people_scene import (
    PER_PIXEL,
    STEP_HALVING,
    PaperConfig,
    around_candidates,
    box_in_view,
    endpoints_in_view,
    paper_scene,
    people_outside,
)

SHAPE = (120, 160)
CENTER = np.array([-1, -1.74, 2.64])
FLOOR = [[-4, -1.6], [2, -1.6], [2, 5], [-4, 5]]
POINTS = [(x, y) for x in (0, -1, -2) for y in (0, 1, 2)]
WALL = np.array([[[-3.0, 0.5, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.8]]])


def camera_1():
    pitch = np.deg2rad(37)
    R = np.array([[1, 0, 0], [0, -np.sin(pitch), -np.cos(pitch)], [0, np.cos(pitch), -np.sin(pitch)]])
    K = np.array([[139.0, 0, 79.5], [0, 139, 59.5], [0, 0, 1]])
    return FloorCamera.from_matrix(K @ np.column_stack([R, -R @ CENTER]), SHAPE)


@jax.jit
def drawn(camera, xy, height, width):
    return ellipse_mask(outline(camera.P, standing(xy, height, width)), SHAPE)


def silhouette(xy, height=1.65, width=0.40):
    return drawn(camera_1(), jnp.asarray(xy, float), jnp.asarray(height), jnp.asarray(width))


def union(*places):
    return jnp.any(jnp.stack([silhouette(xy) for xy in places]), axis=0)


def scene_of(**options):
    patches = options.pop("patches", None)
    floor = options.pop("floor", FLOOR)
    return paper_scene(camera_1(), floor, patches=patches, config=PaperConfig(**{"capacity": 3, **options}))


def state_of(scene, *places, mode=None):
    state = paper_start(scene.config)
    for xy in places:
        state = with_person(state, xy)
    return state if mode is None else state._replace(mode=jnp.full_like(state.mode, mode))


@pytest.fixture(scope="module")
def scene():
    return scene_of()


def literal_frame(places, mode, mask, steps=(0.05,) * 3):
    """One frame as section 2.8 to 2.10 reads, for people in one mode; places are moved."""
    kernel = np.ones((11, 11), np.uint8)

    def ternary(image):
        return image.astype(float) - ((cv2.dilate(image.astype(np.uint8), kernel) > 0) & ~image)

    def score(k, xy):
        mine = np.asarray(silhouette(xy))
        if mode == ACQUIRE:
            return (mine & mask).sum() / mine.sum()
        others = [np.asarray(silhouette(place)) for i, place in enumerate(places) if i != k]
        sim = ternary(np.any([mine, *others], axis=0))
        return (sim * ternary(mask)).sum() / np.abs(sim).sum()

    for step in steps:
        for k, (x, y) in enumerate(places):
            offsets = sorted(((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)), key=lambda o: o[0] ** 2 + o[1] ** 2)
            # e1 is +Y, e2 is +X for this camera.
            candidates = [np.float32([x + step * j, y + step * i]) for i, j in offsets]
            scores = [score(k, xy) for xy in candidates]
            best = int(np.argmax(np.round(scores, 6)))
            places[k] = tuple(candidates[best])
    return places


@pytest.mark.system
@pytest.mark.parametrize("mode", [ACQUIRE, TRACK])
def test_a_frame_is_that_of_the_literal_loops(scene, mode):
    rng = np.random.default_rng(mode)
    mask = np.asarray(union((-1.4, 1.3), (-0.7, 1.9))) & (rng.random(SHAPE) > 0.1)
    starts = [(-1.3, 1.2), (-0.75, 2.05)]
    after, _ = paper_step(scene, state_of(scene, *starts, mode=mode), jnp.asarray(mask))
    np.testing.assert_allclose(after.xy[:2], literal_frame(list(starts), mode, mask), atol=1e-4)


def test_candidates_are_a_lattice_that_begins_where_somebody_is():
    axes = jnp.array([[0.6, 0.8], [0.8, -0.6]])
    found = np.asarray(candidate_positions(jnp.array([1.0, 2.0]), axes, jnp.array(0.05)))
    moves = (found - [1, 2]) @ np.asarray(axes).T / 0.05
    np.testing.assert_allclose(moves[0], 0, atol=1e-5)
    np.testing.assert_allclose(np.sort(np.abs(moves[1:5]).sum(axis=1)), 1, atol=1e-5)
    np.testing.assert_allclose(np.abs(moves[5:]), 1, atol=1e-5)
    assert len(np.unique(moves.round(), axis=0)) == 9


def test_of_equal_candidates_the_nearest_is_taken(scene):
    state = state_of(scene, (-1.0, 1.0))
    after, report = paper_step(scene, state, jnp.ones(SHAPE, bool))
    np.testing.assert_array_equal(after.xy[0], state.xy[0])
    assert report.score[0] == 1
    assert after.mode[0] == TRACK


def run(scene, state, mask, frames=8):
    for _ in range(frames):
        state, report = paper_step(scene, state, mask)
    return state, report


@pytest.mark.system
@pytest.mark.parametrize(("steps_m", "most"), [((0.05,) * 3, 0.06), (STEP_HALVING, 0.03)])
def test_people_who_are_ellipsoids_are_found(steps_m, most):
    """Oracle 13: on average within 0.06 m, with step halving (prototype .019) within 0.03 m."""
    scene, rng = scene_of(steps_m=steps_m), np.random.default_rng(0)
    errors = []
    for point in POINTS:
        state = state_of(scene, np.add(point, rng.uniform(-0.15, 0.15, 2)))
        state, _ = run(scene, state, silhouette(point))
        errors.append(np.linalg.norm(np.asarray(state.xy[0]) - point))
    assert np.mean(errors) <= most


@pytest.mark.system
def test_the_score_never_decreases_within_a_frame(scene):
    rng = np.random.default_rng(1)
    score = jax.jit(lambda sim, real: match_score(ternary_mask(sim), ternary_mask(real)))
    for point in POINTS:
        start = np.add(point, rng.uniform(-0.15, 0.15, 2))
        state, report = paper_step(scene, state_of(scene, start, mode=TRACK), silhouette(point))
        before = score(silhouette(start), silhouette(point))
        assert report.score[0] >= before - 1e-6
        np.testing.assert_allclose(report.score[0], score(silhouette(state.xy[0]), silhouette(point)), rtol=1e-5)


@pytest.mark.system
@pytest.mark.parametrize("region", [None, around_candidates])
def test_the_order_of_people_who_are_apart_means_nothing(region):
    """Oracle 14."""
    scene = scene_of(**({"region": region} if region else {}))
    truth, starts = [(-2.4, 1.5), (-1.0, 1.0), (0.3, 1.6)], [(-2.3, 1.6), (-1.1, 0.9), (0.35, 1.5)]
    mask = union(*truth)
    first, _ = run(scene, state_of(scene, *starts, mode=TRACK), mask)
    second, _ = run(scene, state_of(scene, *starts[::-1], mode=TRACK), mask)
    np.testing.assert_allclose(first.xy, second.xy[::-1], atol=1e-5)


@pytest.mark.system
def test_either_nesting_of_the_loops_follows_two_people():
    truth, starts = [(-1.3, 1.2), (-0.8, 1.7)], [(-1.2, 1.3), (-0.7, 1.65)]
    for turns in (PaperConfig().turns, people_outside):
        scene = scene_of(turns=turns)
        state, _ = run(scene, state_of(scene, *starts), union(*truth))
        assert np.linalg.norm(np.asarray(state.xy[:2]) - truth, axis=1).max() <= 0.1


@pytest.mark.system
def test_somebody_is_acquired_tracked_and_lost(scene):
    state, mask = state_of(scene, (-1.5, 1.4)), silhouette((-1.1, 1.0))
    assert state.mode[0] == ACQUIRE
    state, report = run(scene, state, mask, 4)
    assert (int(state.mode[0]), int(state.low_frames[0])) == (TRACK, 0)
    empty = jnp.zeros(SHAPE, bool)
    state, _ = run(scene, state, empty, 9)
    assert (int(state.mode[0]), int(state.low_frames[0])) == (TRACK, 9)
    resumed, _ = run(scene, state, mask, 1)
    assert int(resumed.low_frames[0]) == 0
    state, _ = run(scene, state, empty, 1)
    assert int(state.mode[0]) == LOST
    after, report = run(scene, state, mask, 1)
    assert int(after.mode[0]) == LOST
    np.testing.assert_array_equal(after.xy, state.xy)
    assert np.all(np.isneginf(report.score))


def test_acquisition_looks_at_one_person_alone(scene):
    """Another person's wrong place changes nothing, and a larger blob does not keep the ellipse away."""
    mask = union((-1.1, 1.0), (-0.8, 1.0))
    alone, first = paper_step(scene, state_of(scene, (-1.2, 1.1)), mask)
    together, second = paper_step(scene, state_of(scene, (-1.2, 1.1), (0.5, 3.0)), mask)
    np.testing.assert_array_equal(alone.xy[0], together.xy[0])
    assert first.score[0] == second.score[0] > 0.9


def test_who_leaves_the_image_is_outside_until_seen_again(scene):
    state, _ = paper_step(scene, state_of(scene, (-1.0, 4.9), mode=TRACK), silhouette((-1.0, 1.0)))
    assert int(state.mode[0]) == TRACK
    away = state._replace(xy=state.xy.at[0].set(jnp.array([30.0, 3.0])))
    outside, _ = paper_step(scene, away, silhouette((-1.0, 1.0)))
    assert int(outside.mode[0]) == OUTSIDE
    back = outside._replace(xy=outside.xy.at[0].set(jnp.array([-1.05, 1.05])))
    found, _ = paper_step(scene, back, silhouette((-1.0, 1.0)))
    assert int(found.mode[0]) == TRACK


@pytest.mark.system
def test_a_close_person_of_whom_only_the_middle_shows_is_seen_by_the_box_alone():
    camera = camera_1()
    near, far = (standing(jnp.array([-1.0, y]), jnp.array(2.6), jnp.array(0.4)) for y in (-0.95, 1.0))
    assert (bool(endpoints_in_view(camera, near)), bool(box_in_view(camera, near))) == (False, True)
    assert bool(endpoints_in_view(camera, far))
    assert bool(box_in_view(camera, far))
    behind = standing(jnp.array([-1.0, -8.0]), jnp.array(1.65), jnp.array(0.4))
    assert not endpoints_in_view(camera, behind)
    assert not box_in_view(camera, behind)


def test_endpoints_are_those_of_the_specification():
    """Section 3: heads at (., 2) are in, at (., 3) out; feet at (., 0) in, at (., -0.5) out."""
    camera = camera_1()
    top, foot = camera.project(jnp.array([[[-1.0, 2, 1.65], [-1, 3, 1.65]], [[-1, 0, 0], [-1, -0.5, 0]]]))[0][..., 1]
    np.testing.assert_allclose(top, [2.9, -5.9], atol=0.1)
    np.testing.assert_allclose(foot, [109, 132.9], atol=0.1)


@pytest.mark.system
def test_obstacles_hide_people_by_distance_on_the_floor_or_by_depth():
    """A wall 0.8 m high hides the legs of whoever is behind it; both measures agree for upright things."""
    floor, pixel = scene_of(patches=WALL), scene_of(patches=WALL, occlusion=PER_PIXEL)
    behind, before = (-1.0, 1.2), (-1.0, 0.0)
    for scene in (floor, pixel):
        hidden = np.asarray(silhouette(behind) & ~np.isfinite(scene.obstacles))
        assert 0 < hidden.sum() < np.asarray(silhouette(behind)).sum()
        state, report = run(scene, state_of(scene, (-1.05, 1.25), mode=TRACK), jnp.asarray(hidden))
        assert np.linalg.norm(np.asarray(state.xy[0]) - behind) <= 0.08
        state, report = run(scene, state_of(scene, (-1.05, 0.05), mode=TRACK), silhouette(before))
        assert report.score[0] > 0.8
    # The floor distance of the wall's pixels is at most its own; the depth image is another measure.
    assert np.isfinite(floor.obstacles).sum() == np.isfinite(pixel.obstacles).sum() > 1000
    assert float(jnp.nanmax(jnp.where(jnp.isfinite(floor.obstacles), floor.obstacles, jnp.nan))) < 3.2


def test_nobody_leaves_the_floor_and_who_is_off_it_is_stuck():
    scene = scene_of(floor=[[-4, -1], [2, -1], [2, 1.0], [-4, 1.0]])
    state, report = run(scene, state_of(scene, (-1.0, 0.93)), silhouette((-1.0, 1.4)))
    assert 0.9 <= float(state.xy[0, 1]) < 1.0
    assert not report.is_stuck[0]
    state, report = run(scene, state_of(scene, (-1.0, 1.4)), silhouette((-1.0, 1.4)), 1)
    np.testing.assert_allclose(state.xy[0], [-1.0, 1.4], atol=1e-6)
    assert bool(report.is_stuck[0])
    assert np.isneginf(report.score[0])


def test_nobody_at_all_is_no_trouble(scene):
    state, report = paper_step(scene, paper_start(scene.config), jnp.ones(SHAPE, bool))
    assert not np.any(state.active)
    assert np.all(np.isneginf(report.score))


@pytest.mark.system
def test_any_number_of_people_is_one_compilation():
    scene = scene_of(capacity=4)
    before = paper_step._cache_size()
    for count in range(5):
        state = state_of(scene, *[(-2.0 + 0.5 * i, 1.0) for i in range(count)])
        for _ in range(2):
            state, _ = paper_step(scene, state, jnp.ones(SHAPE, bool))
    assert paper_step._cache_size() - before == 1


@pytest.mark.system
def test_the_profile_says_in_which_direction_the_place_is_known(scene):
    whole, lower, upper = (-1.0, 1.0), (-1.0, 3.0), (-1.0, -0.5)
    profiles = {
        place: jax.tree.map(
            lambda leaf: np.asarray(leaf[0]), score_profile(scene, state_of(scene, place), silhouette(place))
        )
        for place in (whole, lower, upper)
    }
    # Section 4, E2: 0.21, 0.10 and 0.37 for bodies; these are ellipsoids.
    assert profiles[upper].flatness > profiles[whole].flatness > profiles[lower].flatness > 0.1
    for profile in profiles.values():
        radial, lateral = profile.covariance[1, 1], profile.covariance[0, 0]
        assert 0 < lateral < radial
        np.testing.assert_allclose(profile.covariance, profile.covariance.T, rtol=1e-6)
    finer = score_profile(scene, state_of(scene, whole), silhouette(whole), looks=160.0)
    np.testing.assert_allclose(finer.covariance[0], profiles[whole].covariance / 4, rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"capacity": 0}, "capacity must be a positive integer; got 0"),
        ({"lost_frames": 0}, "lost_frames must be a positive integer; got 0"),
        ({"ring_px": -1}, "ring_px must be 0 or more pixels; got -1"),
        ({"steps_m": ()}, "steps_m must be one or more positive"),
        ({"steps_m": (0.05, 0.0)}, "steps_m must be one or more positive"),
        ({"acquired": 1.5}, "lost and acquired must be scores"),
        ({"lost": 0.8}, "lost and acquired must be scores"),
    ],
)
def test_bad_constants_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        PaperConfig(**options)


def test_bad_scenes_people_and_masks_are_named(scene):
    with pytest.raises(ValueError, match=r"floor must be a polygon.*got shape \(2, 2\)"):
        paper_scene(camera_1(), [[0, 0], [1, 1]])
    with pytest.raises(ValueError, match=r"patches must be finite.*got \(3, 3\)"):
        paper_scene(camera_1(), FLOOR, patches=WALL[0])
    state = paper_start(scene.config)
    for xy in ((np.nan, 0.0), (1.0, 2.0, 3.0)):
        with pytest.raises(ValueError, match="xy must be two finite numbers"):
            with_person(state, xy)
    with pytest.raises(ValueError, match=r"height_m and width_m must be positive; got 0\.0"):
        with_person(state, (0, 0), height_m=0.0)
    with pytest.raises(ValueError, match="all 3 slots are taken"):
        state_of(scene, *[(0, 1)] * 4)
    for act in (paper_step, score_profile):
        with pytest.raises(ValueError, match=r"mask must have the shape of the camera's image, \(120, 160\)"):
            act(scene, state, jnp.zeros((160, 120), bool))
    with pytest.raises(ValueError, match="mask must be of bool; got uint8"):
        people._check_mask(scene, jnp.zeros((120, 160), jnp.uint8))
