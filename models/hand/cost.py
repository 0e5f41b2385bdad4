r"""How badly a rendered hand explains a depth image, and the likelihoods made of it.

Source: Kajihara and Tanaka, equations [3], [4], [47], [48], and the union cost

$$D_\cup = \frac{1}{|O \cup M|} \Big( \sum_{O \cap M} \min(|d - y|, c) + c\,|O \mathbin{\triangle} M| \Big)$$

with $M$ the rendered and $O$ the observed hand pixels. Observed images are in metres; `inf` is background (measured,
and not the hand), NaN no reading. A pixel without a reading belongs to neither set; a rendered pixel over background
counts `c`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.models.rendering.comparison import DepthTerms


def rendered_cost(terms: DepthTerms, max_error: float | Float[Array, ""]) -> Float[Array, "*poses"]:
    """The paper's cost D, metres [4], [48]: mean error over the rendered pixels; `max_error` where there are none."""
    return _mean(terms.absolute_sum, terms.rendered_count, max_error)


def union_cost(
    terms: DepthTerms, observed_count: Int[Array, ""], max_error: float | Float[Array, ""]
) -> Float[Array, "*poses"]:
    """Mean error, metres, over the rendered or observed hand pixels; uncovered observed ones count `max_error`.

    `observed_count` is the number of hand pixels in the same window (`count_observed`). Without any pixel at all the
    cost is `max_error`.
    """
    uncovered = observed_count - terms.overlap_count
    return _mean(terms.absolute_sum + max_error * uncovered, terms.rendered_count + uncovered, max_error)


def count_observed(observed: Float[Array, "rows cols"]) -> Int[Array, ""]:
    """Number of hand pixels: those with a finite depth."""
    return jnp.sum(jnp.isfinite(observed), dtype=int)


def gibbs_abs(cost: Float[Array, "*shape"], sigma: float | Float[Array, ""]) -> Float[Array, "*shape"]:
    """Log-likelihood -D / sigma [3], up to a constant; `cost` and `sigma` in metres."""
    return -cost / sigma


def gibbs_sq(cost: Float[Array, "*shape"], sigma: float | Float[Array, ""]) -> Float[Array, "*shape"]:
    """Log-likelihood -D^2 / (2 sigma^2) [47], up to a constant; `cost` and `sigma` in metres."""
    return -0.5 * (cost / sigma) ** 2


def gate(
    observed: Float[Array, "rows cols"], near: float | Float[Array, ""], far: float | Float[Array, ""]
) -> Float[Array, "rows cols"]:
    """The image with only the depths in [near, far] left as hand, metres.

    What lies farther is background (`inf`): a hand there would have hidden it. What lies nearer hides the hand and
    says nothing about it: no reading (NaN), as are the pixels without one.
    """
    nearer = observed < near
    return jnp.where(observed > far, jnp.inf, jnp.where(nearer, jnp.nan, observed))


def _mean(total, count, empty):
    return jnp.where(count > 0, total / jnp.where(count > 0, count, 1), empty)
