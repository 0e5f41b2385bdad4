"""What people wear, and identities that were exchanged while two people were close, put right by it.

Clothes are joint histograms of the three colours in the upper and the lower half of silhouettes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._full_precision import dot
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.person import foreground
from jaxfilters.models.person.ellipsoid import VISIBLE, ellipse_of, outline
from jaxfilters.trackers.people.silhouettes import body_of, overlapping, presence_of
from jaxfilters.trackers.people.state import (
    APPEARANCE,
    HEIGHT,
    STATE,
    TRACKED,
    CameraFrame,
    Meetings,
    People,
    PeopleScene,
)

STEPS = 4
"""Of each colour, whose values are divided between the two nearest."""
BINS = STEPS**3
GRID = (24, 12)
LEAST_PIXELS = 12.0
"""Effective samples below which a half says nothing."""
CLOSE_M = 0.8
"""People nearer than this on the floor may be mistaken for each other."""
HIDING_M = 0.4
"""Clothes of people nearer than this on the floor are not compared: of the one behind hardly more than edges shows."""
DECIDED = 0.5
"""Summed difference of dissimilarities that settles who is who."""
LONGEST_S = 4.0
"""Of clear view, after which people who look alike are left as they are."""


def appearances(
    scene: PeopleScene,
    places: Float[Array, "slots shape"],
    active: Bool[Array, " slots"],
    frames: tuple[CameraFrame, ...],
) -> tuple[Float[Array, "slots 128"], Bool[Array, " slots"]]:
    """Histograms of everybody, and whose are worth something; of the first camera that sees enough of a person."""
    histograms, good = jnp.full((len(places), APPEARANCE), 1 / BINS), jnp.zeros(len(places), bool)
    for camera, depth, frame in zip(scene.cameras, scene.furniture, frames, strict=True):
        found, enough = _in_camera(scene, camera, depth, frame, places, active)
        use = enough & ~good & frame.present
        histograms, good = jnp.where(use[:, None], found, histograms), good | use
    return histograms, good


def dissimilarity(a: Float[Array, "*#batch 128"], b: Float[Array, "*#batch 128"]) -> Float[Array, "*_"]:
    """Mean Hellinger distance of the two histograms, from 0 to 1."""
    common = jnp.sum(jnp.sqrt(a * b).reshape(*jnp.broadcast_shapes(a.shape, b.shape)[:-1], -1, BINS), axis=-1)
    return jnp.mean(jnp.sqrt(jnp.maximum(1 - common, 0.0)), axis=-1)


def _in_camera(scene, camera, furniture, frame, places, active):
    outlines = jax.vmap(lambda place: outline(camera.P, body_of(place)))(places)
    image, mask = jnp.asarray(frame.image).reshape(-1, 3), jnp.asarray(frame.foreground).ravel()

    order = jnp.argsort(~active)
    num_active = jnp.sum(active)

    def one(turn, found):
        k = order[turn]
        contour = jax.tree.map(lambda leaf: leaf[k], outlines)
        shown = contour.code == VISIBLE
        box = jnp.where(shown, ellipse_of(contour).box, jnp.array([0.0, 0.0, 1.0, 1.0]))
        window = foreground.window(box, camera.shape, GRID)

        near = overlapping(camera.P, places, active.at[k].set(False), window.uv)
        nearest = jnp.argsort(~near)

        def hide(turn, free):
            other = nearest[turn]
            ahead = outlines.depth[other] < contour.depth
            return free * (1 - presence_of(scene.config, camera.P, places[other], window.uv) * ahead)

        free = jax.lax.fori_loop(
            0, jnp.sum(near), hide, window.inside * (contour.depth < furniture.ravel()[window.pixel])
        )
        mine = presence_of(scene.config, camera.P, places[k], window.uv) * shown * (mask[window.pixel] / 255)
        histogram, enough = _histogram(image[window.pixel], mine * free, window.uv[:, 1] < contour.center[1])
        return found[0].at[k].set(histogram), found[1].at[k].set(enough)

    nothing = jnp.full((len(places), APPEARANCE), 1 / BINS), jnp.zeros(len(places), bool)
    return jax.lax.fori_loop(0, num_active, one, nothing)


def _histogram(colors, weight, upper):
    """Of both halves, and whether both hold enough pixels."""
    halves = jnp.stack([weight * upper, weight * ~upper])
    # Equal steps of the square root: clothes are mostly dark.
    level = jnp.clip(STEPS * jnp.sqrt(colors / 256) - 0.5, 0, STEPS - 1)
    blue, green, red = jnp.moveaxis(jnp.maximum(1 - jnp.abs(level[..., None] - jnp.arange(STEPS)), 0), 1, 0)
    joint = (blue[:, :, None, None] * green[:, None, :, None] * red[:, None, None, :]).reshape(-1, BINS)
    sizes = jnp.sum(halves, axis=1)
    histogram = dot(halves, joint) / jnp.maximum(sizes, 1e-6)[:, None]
    return histogram.ravel(), jnp.all(sizes > LEAST_PIXELS)


def is_meeting(meetings: Meetings) -> Bool[Array, " slots"]:
    """Who may be another person, so that the model of their clothes should not be updated."""
    return jnp.any(meetings.is_open, axis=1)


def identity_switch_correction(
    people: People,
    histograms: Float[Array, "slots 128"],
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
    squared = jnp.sum((xy[:, None] - xy) ** 2, axis=-1)
    close, hiding = (squared < CLOSE_M**2) & others, (squared < HIDING_M**2) & others
    clear = good[:, None] & good & ~hiding & others
    unlike = dissimilarity(people.appearance[:, None], histograms[None])
    own = jnp.diagonal(unlike)
    gain = own[:, None] + own - unlike - unlike.T
    is_open = (meetings.is_open | close) & others
    evidence = jnp.where(hiding | ~is_open, 0.0, meetings.evidence + jnp.where(clear, gain, 0.0))
    clear_s = jnp.where(hiding | ~is_open, 0.0, meetings.clear_s + clear * dt)
    people, exchanged = _exchanged(people, jnp.where(is_open, evidence, 0.0))
    settled = (jnp.abs(evidence) > DECIDED) | (clear_s > LONGEST_S) | exchanged[:, None] | exchanged
    return people._replace(meetings=Meetings(is_open & ~settled, evidence * ~settled, clear_s * ~settled))


def _exchanged(people: People, evidence: Array) -> tuple[People, Array]:
    """The pair with the strongest evidence, if it is enough, with each other's identity, clothes and height.

    What hardly changes is of the person from before the meeting. All else follows the body in the image within seconds
    and stays with it: place, width (arms, stride, the side that shows), detectability and the evidence of existence.
    """
    slots = len(evidence)
    i, j = jnp.unravel_index(jnp.argmax(evidence), evidence.shape)
    enough = evidence[i, j] > DECIDED
    order = jnp.arange(slots).at[i].set(jnp.where(enough, j, i)).at[j].set(jnp.where(enough, i, j))
    swapped = people._replace(
        identity=people.identity[order],
        appearance=people.appearance[order],
        appearance_frames=people.appearance_frames[order],
        belief=_with_height_of(order, people.belief),
    )
    return swapped, order != jnp.arange(slots)


def _with_height_of(order: Int[Array, " slots"], belief: Gaussian) -> Gaussian:
    """Beliefs whose height, with its variance, is that of another slot where `order` says so.

    A height that was measured on another body does not correlate with the errors of a slot's place. With covariances of
    zero, the covariance matrix consists of two positive semidefinite blocks.
    """
    is_height = jnp.arange(STATE) == HEIGHT
    variance, one_height = is_height[:, None] & is_height, is_height[:, None] ^ is_height
    taken = (order != jnp.arange(len(order)))[:, None, None]
    covariance = jnp.where(variance, belief.covariance[order], belief.covariance)
    return Gaussian(
        jnp.where(is_height, belief.mean[order], belief.mean),
        jnp.where(taken & one_height, 0.0, covariance),
    )
