"""Guided and auxiliary particle filters beside particles, smcx and cuthbert: time, and error of the log evidence.

An autoregression whose readings are five times as precise as its steps, which is hard for the bootstrap filter (N.
Chopin and O. Papaspiliopoulos, "An Introduction to Sequential Monte Carlo", 2020, figure 10.2): the optimal proposal,
and with it the exact first stage. `ratio_NAME_nN_to_PEER` is the median over the rounds of processor times, in turns,
of filters of N particles that resample in every step. `log_evidence_rmse_NAME` is the error of 100 particles over 200
random keys against the Kalman filter. All libraries have to agree with the Kalman filter within 5 standard errors, or
nothing is timed. Peers that are not installed are missing.
"""

import statistics
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float

import jaxfilters
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.timing import taking_turns
from jaxfilters.filter import Filter
from jaxfilters.typing import AnyKey

RHO, STD_X, STD_Y = 0.9, 1.0, 0.2
STATIONARY = STD_X / (1 - RHO**2) ** 0.5
SPREAD = (STD_X**-2 + STD_Y**-2) ** -0.5
SIZES = ((1000, 100), (100_000, 20))
"""Particles and frames."""
FEW, KEYS, ROUNDS, QUICK_ROUNDS, CHECKED = 100, 200, 9, 3, 12
SCALE = 1.0
"""Of the sizes; below 1 to see that it runs."""
OfKey = Callable[[AnyKey], Any]


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Measure in this process; `out` is not used."""
    del out
    found = accuracy(seed)
    for num_particles, num_steps in SIZES[:1] if quick else SIZES:
        count, ys = max(64, round(SCALE * num_particles)), simulate(seed, max(4, round(SCALE * num_steps)))
        for name, libraries in contests(count, ys).items():
            check(libraries, seed, ys)
            rounds = QUICK_ROUNDS if quick else ROUNDS
            calls = {library: partial(of, jax.random.key(seed)) for library, of in libraries.items()}
            times = taking_turns(calls, rounds)
            ours = [one.processor for one in times.pop("ours")]
            size = f"{name}_n{num_particles}"
            found[f"{size}_processor_ms"] = Metric(1e3 * statistics.median(ours), "ms of processors", "lower")
            for library, of in times.items():
                ratio = statistics.median(a / b.processor for a, b in zip(ours, of, strict=True))
                found[f"ratio_{size}_to_{library}"] = Metric(ratio, "", "lower")
    return found


def simulate(seed: int, num_steps: int) -> Float[Array, "t 1"]:
    """Readings of the autoregression."""
    rng = np.random.default_rng(seed)
    x, ys = STATIONARY * rng.normal(), []
    for _ in range(num_steps):
        x = RHO * x + STD_X * rng.normal()
        ys.append(x + STD_Y * rng.normal())
    return jnp.asarray(ys, float)[:, None]


def accuracy(seed: int) -> dict[str, Metric]:
    """Errors of the log evidence by few particles."""
    ys = simulate(seed, max(4, round(SCALE * 100)))
    truth = exact(ys)
    keys = jax.random.split(jax.random.key(seed), KEYS)
    found = {}
    for name, filter in filters(FEW).items():
        estimates = jax.jit(jax.vmap(partial(estimate, filter=filter, ys=ys)))(keys)
        rmse = float(np.sqrt(np.mean((np.asarray(estimates) - truth) ** 2)))
        found[f"log_evidence_rmse_{name}"] = Metric(rmse, "", "lower")
    return found


def exact(ys: Float[Array, "t 1"]) -> float:
    """Log evidence of the Kalman filter."""
    one = jnp.eye(1)
    prior = jaxfilters.Gaussian(jnp.zeros(1), STATIONARY**2 * one)
    filter = jaxfilters.kalman(prior, RHO * one, STD_X**2 * one, one, STD_Y**2 * one)
    return float(jaxfilters.log_evidence(filter, jax.random.key(0), ys))


def estimate(key: AnyKey, filter: Filter, ys: Float[Array, "t 1"]) -> Array:
    """Estimate of a particle filter."""
    return jaxfilters.log_evidence(filter, key, ys)


def filters(num_particles: int) -> dict[str, Filter]:
    """This library's filters by name; the proposal is a pair of functions, as that of the peers."""
    model: dict[str, Any] = {
        "sample_prior": jaxfilters.priors.from_noise(lambda noise: STATIONARY * noise, jaxfilters.StandardNormal(1)),
        "sample_transition": lambda noise, x: RHO * x + STD_X * noise,
        "log_likelihood": log_likelihood,
        "num_particles": num_particles,
        "noise": jaxfilters.StandardNormal(1),
        "ess_threshold": 1.0,
    }
    proposal = (lambda noise, x, y: center(x, y) + SPREAD * noise, lambda new, x, y: log_proposal(new, x, y))
    guided = model | {"log_transition": log_transition, "proposal": proposal}
    return {
        "bootstrap": jaxfilters.bootstrap(**model),
        "guided": jaxfilters.guided(**guided),
        "auxiliary": jaxfilters.auxiliary(**model, log_first_stage=log_first_stage),
        "adapted": jaxfilters.auxiliary(**guided, log_first_stage=log_first_stage),
    }


