"""What the tracker is given frame by frame, what is kept of it, and that it can be continued."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.trackers.background.median import MedianBackground
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people import session
from jaxfilters.trackers.people.demo_room import demo_room
from jaxfilters.trackers.people.detected import DetectedForeground
from jaxfilters.trackers.people.state import TENTATIVE, TRACKED, CameraFrame, PeopleConfig, Report
from jaxfilters.trackers.people.table import as_rows, from_rows
from jaxfilters.trackers.people.tracker import people_scene

NO_BOXES = DetectedForeground({}, Undistortion((120, 160)))


@pytest.fixture(scope="module")
def scene(camera, floor):
    return people_scene([camera], floor, config=PeopleConfig(capacity=2, cell_m=2.0))


def shown(number, *, present=True):
    """Frames that can be told from others."""
    return (CameraFrame(np.full((2, 2), number, np.uint8), np.zeros((2, 2, 3), np.uint8), np.bool_(present)),)


@pytest.fixture
def given(monkeypatch):
    """Steps taken: frames and seconds. Somebody is tentative at first and tracked, as number 4, from the third on."""
    steps = []

    def step(scene, people, frames, dt):
        assert scene.config.capacity == len(people.mode)
        steps.append((int(frames[0].foreground[0, 0]), float(dt)))
        tracked = len(steps) > 2
        people = people._replace(
            mode=people.mode.at[0].set(TRACKED if tracked else TENTATIVE),
            identity=people.identity.at[0].set(4 if tracked else -1),
            log_odds=people.log_odds + 1,
        )
        n, none = jnp.ones(len(people.mode)), jnp.zeros((len(people.mode), 2), jnp.int32)
        return people, Report(people.identity, people.mode, people.belief.mean[:, :2], n, n, n, n, n, n > 0, n, none)

    monkeypatch.setattr(session, "step", step)
    return steps


@pytest.mark.system
def test_frames_come_in_turn_with_the_seconds_between_them(scene, given):
    """Frame numbers are counted, steps are differences of times, and tracks go back to before the confirmation."""
    people, times = session.PeopleTracks(scene), [0.0, 0.1, 0.4, 0.5]
    found = [people.step(shown(i), at) for i, at in enumerate(times)]
    assert [number for number, _ in given] == [0, 1, 2, 3]
    np.testing.assert_allclose([dt for _, dt in given], [0.0, 0.1, 0.3, 0.1], rtol=1e-6)
    assert [(now.frame, now.time_s) for now in found] == list(enumerate(times))
    assert [len(now.added) for now in found] == [0, 0, 3, 1]
    assert [observed.frame for observed in people.recorder.tracks[4]] == [0, 1, 2, 3]
    assert all(now.seconds > 0 and isinstance(now.people.mode, np.ndarray) for now in found)


@pytest.mark.parametrize("interrupted_after", [0, 1, 4])
def test_images_of_the_first_camera_are_counted_also_in_a_run_that_was_interrupted(scene, given, interrupted_after):
    """At half the rate of a second camera: moments 0, 2 and 4 have its images 0, 1 and 2."""
    people = session.PeopleTracks(scene)
    for i in range(6):
        if i == interrupted_after:
            state, tracks = people.state(), [(4, one) for one in people.recorder.tracks.get(4, [])]
            people = session.PeopleTracks(scene)
            people.restore(state, tracks)
        people.step(shown(i, present=i % 2 == 0), 0.1 * i)
    assert [(one.frame, one.image) for one in people.recorder.tracks[4]] == list(enumerate([0, -1, 1, -1, 2, -1]))


def test_the_reference_of_a_slower_camera_is_renewed_after_so_many_of_its_own_images(scene, given, monkeypatch):
    """A camera at half the rate has no image at any odd moment."""
    monkeypatch.setattr(session, "REFERENCE_EVERY", 2)
    monkeypatch.setattr(MedianBackground, "apply", lambda self, image, keep: image[..., 0] / 255)
    one, renewed = session.PeopleSession(scene), []
    monkeypatch.setattr(one, "_renew_reference", lambda camera: renewed.append((camera, one.tracks.frames)))
    for i in range(8):
        one.process([np.zeros((120, 160, 3), np.uint8) if i % 2 == 0 else None], 0.1 * i)
    assert renewed == [(0, 2), (0, 6)]


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (
            [np.zeros((60, 80, 3), np.uint8)],
            r"images: camera 0 must deliver the shape \(120, 160, 3\); got \(60, 80, 3\)",
        ),
        (
            [np.zeros((120, 160), np.uint8)],
            r"images: camera 0 must deliver the shape \(120, 160, 3\); got \(120, 160\)",
        ),
        ([None, None], "images: expected one for each of 1 cameras; got 2"),
    ],
)
def test_images_that_do_not_fit_are_named(scene, images, message):
    with pytest.raises(ValueError, match=message):
        session.PeopleSession(scene).process(images, 0.0)


@pytest.mark.system
def test_a_session_that_is_saved_and_restored_goes_on_bit_for_bit():
    room = demo_room(0, frames=30)
    scene = people_scene(room.cameras, room.floor, furniture=room.furniture, config=PeopleConfig(capacity=6))
    images = [[room.image(0, i)] for i in range(30)]
    boxes = {i: np.array([[10.0 + 4 * i, 20, 34 + 4 * i, 90, 0.9]]) for i in range(30)}
    with_boxes = lambda: session.PeopleSession(
        scene, detected=[DetectedForeground(boxes, Undistortion(room.cameras[0].shape))]
    )
    primed = with_boxes()
    primed.prime([[image for (image,) in images[::3]]])
    before = primed.state()
    for i in range(20):
        primed.process(images[i], i / room.fps)
    state = primed.state()
    tracks = [(who, one) for who, track in primed.tracks.recorder.tracks.items() for one in track]
    restored = with_boxes()
    restored.restore(state, from_rows(as_rows(tracks)))
    for i in range(20, 30):
        expected, found = (one.process(images[i], i / room.fps) for one in (primed, restored))
        for a, b in zip(jax.tree.leaves(expected[:-2]), jax.tree.leaves(found[:-2]), strict=True):
            np.testing.assert_array_equal(a, b)
    assert np.any(expected.people.mode == TRACKED)
    assert before["clock"][0] == 0
    assert {who: len(track) for who, track in restored.tracks.recorder.tracks.items()} == {
        who: len(track) for who, track in primed.tracks.recorder.tracks.items()
    }


def test_foreground_without_a_box_and_a_box_without_foreground_count_less(scene, given, monkeypatch):
    """A patch that differs from the background holds 0.99 alone; the numbers are Bayes' theorem over both answers."""
    room = np.full((120, 160, 3), 90, np.uint8)
    image = room.copy()
    image[30:90, 20:40] = image[30:90, 100:120] = 240
    boxes = {0: np.array([(94.0, 28, 126, 92, 1.0), (52.0, 28, 84, 92, 1.0)])}
    frames = []
    step = session.step
    monkeypatch.setattr(
        session, "step", lambda s, p, observed, dt: (frames.append(observed), step(s, p, observed, dt))[1]
    )
    one = session.PeopleSession(scene, detected=[DetectedForeground(boxes, Undistortion((120, 160)))])
    one.prime([[room] * 10])
    one.process([image], 0.0)
    ((frame,),) = frames
    alone, both, box, neither = frame.foreground[[60, 60, 60, 10], [30, 110, 68, 5]] / 255
    bayes = lambda s, d: s * d / (s * d + (1 - s) * (1 - d))
    np.testing.assert_allclose(
        [alone, both, box, neither],
        [bayes(0.99, 0.1), bayes(0.99, 0.99), bayes(0.01, 0.99), bayes(0.01, 0.1)],
        atol=0.003,
    )


