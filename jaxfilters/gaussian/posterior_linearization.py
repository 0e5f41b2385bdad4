"""Posterior linearisation filter: observations are linearised over the belief after them, by iteration."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.affine import linear_observation, read_components
from jaxfilters.gaussian.arithmetic import KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import ExtendedKalman
from jaxfilters.gaussian.linearize import lower_root
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.gaussian.measurement_update import exact_rows, feasible, misfit
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey

_HALVINGS = 8


def posterior_linearization(inner: Filter, iterations: int = 5) -> Filter:
    """Iterated posterior linearisation filter: `inner`, whose updates linearise over the belief that results.

    A sigma-point filter linearises an observation over the prediction, which is wide where the observation is precise.
    Here the linear regression is repeated over the belief after the update, until both agree (A. F. Garcia-Fernandez,
    L. Svensson, M. R. Morelande and S. Särkkä, "Posterior linearization filter: principles and implementation using
    sigma points", IEEE Transactions on Signal Processing 63(20), 2015). Steps of the mean are halved until they lower
    the cost with the covariances and the linearisation errors of the iteration (M. Raitoharju, L. Svensson,
    A. F. Garcia-Fernandez and R. Piche, "Damped posterior linearization filter", IEEE Signal Processing Letters 25(4),
    2018), so that it cannot diverge. Where the noise is singular, what is exact comes first: a step is taken if it
    reduces its violation, or else the cost. With `jf.linearize.taylor` it is the iterated extended Kalman filter.

    Args:
        inner: Filter made by `extended_kalman`, `unscented_kalman` or `cubature_kalman`, of vectors; its own
            `iterations` do not count.
        iterations: Number of linearisations of each update, at least 1; 3 to 10 are usual.

    Returns:
        The filter, whose states, infos and smoothers are those of `inner`.

    Raises:
        ValueError: If `inner` is another kind of filter or its states are no vectors, or `iterations < 1`.
        TypeError: If `inner` is no filter.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.array([3.0, 4.0]), jnp.eye(2))
        >>> distance = lambda x: jnp.sqrt(x[:1] ** 2 + x[1:] ** 2)
        >>> inner = jf.cubature_kalman(prior, lambda x: x, 0.1 * jnp.eye(2), distance, 1e-4 * jnp.eye(1))
        >>> last, _ = jf.run(jf.posterior_linearization(inner), jax.random.key(0), 5.0 * jnp.ones((10, 1)))
        >>> last.mean.shape
        (2,)
    """
    checks.is_filter("inner", inner)
    checks.count("iterations", iterations)
    if not isinstance(inner.params, ExtendedKalman) or not inner.params.manifold.flat:
        raise ValueError(
            "inner must be made by extended_kalman, unscented_kalman or cubature_kalman, and have vectors for states; "
            f"its parameters are {type(inner.params).__name__}."
        )
    return Filter(replace(inner.params, iterations=iterations), inner.init, inner.predict, _update)


def _update(
    model: ExtendedKalman, key: AnyKey, belief: Belief, observation: PyTree, inputs: PyTree
) -> tuple[Belief, KalmanInfo]:
    del key
    checks.state(belief, model.prior)
    y, read, own_noise = read_components(observation)
    root_P = lower_root(belief)

    def improve(carry: tuple[Belief, Array], _: None) -> tuple[tuple[Belief, Array], KalmanInfo]:
        at, over = carry[0], widened(carry[0], belief, carry[1])
        linear = linear_observation(model, over, y, own_noise, inputs)
        y_hat = factor.apply(linear.H, belief.mean) + linear.d
        target, report = model.arithmetic.update(belief, linear.y, linear.H, linear.R, y_hat, read, linear.added_R)
        root_R = model.arithmetic.noise_root(linear.R, read, linear.added_R)

        scales = linalg.safe_norm(report.innovation_root)

        def cost(length: Array) -> tuple[Array, Array]:
            here = replace(over, mean=at.mean + length * (target.mean - at.mean))
            linear = linear_observation(model, here, y, own_noise, inputs)
            residual = jnp.where(read, linear.y - factor.apply(linear.H, here.mean) - linear.d, 0.0)
            away = linalg.solve_triangular(root_P, here.mean - belief.mean)
            square, violation = misfit(root_R, scales, residual)
            return 0.5 * (jnp.sum(away**2) + square), violation

        lengths = jnp.append(0.5 ** jnp.arange(_HALVINGS, dtype=y.dtype), 0.0)
        costs, violations = jax.lax.map(cost, lengths)
        merits = costs + 0.5 * violations
        # The first that does not raise the cost; none where the cost is not a number.
        first = jnp.argmax((merits <= merits[-1]).at[-1].set(True))
        length = lengths[feasible(lengths, violations, first)]
        moved = jnp.where(length > 0, at.mean + length * (target.mean - at.mean), at.mean)
        return (replace(target, mean=moved), jnp.any(exact_rows(root_R, scales))), report

    (found, _), reports = jax.lax.scan(improve, (belief, jnp.zeros((), bool)), None, length=model.iterations)
    return found, jax.tree.map(lambda leaf: leaf[-1], reports)


def widened(belief: Belief, predicted: Belief, is_exact: Bool[Array, ""]) -> Belief:
    """The belief after exact observations, with a little of the predicted covariance; as it is where none was exact.

    A regression over the belief has no slopes in directions of which nothing is left to know, while the update needs
    them over the prediction.
    """
    share = float(jnp.finfo(belief.mean.dtype).eps) ** 0.5
    if isinstance(belief, Gaussian):
        assert isinstance(predicted, Gaussian)
        wide = belief.covariance + share * predicted.covariance
        return replace(belief, covariance=jnp.where(is_exact, wide, belief.covariance))
    assert isinstance(predicted, GaussianRoot)
    wide = linalg.tria(jnp.hstack([belief.root, share**0.5 * predicted.root]))
    wide = jnp.pad(wide, ((0, 0), (0, belief.root.shape[1] - len(wide))))
    return replace(belief, root=jnp.where(is_exact, wide, belief.root))
