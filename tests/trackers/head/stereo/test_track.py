"""Short rendered videos followed frame by frame (acceptance runs of the specification, section 5.1, thinned)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.rig import project_shape
from jaxfilters.models.synthetic.face_motion import STEREO_PLACE_MM
from jaxfilters.models.synthetic.face_sequence import face_sequence, sequence
from jaxfilters.trackers.head.common.config import HeadConfig, compiled
from jaxfilters.trackers.head.common.search import first_diffusion, searches
from jaxfilters.trackers.head.common.state import DOUBTFUL, LOST, NUM_MODES, RIGID, UNITS
from jaxfilters.trackers.head.stereo import tracking as module
from jaxfilters.trackers.head.stereo.redetection import DETECTED_STD, placed
from jaxfilters.trackers.head.stereo.registration import register

pytestmark = pytest.mark.optimised

CHUNK = 8
MODERN, PAPER = HeadConfig(), HeadConfig(variant="published")
FIXED = HeadConfig(variant="published", diffusion="fixed", fixed_diffusion=1.0)
PAPER_ADAPTIVE = {"slow": (1.25, 1.91, 2.71, 0.25, 1.55, 1.70), "fast": (3.42, 3.34, 4.92, 0.87, 2.86, 2.34)}
"""Published errors of the adaptive tracker, millimetres and degrees (P, tables 3 and 4)."""


class Video:
    """A video in memory, its registration, and the trackers that have followed it."""

    def __init__(self, video):
        self.video, self.images, self._tracks = video, video.frames(0, len(video)), {}
        self.registration = register(self.images[0], video.uv[0, 0].astype(float), video.rig, num_modes=NUM_MODES)

    def begin(self, options, seed=0):
        model, pose, _ = self.registration
        time = jnp.asarray(self.video.times[0], float)
        arguments = jax.random.key(seed), model, pose, self.images[0], time, self.video.rig
        return module.begin(*arguments, options=compiled(options), diffusion=first_diffusion(options))

    def advance(self, state, start, stop, options, filters=None, chunk=CHUNK):
        """State after the frames `start` to `stop`, at most a chunk, and their rows."""
        images = np.zeros((chunk, *self.images.shape[1:]), np.uint8)
        images[: stop - start] = self.images[start:stop]
        times = np.resize(self.video.times[start:stop], chunk).astype(np.float32)
        filters = searches(self.video.rig, options) if filters is None else filters
        is_frame = np.arange(chunk) < stop - start
        state, track = module.advance(self.video.rig, filters, state, images, times, is_frame, compiled(options))
        return state, jax.tree.map(lambda a: np.asarray(a)[: stop - start], track)

    def track(self, options, seed=0):
        """The last state, and rows from the second frame on."""
        if (options, seed) not in self._tracks:
            state, rows, filters = self.begin(options, seed), [], searches(self.video.rig, options)
            for start in range(1, len(self.video), CHUNK):
                state, row = self.advance(state, start, min(start + CHUNK, len(self.video)), options, filters)
                rows.append(row)
            self._tracks[options, seed] = state, jax.tree.map(lambda *parts: np.concatenate(parts), *rows)
        return self._tracks[options, seed]

    def errors(self, options, seed=0):
        """Millimetres and degrees."""
        return (self.track(options, seed)[1].pose - self.video.poses[1:]) / UNITS


@pytest.fixture(scope="module")
def videos():
    return {kind: Video(sequence(jax.random.key(1), kind, 81, 1)) for kind in ("slow", "fast")}


def rms(errors):
    return np.sqrt(np.mean(errors**2, axis=0))


@pytest.mark.system
def test_two_images_of_one_time_tell_no_velocity(videos):
    """A correction of the pose within no time would be a motion of thousands of millimetres a frame."""
    video, state = videos["fast"], videos["fast"].begin(MODERN)
    off = state.belief.mean[:6] + jnp.asarray(UNITS * [2.0, -2.0, 3.0, 1.0, 2.0, -1.0])
    state = placed(state, off, video.images[0], video.video.rig, DETECTED_STD)
    images, times = np.repeat(video.images[:1], CHUNK, axis=0), np.full(CHUNK, float(state.time), np.float32)
    filters, is_frame = searches(video.video.rig, MODERN), np.arange(CHUNK) < 1
    after, track = module.advance(video.video.rig, filters, state, images, times, is_frame, compiled(MODERN))
    assert np.all(np.abs(track.pose[0] - video.video.poses[0]) < UNITS)
    np.testing.assert_array_equal(after.search.velocity, 0)
    jax.tree.map(np.testing.assert_array_equal, after.search.fit, state.search.fit)


@pytest.mark.system
@pytest.mark.parametrize("kind", ["slow", "fast"])
def test_the_fit_is_far_within_half_of_the_published_errors(videos, kind):
    state, track = videos[kind].track(MODERN)
    error = rms(videos[kind].errors(MODERN))
    assert np.all(error < 0.5 * np.array(PAPER_ADAPTIVE[kind]))
    assert np.all(error < [0.1, 0.1, 0.6, 0.1, 0.3, 0.3])
    np.testing.assert_array_equal(track.status, RIGID)
    assert track.score.min() > 0.8
    assert int(state.age) == 80
    assert int(state.misses) == 0


@pytest.mark.system
@pytest.mark.parametrize("kind", ["slow", "fast"])
def test_the_tracker_of_the_paper_is_about_as_good_as_published(videos, kind):
    """80 frames of one face, whose registration errs in its own way: twice as much is allowed.

    Over forty draws of the particles this face is never lost where it moves slowly: three serve. Where it moves
    fast it is in two: four or more of eight are, once in 2700 times; it has 1.4 times the published errors in the
    median of four others, and of 100,000 sets of five none is beyond. Roundings of another machine are other draws.
    """
    draws = range({"slow": 3, "fast": 8}[kind])
    tracks = [videos[kind].track(PAPER, seed)[1] for seed in draws]
    errors = [videos[kind].errors(PAPER, seed) for seed in draws]
    followed = [np.all(track.status == RIGID) for track in tracks]
    assert sum(followed) >= {"slow": 3, "fast": 5}[kind]
    kept = np.concatenate([error for error, is_followed in zip(errors, followed, strict=True) if is_followed])
    assert np.all(rms(kept) < 2.0 * np.array(PAPER_ADAPTIVE[kind]))


@pytest.mark.system
@pytest.mark.parametrize("kind", ["slow", "fast"])
def test_standard_deviations_are_true(videos, kind):
    """Two of them hold most errors; over 80 frames errors are alike, and one face is but one."""
    error, deviation = videos[kind].errors(MODERN), videos[kind].track(MODERN)[1].pose_std / UNITS
    assert np.mean(np.abs(error) < 2 * deviation) > 0.7
    assert np.all(deviation > 1e-4)
    assert np.all(deviation.mean(axis=0) < [0.3, 0.3, 1.0, 0.2, 0.5, 0.5])


@pytest.mark.system
def test_rows_are_of_one_piece(videos):
    """Image points are the projected shape, deformations are none in the first frames, weights are sound."""
    video, (_, track) = videos["fast"].video, videos["fast"].track(MODERN)
    for row in (0, 40):
        uv, in_front = project_shape(video.rig, jnp.asarray(track.shape[row]), jnp.asarray(track.pose[row]))
        np.testing.assert_allclose(track.image_points[row], uv, atol=1e-2)
        assert np.all(in_front)
    np.testing.assert_allclose(track.image_points, video.uv[1:], atol=0.6)
    np.testing.assert_allclose(track.deformation, 0, atol=1e-3)
    assert np.all((track.effective_sample_size >= 1) & (track.effective_sample_size <= MODERN.num_particles))


@pytest.mark.system
def test_the_registered_shape_gets_sharper(videos):
    """From matches to what slopes of the skin and a second look make of them."""
    video = videos["fast"]
    state, _ = video.track(MODERN)
    before = np.asarray(video.registration.model.mean) - video.video.shapes[0]
    after = np.asarray(state.registered.shape) - video.video.shapes[0]
    depth = lambda off: np.sqrt(np.mean((off - off.mean(axis=0))[:, 2] ** 2))
    assert depth(after) < 0.6 * depth(before)
    claimed = np.sqrt(np.asarray(state.registered.covariance)[:, 2, 2])
    assert np.all(np.abs(after[:, 2]) < 4 * claimed)


@pytest.mark.system
def test_rows_that_are_no_frames_leave_the_state_alone(videos):
    video = videos["slow"]
    state = video.begin(MODERN)
    after, track = video.advance(state, 1, 1, MODERN)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)
    assert len(track.pose) == 0
    one, _ = video.advance(state, 1, 4, MODERN)
    one, last = video.advance(one, 4, 7, MODERN)
    both, whole = video.advance(state, 1, 7, MODERN)
    np.testing.assert_allclose(last.pose[-1], whole.pose[-1], atol=1e-5)
    assert int(one.age) == int(both.age) == 6


@pytest.mark.system
def test_dropped_frames_are_bridged(videos):
    """Every third frame of the fast motion, at its own time; and two frames of one time."""
    video, state = videos["fast"], videos["fast"].begin(MODERN)
    filters = searches(video.video.rig, MODERN)
    for frame in [*range(1, 41, 3), 40]:
        state, track = video.advance(state, frame, frame + 1, MODERN, filters)
        error = np.abs(track.pose[0] - video.video.poses[frame]) / UNITS
        assert np.all(error < [0.5, 0.5, 2.5, 0.5, 1.5, 1.5])


@pytest.mark.system
def test_a_head_at_rest_does_not_jitter():
    """Oracle 12, in the paper's mode, with 70 of its 200 frames."""
    poses = np.tile([*STEREO_PLACE_MM, 0.0, 0, 0], (73, 1))
    video = Video(face_sequence(jax.random.key(4), poses))
    deviation = (video.track(PAPER)[1].pose[20:] / UNITS).std(axis=0)
    assert np.all(deviation <= [0.1, 0.1, 1.5, 0.15, 1.0, 0.9])
    modern = (video.track(MODERN)[1].pose[20:] / UNITS).std(axis=0)
    assert np.all(modern < 0.25 * np.array([0.1, 0.1, 1.5, 0.15, 1.0, 0.9]))


