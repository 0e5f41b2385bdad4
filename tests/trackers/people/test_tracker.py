"""The people tracker as a whole: walkers in the synthetic room, nobody at all, and cameras that deliver nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.synthetic.room import room_image
from jaxfilters.models.synthetic.walkers import Walker
from jaxfilters.trackers.people.demo_room import CLOTHES, SIZES_M, demo_room
from jaxfilters.trackers.people.state import DORMANT, FREE, TENTATIVE, TRACKED, CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import outlines, people_scene, start, step

SLOTS = 2
"""Three people come."""
FRAMES = 60
DT = np.float32(0.1)


@pytest.fixture(scope="module")
def room():
    return demo_room(0, frames=FRAMES)


@pytest.fixture(scope="module")
def scene(room):
    config = PeopleConfig(capacity=SLOTS, spread_px=0.0)
    return people_scene(room.cameras, room.floor, furniture=room.furniture, config=config)


@pytest.fixture(scope="module")
def frames(room):
    """Images with true silhouettes: the background is not what is tested."""
    found = []
    for i in range(FRAMES):
        leaves = [*(leaf[i] for leaf in room.routes), *np.transpose(SIZES_M)]
        people = Walker(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))
        clothes = jnp.asarray(CLOTHES, jnp.float32)
        image, who = room_image(jax.random.key(i), room.rooms[0], people, clothes, room.present(i))
        mask = (255 * (np.asarray(who) >= 0)).astype(np.uint8)
        found.append((CameraFrame(mask, np.asarray(image), np.bool_(True)),))
    return found


@pytest.fixture(scope="module")
def followed(scene, frames):
    """States and reports of all frames."""
    people, history = start(scene), []
    for frame in frames:
        people, report = step(scene, people, frame, DT)
        history.append((people, jax.tree.map(np.asarray, report)))
    return history


@pytest.mark.system
def test_who_walks_in_is_found_confirmed_and_followed(room, followed):
    """The first walker is on the floor from frame 8 on; somebody tall in mid-stride is seen 0.1 m too short."""
    first = followed[25][1]
    who = first.identity[np.argmin(np.linalg.norm(first.xy - room.routes.xy[25, 0], axis=-1))]
    errors = []
    for i in range(25, FRAMES):
        people, report = followed[i]
        (slot,) = np.flatnonzero((report.mode == TRACKED) & (report.identity == who))
        errors.append(np.linalg.norm(report.xy[slot] - room.routes.xy[i, 0]))
    assert max(errors) < 0.5
    assert np.mean(errors) < 0.4
    assert report.height[slot] == pytest.approx(SIZES_M[0][0], abs=0.15)
    variances = np.linalg.eigvalsh(people.belief.covariance[slot, :2, :2])
    assert 0 < np.sqrt(variances[0]) < report.sd_radial[slot] < 0.5


@pytest.mark.system
def test_a_full_house_follows_those_it_has(room, followed):
    """Three are in view at the end, and two slots."""
    assert room.present(FRAMES - 1).sum() > SLOTS
    report = followed[-1][1]
    assert np.all(report.mode == TRACKED)
    assert len(set(report.identity.tolist())) == SLOTS
    off = np.linalg.norm(report.xy[:, None] - room.routes.xy[-1], axis=-1)
    assert np.all(off.min(axis=1) < 0.5)
    assert len(set(off.argmin(axis=1))) == SLOTS


@pytest.mark.system
def test_what_is_said_is_finite_and_covariances_are_positive(followed):
    for people, report in followed:
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((people, report)))
        assert np.linalg.eigvalsh(people.belief.covariance).min() > 0


@pytest.mark.system
def test_nobody_stays_nobody(scene, frames):
    frame = (frames[0][0]._replace(foreground=np.zeros_like(frames[0][0].foreground)),)
    people, report = step(scene, start(scene), frame, DT)
    assert np.all(report.mode == FREE)
    assert np.all(report.identity == -1)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((people, report)))


@pytest.mark.system
@pytest.mark.parametrize("dt", [0.1, 2.0])
def test_without_a_camera_people_go_on_as_they_went_and_are_less_certain(scene, frames, followed, dt):
    """What the image of an absent camera holds does not matter."""
    people, _ = followed[-1]
    absent = (frames[-1][0]._replace(present=np.bool_(False)),)
    after, report = step(scene, people, absent, np.float32(dt))
    moved = people.belief.mean[:, :2] + dt * people.belief.mean[:, 2:4]
    np.testing.assert_allclose(after.belief.mean[:, :2], moved, rtol=1e-6)
    np.testing.assert_allclose(after.unseen_s - people.unseen_s, dt, rtol=1e-6)
    assert np.all(np.diagonal(after.belief.covariance, axis1=1, axis2=2)[:, :2] > 0)
    assert np.all(after.belief.covariance[:, 0, 0] > people.belief.covariance[:, 0, 0])
    np.testing.assert_array_equal(after.identity, people.identity)
    np.testing.assert_array_equal(after.log_odds, people.log_odds)
    black = (absent[0]._replace(foreground=np.zeros_like(absent[0].foreground)),)
    same, _ = step(scene, people, black, np.float32(dt))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(same), strict=True))
    assert np.isfinite(report.nis).all()


@pytest.mark.system
def test_whoever_is_unseen_for_long_is_no_longer_followed(scene, frames, followed):
    people, absent = followed[-1][0], (frames[-1][0]._replace(present=np.bool_(False)),)
    for _ in range(4):
        people, report = step(scene, people, absent, np.float32(1.0))
    assert not np.any(report.mode == TRACKED)


@pytest.mark.system
@pytest.mark.parametrize(("gap_s", "modes"), [(2.5, (TRACKED, TRACKED)), (3.5, (TENTATIVE, DORMANT))])
def test_people_who_stand_are_lost_by_a_gap_that_is_longer_than_hidden_people_are_believed_in(
    scene, frames, followed, gap_s, modes
):
    """The image at the end shows them at their places, and a third person, who gets the place of one who was lost."""
    people = followed[-1][0]
    standing = Gaussian(people.belief.mean.at[:, 2:4].set(0.0), people.belief.covariance)
    _, report = step(scene, people._replace(belief=standing), frames[-1], np.float32(gap_s))
    assert sorted(report.mode.tolist()) == sorted(modes)


@pytest.mark.system
def test_after_an_hour_without_images_everybody_is_somebody_else(scene, frames, followed):
    """Nobody is taken for a person of before the hour, though the image shows both at the same places."""
    people, report = followed[-1]
    before = set(report.identity.tolist())
    people, report = step(scene, people, frames[-1], np.float32(3600.0))
    assert not np.any(report.mode == TRACKED)
    assert np.all(report.identity == -1)
    for _ in range(12):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((people, report)))
        people, report = step(scene, people, frames[-1], DT)
    assert np.all(report.mode == TRACKED)
    assert min(report.identity) > max(before)


@pytest.mark.system
@pytest.mark.parametrize("dt", [0.0, -1.0, 1e6])
def test_time_that_stands_still_or_jumps_harms_nothing(scene, frames, followed, dt):
    people, report = step(scene, followed[-1][0], frames[-1], np.float32(dt))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((people, report)))
    assert np.linalg.eigvalsh(people.belief.covariance).min() > 0
    if dt <= 0:
        assert np.all(report.mode == TRACKED)


@pytest.mark.system
def test_outlines_surround_the_silhouettes(scene, frames, followed):
    """The middle of each lies within the foreground of the last frame."""
    (observed,) = outlines(scene, followed[-1][0])
    u, v = np.asarray(observed.center).round().astype(int).T
    assert np.all(frames[-1][0].foreground[v, u] == 255)


SQUARE = ((-1.0, 0.0), (1.0, 0.0), (1.0, 2.0), (-1.0, 2.0))


@pytest.mark.system
@pytest.mark.parametrize(
    ("floor", "message"),
    [
        (((0, 0), (1, 1)), r"floor must be a polygon of at least 3 finite corners \(n, 2\); got shape \(2, 2\)"),
        (((0, 0, 0), (1, 1, 0), (1, 0, 0)), r"got shape \(3, 3\)"),
        (((0, 0), (1, np.nan), (1, 0)), "floor must be a polygon of at least 3 finite corners"),
        (((0, 0), (1, 1), (2, 2)), "floor: its corners enclose no area"),
        (((0, -60), (1, -60), (0, -50)), "floor: no camera sees half of a person"),
    ],
)
def test_wrong_floors_are_named(camera, floor, message):
    with pytest.raises(ValueError, match=message):
        people_scene([camera], floor)


def test_wrong_cameras_and_furniture_are_named(camera):
    with pytest.raises(ValueError, match="cameras: at least one is needed"):
        people_scene([], SQUARE)
    with pytest.raises(
        ValueError, match=r"furniture must be one depth image a camera, \[\(120, 160\)\]; got \[\(9, 9\)"
    ):
        people_scene([camera], SQUARE, furniture=[np.full((9, 9), np.inf)])
    with pytest.raises(ValueError, match="furniture must be one depth image a camera"):
        people_scene([camera], SQUARE, furniture=[np.full(camera.shape, np.inf)] * 2)
