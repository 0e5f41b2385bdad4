"""`track` of every system from Python: times, and frames that come in pieces of any size."""

import jax
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.hand.skeleton import anatomical_hand
from jaxfilters.models.synthetic.desk_hand import desk_video
from jaxfilters.models.synthetic.face_sequence import sequence
from jaxfilters.models.synthetic.hand import kinect_v2, simulate_sequence
from jaxfilters.trackers import articulated, fingertips, hand_depth, people
from jaxfilters.trackers import tracker as protocol
from jaxfilters.trackers.fingertips.images import angles_of, estimate_user, hands_in
from jaxfilters.trackers.head import mono, stereo
from jaxfilters.trackers.io.face_models import default_face_model
from jaxfilters.trackers.io.video_input import FrameSet
from jaxfilters.trackers.people.run import PeopleStream
from jaxfilters.trackers.registry import SYSTEMS

BLANK = np.zeros((8, 48, 64), np.uint8)
LENGTHS = {"head-stereo": ("pose", "pose_std", "shape", "deformation"), "head-mono": ("pose", "pose_std", "shape")}
"""Fields of tracks of heads that agree to five micrometres at a distance of 0.6 m, and to as many microradians."""
CAMERA = Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640))


def blank_scene():
    down = np.array([[1, 0, 0, 0], [0, -0.4, -0.9, 0.7], [0, 0.9, -0.4, 5.7]])  # 3 m high, 5 m before the origin
    above = FloorCamera.from_matrix(np.array([[75, 0, 31.5], [0, 75, 23.5], [0, 0, 1]]) @ down, (48, 64))
    return people.people_scene([above], np.array([(-1.0, 0.0), (1.0, 0.0), (1.0, 2.0), (-1.0, 2.0)]))


def blank_tracks():
    """By system: `track` on eight frames that show nothing, but for their times."""
    return {
        "hand-depth": lambda times: hand_depth.track(0.5 + BLANK, times, CAMERA),
        "articulated": lambda times: articulated.track(np.ones((8, 21, 2)), times),
        "people": lambda times: people.track([[frame] for frame in BLANK], times, blank_scene()),
        "head-stereo": lambda times: stereo.track(BLANK[:, None], times, monocular(CAMERA)),
        "head-mono": lambda times: mono.track(BLANK, times, CAMERA),
        "fingertips": lambda times: fingertips.track(list(BLANK), times),
    }


@pytest.mark.parametrize(
    ("times", "words"),
    [
        ([0, 1, 2, 3, 3, 4, 5, 6], r"strictly increasing seconds; got 3.000000 for frame 3, 3.000000 for frame 4"),
        ([0, 1, 2, 3, 4, 3.5, 5, 6], r"strictly increasing seconds; got 4.000000 for frame 4, 3.500000 for frame 5"),
        ([0, 1, 2, 3, np.nan, 5, 6, 7], r"finite seconds; got nan for frame 4"),
    ],
    ids=["repeated", "late", "nan"],
)
@pytest.mark.parametrize("name", [system.name for system in SYSTEMS])
def test_frames_that_come_twice_or_late_are_named(name, times, words):
    with pytest.raises(ValueError, match=f"times_s: expected {words}"):
        blank_tracks()[name](np.asarray(times, float))


def in_pieces(session, images, times):
    rows = [session.process(images[i : i + 1], times[i : i + 1]) for i in range(len(times))]
    return jax.tree.map(lambda *parts: np.concatenate(parts), *rows)


def head_stereo_tracks(monkeypatch):
    made = sequence(jax.random.key(0), "mix", 6, 0, deform=True)
    images, points = np.asarray(made.frames(0, 6)), np.asarray(made.uv[0, 0])
    whole = stereo.track(images, made.times, made.rig, points=points)
    return whole, in_pieces(stereo.HeadSession(made.rig, None, points), images, made.times), whole.status > 0


def head_mono_tracks(monkeypatch):
    made = sequence(jax.random.key(0), "mix", 6, 0, rig=monocular(CAMERA))
    images, points, face = np.asarray(made.frames(0, 6)), np.asarray(made.uv[0, 0]), default_face_model().model
    whole = mono.track(images[:, 0], made.times, CAMERA, face=face, points=points)
    pieces = in_pieces(mono.MonoSession(monocular(CAMERA), face, points=points), images, made.times)
    return whole, pieces, whole.status > 0


def hand_tracks(track, frames, monkeypatch):
    whole = track(frames)
    monkeypatch.setattr(protocol, "CHUNK", 1)
    return whole, track(frames), whole.status == 1


def articulated_tracks(monkeypatch):
    recording = articulated.synthetic_sequence(0)
    built = articulated.build(recording)
    track = lambda frames: protocol.track_frames(built, jax.random.key(0), frames, recording.times_s[: len(frames)])
    return hand_tracks(track, [recording[i] for i in range(20)], monkeypatch)


def hand_depth_tracks(monkeypatch):
    made = simulate_sequence(jax.random.key(1), "B", num_frames=6, geometry=anatomical_hand())
    config = hand_depth.HandDepthConfig(num_particles=64)
    track = lambda frames: hand_depth.track(frames, np.arange(len(frames)) / 30, kinect_v2(), config)
    return hand_tracks(track, np.asarray(made.depth_mm, np.float32) / 1000, monkeypatch)


def fingertip_tracks(monkeypatch):
    images = [frame.image for frame in desk_video(jax.random.key(0), np.ones((20, 5), bool), shape=(240, 320))]
    times, user = np.arange(20) / 30, estimate_user(images, "infrared")
    session = fingertips.FingertipSession(
        angles_of(user), handedness=user.parameters.handedness, height=240.0, fps=30.0, num_hands=1
    )
    observed = [hands_in(image, user, 1) for image in images]
    whole = session.process(jax.tree.map(lambda *parts: np.concatenate(parts), *observed), times)
    return whole, fingertips.track(images, times)[0], whole.num_tips[:, 0] == 5


PIECES = {
    "hand-depth": hand_depth_tracks,
    "articulated": articulated_tracks,
    "head-stereo": head_stereo_tracks,
    "head-mono": head_mono_tracks,
    "fingertips": fingertip_tracks,
}
"""Of each system but that of people: the track of all frames at once, that of the frames one by one, and in which of
them what is followed was found."""


@pytest.mark.system
@pytest.mark.parametrize("name", PIECES)
def test_frames_one_by_one_give_the_track_of_all_at_once(name, monkeypatch):
    """To the rounding of programs of other shapes, which the processor's vector width changes too."""
    whole, pieces, found = PIECES[name](monkeypatch)
    assert np.any(found)
    for field in whole._fields:
        atol = 5e-6 if field in LENGTHS.get(name, ()) else 1e-3
        np.testing.assert_allclose(getattr(pieces, field), getattr(whole, field), rtol=1e-3, atol=atol, err_msg=field)


def test_people_are_followed_one_frame_at_a_time():
    assert {system.name for system in SYSTEMS} - set(PIECES) == {"people"}
    session, moment = PeopleStream(people.PeopleSession(blank_scene())), FrameSet(0.0, (BLANK[0],))
    assert session.is_due([moment])
    with pytest.raises(ValueError, match="too many values"):
        session.process([moment, moment])
