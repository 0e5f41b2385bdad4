"""How much of each person differs from the background: the probability that a pixel of a silhouette is detected.

Clothes in the colour of the background, bad light and compression leave holes in a silhouette. A search that expects
all of a body takes holes for places where nobody is, and moves the person to where fewer of them are. The probability
is one number a person for all cameras, with a few possible values. Its filter is that of a discrete state (the forward
recursion of a hidden Markov model) that forgets in time (a power of the posterior; A. Raftery, M. Karny, P. Ettler,
"Online prediction under model uncertainty via dynamic model averaging", Technometrics 52, 2010). Images in which other
people may explain the same pixels do not count: a second track on one person would otherwise pass for a person of whom
little is detected.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.trackers.people.silhouettes import View, log_likelihood
from jaxfilters.trackers.people.state import DETECTABILITIES, DETECTABILITY, PeopleScene

MEMORY_S = 3.0
"""Time after which an image counts 1 / e as much. A person who leaves is a silhouette of which nothing is detected, and
must be given up before little of it is expected: at 7 frames a second, 2 seconds are too short for that."""
PRIOR_NATS = 2.0
"""By how much the first of the values is more probable than each of the others without an image."""


def prior_log_weights() -> Float[Array, " values"]:
    """Of a person of whom no image has been compared yet, up to a constant."""
    return -PRIOR_NATS * (jnp.arange(len(DETECTABILITIES)) > 0)


def most_probable(log_weights: Float[Array, "*slots values"]) -> Float[Array, "*slots"]:
    """The most probable value of each person."""
    return jnp.array(DETECTABILITIES)[jnp.argmax(log_weights, axis=-1)]


def predicted(log_weights: Float[Array, "slots values"], dt: Float[Array, ""]) -> Float[Array, "slots values"]:
    """Log weights `dt` seconds later."""
    kept = jnp.exp(-dt / MEMORY_S)
    return kept * log_weights + (1 - kept) * prior_log_weights()


def updated(
    log_weights: Float[Array, "slots values"], evidence: Float[Array, "slots values"]
) -> Float[Array, "slots values"]:
    """Log weights after an image.

    Args:
        log_weights: Before it.
        evidence: Log likelihood of the image under each value (`evidence_of`).
    """
    after = log_weights + evidence
    return after - jnp.max(after, axis=-1, keepdims=True)


def evidence_of(
    scene: PeopleScene, shape: Float[Array, " shape"], views: View, contrasts: Float[Array, "cameras samples"]
) -> Float[Array, " values"]:
    """Log likelihood of the images of a person under each value.

    Args:
        scene: Cameras and constants.
        shape: Of the silhouette.
        views: The windows of the person.
        contrasts: What silhouettes are compared with.
    """
    values = jnp.array(DETECTABILITIES, shape.dtype)
    candidates = jnp.broadcast_to(shape, (len(values), len(shape))).at[:, DETECTABILITY].set(values)
    return jax.vmap(log_likelihood, in_axes=(None, 0, None, None))(scene, candidates, views, contrasts)
