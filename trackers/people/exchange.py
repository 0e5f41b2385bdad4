"""Identities that were exchanged while two people were close, put right by what they wear once they are apart."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.trackers.people.appearance import dissimilarity
from jaxfilters.trackers.people.state import HEIGHT, STATE, TRACKED, Meetings, People

CLOSE_M = 0.8
"""People nearer than this on the floor may be mistaken for each other."""
DECIDED = 0.5
"""Summed difference of dissimilarities that settles who is who."""
LONGEST_S = 4.0
"""Of clear view, after which people who look alike are left as they are."""


def is_meeting(meetings: Meetings) -> Bool[Array, " slots"]:
    """Who may be another person, so that the model of their clothes should not be updated."""
    return jnp.any(meetings.is_open, axis=1)


def identity_switch_correction(
    people: People,
    histograms: Float[Array, "slots 48"],
    good: Bool[Array, " slots"],
    dt: Float[Array, ""],
) -> People:
    """Identities put right, and meetings brought up to date.

    Args:
        people: After this frame, with clothes as they were known before.
        histograms: What everybody wears in this frame.
        good: Whose histograms are clear.
        dt: Seconds since the last frame.
    """
    meetings = people.meetings
    xy, followed = people.belief.mean[:, :2], people.mode == TRACKED
    others = ~jnp.eye(len(xy), dtype=bool) & followed[:, None] & followed
    close = (jnp.sum((xy[:, None] - xy) ** 2, axis=-1) < CLOSE_M**2) & others
    clear = good[:, None] & good & ~close & others
    unlike = dissimilarity(people.appearance[:, None], histograms[None])
    own = jnp.diagonal(unlike)
    gain = own[:, None] + own - unlike - unlike.T
    is_open = (meetings.is_open | close) & others
    evidence = jnp.where(close | ~is_open, 0.0, meetings.evidence + jnp.where(clear, gain, 0.0))
    clear_s = jnp.where(close | ~is_open, 0.0, meetings.clear_s + clear * dt)
    people, exchanged = _exchanged(people, jnp.where(is_open, evidence, 0.0))
    settled = (jnp.abs(evidence) > DECIDED) | (clear_s > LONGEST_S) | exchanged[:, None] | exchanged
    return people._replace(meetings=Meetings(is_open & ~settled, evidence * ~settled, clear_s * ~settled))


def _exchanged(people: People, evidence: Array) -> tuple[People, Array]:
    """The pair with the strongest evidence, if it is enough, with each other's identity, clothes and height."""
    slots = len(evidence)
    i, j = jnp.unravel_index(jnp.argmax(evidence), evidence.shape)
    enough = evidence[i, j] > DECIDED
    order = jnp.arange(slots).at[i].set(jnp.where(enough, j, i)).at[j].set(jnp.where(enough, i, j))
    height = jnp.arange(STATE) == HEIGHT
    belief = people.belief
    mean = jnp.where(height, belief.mean[order], belief.mean)
    swapped = people._replace(
        identity=people.identity[order],
        appearance=people.appearance[order],
        belief=Gaussian(mean, belief.covariance),
    )
    return swapped, enough & ((jnp.arange(slots) == i) | (jnp.arange(slots) == j))
