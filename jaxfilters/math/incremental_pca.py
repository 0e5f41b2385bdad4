r"""Incremental principal component analysis: the candid covariance-free algorithm, and exact moments.

The candid covariance-free algorithm (CCIPCA) keeps a vector $v_j$ for each component, whose direction is the component
and whose length is its variance, and needs no covariance matrix (J. Weng, Y. Zhang and W. Hwang, "Candid
covariance-free incremental principal component analysis", IEEE PAMI 25(8), 2003). `Moments` is the exact alternative
for vectors that are short enough for a covariance matrix.

The mean is not part of `IncrementalPCA`: `running_mean` updates it, and may take other samples than the components do.
Earlier samples were centred with earlier means, an error that decays as the inverse of their number.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

from jaxfilters._full_precision import qr
from jaxfilters.math.linalg import safe_norm


class IncrementalPCA(NamedTuple):
    """The state of the candid covariance-free algorithm for b components of vectors (d,)."""

    vectors: Float[Array, "b d"]
    """Vectors whose direction is a component and whose length is its variance; zero for components without a sample."""
    residual_energy: Float[Array, ""]
    """Mean squared length of the residuals of the samples."""
    num_samples: Int32[Array, ""]
    """Number of accepted samples: those that are finite and not zero."""


class PrincipalComponents(NamedTuple):
    """Principal components, in the order of decreasing variance."""

    basis: Float[Array, "d b"]
    """Orthonormal columns; zero if there is no such component yet."""
    variances: Float[Array, " b"]
    """Variances of the components."""


def start(size: int, num_components: int) -> IncrementalPCA:
    """The state before the first sample, for vectors of `size` numbers.

    Raises:
        ValueError: Unless `1 <= num_components <= size`.

    Examples:
        >>> from jaxfilters.math import incremental_pca
        >>> pca = incremental_pca.start(size=3, num_components=2)
        >>> print(pca.vectors.shape, pca.num_samples)
        (2, 3) 0
    """
    _check_sizes(size, num_components)
    return IncrementalPCA(
        jnp.zeros((num_components, size), dtype=float), jnp.zeros((), dtype=float), jnp.zeros((), dtype=jnp.int32)
    )


def update(
    pca: IncrementalPCA,
    deviation: Float[Array, " d"],
    *,
    amnesic: float | Float[Array, ""] = 2.0,
    ramp: int | Int32[Array, ""] = 20,
) -> IncrementalPCA:
    r"""The state after one more sample, given as its deviation $u$ from the mean.

    For each component in turn $v \leftarrow \frac{n-1-l}{n} v + \frac{1+l}{n} u u^T \hat v$, and the part of the sample
    along the new direction is subtracted before the next one, $u \leftarrow u - u^T \hat v \hat v$ (Weng et al. 2003,
    section 2). A component is initialised with the first residual that reaches it, as $v = u \|u\|$: then the
    variances are quadratic in the data, and in one dimension exactly the mean square.

    Args:
        pca: The state so far.
        deviation: (d,): `x - mean`. A deviation that is zero or not finite changes nothing.
        amnesic: The amnesic parameter $l$, by which new samples have more weight. Without it a component with a poor
            initial direction converges slowly; from the first sample on it would discard the state.
        ramp: Number of samples up to which $l$ is 0.

    Raises:
        ValueError: If `deviation` is not (d,).

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import incremental_pca
        >>> pca = incremental_pca.start(size=3, num_components=1)
        >>> pca = incremental_pca.update(pca, jnp.array([0.0, 2.0, 0.0]))
        >>> print(incremental_pca.principal_components(pca).variances)
        [4.]
    """
    if jnp.shape(deviation) != pca.vectors.shape[1:]:
        raise ValueError(f"deviation must be {pca.vectors.shape[1:]}, as in start; got {jnp.shape(deviation)}.")
    size = safe_norm(jnp.where(jnp.isfinite(deviation), deviation, 0.0))
    accepted = jnp.all(jnp.isfinite(deviation)) & (size > 0)
    count = pca.num_samples + accepted.astype(jnp.int32)
    n = jnp.maximum(count, 1).astype(pca.vectors.dtype)
    weight = jnp.minimum(jnp.where(count > ramp, 1 + amnesic, 1.0) / n, 1.0)
    # A residual below rounding error has no direction.
    threshold = size * max(1e-9, 32 * float(jnp.finfo(pca.vectors.dtype).eps))

    def advance(residual: Array, v: Array) -> tuple[Array, Array]:
        length, left = safe_norm(v), safe_norm(residual)
        direction = v / jnp.where(length > 0, length, 1.0)
        turned = (1 - weight) * v + weight * residual * jnp.sum(residual * direction)
        v = jnp.where(left > threshold, jnp.where(length > 0, turned, residual * left), v)
        length = safe_norm(v)
        direction = v / jnp.where(length > 0, length, 1.0)
        return residual - jnp.sum(residual * direction) * direction, v

    residual, vectors = jax.lax.scan(advance, jnp.where(accepted, deviation, 0.0), pca.vectors)
    energy = (1 - weight) * pca.residual_energy + weight * jnp.sum(jnp.square(residual))
    return IncrementalPCA(
        jnp.where(accepted, vectors, pca.vectors), jnp.where(accepted, energy, pca.residual_energy), count
    )


def principal_components(pca: IncrementalPCA) -> PrincipalComponents:
    """The orthonormal basis and the variances. Each column keeps the sign of its vector, so that no coordinate flips.

    A vector whose sine to the span of those with larger variances is at most 0.001 is not a component.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import incremental_pca
        >>> pca = incremental_pca.start(size=2, num_components=2)
        >>> for deviation in jnp.array([[0.0, 2.0], [1.0, 0.0], [0.0, -2.0], [-1.0, 0.0]]):
        ...     pca = incremental_pca.update(pca, deviation)
        ...
        >>> print(abs(incremental_pca.principal_components(pca).basis).round(1))
        [[0. 1.]
         [1. 0.]]
    """
    variances = safe_norm(pca.vectors)
    order = jnp.argsort(-variances)
    vectors, variances = pca.vectors[order], variances[order]
    is_initialised = variances > 0
    directions = vectors / jnp.where(is_initialised, variances, 1.0)[:, None]
    Q, R = qr(directions.T)
    own = jnp.diagonal(R)
    basis = Q * jnp.where(own < 0, -1.0, 1.0)
    is_component = is_initialised & (jnp.abs(own) > 1e-3)
    return PrincipalComponents(jnp.where(is_component, basis, 0.0), jnp.where(is_component, variances, 0.0))


@jax.jit
def explained_variance_ratio(pca: IncrementalPCA) -> Float[Array, ""]:
    """The fraction of the mean squared deviation that the components explain, from 0 to 1; 0 without a sample.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import incremental_pca
        >>> pca = incremental_pca.start(size=3, num_components=1)
        >>> pca = incremental_pca.update(pca, jnp.array([0.0, 2.0, 0.0]))
        >>> print(incremental_pca.explained_variance_ratio(pca))
        1.0
    """
    explained = jnp.sum(safe_norm(pca.vectors))
    total = explained + pca.residual_energy
    return explained / jnp.where(total > 0, total, 1.0)


def running_mean(mean: Float[Array, " d"], x: Float[Array, " d"], count: Int32[Array, ""] | int) -> Float[Array, " d"]:
    """The mean of `count` vectors, from the mean of all but the last one.

    Args:
        mean: (d,): mean of the first `count - 1` vectors.
        x: (d,): the last vector.
        count: Number of vectors, at least 1.

    Raises:
        ValueError: If `x` does not have the shape of `mean`.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import incremental_pca
        >>> print(incremental_pca.running_mean(jnp.array([1.0, 2.0]), jnp.array([4.0, 2.0]), 3))
        [2. 2.]
    """
    if jnp.shape(x) != jnp.shape(mean):
        raise ValueError(f"x must have the shape of mean, {jnp.shape(mean)}; got {jnp.shape(x)}.")
    return mean + (x - mean) / count


def change_basis(
    coordinates: Float[Array, "b n"],
    mean: Float[Array, " d"],
    basis: Float[Array, "d b"],
    new_mean: Float[Array, " d"],
    new_basis: Float[Array, "d c"],
) -> Float[Array, "c n"]:
    """Coordinates with respect to a new mean and basis, by orthogonal projection.

    Args:
        coordinates: (b, n): coordinates of n vectors with respect to the old mean and basis.
        mean: (d,): the old mean.
        basis: (d, b): the old basis.
        new_mean: (d,): the new mean.
        new_basis: (d, c): the new basis, with orthonormal columns.

    Returns:
        (c, n).

    Raises:
        ValueError: If shapes do not match.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import incremental_pca
        >>> axes = jnp.eye(2)
        >>> coordinates = jnp.array([[3.0], [1.0]])
        >>> print(incremental_pca.change_basis(coordinates, jnp.zeros(2), axes, jnp.array([1.0, 0.0]), axes[:, ::-1]))
        [[1.]
         [2.]]
    """
    sizes = {jnp.shape(mean)[:1], jnp.shape(basis)[:1], jnp.shape(new_mean)[:1], jnp.shape(new_basis)[:1]}
    if len(sizes) != 1 or jnp.shape(coordinates)[:1] != jnp.shape(basis)[1:]:
        raise ValueError(
            f"coordinates, mean, basis, new_mean and new_basis must be (b, n), (d,), (d, b), (d,) and (d, c); got "
            f"{[jnp.shape(one) for one in (coordinates, mean, basis, new_mean, new_basis)]}."
        )
    vectors = mean[:, None] + jnp.matmul(basis, coordinates, precision="highest")
    return jnp.matmul(new_basis.T, vectors - new_mean[:, None], precision="highest")


class Moments(NamedTuple):
    """The mean and the scatter matrix of the samples so far."""

    mean: Float[Array, " d"]
    """Mean of the samples."""
    scatter: Float[Array, "d d"]
    """Sum of the outer products of deviations from the mean."""
    num_samples: Int32[Array, ""]
    """Number of finite samples."""


def start_moments(size: int) -> Moments:
    """The moments before the first sample, for vectors of `size` numbers.

    Raises:
        ValueError: If `size` is less than 1.

    Examples:
        >>> from jaxfilters.math import incremental_pca
        >>> print(incremental_pca.start_moments(2).scatter)
        [[0. 0.]
         [0. 0.]]
    """
    if size < 1:
        raise ValueError(f"size must be at least 1; got {size}.")
    return Moments(jnp.zeros(size, dtype=float), jnp.zeros((size, size), dtype=float), jnp.zeros((), dtype=jnp.int32))


def update_moments(moments: Moments, x: Float[Array, " d"]) -> Moments:
    """The moments after one more sample; a sample that is not finite changes nothing.

    See B. P. Welford, "Note on a method for calculating corrected sums of squares and products", Technometrics 4(3),
    1962.

    Raises:
        ValueError: If `x` is not (d,).

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import incremental_pca
        >>> moments = incremental_pca.start_moments(1)
        >>> for x in jnp.array([[1.0], [2.0], [6.0]]):
        ...     moments = incremental_pca.update_moments(moments, x)
        ...
        >>> print(moments.mean, moments.scatter)
        [3.] [[14.]]
    """
    if jnp.shape(x) != moments.mean.shape:
        raise ValueError(f"x must be {moments.mean.shape}, as in start_moments; got {jnp.shape(x)}.")
    accepted = jnp.all(jnp.isfinite(x))
    count = moments.num_samples + accepted.astype(jnp.int32)
    before = jnp.where(accepted, x - moments.mean, 0.0)
    mean = moments.mean + before / jnp.maximum(count, 1)
    after = jnp.where(accepted, x - mean, 0.0)
    product = jnp.outer(before, after)
    return Moments(mean, moments.scatter + 0.5 * (product + product.T), count)


def exact_principal_components(moments: Moments, num_components: int) -> PrincipalComponents:
    """The eigenvectors and eigenvalues of the sample covariance `scatter / (num_samples - 1)`, with arbitrary signs.

    Raises:
        ValueError: Unless `1 <= num_components <= d`.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import incremental_pca
        >>> moments = incremental_pca.start_moments(2)
        >>> for x in jnp.array([[0.0, 2.0], [1.0, 0.0], [0.0, -2.0], [-1.0, 0.0]]):
        ...     moments = incremental_pca.update_moments(moments, x)
        ...
        >>> print(incremental_pca.exact_principal_components(moments, 1).variances.round(3))
        [2.667]
    """
    _check_sizes(moments.mean.shape[0], num_components)
    values, vectors = jnp.linalg.eigh(moments.scatter / jnp.maximum(moments.num_samples - 1, 1))
    return PrincipalComponents(vectors[:, ::-1][:, :num_components], jnp.maximum(values[::-1][:num_components], 0.0))


def _check_sizes(size: int, num_components: int) -> None:
    if not 1 <= num_components <= size:
        raise ValueError(f"num_components must be from 1 to {size}, the size of the vectors; got {num_components}.")
