"""Log evidence of the same problems by other libraries; each is imported only where it is asked for."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxfilters
from jaxfilters.benchmarks.scenarios._filter_models import DT, POSE, DriftProblem
from jaxfilters.benchmarks.scenarios._gaussian_models import Coupled, Problem
from jaxfilters.filter import Filter
from jaxfilters.typing import AnyKey

PEERS = ("dynamax", "cuthbert", "smcx", "particles")
OfKey = Callable[[AnyKey], Any]
"""Log evidence of a particle filter with that key."""


def installed() -> list[str]:
    """Those of `PEERS` that this Python can import."""
    return [name for name in PEERS if find_spec(name) is not None]


def smcx(problem: DriftProblem, num_particles: int) -> OfKey:
    """Bootstrap filter of smcx, which starts with an update: its prior is moved once before."""
    library, model = import_module("smcx"), problem.model

    def sample_initial(key: AnyKey, params: None, given: None) -> Array:
        del params, given
        prior_key, move_key = jax.random.split(key)
        return _moved(model, move_key, model.sample_prior(prior_key))

    there = library.StateSpaceModel(
        sample_initial, lambda key, x, *_: _moved(model, key, x), lambda y, x, *_: model.log_likelihood(x, y)
    )

    @jax.jit
    def log_evidence(key: AnyKey, readings: Float[Array, "t 3"]) -> Array:
        kernel = library.bootstrap_fk(there, None, readings)
        found = library.run_smc(key, kernel, num_particles, resampling_threshold=1.0, store_history=False)
        return found.marginal_loglik

    return lambda key: log_evidence(key, problem.readings)


def cuthbert(problem: DriftProblem, num_particles: int) -> OfKey:
    """Particle filter of cuthbert, which keeps the particles of every step."""
    library, model = import_module("cuthbert"), problem.model
    filtering = import_module("cuthbert.smc.particle_filter").build_filter(
        model.sample_prior,
        lambda key, x, *_: _moved(model, key, x),
        lambda _, x, y: model.log_likelihood(x, y),
        num_particles,
        import_module("cuthbertlib.resampling.systematic").resampling,
    )

    @jax.jit
    def log_evidence(key: AnyKey, readings: Float[Array, "t 3"]) -> Array:
        start, rest = jax.random.split(key)
        states = library.filter(filtering, readings, filtering.init_prepare(key=start), key=rest)
        return states.log_normalizing_constant[-1]

    return lambda key: log_evidence(key, problem.readings)


def particles(problem: DriftProblem, num_particles: int) -> OfKey:
    """Bootstrap filter of particles, in numpy and float64."""
    library = import_module("particles")
    beacons, spread, std = (np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(problem.model))
    readings = np.asarray(problem.readings, np.float64)

    class Kernel(library.FeynmanKac):  # type: ignore[name-defined]
        def M0(self, N: int) -> np.ndarray:
            return self.M(0, 0.5 * self.rng.normal(size=(N, 2 * POSE)))

        def M(self, t: int, xp: np.ndarray) -> np.ndarray:
            del t
            ahead = np.concatenate([xp[:, :POSE] + DT * xp[:, POSE:], xp[:, POSE:]], axis=1)
            return ahead + spread * self.rng.normal(size=xp.shape)

        def logG(self, t: int, xp: np.ndarray | None, x: np.ndarray) -> np.ndarray:
            del xp
            distances = np.sqrt(((x[:, None, :3] - beacons) ** 2).sum(2))
            error = (readings[t] - distances) / std
            return -0.5 * (error**2).sum(1) - 3 * np.log(std) - 1.5 * np.log(2 * np.pi)

    def log_evidence(key: AnyKey) -> float:
        kernel = Kernel(len(readings))
        kernel.rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        algorithm = library.SMC(fk=kernel, N=num_particles, ESSrmin=1.0)
        algorithm.run()
        return float(algorithm.logLt)

    return log_evidence


def dynamax_linear(problem: Problem) -> Callable[[Any, Array], Array]:
    """Kalman filter of dynamax on the linear part of `Coupled`."""
    ssm = import_module("dynamax.linear_gaussian_ssm")

    def log_evidence(model: Coupled, readings: Float[Array, "t m"]) -> Array:
        return ssm.lgssm_filter(_linear_params(problem, model), readings).marginal_loglik

    return log_evidence


def dynamax_linear_smoother(problem: Problem) -> Callable[[Any, Array], Array]:
    """Smoothed means of dynamax's Kalman filter on the linear part of `Coupled`."""
    ssm = import_module("dynamax.linear_gaussian_ssm")

    def means(model: Coupled, readings: Float[Array, "t m"]) -> Array:
        return ssm.lgssm_smoother(_linear_params(problem, model), readings).smoothed_means

    return means


def _linear_params(problem, model):
    inference = import_module("dynamax.linear_gaussian_ssm.inference")
    Q, R = _noises(problem)
    mean, P, num_readings = problem.start.mean, problem.start.covariance, model.C.shape[0]
    return inference.ParamsLGSSM(
        initial=inference.ParamsLGSSMInitial(mean=model.A @ mean, cov=model.A @ P @ model.A.T + Q),
        dynamics=inference.ParamsLGSSMDynamics(
            weights=model.A, bias=jnp.zeros(mean.size), input_weights=jnp.zeros((mean.size, 0)), cov=Q
        ),
        emissions=inference.ParamsLGSSMEmissions(
            weights=model.C, bias=jnp.zeros(num_readings), input_weights=jnp.zeros((num_readings, 0)), cov=R
        ),
    )


def dynamax_unscented(problem: Problem, filter: Filter) -> Callable[[Any, Array], Array]:
    """Unscented filter of dynamax, from the first prediction of `filter`, with which it shares the points."""
    ssm = import_module("dynamax.nonlinear_gaussian_ssm")
    inference = import_module("dynamax.nonlinear_gaussian_ssm.inference_ukf")
    Q, R = _noises(problem)
    ahead = jaxfilters.predict(filter, jax.random.key(0), problem.start)

    def log_evidence(model: Coupled, readings: Float[Array, "t m"]) -> Array:
        params = ssm.ParamsNLGSSM(ahead.mean, ahead.covariance, model.move, Q, model.observe, R)
        points = inference.UKFHyperParams(alpha=1.0, beta=2.0, kappa=0.0)
        return ssm.unscented_kalman_filter(params, readings, points, output_fields=["filtered_means"]).marginal_loglik

    return log_evidence


def dynamax_smoother(problem: Problem) -> Callable[[Any, Array], Array]:
    """Smoothed means of dynamax's extended filter."""
    ssm = import_module("dynamax.nonlinear_gaussian_ssm")
    Q, R = _noises(problem)
    mean, P = problem.start.mean, problem.start.covariance

    def means(model: Coupled, readings: Float[Array, "t m"]) -> Array:
        F = jax.jacfwd(model.move)(mean)
        params = ssm.ParamsNLGSSM(model.move(mean), F @ P @ F.T + Q, model.move, Q, model.observe, R)
        return ssm.extended_kalman_smoother(params, readings).smoothed_means

    return means


def _moved(model, key, x):
    return model.move(jax.random.normal(key, (2 * POSE,)), x)


def _noises(problem):
    size, count = problem.start.mean.size, problem.readings.shape[1]
    return problem.process_variance * jnp.eye(size), problem.reading_variance * jnp.eye(count)
