"""The measurement update of a Gaussian belief by an emission: conditional moments, or Laplace's method."""

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo, factor
from jaxfilters.gaussian.belief import GaussianRoot
from jaxfilters.gaussian.emissions import Emission
from jaxfilters.gaussian.linearize import Linearize, taylor
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.gaussian.measurement_update import (
    Measurement,
    dual_of,
    iterated_update,
    laplace_log_evidence,
    linear_update,
    subtract,
)
from jaxfilters.gaussian.noise_models import StateNoise, noise_of_step
from jaxfilters.gaussian.observation import Observation


def emission_update(
    emission: Emission,
    belief: Belief,
    point: Callable[[Array], Array],
    observation: PyTree,
    inputs: PyTree,
    linearize: Linearize,
    arithmetic: Arithmetic,
    iterations: int,
) -> tuple[Belief, KalmanInfo]:
    """Belief in the coordinates after an observation with this emission, and the diagnostics of the update.

    Args:
        emission: The distribution of the observation.
        belief: Belief about the coordinates of the state.
        point: `coordinates -> x`.
        observation: The observation, or an `Observation` without a noise.
        inputs: Inputs of the step.
        linearize: Strategy of the conditional moments.
        arithmetic: Arithmetic of the update.
        iterations: 1 for conditional moments; more are the steps of Laplace's method.

    Raises:
        ValueError: If the observation has another shape than the emission, or a noise.
    """
    measured = observation if isinstance(observation, Observation) else Observation(observation)
    if measured.noise is not None:
        raise ValueError("Observation.noise must be None for an emission, which has its own distribution.")
    natural, family = emission.of_step(inputs), emission.family
    eta = lambda coordinates: natural(point(coordinates))
    y, possible = family.encoded(measured.y, eta(belief.mean))
    if measured.mask is not None:
        checks.boolean("Observation.mask", measured.mask, jnp.shape(measured.y), ", that of the observation y")
    mask = jnp.ones(y.shape, bool) if measured.mask is None else jnp.broadcast_to(measured.mask, y.shape)
    given = jnp.isfinite(y) & mask
    read = given & possible
    safe = jnp.where(read, y, 0.0)
    is_root = isinstance(belief, GaussianRoot)

    def spread(x: Array, inputs: PyTree) -> Array:
        del inputs
        covariance = family.covariance(natural(x))
        return factor.root(covariance) if is_root else covariance

    at_mode = iterations > 1
    linearize = taylor if at_mode else linearize
    measurement = Measurement(
        belief,
        belief.mean,
        jnp.where(possible, y, jnp.nan),
        mask,
        noise_of_step("the emission", StateNoise(spread), inputs, y.size, belief, point, linearize),
        lambda coordinates: family.mean(eta(coordinates)),
        subtract,
        linearize,
        arithmetic,
        lambda coordinates: spread(point(coordinates), inputs),
        lambda coordinates: jnp.sum(jnp.where(read, family.log_probability(eta(coordinates), safe), 0.0)),
    )
    if at_mode:
        posterior, report = iterated_update(measurement, None, iterations, False)
    else:
        posterior, report = _by_moments(measurement)
    impossible = jnp.any(given & ~possible)
    return posterior, replace(report, log_evidence=jnp.where(impossible, -jnp.inf, report.log_evidence))


def _by_moments(measurement: Measurement) -> tuple[Belief, KalmanInfo]:
    posterior, report, linear = linear_update(measurement)
    offset = posterior.mean - measurement.start
    dual = dual_of(report, linear.F, report.innovation)
    log_evidence = laplace_log_evidence(measurement, report, linear, offset, dual)
    return posterior, replace(report, log_evidence=log_evidence)
