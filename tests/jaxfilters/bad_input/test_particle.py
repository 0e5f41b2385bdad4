"""Bad input: Particle and ensemble filters reject it at trace time or before, and name the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
Q, R = 0.1 * jnp.eye(2), jnp.eye(1)
NORMAL, ONE = jf.StandardNormal(1), jnp.eye(1)
YS = jnp.zeros((3, 1))


def prior(key):
    return jnp.zeros(1)


def move(noise, x, u):
    return x + noise


def log_likelihood(x, y):
    return -jnp.sum((x - y) ** 2)


def integer_prior(key):
    return jnp.zeros(1, int)


def vector_log_likelihood(x, y):
    return -((x - y) ** 2)


def run_bootstrap(prior=prior, move=move, log_likelihood=log_likelihood, ys=YS, noise=NORMAL, **options):
    options = {"num_particles": 8} | options
    return jf.run(jf.bootstrap(prior, move, log_likelihood, noise=noise, **options), KEY, ys)


def run_correlated(variance=None, B=None, tau=1.0, ys=YS, observe=lambda x: x, **options):
    process = jf.GaussMarkov(jnp.array(tau), jnp.ones(1) if B is None else B)
    variance = jnp.ones(1) if variance is None else variance
    filter = jf.correlated_bootstrap(
        prior, move, observe, variance, process, num_particles=8, noise=NORMAL, **options
    )  # fmt: skip
    return jf.run(filter, KEY, ys)


def log_transition(x_next, x):
    return -jnp.sum((x_next - x) ** 2)


def log_q(x_next, x, y):
    return -jnp.sum((x_next - y) ** 2)


def run_proposed(sample=lambda noise, x, y: y + noise, density=log_q, proposal=None, **options):
    proposal = (sample, density) if proposal is None else proposal
    options = {"num_particles": 8, "noise": NORMAL, "log_transition": log_transition} | options
    return jf.run(jf.guided(prior, move, log_likelihood, proposal=proposal, **options), KEY, YS)


def run_auxiliary(log_first_stage=log_likelihood, **options):
    options = {"num_particles": 8, "noise": NORMAL} | options
    return jf.run(jf.auxiliary(prior, move, log_likelihood, log_first_stage=log_first_stage, **options), KEY, YS)


def run_optimal(ys=YS, **options):
    model = {"prior": jf.Gaussian(jnp.zeros(1), ONE), "transition": lambda x: x, "process_noise": ONE}
    model |= {"observe": lambda x: x, "observation_noise": ONE, "num_particles": 8} | options
    return jf.run(jf.locally_optimal(**model), KEY, ys)


def run_laplace(Q=ONE, log_likelihood=log_likelihood, transition=lambda x: x, **options):
    proposal = jf.proposals.laplace(transition, Q, log_likelihood, **options)
    return run_proposed(proposal=proposal)


def run_twisted(ys=YS, inputs=None, prior=jf.Gaussian(jnp.zeros(1), ONE), **options):  # noqa: B008
    model = {"transition": lambda x: x, "process_noise": ONE, "log_likelihood": log_likelihood, "num_particles": 8}
    return jf.iterated_auxiliary(key=KEY, prior=prior, observations=ys, inputs=inputs, **model | options)


def tempered(ess_fraction):
    return lambda: run_bootstrap(temper=jf.AdaptiveTempering(ess_fraction))


VELOCITY = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
STEP = {"A_n": jnp.ones((1, 2)), "Q_n": jnp.eye(1), "f_l": jnp.zeros(2), "A_l": jnp.eye(2), "Q_l": jnp.eye(2)}
READING = {"h": jnp.zeros(1), "C": jnp.ones((1, 2)), "R": jnp.eye(1)}


def marginal(build=jf.rao_blackwell, prior=prior, belief=VELOCITY, likelihood=log_likelihood, **options):
    step = STEP | {name: options.pop(name) for name in STEP if name in options}
    f_n = options.pop("f_n", lambda x: x)
    options = {"num_particles": 8, "noise_dim": 1} | options
    return build(prior, belief, lambda x, u: jf.MixedDynamics(f_n=f_n(x), **step), likelihood, **options)


def run_marginal(*, ys=YS, **options):
    return jf.run(marginal(**options), KEY, ys)


def run_linear(ys=YS, **fields):
    return run_marginal(likelihood=None, observe=lambda x: jf.LinearObservation(**READING | fields), ys=ys)


def depends_on_x(x, u):
    return jf.MixedDynamics(x, jnp.cos(x)[:, None] * jnp.ones((1, 2)), *list(STEP.values())[1:])


def run_guided(point=lambda y: y, information=ONE, **options):
    guide = lambda particles, log_weights, y: jf.Guidance(point(y), information)
    return jf.run(jf.guided_rao_blackwell(marginal(jf.rao_blackwell_shared), guide, **options), KEY, YS)


def run_adaptive(prior=lambda key: jnp.zeros(2), log_likelihood=lambda x, y: -jnp.sum(x**2, axis=0), **options):
    fit = jf.math.diffusion.start(jnp.ones(2))
    options = {"num_particles": 8, "mode_scale": jnp.ones(2)} | options
    return jf.run(jf.adaptive_diffusion(prior, log_likelihood, fit, **options), KEY, YS)


def partitions(groups, **options):
    return lambda: run_adaptive(partitions=jf.Partitions(groups, **options))


def run_ensemble(
    prior=lambda key: jnp.zeros(2), move=lambda noise, x, u: x, R=R, observe=lambda x: x[:1], ys=YS, **options
):
    return jf.run(jf.ensemble_kalman(prior, move, observe, R, **{"num_particles": 8} | options), KEY, ys)


def history(**fields):
    good = {"particles": jnp.zeros((3, 1, 8)), "log_weights": jnp.zeros((3, 8)), "ancestors": jnp.zeros((3, 8), int)}
    return jf.smoothing.History(**good | fields)


def sample_paths(log_transition=lambda x_next, x, u: -jnp.sum((x_next - x) ** 2), *, past=None, **options):
    past = history() if past is None else past
    return jf.smoothing.backward_sampling(KEY, past, log_transition, **{"num_paths": 4} | options)


def gaussian_filter():
    return jf.extended_kalman(PRIOR, lambda x, u: x, Q, lambda x: x[:1], R)


def one_device():
    return jax.sharding.Mesh(jax.devices()[:1], ("particles",))


def filter_of(**options):
    return jf.bootstrap(prior, move, log_likelihood, num_particles=8, noise=jf.StandardNormal(1), **options)


def bad_dynamics():
    return jf.rao_blackwell(prior, VELOCITY, lambda x, u: x, log_likelihood, num_particles=8, noise_dim=1)


def not_shared():
    return jf.rao_blackwell_shared(prior, VELOCITY, depends_on_x, log_likelihood, num_particles=8, noise_dim=1)


def run_guided_by_mixture(**fields):
    several = jf.GuidanceMixture(jnp.zeros((2, 1)), jnp.ones((2, 1, 1)), jnp.zeros(2))._replace(**fields)
    inner = marginal(jf.rao_blackwell_shared)
    return jf.run(jf.guided_rao_blackwell(inner, lambda particles, log_weights, y: several), KEY, YS)


def unguided():
    return jf.guided_rao_blackwell(marginal(jf.rao_blackwell_shared), lambda particles, log_weights, y: y)


NAN = float("nan")
INDEFINITE = jnp.array([[1.0, 2.0], [2.0, 1.0]])
ASYMMETRIC = jnp.array([[1.0, 0.5], [0.0, 1.0]])

PARTICLE = [
    Case("batch, no function", lambda: jf.batch_log_likelihood(3.0), ("log_likelihood", "callable", "3.0")),
    # The bootstrap filter, and what all particle filters have in common.
    Case("likelihood (1,)", lambda: run_bootstrap(log_likelihood=vector_log_likelihood), ("log_likelihood", "(1,)")),
    Case("likelihood pair", lambda: run_bootstrap(log_likelihood=lambda x, y: (0.0, 0.0)), ("log_likelihood", "(0.0")),
    Case("scalar state", lambda: run_bootstrap(lambda key: jnp.zeros(())), ("sample_transition", "()", "(1,)")),
    Case("longer state", lambda: run_bootstrap(move=lambda e, x, u: jnp.append(x, e)), ("sample_transition", "(2,)")),
    Case("other structure", lambda: run_bootstrap(move=lambda e, x, u: (x, e)), ("sample_transition", "structure")),
    Case("integer prior", lambda: run_bootstrap(integer_prior), ("sample_prior", "int32", "float32")),
    Case("integer state", lambda: run_bootstrap(move=lambda e, x, u: x.astype(int)), ("sample_transition", "int32")),
    Case("prior no function", lambda: run_bootstrap(jnp.zeros(1)), ("sample_prior",)),
    Case("likelihood no function", lambda: run_bootstrap(log_likelihood=0.0), ("log_likelihood",)),
    Case("noise no function", lambda: run_bootstrap(noise=3), ("noise", "3")),
    Case("noise of one particle", lambda: run_bootstrap(noise=lambda key, n: jnp.zeros(1)), ("noise", "8", "(1,)")),
    Case("correlated, time", lambda: run_correlated(tau=0.0), ("time_constant", "positive", "0.0")),
    Case("correlated, rows", lambda: run_correlated(B=jnp.eye(1)), ("process", "independent", "(1, 1)")),
    Case("correlated, variances", lambda: run_correlated(jnp.ones(2)), ("variance", "(1,)", "(2,)")),
    Case("correlated, negative", lambda: run_correlated(-jnp.ones(1)), ("variance", "at least 0", "-1.0")),
    Case("correlated, wide y", lambda: run_correlated(ys=jnp.zeros((3, 2))), ("observation y", "(1,)", "(2,)")),
    Case("correlated, observe", lambda: run_correlated(observe=lambda x: x[0]), ("observe", "(1, 8)", "(8,)")),
    Case("correlated, dt", lambda: run_correlated(dt=-1.0), ("dt", "positive", "-1.0")),
    Case("normal of half", lambda: jf.StandardNormal(0.5), ("shape", "0.5")),
    Case("normal negative", lambda: jf.StandardNormal((3, -1)), ("shape", "-1")),
    Case("no particles", lambda: run_bootstrap(num_particles=0), ("num_particles", "0")),
    Case("particles True", lambda: run_bootstrap(num_particles=True), ("num_particles", "True")),
    Case("half a particle", lambda: run_bootstrap(num_particles=8.5), ("num_particles", "8.5")),
    Case("threshold NaN", lambda: run_bootstrap(ess_threshold=NAN), ("ess_threshold", "nan")),
    Case("threshold -1", lambda: run_bootstrap(ess_threshold=-1.0), ("ess_threshold", "-1.0")),
    Case("threshold True", lambda: run_bootstrap(ess_threshold=jnp.array(True)), ("ess_threshold",)),
    Case("threshold None", lambda: run_bootstrap(ess_threshold=None), ("ess_threshold", "None")),
    Case("threshold (2,)", lambda: run_bootstrap(ess_threshold=jnp.ones(2)), ("ess_threshold", "(2,)")),
    Case("scheme by name", lambda: run_bootstrap(scheme="systematic"), ("scheme", "systematic")),
    Case("few ancestors", lambda: run_bootstrap(scheme=lambda k, w: jnp.zeros(3, int)), ("scheme", "(8,)", "(3,)")),
    Case("float ancestors", lambda: run_bootstrap(scheme=lambda k, w: 0 * w), ("scheme", "float32")),
    Case("ess fraction -0.5", tempered(-0.5), ("ess_fraction", "-0.5")),
    Case("ess fraction 0", tempered(0.0), ("ess_fraction", "0.0")),
    Case("ess fraction 1.5", tempered(1.5), ("ess_fraction", "1.5")),
    Case("ess fraction NaN", tempered(NAN), ("ess_fraction", "nan")),
    Case("ess fraction array", tempered(jnp.array(2.0)), ("ess_fraction", "2.0")),
    Case("temper (1,)", lambda: run_bootstrap(temper=lambda ll, lw: ll[:1]), ("temper", "(1,)", "(8,)")),
    Case("temper number", lambda: run_bootstrap(temper=0.2), ("temper", "0.2")),
    # Weights, resampling and priors.
    Case("integer weights", lambda: jf.weights.normalize(jnp.arange(3)), ("log_weights",)),
    Case("square weights", lambda: jf.weights.linear(jnp.zeros((3, 3))), ("log_weights", "3")),
    Case("resampling, integers", lambda: jf.resampling.stratified(KEY, jnp.arange(3)), ("log_weights",)),
    Case("resampling, NaN", lambda: jf.resampling.ssp(KEY, jnp.array([0.0, NAN])), ("log_weights", "NaN", "1 of 2")),
    Case("resampling, square", lambda: jf.resampling.systematic(KEY, jnp.zeros((3, 3))), ("log_weights", "3")),
    Case("soft share 1", lambda: jf.differentiable_resampling.soft(1.0), ("share", "1.0")),
    Case("transport 0", lambda: jf.differentiable_resampling.transport(0.0), ("regularization", "0.0")),
    Case("prior indefinite", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), INDEFINITE)), ("belief", "-1")),
    Case("prior lopsided", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), ASYMMETRIC)), ("belief", "0.5")),
    Case("prior NaN", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), NAN * Q)), ("belief", "nan")),
    Case("prior (3,)", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(3), Q)), ("belief", "(3,)", "(2, 2)")),
    Case("prior ints", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2, int), Q)), ("belief.mean", "int32")),
    Case("prior of noise", lambda: jf.priors.from_noise(lambda e: e, 3), ("noise", "3")),
    Case("resampling, no draws", lambda: jf.resampling.ssp(KEY, jnp.zeros(3), 0), ("num_samples", "0")),
    Case("resampling, half a draw", lambda: jf.resampling.residual(KEY, jnp.zeros(3), 2.5), ("num_samples", "2.5")),
    Case("killing, square", lambda: jf.resampling.killing(KEY, jnp.zeros((3, 3))), ("log_weights", "3")),
    Case("metropolis 0", lambda: jf.resampling.metropolis(0), ("num_steps", "0")),
    Case("metropolis, integers", lambda: jf.resampling.metropolis(3)(KEY, jnp.arange(3)), ("log_weights",)),
    Case("metropolis steps", lambda: jf.resampling.metropolis_steps(0.5, 0.1), ("largest", "0.5")),
    Case("metropolis bias", lambda: jf.resampling.metropolis_steps(2.0, 1.0), ("bias", "1.0")),
    # Proposals and first stages.
    Case("proposal of one", lambda: run_proposed(proposal=log_q), ("proposal", "pair", "log_q")),
    Case("proposal of three", lambda: run_proposed(proposal=(log_q, log_q, log_q)), ("proposal", "pair")),
    Case("proposal number", lambda: run_proposed(sample=0.0), ("sample of proposal", "0.0")),
    Case("proposal arguments", lambda: run_proposed(density=lambda x: 0.0), ("log_density of proposal", "x_next")),
    Case("proposal state", lambda: run_proposed(lambda e, x, y: x[0]), ("sample of proposal", "()", "(1,)")),
    Case("proposal vector", lambda: run_proposed(density=lambda a, x, y: x), ("log_density of proposal", "(1,)")),
    Case("no transition density", lambda: run_proposed(log_transition=None), ("log_transition", "None")),
    Case("transition vector", lambda: run_proposed(log_transition=lambda a, x: x), ("log_transition", "(1,)")),
    Case("jump, no function", lambda: run_guided(jump=0.1), ("jump", "callable", "0.1")),
    Case("jump, a number", lambda: run_guided(jump=lambda inputs: 0.1), ("jump", "Jump", "float")),
    Case("jump, sure", lambda: run_guided(jump=lambda inputs: jf.Jump(1.0, ONE)), ("probability of jump", "1.0")),
    Case("jump (2, 2)", lambda: run_guided(jump=lambda u: jf.Jump(0.1, jnp.eye(2))), ("covariance of jump", "(2, 2)")),
    Case("guided noise", lambda: run_proposed(noise=lambda key, n: jnp.zeros(1)), ("noise", "8", "(1,)")),
    Case(
        "guided, a filter",
        lambda: jf.guided(filter_of(), 0, 0, log_transition=0, proposal=0, num_particles=8),
        ("guided_rao_blackwell",),
    ),
    Case("guided threshold", lambda: run_proposed(ess_threshold=-1.0), ("ess_threshold", "-1.0")),
    Case("no first stage", lambda: run_auxiliary(None), ("log_first_stage", "None")),
    Case("first stage vector", lambda: run_auxiliary(lambda x, y: x - y), ("log_first_stage", "(1,)")),
    Case("half a proposal", lambda: run_auxiliary(log_transition=log_transition), ("proposal", "log_transition")),
    Case(
        "auxiliary transport",
        lambda: run_auxiliary(scheme=jf.differentiable_resampling.transport()),
        ("scheme", "transport"),
    ),
    Case("optimal R sign", lambda: run_optimal(observation_noise=-ONE), ("observation_noise", "-1")),
    Case("optimal Q (2, 2)", lambda: run_optimal(process_noise=Q), ("process_noise", "(2, 2)", "(1, 1)")),
    Case("optimal Q of inputs", lambda: run_optimal(process_noise=lambda u: Q), ("process_noise", "(2, 2)")),
    Case("optimal wide y", lambda: run_optimal(jnp.zeros((3, 2))), ("observation", "(2,)", "(1,)")),
    Case("optimal observe", lambda: run_optimal(observe=lambda x: jnp.append(x, x)), ("observe", "(2,)", "(1,)")),
    Case("optimal transition", lambda: run_optimal(transition=lambda x: x[0]), ("transition", "()", "(1,)")),
    Case("optimal share", lambda: run_optimal(prior_share=1.0), ("prior_share", "1.0")),
    Case("optimal rounds", lambda: run_optimal(iterations=0), ("iterations", "0")),
    Case("optimal prior", lambda: run_optimal(prior=jnp.zeros(1)), ("prior", "Gaussian")),
    Case("laplace Q sign", lambda: run_laplace(-ONE), ("process_noise", "-1")),
    Case("laplace likelihood", lambda: run_laplace(log_likelihood=lambda x, y: x), ("log_likelihood", "(1,)")),
    Case("laplace rounds", lambda: run_laplace(iterations=True), ("iterations", "True")),
    Case("twisted few", lambda: run_twisted(num_particles=3), ("num_particles", "4", "3")),
    Case("twisted rounds", lambda: run_twisted(iterations=0), ("iterations", "0")),
    Case("twisted share", lambda: run_twisted(prior_share=0.0), ("prior_share", "0.0")),
    Case("twisted prior", lambda: run_twisted(prior=jnp.zeros(1)), ("prior", "Gaussian")),
    Case("twisted Q", lambda: run_twisted(process_noise=Q), ("process_noise", "(2, 2)", "(1, 1)")),
    Case("twisted Q of inputs", lambda: run_twisted(process_noise=lambda u: Q), ("process_noise", "(2, 2)")),
    Case("twisted likelihood", lambda: run_twisted(log_likelihood=lambda x, y: x), ("log_likelihood", "(1,)")),
    Case("twisted transition", lambda: run_twisted(transition=lambda x: x[0]), ("transition", "()", "(1,)")),
    Case("twisted inputs", lambda: run_twisted(inputs=jnp.zeros(4)), ("inputs", "3, 4")),
    Case("twisted nothing", lambda: run_twisted(ys=jnp.zeros((0, 1))), ("observations", "0")),
    # Rao-Blackwellized filters.
    Case("RB likelihood (1,)", lambda: run_marginal(likelihood=vector_log_likelihood), ("log_likelihood", "(1,)")),
    Case("RB A_n", lambda: run_marginal(A_n=jnp.ones((2, 2))), ("A_n", "(2, 2)", "(1, 2)", "noise_dim")),
    Case("RB Q_n", lambda: run_marginal(Q_n=jnp.ones(1)), ("Q_n", "(1,)", "(1, 1)")),
    Case("RB f_l", lambda: run_marginal(f_l=jnp.zeros(1)), ("f_l", "(1,)", "(2,)")),
    Case("RB A_l", lambda: run_marginal(A_l=jnp.ones(())), ("A_l", "()", "(2, 2)")),
    Case("RB Q_l", lambda: run_marginal(Q_l=jnp.eye(3)), ("Q_l", "(3, 3)", "(2, 2)")),
    Case("RB Q_l scalar", lambda: run_marginal(Q_l=0.1), ("Q_l", "()", "(2, 2)")),
    Case("RB indefinite", lambda: run_marginal(Q_l=INDEFINITE), ("Q_l", "-1")),
    Case("RB negative", lambda: run_marginal(Q_n=-jnp.eye(1)), ("Q_n", "-1")),
    Case("RB f_n", lambda: run_marginal(f_n=lambda x: x[0]), ("f_n", "()", "(1,)")),
    Case("RB noise_dim 2", lambda: run_marginal(noise_dim=2), ("noise_dim", "2", "A_n")),
    Case("RB noise_dim 0", lambda: run_marginal(noise_dim=0), ("noise_dim", "0")),
    Case("RB retract", lambda: run_marginal(retract=lambda x, d: jnp.append(x, d)), ("retract", "(2,)", "(1,)")),
    Case(
        "RB integer prior", lambda: run_marginal(prior=integer_prior, retract=lambda x, d: x + d), ("int32", "float32")
    ),
    Case("RB dynamics", lambda: jf.run(bad_dynamics(), KEY, YS), ("dynamics", "MixedDynamics")),
    Case("RB belief", lambda: run_marginal(belief=jnp.zeros(2)), ("linear_prior", "Gaussian")),
    Case(
        "RB belief (3,)", lambda: run_marginal(belief=jf.Gaussian(jnp.zeros(3), jnp.eye(2))), ("linear_prior", "(3,)")
    ),
    Case("RB belief sign", lambda: run_marginal(belief=jf.Gaussian(jnp.zeros(2), -jnp.eye(2))), ("linear_prior", "-1")),
    Case("RB neither", lambda: run_marginal(likelihood=None), ("log_likelihood", "observe", "neither")),
    Case(
        "RB transport", lambda: run_marginal(scheme=jf.differentiable_resampling.transport()), ("scheme", "transport")
    ),
    Case("RB C", lambda: run_linear(C=jnp.ones((1, 3))), ("C", "(1, 3)", "(1, 2)")),
    Case("RB R", lambda: run_linear(R=jnp.eye(2)), ("R", "(2, 2)", "(1, 1)")),
    Case("RB R sign", lambda: run_linear(R=-jnp.eye(1)), ("R", "-1")),
    Case("RB h", lambda: run_linear(h=jnp.zeros(())), ("h", "()")),
    Case("RB wide y", lambda: run_linear(jnp.zeros((3, 2))), ("observation", "(2,)", "(1,)")),
    Case("shared A_n of x", lambda: jf.run(not_shared(), KEY, YS), ("A_n", "dynamics")),
    # Guided filters.
    Case("guide point", lambda: run_guided(lambda y: y[0]), ("guide", "point", "()", "(1,)")),
    Case(
        "guide points", lambda: run_guided_by_mixture(points=jnp.zeros((3, 1))), ("points of guide", "(3, 1)", "(2, 1)")
    ),
    Case(
        "guide informations",
        lambda: run_guided_by_mixture(information=ONE),
        ("information of guide", "(2, 1, 1)", "(1, 1)"),
    ),
    Case(
        "guide heights", lambda: run_guided_by_mixture(log_likelihoods=jnp.zeros((2, 1))), ("log_likelihoods", "(2, 1)")
    ),
    Case("guide mixture sign", lambda: run_guided_by_mixture(information=-jnp.ones((2, 1, 1))), ("information", "-1")),
    Case(
        "guide mixture infinite",
        lambda: run_guided_by_mixture(log_likelihoods=jnp.array([0.0, jnp.inf])),
        ("log_likelihoods of guide", "inf"),
    ),
    Case("guide no point", lambda: run_guided_by_mixture(log_likelihoods=jnp.zeros(0)), ("guide", "none")),
    Case("guide information", lambda: run_guided(information=jnp.eye(2)), ("information", "(2, 2)", "(1, 1)")),
    Case("guide sign", lambda: run_guided(information=-jnp.eye(1)), ("information", "-1")),
    Case("guide local", lambda: run_guided(local=lambda x, other: 0.0), ("local", "()", "(1,)")),
    Case("guide share", lambda: run_guided(prior_share=1.0), ("prior_share", "1.0")),
    Case("guide kind", lambda: jf.guided_rao_blackwell(marginal(), lambda *a: None), ("inner", "rao_blackwell_shared")),
    Case("guide no function", lambda: jf.guided_rao_blackwell(marginal(jf.rao_blackwell_shared), 0), ("guide", "0")),
    Case("guide result", lambda: jf.run(unguided(), KEY, YS), ("guide", "Guidance")),
    # Adaptive diffusion and partitions.
    Case(
        "adaptive likelihood", lambda: run_adaptive(log_likelihood=lambda x, y: x), ("log_likelihood", "(8,)", "(2, 8)")
    ),
    Case("adaptive prior", lambda: run_adaptive(lambda key: jnp.zeros(3)), ("sample_prior", "3")),
    Case("adaptive scalar", lambda: run_adaptive(lambda key: jnp.zeros(())), ("sample_prior", "()")),
    Case("adaptive integer", lambda: run_adaptive(lambda key: jnp.zeros(2, int)), ("sample_prior", "int32")),
    Case("adaptive scale", lambda: run_adaptive(mode_scale=jnp.ones(3)), ("mode_scale", "3")),
    Case(
        "adaptive steady", lambda: run_adaptive(steady_std=-jnp.ones(1), mode_scale=jnp.ones(3)), ("steady_std", "-1")
    ),
    Case("adaptive low", lambda: run_adaptive(low=jnp.ones(3)), ("low", "(3,)", "(2,)")),
    Case("adaptive high", lambda: run_adaptive(low=2.0, high=1.0), ("low", "high", "2.0", "1.0")),
    Case("adaptive distance", lambda: run_adaptive(mode_distance=0.0), ("mode_distance", "0.0")),
    Case("groups (1, 3)", partitions(jnp.ones((1, 3), bool)), ("groups", "(1, 3)", "2")),
    Case("groups (2,)", partitions(jnp.ones(2, bool)), ("groups", "(2,)")),
    Case("groups of numbers", partitions(jnp.ones((1, 2))), ("groups", "float32")),
    Case("groups without one", partitions(jnp.array([[True, False]])), ("groups", "[1]")),
    Case("jitter", partitions(jnp.ones((1, 2), bool), jitter=-1.0), ("jitter", "-1.0")),
    # Ensemble Kalman filter.
    Case("ensemble R", lambda: run_ensemble(R=jnp.eye(2)), ("R", "(2,)", "(1,)")),
    Case("ensemble R sign", lambda: run_ensemble(R=-jnp.eye(1)), ("R", "-1")),
    Case("ensemble wide y", lambda: run_ensemble(ys=jnp.zeros((3, 2))), ("observation", "(2,)", "(1,)")),
    Case("ensemble observe", lambda: run_ensemble(observe=lambda x: x[0]), ("observe", "()", "(1,)")),
    Case("ensemble state", lambda: run_ensemble(lambda key: jnp.zeros(())), ("sample_prior", "()")),
    Case("ensemble integer", lambda: run_ensemble(lambda key: jnp.zeros(2, int)), ("sample_prior", "int32")),
    Case("ensemble move", lambda: run_ensemble(move=lambda e, x, u: x[:1]), ("sample_transition", "(1,)", "(2,)")),
    Case("ensemble of one", lambda: run_ensemble(num_particles=1), ("num_particles", "1")),
    Case("ensemble True", lambda: run_ensemble(num_particles=True), ("num_particles", "True")),
    Case("inflation 0.9", lambda: run_ensemble(inflation=0.9), ("inflation", "0.9")),
    Case("inflation NaN", lambda: run_ensemble(inflation=NAN), ("inflation", "nan")),
    Case("inflation (2,)", lambda: run_ensemble(inflation=jnp.ones(2)), ("inflation", "(2,)")),
    # Smoothing.
    Case("no paths", lambda: sample_paths(num_paths=0), ("num_paths", "0")),
    Case("paths True", lambda: sample_paths(num_paths=True), ("num_paths", "True")),
    Case("half a path", lambda: sample_paths(num_paths=2.5), ("num_paths", "2.5")),
    Case("transition (1,)", lambda: sample_paths(lambda new, x, u: x - new), ("log_transition", "(1,)")),
    Case("long inputs", lambda: sample_paths(inputs=jnp.zeros(4)), ("inputs", "3", "(4,)")),
    Case("scalar inputs", lambda: sample_paths(inputs=jnp.zeros(())), ("inputs", "()")),
    Case("no history", lambda: sample_paths(past=jnp.zeros(3)), ("history",)),
    Case("history weights", lambda: sample_paths(past=history(log_weights=jnp.zeros(8))), ("log_weights", "(8,)")),
    Case(
        "history floats",
        lambda: jf.smoothing.trajectories(history(ancestors=jnp.zeros((3, 8)))),
        ("ancestors", "float32"),
    ),
    Case(
        "history short",
        lambda: jf.smoothing.trajectories(history(particles=jnp.zeros((2, 8)))),
        ("particles", "(2, 8)"),
    ),
    # Sharding.
    Case("placement, no mesh", lambda: jf.sharding.placement(filter_of(), 4), ("mesh", "4")),
    Case("placement, no filter", lambda: jf.sharding.placement(0, one_device()), ("filter", "0")),
    Case(
        "placement, Gaussian",
        lambda: jf.sharding.placement(gaussian_filter(), one_device()),
        ("filter", "ExtendedKalman"),
    ),
    Case("axis", lambda: jf.sharding.placement(filter_of(), one_device(), axis="rows"), ("axis", "rows")),
    Case(
        "islands NaN",
        lambda: jf.sharding.sharded(filter_of(), one_device(), island_threshold=NAN),
        ("island_threshold", "nan"),
    ),
    Case(
        "islands tempered",
        lambda: jf.sharding.sharded(filter_of(temper=jf.AdaptiveTempering(0.5)), one_device()),
        ("filter", "tempered"),
    ),
    Case(
        "scalar sequences",
        lambda: jf.sharding.spread_sequences(jnp.zeros(()), one_device(), axis="particles"),
        ("sequences", "()"),
    ),
]


@pytest.mark.parametrize("case", PARTICLE, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)
