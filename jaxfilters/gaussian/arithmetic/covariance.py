"""What the arithmetics on covariances share: the measurement update as one function with a derivative of its own.

At the optimal gain the posterior does not change with the gain, to first order; so the derivative needs neither that
of the gain nor that of the Cholesky factor, and costs about as much as the update.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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
    """`-inf` where the innovation covariance is not positive semidefinite; then all else is as without observation."""
    nis: Float[Array, ""]
    valid: Bool[Array, " m"]
    """Which components have a usable reading, and finite rows of H and R."""


class Usable(NamedTuple):
    """Which readings can be used."""

    rows: Bool[Array, " m"]
    """Neither masked nor invalid; the innovation is 0 in the other rows, where H and R may hold anything."""
    mean: Float[Array, " n"]
    """The predicted mean: where it is not finite, no row can be used."""


Form = Callable[[Array, Array, Array, Array, Array], Array]
"""`(P, H, R, gain, W) -> P` after the update, where `W = P H^T root^-T`."""


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def condition(
    form: Form,
    P: Float[Array, "n n"],
    H: Float[Array, "m n"],
    R: Float[Array, "m m"],
    innovation: Float[Array, " m"],
    usable: Usable | None = None,
) -> Update:
    """The update with the usable components, and with the covariance that `form` makes of it.

    Without `usable` all components are used, and nothing is tested. The derivative takes P and R to be symmetric and
    the gain to be optimal.
    """
    return _condition(form, P, H, R, innovation, usable)[0]


class _Whitening(NamedTuple):
    """The innovation covariance of the components that count, and what it was made of."""

    H: Float[Array, "m n"]
    """Zero in rows that are not valid."""
    R: Float[Array, "m m"]
    """Zero in rows and columns that are not valid."""
    PH: Float[Array, "n m"]
    """`P H^T`."""
    upper: Float[Array, "m m"]
    """U with `U^T U` the innovation covariance, rows and columns of the identity for components that do not count."""
    counts: Bool[Array, " m"]
    valid: Bool[Array, " m"]
    definite: Bool[Array, ""]


def _condition(form, P, H, R, innovation, usable):
    # Every product is A B or A B^T: XLA has no fast kernel for A^T B on a CPU. The innovation covariance is held as an
    # upper factor: stored by rows, it is the lower factor stored by columns that LAPACK reads and writes.
    whiten = _whitening_small if len(H) <= factor.UNROLLED else _whitening
    found = whiten(P, H, R, usable)
    inverse = factor.inverse_of_upper(found.upper, found.counts)
    W, whitened = linalg.matmul(found.PH, inverse), factor.apply(inverse.T, innovation)
    gain = factor.outer(W, inverse)
    log_density, nis = info.evidence(factor.diagonal(found.upper), found.counts, whitened)
    root = jnp.where(found.counts, found.upper.T, 0.0)
    update = Update(
        factor.apply(W, whitened),
        form(P, found.H, found.R, gain, W),
        root,
        gain,
        jnp.where(found.definite, log_density, -jnp.inf),
        nis,
        found.valid,
    )
    return update, found, inverse, whitened


def _whitening_small(P, H, R, usable):
    valid = jnp.ones(H.shape[:1], bool)
    if usable is not None:
        valid = materialized(_valid(usable.rows, usable.mean, H, R))
        H, R = _cleared(H, R, valid)
    PH = factor.outer(P, H)
    L, counts, definite = factor.independent_root(linalg.matmul(H, PH) + R)
    return _Whitening(H, R, PH, L.T, counts, valid, definite)


def _cleared(H, R, valid):
    def clear(H, R):
        return info.observed(valid, H), among(valid, R)

    if max(H.shape) <= factor.UNROLLED:
        H, R = clear(H, R)
        return materialized(H), materialized(R)
    # Selections would be computed inside the products that follow, and slow them down by more than a branch costs.
    return jax.lax.cond(jnp.all(valid), lambda H, R: (H, R), clear, H, R)


def _whitening(P, H, R, usable):
    def innovation_covariance(H, R):
        PH = factor.outer(P, H)
        return PH, linalg.matmul(H, PH) + R

    PH, S = innovation_covariance(H, R)
    upper = factor.upper_root(S)
    margins = factor.margins(upper)
    if usable is None:
        rows, mean = np.ones(H.shape[:1], bool), ()
    else:
        # NaN and infinity in H and R reach the margins: rows need no test of their own.
        (rows, mean), margins = usable, jnp.where(usable.rows, margins, -1.0) + jnp.sum(0.0 * usable.mean)

    def as_it_is(H, R, rows, _mean, PH, upper):
        return _Whitening(H, R, PH, upper, rows, rows, jnp.ones((), bool))

    def repaired(H, R, rows, mean, _PH, _upper):
        if usable is not None:
            rows = _valid(rows, mean, H, R)
            H, R = info.observed(rows, H), among(rows, R)
        PH, S = innovation_covariance(H, R)
        upper, counts = factor.loosened_root(S)
        return _Whitening(H, R, PH, upper, counts, rows, jnp.any(counts) | jnp.all(S == 0))

    return jax.lax.cond(jnp.min(margins) > 0, as_it_is, repaired, H, R, rows, mean, PH, upper)


def _valid(rows, mean, H, R):
    """Which of the rows are finite in H and R, none where the mean is not: sums show NaN and infinity."""
    return rows & jnp.isfinite(jnp.sum(H, axis=1) + jnp.sum(R, axis=1) + jnp.sum(0.0 * mean))


@condition.defjvp
def _condition_jvp(form, primals, tangents):
    P, H, R, innovation, usable = primals
    dP, dH, dR, d_innovation, _ = tangents
    update, found, inverse, whitened = _condition(form, P, H, R, innovation, usable)
    H, R, PH = found.H, found.R, found.PH
    if usable is not None:
        dH, dR = info.observed(update.valid, dH), among(update.valid, dR)
    K, posterior = update.gain, update.covariance
    left = kept(K, H)
    weights = factor.apply(inverse, whitened)
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
    precision = factor.outer(inverse, inverse)
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
    valid = np.zeros(update.valid.shape, jax.dtypes.float0)
    return update, Update(shift, covariance, root, gain, log_density, nis, valid)


def kept(gain: Float[Array, "n m"], H: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """What of a deviation from the mean remains after the update, `I - K H`."""
    return factor.identity(gain.shape[0], gain.dtype) - linalg.matmul(gain, H)


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
    y_hat = factor.apply(H, belief.mean) if y_hat is None else y_hat
    read = jnp.isfinite(y) if mask is None else jnp.isfinite(y) & mask
    usable = jnp.isfinite(y - y_hat) if mask is None else jnp.isfinite(y - y_hat) & mask
    deviation = jnp.where(usable, y - y_hat, 0.0)
    found = condition(form, belief.covariance, H, R, deviation, Usable(usable, belief.mean))
    posterior = Gaussian(belief.mean + found.shift, found.covariance)
    used = info.used_rows(deviation, read, found.valid, mask)
    return posterior, info.report(used, found.root, info.Evidence(found.log_density, found.nis))


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
    found = condition(form, belief.covariance, F, total(Q, lost), surprise)
    return Gaussian(belief.mean + found.shift, found.covariance + factor.turned(found.gain, following.covariance))


def among(mask: Bool[Array, " m"] | None, R: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """The rows and columns of R, zero where masked; all of R without a mask."""
    return R if mask is None else jnp.where(mask[:, None] & mask, R, 0.0)
