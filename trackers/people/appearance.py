"""What people wear: colour histograms of the upper and the lower half of their silhouettes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.models.person import foreground
from jaxfilters.models.person.ellipsoid import VISIBLE, ellipse_of, outline
from jaxfilters.trackers.people.silhouettes import body_of, overlapping, presence_of
from jaxfilters.trackers.people.state import APPEARANCE, CameraFrame, PeopleScene

BINS = 8
GRID = (24, 12)
LEAST_PIXELS = 12.0
"""Effective samples below which a half says nothing."""


def appearances(
    scene: PeopleScene, places: Float[Array, "slots 4"], active: Bool[Array, " slots"], frames: tuple[CameraFrame, ...]
) -> tuple[Float[Array, "slots 48"], Bool[Array, " slots"]]:
    """Histograms of everybody, and whose are worth something; of the first camera that sees enough of a person."""
    histograms, good = jnp.full((len(places), APPEARANCE), 1 / BINS), jnp.zeros(len(places), bool)
    for camera, depth, frame in zip(scene.cameras, scene.furniture, frames, strict=True):
        found, enough = _in_camera(scene, camera, depth, frame, places, active)
        use = enough & ~good & frame.present
        histograms, good = jnp.where(use[:, None], found, histograms), good | use
    return histograms, good


def dissimilarity(a: Float[Array, "*#batch 48"], b: Float[Array, "*#batch 48"]) -> Float[Array, "*_"]:
    """Mean Hellinger distance of the six histograms, from 0 to 1."""
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
    bins = jax.nn.one_hot((BINS * jnp.sqrt(colors / 256)).astype(jnp.int32), BINS)
    sizes = jnp.sum(halves, axis=1)
    histogram = jnp.einsum("hs,scb->hcb", halves, bins) / jnp.maximum(sizes, 1e-6)[:, None, None]
    return histogram.ravel(), jnp.all(sizes > LEAST_PIXELS)
