"""Sigma-point Kalman filters: `extended_kalman` with a regression on points in place of derivatives."""

from collections.abc import Callable

from jaxtyping import Array, Float

from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.arithmetic import Arithmetic
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.emissions import Emission
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.gaussian.linearize import cubature, unscented
from jaxfilters.gaussian.manifold import Manifold, euclidean
from jaxfilters.gaussian.measurement_update import subtract
from jaxfilters.gaussian.noise_models import NonAdditiveNoise


def unscented_kalman(
    prior: Gaussian | GaussianRoot,
    transition: Callable[..., Array] | NonAdditiveNoise,
    process_noise: Array | Callable[..., Array],
    observe: Callable[..., Float[Array, " m"]] | NonAdditiveNoise | Emission,
    observation_noise: Array | Callable[..., Array] | None = None,
    *,
    alpha: float = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
    arithmetic: Arithmetic = arithmetics.joseph,
    manifold: Manifold = euclidean,
    residual: Callable[[Array, Array], Array] = subtract,
) -> Filter:
    """Unscented Kalman filter: 2 n + 1 sigma points in place of derivatives.

    E. A. Wan and R. van der Merwe, "The unscented Kalman filter for nonlinear estimation", AS-SPCC 2000.

    Args:
        prior: Belief before the first observation, with a mean of shape (n,), as for `extended_kalman`.
        transition: `x -> x` or `(x, inputs) -> x` without noise, (n,) to (n,); or `NonAdditiveNoise`.
        process_noise: Covariance of the process noise, (n, n), or a function `inputs -> covariance` or
            `(x, inputs) -> covariance`.
        observe: `x -> y` or `(x, inputs) -> y` without noise, (n,) to (m,); or `NonAdditiveNoise`; or an emission
            of `jf.emissions`.
        observation_noise: Covariance of the observation noise, (m, m), or a function like `process_noise`; None for an
            emission.
        alpha: Distance of the points from the mean, relative to sqrt(n + kappa) standard deviations; positive.
        beta: Weight of the centre point in the covariance, at least 0; 2 suits Gaussian states.
        kappa: Addition to the dimension n in the distance of the points, at least 0.
        arithmetic: `jf.arithmetic.joseph`, `square_root` (all covariances are then roots) or `fast`.
        manifold: Space of the states, as for `extended_kalman`.
        residual: `(y, y_hat) -> y - y_hat`, for observations that wrap around.

    Returns:
        The filter, like that of `extended_kalman`.

    Raises:
        ValueError: If `alpha` is not positive, `beta` or `kappa` negative, or as for `extended_kalman`.
        TypeError: As for `extended_kalman`.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.array([3.0, 4.0]), jnp.eye(2))
        >>> observe = lambda x: jnp.sqrt(x[:1] ** 2 + x[1:] ** 2)
        >>> filter = jf.unscented_kalman(prior, lambda x: x, 0.1 * jnp.eye(2), observe, 0.01 * jnp.eye(1))
        >>> last, _ = jf.run(filter, jax.random.key(0), 5.0 * jnp.ones((10, 1)))
        >>> last.mean.shape
        (2,)
    """
    return extended_kalman(
        prior,
        transition,
        process_noise,
        observe,
        observation_noise,
        linearize=unscented(alpha, beta, kappa),
        arithmetic=arithmetic,
        manifold=manifold,
        residual=residual,
    )


def cubature_kalman(
    prior: Gaussian | GaussianRoot,
    transition: Callable[..., Array] | NonAdditiveNoise,
    process_noise: Array | Callable[..., Array],
    observe: Callable[..., Float[Array, " m"]] | NonAdditiveNoise | Emission,
    observation_noise: Array | Callable[..., Array] | None = None,
    *,
    arithmetic: Arithmetic = arithmetics.joseph,
    manifold: Manifold = euclidean,
    residual: Callable[[Array, Array], Array] = subtract,
) -> Filter:
    """Cubature Kalman filter: 2 n equally weighted points in place of derivatives, and no parameter.

    I. Arasaratnam and S. Haykin, "Cubature Kalman filters", IEEE Transactions on Automatic Control 54(6), 2009.

    Args:
        prior: Belief before the first observation, with a mean of shape (n,), as for `extended_kalman`.
        transition: `x -> x` or `(x, inputs) -> x` without noise, (n,) to (n,); or `NonAdditiveNoise`.
        process_noise: Covariance of the process noise, (n, n), or a function `inputs -> covariance` or
            `(x, inputs) -> covariance`.
        observe: `x -> y` or `(x, inputs) -> y` without noise, (n,) to (m,); or `NonAdditiveNoise`; or an emission
            of `jf.emissions`.
        observation_noise: Covariance of the observation noise, (m, m), or a function like `process_noise`; None for an
            emission.
        arithmetic: `jf.arithmetic.joseph`, `square_root` (all covariances are then roots) or `fast`.
        manifold: Space of the states, as for `extended_kalman`.
        residual: `(y, y_hat) -> y - y_hat`, for observations that wrap around.

    Returns:
        The filter, like that of `extended_kalman`.

    Raises:
        ValueError: As for `extended_kalman`.
        TypeError: As for `extended_kalman`.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.array([3.0, 4.0]), jnp.eye(2))
        >>> observe = lambda x: jnp.sqrt(x[:1] ** 2 + x[1:] ** 2)
        >>> filter = jf.cubature_kalman(prior, lambda x: x, 0.1 * jnp.eye(2), observe, 0.01 * jnp.eye(1))
        >>> last, _ = jf.run(filter, jax.random.key(0), 5.0 * jnp.ones((10, 1)))
        >>> last.mean.shape
        (2,)
    """
    return extended_kalman(
        prior,
        transition,
        process_noise,
        observe,
        observation_noise,
        linearize=cubature,
        arithmetic=arithmetic,
        manifold=manifold,
        residual=residual,
    )