@pytest.mark.parametrize(("speed_m_per_s", "is_kept"), [(0.0, True), (0.2, True), (0.4, False), (1.2, False)])
def test_the_background_is_kept_beneath_people_who_stand_and_follows_beneath_walkers(
    scene, given, monkeypatch, speed_m_per_s, is_kept
):
    step, kept = session.step, []

    def walking(*arguments):
        people, report = step(*arguments)
        velocity = speed_m_per_s * np.array([0.6, -0.8])
        mean = people.belief.mean.at[0].set(jnp.array([0.0, 0.0, *velocity, 1.75, 0.5, 0.0, 0.0, 0.0]))
        return people._replace(belief=dataclasses.replace(people.belief, mean=mean)), report

    monkeypatch.setattr(session, "step", walking)
    monkeypatch.setattr(
        MedianBackground, "apply", lambda self, image, keep: (kept.append(keep), image[..., 0] / 255)[1]
    )
    one = session.PeopleSession(scene)
    for i in range(4):
        one.process([np.zeros((120, 160, 3), np.uint8)], 0.1 * i)
    u, v = np.asarray(scene.cameras[0].project(jnp.array([0.0, 0.0, 0.9]))[0]).round().astype(int)
    assert [bool(keep[v, u]) for keep in kept[1:]] == [is_kept] * 3


@pytest.mark.parametrize(("argument", "given"), [("subtraction", []), ("detected", [NO_BOXES] * 2)])
def test_one_object_for_each_camera_is_expected(scene, argument, given):
    with pytest.raises(ValueError, match=f"{argument}: expected one for each of 1 cameras; got {len(given)}"):
        session.PeopleSession(scene, **{argument: given})


@pytest.mark.system
def test_what_the_floor_mirrors_is_found_from_people_who_are_taken_out_of_the_background(scene, monkeypatch):
    room = np.random.default_rng(0).integers(150, 190, (120, 160, 3)).astype(np.uint8)
    images = [room.copy() for _ in range(20)]
    for i, image in enumerate(images):
        image[40:80, 10 + 6 * i : 22 + 6 * i] -= 120
        image[80:115, 10 + 6 * i : 22 + 6 * i] -= 36
    monkeypatch.setattr(session, "emptied", lambda camera, floor, images, blank: [room] * len(images))
    of_people = session.PeopleSession(scene)
    of_people.prime([images])
    assert of_people.trouble() == ["camera 0: the floor mirrors 30% of people; reflections count as background"]
    nobody = session.PeopleSession(scene)
    nobody.prime([[room] * 20])
    assert not nobody.trouble()
