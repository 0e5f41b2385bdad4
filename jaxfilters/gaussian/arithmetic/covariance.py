"""What the arithmetics on covariances share: the measurement update as one function with a derivative of its own.

At the optimal gain the posterior does not change with the gain, to first order; so the derivative needs neither that
of the gain nor that of the Cholesky factor, and costs about as much as the update.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters._xla.materialize import materialized
from jaxfilters.gaussian.arithmetic import factor, info
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math import linalg


def predict(
    belief: Gaussian,
    F: Float[Array, "k n"],
    Q: Float[Array, "k k"],
    b: Float[Array, " k"] | float = 0.0,
    lost: Float[Array, "k _"] | None = None,
) -> Gaussian:
    """Belief in `x' = F x + b + q`, q ~ N(0, Q); `lost` is a root of more noise."""
    return Gaussian(factor.apply(F, belief.mean) + b, factor.turned(F, belief.covariance) + total(Q, lost))


def noise_root(
    R: Float[Array, "m m"], mask: Bool[Array, " m"] | None = None, lost: Float[Array, "m _"] | None = None
) -> Float[Array, "m m"]:
    """Lower root of the noise R and of what is lost beside it, zero where masked."""
    return factor.root(among(mask, total(R, lost)))


def total(Q: Float[Array, "k k"], lost: Float[Array, "k _"] | None) -> Float[Array, "k k"]:
    """Covariance of the noise Q and of what is lost beside it, of which a root is given."""
    return Q if lost is None or lost.shape[1] == 0 else Q + factor.outer(lost, lost)


class Update(NamedTuple):
    """A belief with covariance P conditioned on `innovation = H (x - mean) + r`, r ~ N(0, R)."""

    shift: Float[Array, " n"]
    """Of the mean."""
    covariance: Float[Array, "n n"]
    root: Float[Array, "m m"]
    """Lower root of the innovation covariance; zero rows and columns for components that add nothing."""
    gain: Float[Array, "n m"]
    log_density: Float[Array, ""]
    """`-inf` where the innovation covariance is not positive semidefinite; then all else is as if nothing was seen."""
    nis: Float[Array, ""]


Form = Callable[[Array, Array, Array, Array, Array], Array]
"""`(P, H, R, gain, W) -> P` after the update, where `W = P H^T root^-T`."""


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def condition(
    form: Form,
    P: Float[Array, "n n"],
    H: Float[Array, "m n"],
    R: Float[Array, "m m"],
    innovation: Float[Array, " m"],
    seen: Bool[Array, " m"],
) -> Update:
    """The update with what was seen, and with the covariance that `form` makes of it.

    `innovation` is 0 where nothing was seen; there H and R may hold anything. The derivative takes P and R to be
    symmetric and the gain to be optimal.
    """
    return _condition(form, P, *_cleared(H, R, seen), innovation)[0]


def _condition(form, P, H, R, innovation):
    # Every product is A B or A B^T: XLA has no fast kernel for A^T B on a CPU.
    PH = factor.outer(P, H)
    L, counts, definite = factor.independent_root(linalg.matmul(H, PH) + R)
    inverse = factor.solve(L, jnp.diag(counts.astype(L.dtype)))
    W, whitened = factor.outer(PH, inverse), factor.apply(inverse, innovation)
    gain = linalg.matmul(W, inverse)
    log_density, nis = info.evidence(factor.diagonal(L), counts, whitened)
    update = Update(
        factor.apply(W, whitened),
        form(P, H, R, gain, W),
        jnp.where(counts, L, 0.0),
        gain,
        jnp.where(definite, log_density, -jnp.inf),
        nis,
    )
    return update, inverse, whitened, PH


def _cleared(H: Array, R: Array, seen: Array) -> tuple[Array, Array]:
    def clear(H, R):
        return info.observed(seen, H), among(seen, R)

    if max(H.shape) <= factor.UNROLLED:
        H, R = clear(H, R)
        return materialized(H), materialized(R)
    # Selections would be computed inside the products that follow, and slow them down by more than a branch costs.
    return jax.lax.cond(jnp.all(seen), lambda H, R: (H, R), clear, H, R)


@condition.defjvp
def _condition_jvp(form, primals, tangents):
    P, H, R, innovation, seen = primals
    dP, dH, dR, d_innovation, _ = tangents
    H, R = _cleared(H, R, seen)
    dH, dR = info.observed(seen, dH), among(seen, dR)
    update, inverse, whitened, PH = _condition(form, P, H, R, innovation)
    K, posterior = update.gain, update.covariance
    left = kept(K, H)
    weights = factor.apply(inverse.T, whitened)
    pull = factor.apply(H.T, weights)

    unexplained = d_innovation - factor.apply(dH, factor.apply(P, pull)) - factor.apply(dR, weights)
    shift = (
        factor.apply(left, factor.apply(dP, pull))
        + factor.apply(posterior, factor.apply(dH.T, weights))
        + factor.apply(K, unexplained)
    )
    KdH = linalg.matmul(linalg.matmul(K, dH), posterior)
    covariance = factor.turned(left, dP) + factor.turned(K, dR) - KdH - KdH.T

    half = linalg.matmul(dH, PH)
    precision = factor.inner(inverse, inverse)
    explained = jnp.outer(weights, weights)

    def along_S(M):
        # The inner product of M and dS.
        return jnp.sum(M * (2 * half + dR)) + jnp.sum(factor.inner(H, linalg.matmul(M, H)) * dP)

    along_innovation = jnp.sum(weights * d_innovation)
    log_density = 0.5 * along_S(explained - precision) - along_innovation
    nis = 2 * along_innovation - along_S(explained)

    dS = half + half.T + factor.turned(H, dP) + dR
    root = factor.root_tangent(update.root, dS)
    seen_less = linalg.matmul(left, factor.outer(dP, H)) + factor.outer(posterior, dH)
    gain = linalg.matmul(seen_less - linalg.matmul(K, half + dR), precision)
    return update, Update(shift, covariance, root, gain, log_density, nis)


def kept(gain: Float[Array, "n m"], H: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """What of a deviation from the mean remains after the update, `I - K H`."""
    return jnp.eye(gain.shape[0], dtype=gain.dtype) - linalg.matmul(gain, H)


def update(
    form: Form,
    belief: Gaussian,
    y: Float[Array, " m"],
    H: Float[Array, "m n"],
    R: Float[Array, "m m"],
    y_hat: Float[Array, " m"] | None,
    mask: Bool[Array, " m"] | None,
    lost: Float[Array, "m _"] | None,
) -> tuple[Gaussian, info.KalmanInfo]:
    """Belief after a measurement, and its diagnostics: `update` of the arithmetic that has this form."""
    R = among(mask, total(R, lost))
    usable = info.rows(belief.mean, y, H, R, y_hat, mask)
    found = condition(form, belief.covariance, H, R, usable.deviation, usable.seen)
    posterior = Gaussian(belief.mean + found.shift, found.covariance)
    return posterior, info.report(usable, found.root, info.Evidence(found.log_density, found.nis))


def rts(
    form: Form,
    belief: Gaussian,
    following: Gaussian,
    F: Float[Array, "k n"],
    Q: Float[Array, "k k"],
    b: Float[Array, " k"] | float,
    lost: Float[Array, "k _"] | None,
) -> Gaussian:
    """Belief given the future too: `rts` of the arithmetic that has this form."""
    surprise = following.mean - factor.apply(F, belief.mean) - b
    found = condition(form, belief.covariance, F, total(Q, lost), surprise, jnp.ones(surprise.shape, bool))
    return Gaussian(belief.mean + found.shift, found.covariance + factor.turned(found.gain, following.covariance))


def among(mask: Bool[Array, " m"] | None, R: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """The rows and columns of R, zero where masked; all of R without a mask."""
    return R if mask is None else jnp.where(mask[:, None] & mask, R, 0.0)
