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
    added_root: Float[Array, "k _"] | None = None,
) -> Gaussian:
    """Belief in `x' = F x + b + q`, q ~ N(0, Q); `added_root` is a root of more noise."""
    mean = factor.apply(F, belief.mean)
    covariance = factor.turned(F, belief.covariance) + total(Q, added_root)
    return Gaussian(mean if isinstance(b, float) and b == 0.0 else mean + b, covariance)


def noise_root(
    R: Float[Array, "m m"], mask: Bool[Array, " m"] | None = None, added_root: Float[Array, "m _"] | None = None
) -> Float[Array, "m m"]:
    """Lower root of the noise R and of what is added to it by a root, zero where masked."""
    return factor.root(among(mask, total(R, added_root)))


def total(Q: Float[Array, "k k"], added_root: Float[Array, "k _"] | None) -> Float[Array, "k k"]:
    """Covariance of the noise Q and of what is added to it by a root, of which a root is given."""
    return Q if added_root is None or added_root.shape[1] == 0 else Q + factor.outer(added_root, added_root)


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
    mean: Float[Array, " n"] | None
    """The predicted mean, where `rows` do not depend on it: no row can be used where it is not finite."""


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
    """Finite."""
    R: Float[Array, "m m"]
    """Finite."""
    PH: Float[Array, "n m"]
    """`P H^T`."""
    L: Float[Array, "m m"]
    """Lower root of the innovation covariance, rows and columns of the identity for components that do not count."""
    counts: Bool[Array, " m"]
    valid: Bool[Array, " m"]
    definite: Bool[Array, ""]


def _condition(form, P, H, R, innovation, usable):
    # Every product is A B or A B^T: XLA has no fast kernel for A^T B on a CPU.
    whiten = _whitening_small if len(H) <= factor.UNROLLED else _whitening
    found = whiten(P, H, R, usable)
    inverse = factor.inverse(found.L, found.counts)
    W, whitened = factor.outer(found.PH, inverse), factor.apply(inverse, innovation)
    gain = linalg.matmul(W, inverse)
    log_density, nis = info.evidence(factor.diagonal(found.L), found.counts, whitened)
    update = Update(
        factor.apply(W, whitened),
        form(P, found.H, found.R, gain, W),
        jnp.where(found.counts, found.L, 0.0),
        gain,
        jnp.where(found.definite, log_density, -jnp.inf),
        nis,
        found.valid,
    )
    return update, found, inverse, whitened


def _whitening_small(P, H, R, usable):
    valid = jnp.ones(H.shape[:1], bool)
    if usable is not None:
        valid = materialized(usable.rows & _finite(H, R, usable.mean))
        H, R = _cleared(H, R, valid)
    PH = factor.outer(P, H)
    L, counts, definite = factor.independent_root(linalg.matmul(H, PH) + R)
    return _Whitening(H, R, PH, L, counts, valid, definite)


def _cleared(H, R, valid):
    def clear(H, R):
        return info.observed(valid, H), among(valid, R)

    if max(H.shape) <= factor.UNROLLED:
        H, R = clear(H, R)
        return materialized(H), materialized(R)
    # Selections would be computed inside the products that follow, and slow them down by more than a branch costs.
    return jax.lax.cond(jnp.all(valid), lambda H, R: (H, R), clear, H, R)


def _whitening(P, H, R, usable):
    valid = np.ones(H.shape[:1], bool)
    if usable is not None:
        valid = usable.rows & _finite(H, R, usable.mean)
        # Rows that are not valid get no gain below; that nothing in them is NaN is all that they need.
        H, R = (jnp.where(jnp.isfinite(A), A, 0.0) for A in (H, R))
    PH = factor.outer(P, H)
    S = linalg.matmul(H, PH) + R
    L = factor.plain_root(S)

    def as_it_is(_H, _PH, _R, L, valid):
        return L, valid, jnp.ones((), bool)

    def repaired(H, PH, R, _L, valid):
        # Computed again, because to keep it for this branch would cost the other a copy.
        S = among(valid, linalg.matmul(H, PH) + R)
        L, counts = factor.loosened_root(S)
        return L, counts, jnp.any(counts) | jnp.all(S == 0)

    margins = jnp.where(valid, factor.margins(L, S), -1.0)
    L, counts, definite = jax.lax.cond(jnp.min(margins) > 0, as_it_is, repaired, H, PH, R, L, valid)
    return _Whitening(H, R, PH, L, counts, valid, definite)


def _finite(H, R, mean):
    """Which rows are finite in H and R, none where the mean is not: sums show NaN and infinity."""
    sums = jnp.sum(H, axis=1) + jnp.sum(R, axis=1)
    return jnp.isfinite(sums if mean is None else sums + jnp.sum(0.0 * mean))


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
    valid = np.zeros(update.valid.shape, jax.dtypes.float0)
    return update, Update(shift, covariance, root, gain, log_density, nis, valid)


def kept(gain: Float[Array, "n m"], H: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """What of a deviation from the mean remains after the update, `I - K H`."""
    return -linalg.matmul(gain, H) + factor.identity(gain.shape[0], gain.dtype)


def update(
    form: Form,
    belief: Gaussian,
    y: Float[Array, " m"],
    H: Float[Array, "m n"],
    R: Float[Array, "m m"],
    y_hat: Float[Array, " m"] | None,
    mask: Bool[Array, " m"] | None,
    added_root: Float[Array, "m _"] | None,
) -> tuple[Gaussian, info.KalmanInfo]:
    """Belief after a measurement, and its diagnostics: `update` of the arithmetic that has this form."""
    R = among(mask, total(R, added_root))
    # A product with the mean is not finite where the mean is not; of other predictions that is not known.
    y_hat, mean = (factor.apply(H, belief.mean), None) if y_hat is None else (y_hat, belief.mean)
    read = jnp.isfinite(y) if mask is None else jnp.isfinite(y) & mask
    usable = jnp.isfinite(y - y_hat) if mask is None else jnp.isfinite(y - y_hat) & mask
    deviation = jnp.where(usable, y - y_hat, 0.0)
    found = condition(form, belief.covariance, H, R, deviation, Usable(usable, mean))
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
    added_root: Float[Array, "k _"] | None,
) -> Gaussian:
    """Belief given the future too: `rts` of the arithmetic that has this form."""
    surprise = following.mean - factor.apply(F, belief.mean) - b
    found = condition(form, belief.covariance, F, total(Q, added_root), surprise)
    return Gaussian(belief.mean + found.shift, found.covariance + factor.turned(found.gain, following.covariance))


def backward(
    form: Form,
    belief: Gaussian,
    F: Float[Array, "k n"],
    Q: Float[Array, "k k"],
    b: Float[Array, " k"] | float,
    added_root: Float[Array, "k _"] | None,
) -> tuple[Float[Array, "n k"], Gaussian]:
    """State given the next one, as a linear function of it: `backward` of the arithmetic that has this form."""
    found = condition(form, belief.covariance, F, total(Q, added_root), -factor.apply(F, belief.mean) - b)
    return found.gain, Gaussian(belief.mean + found.shift, found.covariance)


def among(mask: Bool[Array, " m"] | None, R: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """The rows and columns of R, zero where masked; all of R without a mask."""
    return R if mask is None else jnp.where(mask[:, None] & mask, R, 0.0)