def center(x: Array, y: Array) -> Array:
    """Mean of the optimal proposal."""
    return SPREAD**2 * (RHO * x / STD_X**2 + y / STD_Y**2)


def log_likelihood(x: Array, y: Array) -> Array:
    """Of one reading."""
    return norm.logpdf(y, x, STD_Y).sum()


def log_transition(new: Array, x: Array) -> Array:
    """Of one step."""
    return norm.logpdf(new, RHO * x, STD_X).sum()


def log_proposal(new: Array, x: Array, y: Array) -> Array:
    """Of the optimal proposal."""
    return norm.logpdf(new, center(x, y), SPREAD).sum()


def log_first_stage(x: Array, y: Array) -> Array:
    """The reading given the state before."""
    return norm.logpdf(y, RHO * x, (STD_X**2 + STD_Y**2) ** 0.5).sum()


def contests(num_particles: int, ys: Float[Array, "t 1"]) -> dict[str, dict[str, OfKey]]:
    """Filter -> library -> log evidence with a key; this library first."""
    compiled = jax.jit(estimate)
    found: dict[str, dict[str, OfKey]] = {
        name: {"ours": partial(compiled, filter=filter, ys=ys)}
        for name, filter in filters(num_particles).items()
        if name != "bootstrap"
    }
    if find_spec("smcx") is not None:
        found["guided"]["smcx"] = _smcx(num_particles, ys, guided=True)
        found["auxiliary"]["smcx"] = _smcx(num_particles, ys, guided=False)
    if find_spec("particles") is not None:
        found["guided"]["particles"] = _particles("GuidedPF", num_particles, ys)
        found["adapted"]["particles"] = _particles("AuxiliaryPF", num_particles, ys)
    if find_spec("cuthbert") is not None and num_particles <= 10_000:
        found["guided"]["cuthbert"] = _cuthbert(num_particles, ys)
    return found


def check(libraries: dict[str, OfKey], seed: int, ys: Float[Array, "t 1"]) -> None:
    """Refuse to time what computes something else; this also compiles.

    Raises:
        RuntimeError: If a mean log evidence differs from that of the Kalman filter by more than 5 standard errors.
    """
    truth = exact(ys)
    for library, of in libraries.items():
        values = np.array([float(of(key)) for key in jax.random.split(jax.random.key(seed + 1), CHECKED)])
        error = values.std(ddof=1) / np.sqrt(CHECKED)
        # A logarithm is biased by half its variance; float32 sums of a hundred terms have errors of 1e-4 of them.
        apart = abs(values.mean() + 0.5 * values.var() - truth)
        if not apart < 5 * error + 1e-4 * abs(truth):
            raise RuntimeError(
                f"{library} finds a log evidence of {values.mean():.4g} +- {error:.2g}, not {truth:.4g}."
            )


def _smcx(num_particles: int, ys: Float[Array, "t 1"], *, guided: bool) -> OfKey:
    library = import_module("smcx")
    start = lambda key, n: STATIONARY * jax.random.normal(key, (n, 1))
    likelihood = lambda y, x: log_likelihood(x, y)
    options = {"resampling_threshold": 1.1, "store_history": False}

    @jax.jit
    def of(key: AnyKey) -> Array:
        if guided:
            sample = lambda key, x, y: center(x, y) + SPREAD * jax.random.normal(key, x.shape)
            log_q = lambda y, new, x: log_proposal(new, x, y)
            arguments = (start, sample, log_q, log_transition, likelihood, ys, num_particles)
            return library.guided_filter(key, *arguments, **options).marginal_loglik
        move = lambda key, x: RHO * x + STD_X * jax.random.normal(key, x.shape)
        first_stage = lambda y, x: log_first_stage(x, y)
        others = (start, move, likelihood, first_stage, ys, num_particles)
        return library.auxiliary_filter(key, *others, **options).marginal_loglik

    return of


def _particles(name: str, num_particles: int, ys: Float[Array, "t 1"]) -> OfKey:
    library, models = import_module("particles"), import_module("particles.state_space_models")
    model = import_module("particles.kalman").LinearGauss(sigmaX=STD_X, sigmaY=STD_Y, rho=RHO)
    data = np.asarray(ys, np.float64)[:, 0]

    def of(key: AnyKey) -> float:
        # The package draws from numpy's global generator: its runs differ whatever the key.
        del key
        algorithm = library.SMC(fk=getattr(models, name)(ssm=model, data=data), N=num_particles, ESSrmin=1.0)
        algorithm.run()
        return float(algorithm.logLt)

    return of


def _cuthbert(num_particles: int, ys: Float[Array, "t 1"]) -> OfKey:
    library = import_module("cuthbert")
    potential = lambda x, new, y: log_likelihood(new, y) + log_transition(new, x) - log_proposal(new, x, y)
    filtering = import_module("cuthbert.smc.particle_filter").build_filter(
        lambda key: STATIONARY * jax.random.normal(key, (1,)),
        lambda key, x, y: center(x, y) + SPREAD * jax.random.normal(key, (1,)),
        potential,
        num_particles,
        import_module("cuthbertlib.resampling.systematic").resampling,
    )

    @jax.jit
    def of(key: AnyKey) -> Array:
        start, rest = jax.random.split(key)
        states = library.filter(filtering, ys, filtering.init_prepare(key=start), key=rest)
        return states.log_normalizing_constant[-1]

    return of
