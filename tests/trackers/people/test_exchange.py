"""Exchanged identities: put right for people in different clothes, left alone for those who look alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.trackers.people.appearance import (
    BINS,
    CLOSE_M,
    HIDING_M,
    LONGEST_S,
    identity_switch_correction,
    is_meeting,
)
from jaxfilters.trackers.people.state import HEIGHT, STATE, TRACKED, WIDTH, PeopleConfig, nobody

DT = jnp.asarray(0.1)
RED, BLUE, GREY = (jnp.tile(jax.nn.one_hot(i, BINS), 2) for i in (3, 48, 42))
CLEARLY = jnp.array([True, True, True])
settle = jax.jit(identity_switch_correction)


def three(*, apart, first=RED, second=BLUE, mode=(TRACKED,) * 3):
    """Two people who are so far apart, and a third in grey who is far from both; each as tall as the slot says."""
    people = nobody(PeopleConfig(capacity=3))
    mean = np.zeros((3, STATE), np.float32)
    mean[:, 0] = [0.0, apart, 9.0]
    mean[:, HEIGHT], mean[:, WIDTH] = [1.6, 1.7, 1.8], [0.40, 0.45, 0.50]
    return people._replace(
        belief=Gaussian(jnp.asarray(mean), people.belief.covariance),
        mode=jnp.array(mode, jnp.int32),
        identity=jnp.array([10, 11, 12], jnp.int32),
        appearance=jnp.stack([first, second, GREY]),
        appearance_frames=jnp.array([5, 6, 7], jnp.int32),
    )


def met_and_parted(worn, *, frames=8, first=RED, second=BLUE, good=CLEARLY):
    """The state after a meeting, and after some frames apart in which everybody wears what is given."""
    near, far = three(apart=0.3, first=first, second=second), three(apart=2.0, first=first, second=second)
    people = settle(near, jnp.stack([first, second, GREY]), good, DT)
    assert is_meeting(people.meetings).tolist() == [True, True, False]
    people = far._replace(meetings=people.meetings)
    for _ in range(frames):
        people = settle(people, jnp.stack(worn), good, DT)
    return people


@pytest.mark.system
def test_whoever_wears_the_other_s_clothes_is_the_other():
    """Identity, clothes and height change hands; place, speed and width stay with the body."""
    people = met_and_parted([BLUE, RED, GREY], frames=1)
    assert people.identity.tolist() == [11, 10, 12]
    np.testing.assert_allclose(people.belief.mean[:, HEIGHT], [1.7, 1.6, 1.8], rtol=1e-6)
    np.testing.assert_allclose(people.belief.mean[:, WIDTH], [0.40, 0.45, 0.50], rtol=1e-6)
    np.testing.assert_allclose(people.belief.mean[:, 0], [0, 2, 9])
    np.testing.assert_array_equal(people.appearance[:2], jnp.stack([BLUE, RED]))
    assert people.appearance_frames.tolist() == [6, 5, 7]
    assert not is_meeting(people.meetings).any()


def test_a_height_changes_hands_with_its_variance_and_without_its_correlation_to_the_place():
    """Short of the exchange, nothing of a covariance changes."""
    rng = np.random.default_rng(0)
    factors = rng.standard_normal((3, STATE, STATE))
    before = (factors @ factors.swapaxes(1, 2)).astype(np.float32)
    people = three(apart=0.9 * CLOSE_M)
    people = people._replace(belief=Gaussian(people.belief.mean, jnp.asarray(before)))
    kept = settle(people, jnp.stack([RED, BLUE, GREY]), CLEARLY, DT).belief.covariance
    np.testing.assert_array_equal(kept, before)
    after = np.asarray(settle(people, jnp.stack([BLUE, RED, GREY]), CLEARLY, DT).belief.covariance)
    expected = before.copy()
    expected[:2, HEIGHT], expected[:2, :, HEIGHT] = 0.0, 0.0
    expected[:2, HEIGHT, HEIGHT] = before[[1, 0], HEIGHT, HEIGHT]
    np.testing.assert_array_equal(after, expected)
    assert np.linalg.eigvalsh(after.astype(float)).min() > 0


def test_it_is_put_right_once():
    assert met_and_parted([BLUE, RED, GREY], frames=9).identity.tolist() == [11, 10, 12]


def test_whoever_kept_the_clothes_keeps_the_name_and_the_case_is_closed():
    people = met_and_parted([RED, BLUE, GREY], frames=1)
    assert people.identity.tolist() == [10, 11, 12]
    assert not is_meeting(people.meetings).any()


def test_people_who_look_alike_are_left_alone_and_the_case_is_closed_in_time():
    """Both wear red; what differs is noise of a few percent that speaks for an exchange."""
    noisy = 0.97 * RED + 0.03 * BLUE
    frames = int(LONGEST_S / 0.1)
    people = met_and_parted([noisy, RED, GREY], first=RED, second=noisy, frames=1)
    assert people.identity.tolist() == [10, 11, 12]
    same = met_and_parted([RED, RED, GREY], first=RED, second=RED, frames=frames - 5)
    assert is_meeting(same.meetings).tolist() == [True, True, False]
    same = met_and_parted([RED, RED, GREY], first=RED, second=RED, frames=frames + 5)
    assert same.identity.tolist() == [10, 11, 12]
    assert not is_meeting(same.meetings).any()


def test_people_who_stay_beside_each_other_are_told_apart():
    """Nearer than what opens a meeting, but each of them in view."""
    people = settle(three(apart=0.9 * CLOSE_M), jnp.stack([BLUE, RED, GREY]), CLEARLY, DT)
    assert people.identity.tolist() == [11, 10, 12]


def test_nothing_is_decided_while_they_hide_each_other_or_cannot_be_seen():
    close = three(apart=0.9 * HIDING_M)
    for _ in range(10):
        close = settle(close, jnp.stack([BLUE, RED, GREY]), CLEARLY, DT)
    assert close.identity.tolist() == [10, 11, 12]
    assert is_meeting(close.meetings).tolist() == [True, True, False]
    people = met_and_parted([BLUE, RED, GREY], good=jnp.array([True, False, True]))
    assert people.identity.tolist() == [10, 11, 12]
    assert is_meeting(people.meetings).tolist() == [True, True, False]


def test_people_who_never_met_are_not_exchanged():
    people = settle(three(apart=2.0), jnp.stack([BLUE, RED, GREY]), CLEARLY, DT)
    assert people.identity.tolist() == [10, 11, 12]
    assert not people.meetings.evidence.any()


@pytest.mark.parametrize("slot", [0, 1])
def test_a_meeting_ends_when_one_is_lost(slot):
    people = settle(three(apart=0.3), jnp.stack([RED, BLUE, GREY]), CLEARLY, DT)
    people = people._replace(mode=people.mode.at[slot].set(0))
    assert not is_meeting(settle(people, jnp.stack([RED, BLUE, GREY]), CLEARLY, DT).meetings).any()
