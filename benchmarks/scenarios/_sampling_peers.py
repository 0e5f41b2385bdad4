"""The samplers of other libraries on the problems of `bench sampling`; each is imported only where it is asked for."""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.benchmarks.scenarios._sampling_problems import (
    PRIOR_MEAN,
    PRIOR_SD,
    RHO,
    Sizes,
    log_evidence_of_first,
    log_prior,
    regression,
)
from jaxfilters.typing import AnyKey

PEERS = ("particles", "smcx", "blackjax")


def installed() -> list[str]:
    """Those of `PEERS` that this Python can import."""
    return [name for name in PEERS if find_spec(name) is not None]


def gibbs_of_particles(returns: Float[Array, " t"], sizes: Sizes) -> Callable[[int], np.ndarray]:
    """Sweeps of conditional SMC with backward sampling; the states of all frames, (sweeps, t)."""
    library = import_module("particles")
    mcmc = import_module("particles.mcmc")
    model = library.state_space_models.Bootstrap(ssm=_model()(z=PRIOR_MEAN), data=list(np.asarray(returns, float)))
    first = library.SMC(fk=model, N=sizes.num_states, store_history=True, collect="off")
    first.run()
    path = [first.hist.extract_one_trajectory()]

    def sweeps(seed: int) -> np.ndarray:
        np.random.seed(seed)  # noqa: NPY002
        found = []
        for _ in range(sizes.num_sweeps):
            sweep = mcmc.CSMC(fk=model, N=sizes.num_states, ESSrmin=1.1, xstar=path[0])
            sweep.run()
            path[0] = [np.ravel(x)[0] for x in sweep.hist.backward_sampling(1)]
            found.append(np.array(path[0]))
        return np.array(found)

    return sweeps


def smc2_of_particles(returns: Float[Array, " t"], sizes: Sizes) -> Callable[[int], float]:
    """SMC^2; its log evidence, to which that of the first return is added, because version 0.3 leaves it out."""
    library = import_module("particles")
    first_return = float(log_evidence_of_first(returns))
    samplers = import_module("particles.smc_samplers")
    # Version 0.3 uses a name that NumPy no longer has.
    vars(np).setdefault("float", float)
    distributions = import_module("particles.distributions")
    prior = distributions.StructDist({"z": distributions.Normal(loc=PRIOR_MEAN, scale=PRIOR_SD)})

    def run(seed: int) -> float:
        np.random.seed(seed)  # noqa: NPY002
        model = samplers.SMC2(
            ssm_cls=_model(),
            prior=prior,
            data=list(np.asarray(returns, float)[: sizes.num_frames_nested]),
            init_Nx=sizes.num_states_nested,
            wastefree=False,
            len_chain=sizes.num_moves + 1,
            smc_options={"ESSrmin": 1.1},
        )
        found = library.SMC(fk=model, N=sizes.num_parameters, collect="off")
        found.run()
        return float(found.logLt) + first_return

    return run


def smc2_of_smcx(returns: Float[Array, " t"], sizes: Sizes) -> Callable[[int], float]:
    """SMC^2; its log evidence. It compiles in every call, because it builds its functions there."""
    smc2 = import_module("smcx.smc2").smc2

    def initial(key: AnyKey, count: int, theta: Array) -> Array:
        prior_key, move_key = jax.random.split(key)
        before = jax.random.normal(prior_key, (count, 1))
        return RHO * before + jnp.exp(theta) * jax.random.normal(move_key, (count, 1))

    def transition(key: AnyKey, x: Array, theta: Array) -> Array:
        return RHO * x + jnp.exp(theta) * jax.random.normal(key, (1,))

    def log_likelihood(y: Array, x: Array, theta: Array) -> Array:
        del theta
        return jax.scipy.stats.norm.logpdf(y[0], 0.0, jnp.exp(x[0] / 2))

    def run(seed: int) -> float:
        found = smc2(
            jax.random.key(seed),
            lambda key, count: PRIOR_MEAN + PRIOR_SD * jax.random.normal(key, (count, 1)),
            lambda theta: log_prior(theta[0]),
            initial,
            transition,
            log_likelihood,
            returns[: sizes.num_frames_nested],
            sizes.num_parameters,
            sizes.num_states_nested,
            num_pmmh_steps=sizes.num_moves,
            store_history=False,
        )
        return float(found.marginal_loglik)

    return run


def tempered_of_blackjax(sizes: Sizes) -> Callable[[int], float]:
    """Adaptive tempered SMC with a random walk; its log evidence."""
    blackjax = import_module("blackjax")
    resampling = import_module("blackjax.smc.resampling")
    prior, log_likelihood, walk = regression()
    step = partial(blackjax.additive_step_random_walk.build_kernel(), random_step=lambda key, _: walk(key))
    sampler = blackjax.adaptive_tempered_smc(
        prior, log_likelihood, step, blackjax.additive_step_random_walk.init, {}, resampling.systematic, 0.5,
        num_mcmc_steps=sizes.num_tempered_moves,
    )  # fmt: skip

    @jax.jit
    def run(key: AnyKey) -> Any:
        start_key, key = jax.random.split(key)
        start = sampler.init(jax.random.normal(start_key, (sizes.num_tempered, 3)))

        def advance(carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
            number, state, total = carry
            state, info = sampler.step(jax.random.fold_in(key, number), state)
            return number + 1, state, total + info.log_likelihood_increment

        return jax.lax.while_loop(lambda carry: carry[1].tempering_param < 1, advance, (0, start, 0.0))[2]

    return lambda seed: float(run(jax.random.key(seed)))


def _model():
    """The stochastic volatility model as a class of particles, which moves its prior once before the first return."""
    spaces = import_module("particles.state_space_models")
    distributions = import_module("particles.distributions")

    class Volatility(spaces.StateSpaceModel):
        def PX0(self):
            return distributions.Normal(scale=np.sqrt(RHO**2 + np.exp(2 * self.z)))

        def PX(self, t, xp):
            del t
            return distributions.Normal(loc=RHO * xp, scale=np.exp(self.z))

        def PY(self, t, xp, x):
            del t, xp
            return distributions.Normal(scale=np.exp(x / 2))

    return Volatility
