"""Bad input: samplers of parameters reject it and name the argument, or announce it where values are traced.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)
YS = jnp.ones((3, 1))
normal = jax.scipy.stats.norm.logpdf


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


def filter_of(noise=1.0, **options):
    prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(1), jnp.eye(1)))
    settings = {"sample_prior": prior, "num_particles": 4, "noise": jf.StandardNormal(1)} | options
    return jf.bootstrap(
        sample_transition=lambda e, x: x + e, log_likelihood=lambda x, y: normal(y, x, noise).sum(), **settings
    )


def two_numbers():
    return jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), jnp.eye(2)))


def kernel(filter=None, redraw=None, **options):
    return jf.mcmc.conditional_smc(filter or filter_of(), redraw or jf.mcmc.ancestral(), **options)


def chain(log_likelihood=lambda key, x: -(x**2), log_prior=normal, start=None, **options):
    sampler = jf.mcmc.pmmh(log_likelihood, log_prior, **options)
    return jf.mcmc.init(KEY, sampler, jnp.ones(3) if start is None else start)


def correlated(filter=None, **options):
    likelihood = jf.mcmc.correlated(lambda x: filter or filter_of(), YS, **options)
    return chain(likelihood)


def smc(sampler=None, sample_prior=jax.random.normal, log_prior=normal, log_likelihood=normal, **options):
    sampler = sampler or partial(jf.mcmc.tempered_smc, num_particles=8, num_moves=1)
    return sampler(KEY, sample_prior, log_prior, log_likelihood, **options)


def nested(filter_of=filter_of, sample_prior=jax.random.exponential, log_prior=lambda x: -x, **options):
    settings = {"observations": YS, "num_particles": 4} | options
    return jf.mcmc.smc2(KEY, filter_of, sample_prior, log_prior, **settings)


def calibrated(draws=9, **options):
    settings = {"num_runs": 2, "num_bins": 5} | options
    posterior = draws if callable(draws) else lambda key, y: jnp.zeros(draws)
    return jf.mcmc.calibrate(KEY, jax.random.normal, lambda key, theta: theta, posterior, **settings)


CASES = [
    Case("another filter", lambda: kernel(jf.kalman(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), *[jnp.eye(1)] * 4)),
         ("filter", "bootstrap", "Kalman")),
    Case("one particle", lambda: kernel(filter_of(num_particles=1)), ("num_particles", "2", "1")),
    Case("tempered", lambda: kernel(filter_of(temper=jf.AdaptiveTempering(0.5))), ("filter", "temper", "0.5")),
    Case("no redraw", lambda: kernel(redraw=3), ("redraw", "ancestral()", "3")),
    Case("no density", lambda: jf.mcmc.ancestor_sampling(None), ("log_transition", "None")),
    Case("backward density", lambda: jf.mcmc.backward_sampling(lambda x: x), ("log_transition", "x_next")),
    Case("short path", lambda: jf.mcmc.update_path(KEY, kernel(), jnp.zeros((3, 1)), YS), ("path", "(4, 1)", "(3, 1)")),
    Case("path of another kind", lambda: jf.mcmc.update_path(KEY, kernel(), {"x": 1.0}, YS), ("path", "structure")),
    Case("lengths", lambda: jf.mcmc.initial_path(KEY, kernel(), YS, jnp.ones(2)), ("observations", "inputs", "(2,)")),
    Case("impossible", lambda: jf.mcmc.initial_path(KEY, kernel(filter_of(jnp.nan)), YS),
         ("observations", "log_likelihood", "3 frames")),
    Case("no scheme", lambda: kernel(scheme=3), ("scheme", "3")),
    Case("kernel of gibbs", lambda: jf.mcmc.init(
        KEY, jf.mcmc.particle_gibbs(lambda x: filter_of(), lambda key, x, path: x, YS), jnp.ones(2)
    ), ("kernel_of", "conditional_smc", "Filter")),
    Case("update of gibbs", lambda: jf.mcmc.particle_gibbs(lambda x: kernel(), 3, YS), ("update_parameters", "3")),
    Case("start outside", lambda: chain(proposal=jf.mcmc.random_walk(jf.fit.positive), start=jnp.array([1.0, -1.0])),
         ("theta", "constraints", "[1]")),
    Case("prior at start", lambda: chain(log_prior=jnp.log, start=jnp.array([0.0, 1.0])),
         ("theta", "log_prior", "[0]")),
    Case("likelihood at start", lambda: chain(lambda key, x: jnp.log(x), start=-jnp.ones(2)),
         ("theta", "log_likelihood", "[0, 1]")),
    Case("prior not scalar", lambda: chain(log_prior=lambda x: x * jnp.ones(2)), ("log_prior", "scalar", "(2,)")),
    Case("chains", lambda: chain(start={"a": jnp.ones(2), "b": jnp.ones(3)}), ("theta", "last axis", "(3,)")),
    Case("no proposal", lambda: chain(proposal=3), ("proposal", "random_walk", "3")),
    Case("step", lambda: jf.mcmc.random_walk(step=0.0), ("step", "positive", "0.0")),
    Case("acceptance", lambda: jf.mcmc.random_walk(target_acceptance=1.0), ("target_acceptance", "1.0")),
    Case("walk constraints", lambda: jf.mcmc.random_walk({"a": 3.0}), ("constraints", "fit.positive", "3.0")),
    Case("proposed shape", lambda: jf.mcmc.sample(KEY, (s := jf.mcmc.pmmh(
        lambda key, x: -(x**2), normal, proposal=jf.mcmc.proposal(lambda key, x: jnp.ones(2), lambda a, b: 0.0)
    )), jf.mcmc.init(KEY, s, jnp.ones(2)), 1), ("sample", "theta", "(2,)")),
    Case("no samples", lambda: jf.mcmc.sample(KEY, jf.mcmc.pmmh(normal, normal), chain(), 0), ("num_samples", "0")),
    Case("thin", lambda: jf.mcmc.sample(KEY, jf.mcmc.pmmh(normal, normal), chain(), 1, thin=0), ("thin", "0")),
    Case("no warm-up", lambda: jf.mcmc.warm_up(KEY, jf.mcmc.pmmh(normal, normal), chain(), 0), ("num_steps", "0")),
    Case("updates", lambda: jf.mcmc.metropolis_update(lambda x, path: x, num_steps=0), ("num_steps", "0")),
    Case("correlation", lambda: correlated(correlation=1.0), ("correlation", "1.0")),
    Case("keys as noise", lambda: correlated(jf.bootstrap(
        two_numbers(), lambda key, x: x, lambda x, y: -1.0, num_particles=4)), ("noise", "StandardNormal")),
    Case("prior without noise", lambda: correlated(filter_of(sample_prior=lambda key: jnp.zeros(1))),
         ("sample_prior", "gaussian_prior", "from_noise")),
    Case("order", lambda: correlated(jf.bootstrap(
        two_numbers(), lambda e, x: x + e, lambda x, y: -1.0, num_particles=4, noise=jf.StandardNormal(2)
    )), ("sort_by", "2")),
    Case("particles", lambda: smc(jf.mcmc.tempered_smc, num_particles=1), ("num_particles", "1")),
    Case("moves", lambda: smc(jf.mcmc.tempered_smc, num_particles=8, num_moves=0), ("num_moves", "0")),
    Case("chain length", lambda: smc(jf.mcmc.waste_free_smc, num_particles=8, chain_length=1), ("chain_length", "1")),
    Case("no multiple", lambda: smc(jf.mcmc.waste_free_smc, num_particles=8, chain_length=3),
         ("num_particles", "chain_length", "3")),
    Case("temperatures fall", lambda: jf.mcmc.fixed_temperatures(jnp.array([0.5, 0.2, 1.0])), ("temperatures", "0.2")),
    Case("temperatures end", lambda: jf.mcmc.fixed_temperatures(jnp.array([0.5, 0.8])), ("temperatures", "end at 1")),
    Case("temperature 0", lambda: jf.mcmc.fixed_temperatures(jnp.array([0.0, 1.0])), ("temperatures", "(0, 1]")),
    Case("no temperatures", lambda: smc(temperatures=0.5), ("temperatures", "0.5")),
    Case("ess fraction", lambda: jf.mcmc.adaptive_temperatures(1.0), ("ess_fraction", "1.0")),
    Case("stages", lambda: jf.mcmc.adaptive_temperatures(max_stages=0), ("max_stages", "0")),
    Case("prior outside", lambda: smc(log_prior=lambda x: jnp.where(x > 0, -x, -jnp.inf)),
         ("sample_prior", "log_prior")),
    Case("NaN likelihood", lambda: smc(log_likelihood=jnp.log), ("log_likelihood", "NaN")),
    Case("no likelihood", lambda: smc(log_likelihood=lambda x: -jnp.inf + 0 * x), ("log_likelihood", "-inf")),
    Case("constraint of draws", lambda: smc(constraints=jf.fit.positive), ("sample_prior", "constraints")),
    Case("stages end", lambda: smc(log_likelihood=lambda x: normal(5.0, x, 0.01),
         temperatures=jf.mcmc.adaptive_temperatures(max_stages=1)), ("max_stages", "temperature 1")),
    Case("nested particles", lambda: nested(num_particles=1), ("num_particles", "1")),
    Case("nested threshold", lambda: nested(ess_threshold=-1.0), ("ess_threshold", "-1.0")),
    Case("nested lengths", lambda: nested(mask=jnp.ones(2, bool)), ("observations", "mask", "(2,)")),
    Case("bins", lambda: calibrated(num_bins=1), ("num_bins", "1")),
    Case("draws and bins", lambda: calibrated(8), ("sample_posterior", "num_bins", "8")),
    Case("draws of another shape", lambda: calibrated(lambda key, y: jnp.zeros((9, 2))),
         ("sample_posterior", "(9, 2)")),
    Case("draws of another kind", lambda: calibrated(lambda key, y: {"x": y}), ("sample_posterior", "tree")),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)


@pytest.mark.system
def test_nested_samplers_reject_draws_outside_their_constraints(check_rejected):
    call = partial(nested, sample_prior=jax.random.normal, constraints=jf.fit.positive)
    check_rejected(call, ("sample_prior", "constraints"))


@pytest.mark.system
def test_under_jit_a_sampler_announces_what_it_would_reject():
    sampler = partial(jf.mcmc.tempered_smc, num_particles=8, num_moves=1)
    densities = {
        jf.mcmc.SMCStatus.OUTSIDE_SUPPORT: (lambda x: jnp.where(x > 0, -x, -jnp.inf), normal),
        jf.mcmc.SMCStatus.INVALID_DENSITY: (normal, jnp.log),
    }
    for status, (log_prior, log_likelihood) in densities.items():
        found = jax.jit(lambda key, p=log_prior, l=log_likelihood: sampler(key, jax.random.normal, p, l))(KEY)
        assert (int(found.status), bool(jnp.isnan(found.log_evidence))) == (status, True)


def test_a_proposal_that_excludes_its_own_draws_never_moves_and_says_so():
    """Uniform draws about the present place, under a density that is zero outside another interval."""
    proposal = jf.mcmc.proposal(
        lambda key, x: x + jax.random.uniform(key), lambda new, old: jnp.where(new > old + 2, 0.0, -jnp.inf)
    )
    sampler = jf.mcmc.pmmh(lambda key, x: -(x**2), normal, proposal=proposal)
    state, draws = jf.mcmc.sample(KEY, sampler, jf.mcmc.init(KEY, sampler, jnp.ones(2)), 5)
    assert draws.info.invalid.all()
    np.testing.assert_array_equal(state.theta, 1.0)


def test_proposed_parameters_whose_likelihood_is_nan_are_rejected_and_counted():
    sampler = jf.mcmc.pmmh(lambda key, x: jnp.log(x), normal, proposal=jf.mcmc.random_walk(step=2.0))
    _, draws = jf.mcmc.sample(KEY, sampler, jf.mcmc.init(KEY, sampler, jnp.ones(8)), 20)
    assert (draws.theta > 0).all()
    assert 0 < int(draws.info.invalid.sum()) < 160
