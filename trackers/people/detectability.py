"""How much of each person differs from the background: a factor on the probability that a pixel is foreground.

Clothes in the colour of the background, bad light and compression leave holes in a silhouette. A search that expects
all of a body takes holes for places where nobody is, and moves the person to where fewer of them are. The factor has a
few possible values. It is one number a person for all cameras, though the background behind a person differs between
them. Each image multiplies the weights of the values by its likelihoods, and older images count less (stabilised
forgetting: R. Kulhavy, M. Zarrop, "On a general concept of forgetting", International Journal of Control 58, 1993: the
weights are raised to a power, and the prior to the rest of it).

The factor belongs to a person's own likelihood alone. A body hides what is behind it whether or not it is detected. An
image in which other people may explain the pixels of a person does not count: a second track on one person would
otherwise pass for a person of whom little is detected.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.trackers.people.silhouettes import View, log_likelihood
from jaxfilters.trackers.people.state import DETECTABILITIES, DETECTABILITY_PRIOR, PeopleScene

MEMORY_S = 3.0
"""Time after which the weight of an image is 1 / e. A person who leaves is a silhouette of which nothing is detected.
After ten seconds of whole silhouettes at 7 frames a second, such a person is given up one frame later than without this
factor; with 2 seconds three frames later."""
LEAST_FOR_EXISTENCE = 0.55
"""Least value under which the score decides whether a person exists: an empty silhouette loses 0.5 nats a pixel under
it, and 0.2 under 0.25, with which the track of a person who left would be kept more than twice as long."""
ALONE = 0.5
"""Least probability that nobody else makes a pixel foreground, over all pixels of a window, for an image to count and
for a stride to be searched for."""


def most_probable(log_weights: Float[Array, "*slots values"]) -> Float[Array, "*slots"]:
    """The value with the largest weight of each person."""
    return jnp.array(DETECTABILITIES)[jnp.argmax(log_weights, axis=-1)]


def predicted(
    log_weights: Float[Array, "slots values"], dt: Float[Array, ""], tracked: Bool[Array, " slots"]
) -> Float[Array, "slots values"]:
    """Log weights of the values `dt` seconds later, up to a constant; only the first value for who is not tracked yet.

    Whoever is not tracked may be clutter, which explains itself as a person of whom little is detected.
    """
    kept = jnp.exp(-dt / MEMORY_S)
    prior = jnp.array(DETECTABILITY_PRIOR)
    whole = jnp.where(jnp.arange(len(DETECTABILITIES)) == 0, 0.0, -jnp.inf)
    return jnp.where(tracked[:, None], kept * log_weights + (1 - kept) * prior, whole)


def updated(
    log_weights: Float[Array, "slots values"], evidence: Float[Array, "slots values"], tracked: Bool[Array, " slots"]
) -> Float[Array, "slots values"]:
    """Log weights of the values after an image, with the maximum 0; the prior for who is not tracked yet.

    Args:
        log_weights: Before the image.
        evidence: Log likelihood ratios of the image (`evidence_of`).
        tracked: Who is a person and no longer a candidate.
    """
    after = log_weights + evidence
    after -= jnp.max(after, axis=-1, keepdims=True)
    return jnp.where(tracked[:, None], after, jnp.array(DETECTABILITY_PRIOR))


def evidence_of(
    scene: PeopleScene,
    shape: Float[Array, " 6"],
    views: View,
    unexplained: Float[Array, "cameras samples"],
    contrasts: Float[Array, "cameras samples"],
) -> Float[Array, " values"]:
    """Log likelihood ratio of a person against nobody under each value, in the cameras where no other person may be.

    Args:
        scene: Cameras and constants.
        shape: X, Y, height, width and stride of the silhouette, metres.
        views: The windows of the person.
        unexplained: Probability that nobody else makes each sample foreground.
        contrasts: What silhouettes are compared with.
    """
    alone = jnp.min(unexplained, axis=-1, keepdims=True) > ALONE
    under = lambda value: log_likelihood(scene, shape, views, value * alone * contrasts)
    return jax.vmap(under)(jnp.array(DETECTABILITIES, contrasts.dtype))