@pytest.mark.system
def test_a_face_behind_noise_is_missed_and_then_lost(videos):
    video = videos["slow"]
    state, _ = video.advance(video.begin(MODERN), 1, 6, MODERN)
    hidden = Video.__new__(Video)
    hidden.video = video.video
    hidden.images = np.random.default_rng(0).integers(0, 256, (30, 2, 480, 640), np.uint8)
    after, first = hidden.advance(state, 6, 14, MODERN)
    np.testing.assert_array_equal(first.status, DOUBTFUL)
    assert int(after.misses) == 8
    assert np.all(first.score < module.LEAST_SCORE)
    assert np.all(first.pose_std[-1] > first.pose_std[0])
    after, second = hidden.advance(after, 14, 22, MODERN)
    np.testing.assert_array_equal(second.status, [DOUBTFUL] * (module.PATIENCE - 9) + [LOST] * (17 - module.PATIENCE))
    # Particles gather where the face was last seen, ever farther around, and find it when it shows again.
    kept = np.asarray(state.belief.mean)
    np.testing.assert_array_equal(after.last_good, kept)
    after, third = hidden.advance(after, 22, 30, MODERN)
    np.testing.assert_array_equal(third.status, LOST)
    off = (np.asarray(after.search.particles)[:6] - kept[:6, None]) / UNITS[:, None]
    assert np.all(np.abs(off.mean(axis=1)) < module.MOST_ASTRAY)
    assert np.all(off.std(axis=1) < 2 * module.MOST_ASTRAY)
    assert off.std(axis=1).max() > 1
    back, found = video.advance(after, 30, 38, MODERN)
    assert found.status[-1] == RIGID
    np.testing.assert_allclose(found.pose[-1], video.video.poses[37], atol=0.5)
    assert int(back.misses) == 0
    # What was learnt of the face stays as it was.
    for name in ("slopes", "model_variance", "residual_scale", "registered"):
        jax.tree.map(np.testing.assert_array_equal, getattr(after, name), getattr(state, name))
