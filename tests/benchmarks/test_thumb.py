"""The scenario of the thumb: its acceptance (section 4.3) on fewer people."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import thumb
from jaxfilters.models.fingertip.thumb import POSTURE


@pytest.mark.system
def test_accumulated_decisions_meet_the_acceptance_and_the_posterior_beats_them():
    metrics = {name: metric.value for name, metric in thumb.run(quick=True, seed=0, out=None).items()}
    for task in thumb.TASKS:
        single, published, modern = (metrics[f"accuracy_{task}{s}"] for s in ("_single_frame", "_published", ""))
        assert single < published
        assert published >= 96.5
        assert modern >= 99.4
        assert modern > published


@pytest.mark.system
def test_people_differ_and_calibration_finds_how():
    people = thumb.everybody(jax.random.key(1), 200)
    offset, found = np.asarray(people.offset), np.asarray(people.measured.offset)
    # The standard deviation of 200 draws is within 4 * 1/sqrt(400) of the true one.
    assert abs(offset.std() / POSTURE.person_sd - 1) < 4 / np.sqrt(400)
    left = np.asarray(people.measured.offset_variance)
    assert abs(np.mean(np.square(found - offset)) / left.mean() - 1) < 4 * np.sqrt(2 / 200)


@pytest.mark.system
def test_tracks_are_of_the_fingers_of_a_task():
    people = thumb.everybody(jax.random.key(2), 3)
    angles = thumb.task_angles(jax.random.key(3), people, jnp.radians(jnp.asarray([51.0, 21.0])))
    assert angles.shape == (thumb.FRAMES, 3, thumb.TRACKS, 2)
    np.testing.assert_allclose(np.degrees(angles.mean(axis=(0, 1, 2)) - people.offset.mean()), [51, 21], atol=3)
