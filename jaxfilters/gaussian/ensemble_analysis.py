r"""Analysis schemes of the ensemble Kalman filter: how samples become consistent with an observation.

With deviations X of the samples and Y of their predicted observations, all schemes move the mean by the Kalman gain of
the sample covariances, $P_{xy} = X Y^T / (N - 1)$ and $P_{yy} = Y Y^T / (N - 1)$, and differ in the deviations.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import dot
from jaxfilters._xla.noise import standard_normal
from jaxfilters.gaussian.localization import Localization
from jaxfilters.math.linalg import cholesky, matmul, safe_sqrt, solve_triangular
from jaxfilters.typing import AnyKey


class Forecast(NamedTuple):
    """What an analysis works on. Of components that were not observed, all rows are zero, and those of R identity."""

    mean: Float[Array, " n"]
    deviations: Float[Array, "n k"]
    """Of the samples from their mean, inflated."""
    predicted: Float[Array, "m k"]
    """Observation of each sample, without noise."""
    observation: Float[Array, " m"]
    observed: Bool[Array, " m"]
    R: Float[Array, "m m"]
    """Covariance of the observation noise."""
    noise_root: Float[Array, "m m"]
    """Lower root of the covariance of the noise of all components, whether observed or not."""
    root: Float[Array, "m m"]
    """Lower root of the innovation covariance, localised."""
    localization: Localization | None

    @property
    def spread(self) -> Float[Array, "m k"]:
        """Deviations of the predicted observations from their mean."""
        return self.predicted - jnp.mean(self.predicted, axis=1, keepdims=True)

    @property
    def innovation(self) -> Float[Array, " m"]:
        """The observation minus the mean of the predicted observations."""
        return jnp.where(self.observed, self.observation - jnp.mean(self.predicted, axis=1), 0.0)


@runtime_checkable
class Analysis(Protocol):
    """Move the samples of a forecast to where its observation says: `(n, N)`, one sample a column."""

    def __call__(self, key: AnyKey, forecast: Forecast, /) -> Float[Array, "n k"]: ...


def perturbed_observations(key: AnyKey, forecast: Forecast) -> Float[Array, "n k"]:
    """Stochastic analysis: every sample is moved by the gain, towards the observation with noise of its own.

    G. Burgers, P. J. van Leeuwen and G. Evensen, "Analysis scheme in the ensemble Kalman filter", Monthly Weather
    Review 126, 1998.

    Examples:
        The samples -1 and 1 have the variance 2, as the noise: their mean moves halfway to the observation.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> samples, R = jnp.array([[-1.0, 1.0]]), jnp.array([[2.0]])
        >>> forecast = jf.ensemble.Forecast(
        ...     mean=jnp.zeros(1), deviations=samples, predicted=samples, observation=jnp.array([2.0]),
        ...     observed=jnp.array([True]), R=R, noise_root=jnp.sqrt(R), root=jnp.sqrt(R + 2.0), localization=None,
        ... )
        >>> after = jf.ensemble.perturbed_observations(jax.random.key(0), forecast)
        >>> round(float(after.mean()), 3)
        1.0
    """
    predicted, observed = forecast.predicted, forecast.observed[:, None]
    noise = _colored(forecast.noise_root, standard_normal(key, predicted.shape, predicted.dtype))
    noise = jnp.where(observed, noise - jnp.mean(noise, axis=1, keepdims=True), 0.0)
    innovations = jnp.where(observed, forecast.observation[:, None] + noise - predicted, 0.0)
    x = forecast.deviations
    return forecast.mean[:, None] + x + _gained(forecast, innovations) / (predicted.shape[1] - 1)


@jax.custom_jvp
def _colored(root: Float[Array, "m m"], noise: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """The product of root and noise, which for uncorrelated components is a scale for each."""
    scale = jnp.diagonal(root)
    is_diagonal = jnp.all(root == jnp.diag(scale))
    return jax.lax.cond(is_diagonal, lambda: scale[:, None] * noise, lambda: matmul(root, noise))


@_colored.defjvp
def _colored_jvp(primals, tangents):
    # Written out, because a correlation changes the product from zero on.
    (root, noise), (d_root, d_noise) = primals, tangents
    return _colored(root, noise), matmul(d_root, noise) + matmul(root, d_noise)


def _gained(forecast: Forecast, innovations: Float[Array, "m k"]) -> Float[Array, "n k"]:
    """Each sample's innovation times the gain, N - 1 times, with the smallest of the possible intermediate matrices.

    These are the cross-covariance (n, m), which localisation needs, and the matrix (k, k) of inner products between
    samples. The first keeps large ensembles linear in k; the second is smaller where both the state and the observation
    are longer than the ensemble.
    """
    x, spread = forecast.deviations, forecast.spread
    (n, k), m = x.shape, spread.shape[0]
    if forecast.localization is None and n * m > k * k:
        return matmul(x, matmul(spread.T, _solve(forecast.root, innovations)))
    cross = matmul(x, spread.T)
    if forecast.localization is not None:
        cross = forecast.localization.state * cross
    # The factorisation is applied to the shorter one of its neighbours.
    return (
        matmul(_solve(forecast.root, cross.T).T, innovations)
        if n < k
        else matmul(cross, _solve(forecast.root, innovations))
    )


def _solve(root: Float[Array, "m m"], rows: Float[Array, "m k"]) -> Float[Array, "m k"]:
    return solve_triangular(root, solve_triangular(root, rows), transpose=True)


def transform(key: AnyKey, forecast: Forecast) -> Float[Array, "n k"]:
    r"""Ensemble transform Kalman filter (ETKF): deviations times the symmetric root of $(I + S^T S)^{-1}$.

    $S = R^{-1/2} Y / \sqrt{N - 1}$. For linear observations the mean and the covariance of the samples are exactly
    those of the Kalman update of their moments before. With localisation it is the local filter (LETKF): each number
    of the state has a transform of its own, in which the precision of an observation is multiplied by its factor.
    B. R. Hunt, E. J. Kostelich and I. Szunyogh, "Efficient data assimilation for spatiotemporal chaos: a local ensemble
    transform Kalman filter", Physica D 230, 2007.

    Examples:
        The samples -1 and 1 have the variance 2, as the noise: the mean moves halfway, and the variance halves.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> samples, R = jnp.array([[-1.0, 1.0]]), jnp.array([[2.0]])
        >>> forecast = jf.ensemble.Forecast(
        ...     mean=jnp.zeros(1), deviations=samples, predicted=samples, observation=jnp.array([2.0]),
        ...     observed=jnp.array([True]), R=R, noise_root=jnp.sqrt(R), root=jnp.sqrt(R + 2.0), localization=None,
        ... )
        >>> after = jf.ensemble.transform(jax.random.key(0), forecast)
        >>> round(float(after.mean()), 3), round(float(after.var(ddof=1)), 3)
        (1.0, 1.0)
    """
    del key
    scale = jnp.sqrt(jnp.asarray(forecast.predicted.shape[1] - 1, forecast.R.dtype))
    if forecast.localization is None:
        root = cholesky(forecast.R)
        S, d = (solve_triangular(root, rows) / scale for rows in (forecast.spread, forecast.innovation))
        return forecast.mean[:, None] + _transformed(forecast.deviations, S, d)
    std = jnp.sqrt(_variances(forecast.R)) * scale
    S, d = forecast.spread / std[:, None], forecast.innovation / std

    def local(row: Array, factors: Array) -> Array:
        nearness = safe_sqrt(factors)
        return _transformed(row[None], nearness[:, None] * S, nearness * d)[0]

    return forecast.mean[:, None] + jax.vmap(local)(forecast.deviations, forecast.localization.state)


def _variances(R: Float[Array, "m m"]) -> Float[Array, " m"]:
    """The diagonal of a diagonal matrix, NaN of another one."""
    diagonal = jnp.diagonal(R)
    return jnp.where(jnp.any(jnp.diag(diagonal) != R), jnp.nan, diagonal)


def serial(key: AnyKey, forecast: Forecast) -> Float[Array, "n k"]:
    """Serial ensemble square-root filter (EnSRF): one observation after the other, without random numbers.

    The predicted observations are updated with the samples, so that `observe` is evaluated once. The noise of the
    observations must be uncorrelated. Without localisation the result for linear observations is exact, as that of
    `transform`. J. S. Whitaker and T. M. Hamill, "Ensemble data assimilation without perturbed observations", Monthly
    Weather Review 130, 2002.

    Examples:
        The samples -1 and 1 have the variance 2, as the noise: the mean moves halfway, and the variance halves.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> samples, R = jnp.array([[-1.0, 1.0]]), jnp.array([[2.0]])
        >>> forecast = jf.ensemble.Forecast(
        ...     mean=jnp.zeros(1), deviations=samples, predicted=samples, observation=jnp.array([2.0]),
        ...     observed=jnp.array([True]), R=R, noise_root=jnp.sqrt(R), root=jnp.sqrt(R + 2.0), localization=None,
        ... )
        >>> after = jf.ensemble.serial(jax.random.key(0), forecast)
        >>> round(float(after.mean()), 3), round(float(after.var(ddof=1)), 3)
        (1.0, 1.0)
    """
    del key
    m, count = forecast.predicted.shape
    # The predicted observations are more variables, so that one gain updates all.
    mean = jnp.concatenate([forecast.mean, jnp.mean(forecast.predicted, axis=1)])
    deviations = jnp.concatenate([forecast.deviations, forecast.spread])
    n = forecast.mean.size
    local = forecast.localization
    factors = jnp.ones((m, 0)) if local is None else jnp.concatenate([local.state, local.observation]).T

    def assimilate(carry: tuple[Array, Array], inputs: tuple) -> tuple[tuple[Array, Array], None]:
        mean, deviations = carry
        j, y, observed, variance, nearness = inputs
        spread = deviations[n + j]
        total = dot(spread, spread) / (count - 1) + variance
        gain = jnp.matmul(deviations, spread, precision="highest") / ((count - 1) * total)
        gain = jnp.where(observed, gain if local is None else nearness * gain, 0.0)
        shrink = 1 / (1 + jnp.sqrt(variance / total))
        return (mean + gain * (y - mean[n + j]), deviations - shrink * gain[:, None] * spread), None

    inputs = (jnp.arange(m), forecast.observation, forecast.observed, _variances(forecast.R), factors)
    (mean, deviations), _ = jax.lax.scan(assimilate, (mean, deviations), inputs)
    return mean[:n, None] + deviations[:n]


def _transformed(X: Float[Array, "n k"], S: Float[Array, "m k"], d: Float[Array, " m"]) -> Float[Array, "n k"]:
    """Deviations after the update, from the mean before it, by the smaller one of two matrices."""
    m, count = S.shape
    if m < count:
        # (I + S^T S)^-1/2 = I - S^T (M + M^1/2)^-1 S with M = I + S S^T, and (I + S^T S)^-1 S^T = S^T M^-1.
        G = _inverse_root(jnp.eye(m, dtype=S.dtype) + matmul(S, S.T))
        outer = cholesky(jnp.eye(m, dtype=S.dtype) + G)
        shrunk = _solve(outer, matmul(G, matmul(G, S)))
        shift = matmul(G, matmul(G, d[:, None]))
        return X + matmul(matmul(X, S.T), shift - shrunk)
    T = _inverse_root(jnp.eye(count, dtype=S.dtype) + matmul(S.T, S))
    return matmul(X, T + matmul(T, matmul(T, matmul(S.T, d[:, None]))))


@jax.custom_jvp
def _inverse_root(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The symmetric inverse square root of a symmetric matrix whose eigenvalues are at least one."""
    values, vectors = _eigen(M)
    return matmul(vectors / values, vectors.T)


def _eigen(M):
    """Roots of the eigenvalues, and the eigenvectors."""
    values, vectors = jnp.linalg.eigh(M)
    return jnp.sqrt(jnp.maximum(values, 1.0)), vectors


@_inverse_root.defjvp
def _inverse_root_jvp(primals, tangents):
    # Divided differences of 1 / sqrt, which are finite for equal eigenvalues, unlike the derivatives of eigenvectors.
    r, vectors = _eigen(primals[0])
    divided = -1 / (r[:, None] * r * (r[:, None] + r))
    inside = divided * matmul(vectors.T, matmul(tangents[0], vectors))
    return matmul(vectors / r, vectors.T), matmul(vectors, matmul(inside, vectors.T))
