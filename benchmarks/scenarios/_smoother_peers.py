"""Smoothers of other libraries on the same problems; each is imported only where it is asked for."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.gaussian.belief import Gaussian

PEERS = ("dynamax", "cuthbert", "particles")


class Linear(NamedTuple):
    """A linear Gaussian model, and readings simulated with it."""

    prior: Gaussian
    F: Float[Array, "n n"]
    Q: Float[Array, "n n"]
    H: Float[Array, "m n"]
    R: Float[Array, "m m"]
    readings: Float[Array, "t m"]


class Walk(NamedTuple):
    """A damped random walk on a line, and noisy readings of it."""

    rate: float
    process_std: float
    noise_std: float
    readings: np.ndarray


def installed() -> list[str]:
    """Those of `PEERS` that this Python can import."""
    return [name for name in PEERS if find_spec(name) is not None]


def linear(seed: int, num_frames: int, n: int = 4, m: int = 2) -> Linear:
    """A model with slow rotations."""
    rng = np.random.default_rng(seed)
    F = 0.97 * np.linalg.qr(rng.normal(size=(n, n)))[0]
    H, Q, R = rng.normal(size=(m, n)), 0.1 * np.eye(n), 0.2 * np.eye(m)
    x, readings = rng.normal(size=n), []
    for _ in range(num_frames):
        x = F @ x + np.sqrt(0.1) * rng.normal(size=n)
        readings.append(H @ x + np.sqrt(0.2) * rng.normal(size=m))
    arrays = (jnp.asarray(each, float) for each in (F, Q, H, R, np.array(readings)))
    return Linear(Gaussian(jnp.zeros(n), jnp.eye(n)), *arrays)


def walk(seed: int, num_frames: int) -> Walk:
    """A walk that forgets its start in ten steps."""
    rng, x, readings = np.random.default_rng(seed), 0.0, []
    for _ in range(num_frames):
        x = 0.9 * x + 0.5 * rng.normal()
        readings.append(x + 0.4 * rng.normal())
    return Walk(0.9, 0.5, 0.4, np.array(readings, np.float32))


def dynamax_params(problem: Linear) -> Any:
    """Parameters for dynamax, which starts with an update: the prior is predicted once before."""
    inference = import_module("dynamax.linear_gaussian_ssm.inference")
    n, m, (mean, P) = problem.F.shape[0], problem.H.shape[0], (problem.prior.mean, problem.prior.covariance)
    start = inference.ParamsLGSSMInitial(mean=problem.F @ mean, cov=problem.F @ P @ problem.F.T + problem.Q)
    return inference.ParamsLGSSM(
        initial=start,
        dynamics=inference.ParamsLGSSMDynamics(
            weights=problem.F, bias=jnp.zeros(n), input_weights=jnp.zeros((n, 0)), cov=problem.Q
        ),
        emissions=inference.ParamsLGSSMEmissions(
            weights=problem.H, bias=jnp.zeros(m), input_weights=jnp.zeros((m, 0)), cov=problem.R
        ),
    )


def dynamax_parallel(problem: Linear) -> Callable[[], Array]:
    """Smoothed means by the parallel smoother of dynamax."""
    library, params = import_module("dynamax.linear_gaussian_ssm.parallel_inference"), dynamax_params(problem)
    smooth = jax.jit(lambda params, readings: library.lgssm_smoother(params, readings).smoothed_means)
    return lambda: smooth(params, problem.readings)


def dynamax_samples(problem: Linear, count: int) -> Callable[[], Array]:
    """Samples (t, n, count) of the states by dynamax, which filters once for all."""
    library, params = import_module("dynamax.linear_gaussian_ssm.inference"), dynamax_params(problem)

    @jax.jit
    def sample(keys: Array, readings: Array) -> Array:
        draw = lambda key: library.lgssm_posterior_sample(key, params, readings)
        return jax.vmap(draw, out_axes=-1)(keys)

    keys = jax.random.split(jax.random.PRNGKey(0), count)
    return lambda: sample(keys, problem.readings)


def dynamax_em(problem: Linear, iterations: int) -> Callable[[], Array]:
    """Observation noise after some iterations of dynamax's expectation-maximisation, without biases, in one loop."""
    library = import_module("dynamax.linear_gaussian_ssm")
    n, m = problem.F.shape[0], problem.H.shape[0]
    model = library.LinearGaussianSSM(n, m, has_dynamics_bias=False, has_emissions_bias=False)
    _, properties = model.initialize(jax.random.PRNGKey(0))
    start = problem._replace(F=0.8 * problem.F, Q=2 * problem.Q, R=2 * problem.R)
    params = dynamax_params(start)
    params = params._replace(
        dynamics=params.dynamics._replace(bias=None), emissions=params.emissions._replace(bias=None)
    )

    @jax.jit
    def train(params: Any, readings: Array) -> Array:
        def iterate(_: Any, params: Any) -> Any:
            statistics, _ = jax.vmap(lambda y: model.e_step(params, y))(readings[None])
            return model.m_step(params, properties, statistics, None)[0]

        return jax.lax.fori_loop(0, iterations, iterate, params).emissions.cov

    return lambda: train(params, problem.readings)


def cuthbert_parallel(problem: Linear) -> Callable[[], Array]:
    """Smoothed means by the parallel square-root filter and smoother of cuthbert."""
    library, kalman = import_module("cuthbert"), import_module("cuthbert.gaussian.kalman")
    root_P, root_Q, root_R = (jnp.linalg.cholesky(C) for C in (problem.prior.covariance, problem.Q, problem.R))
    n, m = problem.F.shape[0], problem.H.shape[0]
    dynamics = lambda _: (problem.F, jnp.zeros(n), root_Q)
    filtering = kalman.build_filter(
        problem.prior.mean, root_P, dynamics, lambda y: (problem.H, jnp.zeros(m), root_R, y)
    )
    smoothing = kalman.build_smoother(dynamics)

    @jax.jit
    def smooth(readings: Array) -> Array:
        states = library.filter(filtering, readings, filtering.init_prepare(), parallel=True)
        return library.smoother(smoothing, states, parallel=True).mean[1:]

    return lambda: smooth(problem.readings)


def particles_backward(problem: Walk, count: int, seed: int) -> dict[str, Callable[[], np.ndarray]]:
    """Trajectories (t, count) by the backward sampling of particles, from all weights and by rejection."""
    library = import_module("particles")
    models, laws = import_module("particles.state_space_models"), import_module("particles.distributions")

    class Model(models.StateSpaceModel):  # type: ignore[name-defined]
        def PX0(self) -> Any:
            return laws.Normal(scale=np.hypot(problem.rate, problem.process_std))

        def PX(self, t: int, xp: np.ndarray) -> Any:
            del t
            return laws.Normal(loc=problem.rate * xp, scale=problem.process_std)

        def PY(self, t: int, xp: np.ndarray, x: np.ndarray) -> Any:
            del t, xp
            return laws.Normal(loc=x, scale=problem.noise_std)

        def upper_bound_log_pt(self, t: int) -> float:
            del t
            return float(-np.log(problem.process_std * np.sqrt(2 * np.pi)))

    np.random.seed(seed)  # noqa: NPY002 - the library draws from the global generator
    kernel = models.Bootstrap(ssm=Model(), data=np.asarray(problem.readings, np.float64))
    algorithm = library.SMC(fk=kernel, N=count, store_history=True)
    algorithm.run()
    sample = algorithm.hist.backward_sampling
    return {
        "particles": lambda: np.array(sample(count)),
        "particles_rejection": lambda: np.array(sample(count, linear_cost=True)),
    }
