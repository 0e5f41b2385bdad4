r"""Principal components of vectors that arrive one by one: candid covariance-free, and exact.

The candid covariance-free algorithm keeps a vector $v_j$ for each component, whose direction is the component and whose
length its variance, and needs no covariance matrix (J. Weng, Y. Zhang and W. Hwang, "Candid covariance-free incremental
principal component analysis", IEEE PAMI 25(8), 2003; Y. Sugano 2007, equations 3.20-3.25). `Moments` is the exact
alternative for vectors that are short enough for a covariance matrix.

The mean stays outside of `Subspace`: `running_mean` follows it, and a caller may let other vectors into it than into
the components. Old samples were centred with older means, an error that decays as the inverse of their number.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

from jaxfilters.math.linalg import safe_norm


class IncrementalPCA(NamedTuple):
    """Components so far."""

    vectors: Float[Array, "b d"]
    """Length the variance, direction the component, in the order in which they were begun; zero before that."""
    residual_energy: Float[Array, ""]
    """Mean square length of what the components leave of a sample."""
    num_samples: Int32[Array, ""]
    """Samples that were accepted: finite, and not zero."""


class Components(NamedTuple):
    """What the principal components are, the largest variance first."""

    basis: Float[Array, "d b"]
    """Orthonormal columns; zero where there is no component yet."""
    variances: Float[Array, " b"]


def start(size: int, num_components: int) -> IncrementalPCA:
    """No components yet, of vectors of `size` numbers.

    Raises:
        ValueError: Unless `1 <= num_components <= size`.
    """
    _check_sizes(size, num_components)
    return IncrementalPCA(
        jnp.zeros((num_components, size), dtype=float), jnp.zeros((), dtype=float), jnp.zeros((), dtype=jnp.int32)
    )


def update(
    subspace: IncrementalPCA,
    deviation: Float[Array, " d"],
    *,
    amnesic: float | Float[Array, ""] = 2.0,
    ramp: int | Int32[Array, ""] = 20,
) -> IncrementalPCA:
    r"""The components after one more sample, given as its deviation $u$ from the mean.

    For each component in turn $v \leftarrow \frac{n-1-l}{n} v + \frac{1+l}{n} u u^T \hat v$, and what the new direction
    explains is taken off before the next, $u \leftarrow u - u^T \hat v \hat v$ (equations 3.24 and 3.25). A component
    begins with the first residual that reaches it, $v = u \|u\|$: then variances scale with the square of the
    data, and in one dimension are their mean square exactly.

    Args:
        subspace: Components so far.
        deviation: `x - mean`. One that is zero or not finite changes nothing.
        amnesic: $l$, how much more than its share a new sample counts. Without it a component that began in a bad
            direction may never turn; with it from the first sample on, the algorithm would forget all it has.
        ramp: Number of samples up to which $l$ is 0.
    """
    size = safe_norm(jnp.where(jnp.isfinite(deviation), deviation, 0.0))
    accepted = jnp.all(jnp.isfinite(deviation)) & (size > 0)
    count = subspace.num_samples + accepted.astype(jnp.int32)
    n = jnp.maximum(count, 1).astype(subspace.vectors.dtype)
    share = jnp.minimum(jnp.where(count > ramp, 1 + amnesic, 1.0) / n, 1.0)
    # What rounding leaves of a sample that the components explain is no direction.
    least = size * max(1e-9, 32 * float(jnp.finfo(subspace.vectors.dtype).eps))

    def turn(residual: Array, v: Array) -> tuple[Array, Array]:
        length, left = safe_norm(v), safe_norm(residual)
        direction = v / jnp.where(length > 0, length, 1.0)
        turned = (1 - share) * v + share * residual * jnp.sum(residual * direction)
        v = jnp.where(left > least, jnp.where(length > 0, turned, residual * left), v)
        length = safe_norm(v)
        direction = v / jnp.where(length > 0, length, 1.0)
        return residual - jnp.sum(residual * direction) * direction, v

    residual, vectors = jax.lax.scan(turn, jnp.where(accepted, deviation, 0.0), subspace.vectors)
    energy = (1 - share) * subspace.residual_energy + share * jnp.sum(jnp.square(residual))
    return IncrementalPCA(
        jnp.where(accepted, vectors, subspace.vectors), jnp.where(accepted, energy, subspace.residual_energy), count
    )


def components(subspace: IncrementalPCA) -> Components:
    """Orthonormal basis and variances. Each column keeps the sign of its vector, so that coordinates do not flip.

    A vector that is within a thousandth of the span of those with larger variances is no component.
    """
    variances = safe_norm(subspace.vectors)
    order = jnp.argsort(-variances)
    vectors, variances = subspace.vectors[order], variances[order]
    begun = variances > 0
    directions = vectors / jnp.where(begun, variances, 1.0)[:, None]
    Q, R = jnp.linalg.qr(directions.T)
    own = jnp.diagonal(R)
    basis = Q * jnp.where(own < 0, -1.0, 1.0)
    is_component = begun & (jnp.abs(own) > 1e-3)
    return Components(jnp.where(is_component, basis, 0.0), jnp.where(is_component, variances, 0.0))


def contribution(subspace: IncrementalPCA) -> Float[Array, ""]:
    """Share of the mean square deviation that the components explain, from 0 to 1; 0 without a sample."""
    explained = jnp.sum(safe_norm(subspace.vectors))
    total = explained + subspace.residual_energy
    return explained / jnp.where(total > 0, total, 1.0)


def running_mean(mean: Float[Array, " d"], x: Float[Array, " d"], count: Int32[Array, ""] | int) -> Float[Array, " d"]:
    """Mean of `count` vectors from that of all but the last, `x` (equation 3.20)."""
    return mean + (x - mean) / count


def transfer(
    coordinates: Float[Array, "b n"],
    mean: Float[Array, " d"],
    basis: Float[Array, "d b"],
    new_mean: Float[Array, " d"],
    new_basis: Float[Array, "d c"],
) -> Float[Array, "c n"]:
    """Coordinates about a new mean and basis of the vectors nearest to those that had them about the old ones."""
    vectors = mean[:, None] + jnp.matmul(basis, coordinates, precision="highest")
    return jnp.matmul(new_basis.T, vectors - new_mean[:, None], precision="highest")


class Moments(NamedTuple):
    """Mean and covariance so far."""

    mean: Float[Array, " d"]
    scatter: Float[Array, "d d"]
    """Sum of the outer products of deviations from the mean."""
    num_samples: Int32[Array, ""]


def start_moments(size: int) -> Moments:
    """No samples yet, of vectors of `size` numbers."""
    return Moments(jnp.zeros(size, dtype=float), jnp.zeros((size, size), dtype=float), jnp.zeros((), dtype=jnp.int32))


def update_moments(moments: Moments, x: Float[Array, " d"]) -> Moments:
    """Mean and scatter after one more sample; one that is not finite changes nothing (Welford 1962)."""
    accepted = jnp.all(jnp.isfinite(x))
    count = moments.num_samples + accepted.astype(jnp.int32)
    before = jnp.where(accepted, x - moments.mean, 0.0)
    mean = moments.mean + before / jnp.maximum(count, 1)
    after = jnp.where(accepted, x - mean, 0.0)
    product = jnp.outer(before, after)
    return Moments(mean, moments.scatter + 0.5 * (product + product.T), count)


def principal(moments: Moments, num_components: int) -> Components:
    """Eigenvectors and eigenvalues of the sample covariance, `scatter / (num_samples - 1)`; the signs are arbitrary.

    Raises:
        ValueError: Unless `1 <= num_components <= d`.
    """
    _check_sizes(moments.mean.shape[0], num_components)
    values, vectors = jnp.linalg.eigh(moments.scatter / jnp.maximum(moments.num_samples - 1, 1))
    return Components(vectors[:, ::-1][:, :num_components], jnp.maximum(values[::-1][:num_components], 0.0))


def _check_sizes(size: int, num_components: int) -> None:
    if not 1 <= num_components <= size:
        raise ValueError(f"num_components must be from 1 to {size}, the length of the vectors; got {num_components}.")
