"""Is it the thumb: table 1 of Oka et al. on angles with a person's habit, drifting postures and noise.

Seven synthetic subjects who draw with the forefinger, pinch, and draw with the thumb, six tracks of 150 frames for each
finger. What counts is the share of frames in which a finger is recognised for what it is, decided in that frame with
what was observed so far; accuracies are means over subjects, averaged over groups of seven, and `sd_` their standard
deviation over the subjects of a group. Names without a suffix are the posterior's after three seconds of an open hand,
with `_uncalibrated` without these; `_published` is the paper's mean score with the standard angles,
`_published_calibrated` with those that were measured; `_single_frame` the paper's without history.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.models.fingertip import thumb
from jaxfilters.models.fingertip.thumb import POSTURE, ThumbAngles
from jaxfilters.models.synthetic.fingertip_points import base_angles

NUM_GROUPS, QUICK_NUM_GROUPS = 40, 4
SUBJECTS, TRACKS, FRAMES = 7, 6, 150
OPEN_FRAMES = 90
"""Of the open hand, for calibration."""
TASKS = {"forefinger": (18.0,), "pinch": (51.0, 21.0), "thumb": (52.0,)}
"""True mean angles of the fingers in degrees; whichever is above 35 is a thumb."""


class People(NamedTuple):
    """Everybody of all groups."""

    offset: jax.Array
    """(people,) by which angles are greater than the task's, radians."""
    measured: ThumbAngles
    """(people,) of their open hands."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Decide about every finger in every frame."""
    del out
    key = jax.random.key(seed)
    groups = QUICK_NUM_GROUPS if quick else NUM_GROUPS
    people = everybody(jax.random.fold_in(key, 0), groups * SUBJECTS)
    metrics: dict[str, Metric] = {}
    for i, (task, degrees) in enumerate(TASKS.items()):
        means = jnp.radians(jnp.asarray(degrees))
        angles = task_angles(jax.random.fold_in(key, 1 + i), people, means)
        is_thumb = np.asarray(degrees) > 35
        for suffix, decided in decisions(people, angles).items():
            right = 100 * (np.asarray(decided) == is_thumb).mean(axis=(0, 2, 3)).reshape(groups, SUBJECTS)
            metrics[f"accuracy_{task}{suffix}"] = Metric(float(right.mean()), "%", "higher")
            metrics[f"sd_{task}{suffix}"] = Metric(float(right.std(axis=1).mean()), "%", "lower")
    return metrics


def everybody(key: jax.Array, count: int) -> People:
    """People with habits of their own, each of whom held an open hand."""
    habit_key, open_key = jax.random.split(key)
    offset = POSTURE.person_sd * jax.random.normal(habit_key, (count,))
    standard = jnp.asarray([POSTURE.open_thumb, POSTURE.open_forefinger])
    shown = np.asarray(base_angles(open_key, offset[:, None] + standard, OPEN_FRAMES))
    measured = [thumb.calibrated(shown[:, i, 0], shown[:, i, 1]) for i in range(count)]
    return People(offset, jax.tree.map(lambda *leaves: jnp.stack(leaves), *measured))


def task_angles(key: jax.Array, people: People, means: jax.Array) -> jax.Array:
    """(frames, people, tracks, fingers) radians."""
    centers = people.offset[:, None, None] + means
    return base_angles(key, jnp.broadcast_to(centers, (len(people.offset), TRACKS, len(means))), FRAMES)


@jax.jit
def decisions(people: People, angles: jax.Array) -> dict[str, jax.Array]:
    """(frames, people, tracks, fingers) whether each finger is taken for the thumb, by the suffix of the metrics."""
    nobody = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, people.offset.shape), thumb.usual())
    increments = thumb.increment(angles, POSTURE.open_thumb, POSTURE.open_forefinger)
    own = jax.vmap(thumb.increment, in_axes=(1, 0, 0), out_axes=1)(
        angles, people.measured.thumb, people.measured.forefinger
    )
    return {
        "": by_posterior(people.measured, angles),
        "_uncalibrated": by_posterior(nobody, angles),
        "_published": thumb.score(increments) >= thumb.THUMB_SCORE,
        "_published_calibrated": thumb.score(own) >= thumb.THUMB_SCORE,
        "_single_frame": increments >= thumb.THUMB_SCORE,
    }


def by_posterior(measured: ThumbAngles, angles: jax.Array) -> jax.Array:
    """The posterior's decisions about the fingers of a track, which are of one hand."""
    num_fingers = angles.shape[-1]
    observed, there = jnp.asarray(True), jnp.ones(num_fingers, bool)

    def one_hand(person: ThumbAngles, angles: jax.Array) -> jax.Array:
        first = thumb.unknown(person)
        beliefs = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_fingers, *leaf.shape)), first)

        def step(state: tuple, angle: jax.Array) -> tuple[tuple, jax.Array]:
            beliefs, was_thumb = state
            beliefs = jax.vmap(thumb.observe, in_axes=(0, 0, None))(beliefs, angle, observed)
            decided = thumb.decided(was_thumb, thumb.probabilities(beliefs.log_odds, there))
            return (beliefs, decided), decided

        return jax.lax.scan(step, (beliefs, jnp.zeros(num_fingers, bool)), angles)[1]

    of_person = jax.vmap(one_hand, in_axes=(None, 1), out_axes=1)
    return jax.vmap(of_person, in_axes=(0, 1), out_axes=1)(measured, angles)
