"""Moments of mixtures of Gaussians: the one Gaussian that has the mean and the covariance of several."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters import weights
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.manifold import Belief, Manifold, euclidean, retract_belief, to_tangent
from jaxfilters.math import linalg


def mixture_moments(
    beliefs: Gaussian | GaussianRoot, log_weights: Float[Array, " k"], *, manifold: Manifold = euclidean
) -> Gaussian | GaussianRoot:
    """Gaussian with the mean and the covariance of a weighted mixture of k Gaussians.

    A component without weight contributes nothing, whatever its values are, NaN included. Roots of covariances are
    combined by an orthogonal transformation, without a product.

    Args:
        beliefs: Components along the last axis: a `Gaussian` of means (n, k) and covariances (n, n, k), or a
            `GaussianRoot` of means (n, k) and roots (n, any, k).
        log_weights: Their log weights, (k,), not necessarily normalised.
        manifold: Space of the states. Where it is no vector space, the mixture is formed in the tangent space at the
            component of largest weight.

    Returns:
        The belief, of the kind of `beliefs`, with a square root.

    Raises:
        TypeError: If `beliefs` is no `Gaussian` or `GaussianRoot`, or `log_weights` no floating-point numbers.
        ValueError: If the last axis of the beliefs is not that of `log_weights`.

    Examples:
        Two equally probable points at -1 and 1 with the variance 0.5 each.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> beliefs = jf.Gaussian(jnp.array([[-1.0, 1.0]]), jnp.full((1, 1, 2), 0.5))
        >>> jf.mixture_moments(beliefs, jnp.zeros(2)).covariance.tolist()
        [[1.5]]
    """
    if not isinstance(beliefs, Gaussian | GaussianRoot):
        raise TypeError(f"beliefs must be a Gaussian or a GaussianRoot; got a {type(beliefs).__name__}.")
    checks.floating("log_weights", log_weights)
    shapes = [leaf.shape for leaf in jax.tree.leaves(beliefs)]
    if log_weights.ndim != 1 or [len(shape) for shape in shapes] != [2, 3]:
        raise ValueError(
            "beliefs and log_weights must have the shapes (n, k), (n, n, k) and (k,), with the components along the "
            f"last axis; got {shapes[0]}, {shapes[1]} and {log_weights.shape}."
        )
    if {shape[-1] for shape in shapes} != {log_weights.size}:
        raise ValueError(
            f"beliefs must have as many components along the last axis as log_weights, {log_weights.size}; "
            f"got the shapes {shapes[0]} and {shapes[1]}."
        )
    return matched(manifold, beliefs, weights.linear(log_weights))


def matched(manifold: Manifold, beliefs: Belief, probabilities: Float[Array, " k"]) -> Belief:
    """Belief with the moments of a mixture whose components lie along the last axis, given their probabilities."""
    if manifold.flat:
        return _matched(beliefs, probabilities)
    origin = beliefs.mean[:, jnp.argmax(probabilities)]
    tangents = jax.vmap(lambda belief: to_tangent(manifold, origin, belief), -1, -1)(beliefs)
    return retract_belief(manifold, origin, _matched(tangents, probabilities))


def _matched(beliefs: Belief, probabilities: Array) -> Belief:
    counts = probabilities > 0
    of_mean = jnp.where(counts, beliefs.mean, 0.0)
    mean = jnp.sum(of_mean * probabilities, axis=-1)
    apart = jnp.where(counts, of_mean - mean[:, None], 0.0)
    if isinstance(beliefs, Gaussian):
        inside = jnp.sum(jnp.where(counts, beliefs.covariance, 0.0) * probabilities, axis=-1)
        return Gaussian(mean, inside + factor.outer(apart * probabilities, apart))
    scale = linalg.safe_sqrt(probabilities)
    inside = (jnp.where(counts, beliefs.root, 0.0) * scale).reshape(mean.size, -1)
    return GaussianRoot(mean, linalg.tria(jnp.hstack([inside, apart * scale])))
