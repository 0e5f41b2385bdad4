"""Bad input: models of motion, filters in continuous time, localisation and diagnostics name the argument."""

import jax
import jax.numpy as jnp
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)
PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
A, L = jnp.eye(2), jnp.ones((2, 1))
ONES = jf.ensemble.Localization(jnp.ones((3, 2)), jnp.ones((2, 2)))
CORRELATED = jnp.array([[1.0, 0.5], [0.5, 1.0]])
M, D = jf.motion, jf.diagnostics


def continuous(drift=lambda x: -x, diffusion=L, dt=0.1, **options):
    filter = jf.continuous_extended_kalman(PRIOR, drift, diffusion, lambda x: x[:1], jnp.eye(1), **options)
    return jf.run(filter, KEY, jnp.zeros((3, 1)), jnp.full(3, dt))


def ensemble(R=None, n=3, **options):
    filter = jf.ensemble_kalman(
        lambda key: jnp.zeros(n),
        lambda key, x: x,
        lambda x: x[:2],
        jnp.eye(2) if R is None else R,
        num_particles=4,
        **options,
    )
    return jf.run(filter, KEY, jnp.zeros((3, 2)))


CASES = {
    "negative dt": (lambda: M.discretize(A, L, -0.1), ("dt", "-0.1")),
    "negative dt among several": (lambda: M.constant_velocity(1.0).discretize(jnp.array([1.0, -2.0])), ("dt", "-2.0")),
    "infinite dt": (lambda: M.singer(1.0, 1.0).discretize(jnp.inf), ("dt", "inf")),
    "negative dt of a turn": (lambda: M.coordinated_turn(1.0, 1.0).discretize(-1.0), ("dt", "-1.0")),
    "wide A": (lambda: M.discretize(jnp.ones((2, 3)), L, 1.0), ("A", "square", "(2, 3)")),
    "L of other rows": (lambda: M.discretize(A, jnp.ones((3, 1)), 1.0), ("L", "2 rows of A", "(3, 1)")),
    "A as a vector": (lambda: M.discretize(jnp.ones(2), L, 1.0), ("A", "matrix", "(2,)")),
    "negative order": (lambda: M.integrated_wiener(-1, 1.0), ("order", "-1")),
    "order as a float": (lambda: M.integrated_wiener(1.0, 1.0), ("order", "integer", "1.0")),
    "negative density": (lambda: M.constant_velocity(-1.0), ("spectral_density", "-1.0")),
    "densities of other dims": (lambda: M.constant_velocity(jnp.ones(3), dims=2), ("spectral_density", "(2,)", "(3,)")),
    "no dims": (lambda: M.constant_acceleration(1.0, dims=0), ("dims", "0")),
    "negative time_constant": (lambda: M.singer(-2.0, 1.0), ("time_constant", "positive", "-2.0")),
    "time_constant of zero": (lambda: M.ornstein_uhlenbeck(0.0, 1.0), ("time_constant", "0.0")),
    "negative std": (lambda: M.integrated_ornstein_uhlenbeck(1.0, -1.0), ("std", "-1.0")),
    "another smoothness": (lambda: M.matern(2.0, 1.0, 1.0), ("smoothness", "2.0")),
    "negative length_scale": (lambda: M.matern(1.5, -1.0, 1.0), ("length_scale", "-1.0")),
    "rates of turn": (lambda: M.coordinated_turn(jnp.ones(2), 1.0), ("rate", "(2,)")),
    "infinite rate of turn": (lambda: M.coordinated_turn(jnp.inf, 1.0), ("rate", "inf")),
    "negative rate_density": (lambda: M.unknown_turn(1.0, -1.0), ("rate_density", "-1.0")),
    "state of another size": (lambda: M.constant_velocity(1.0).transition(jnp.ones(3), 1.0), ("x", "(2,)", "(3,)")),
    "state of another turn": (lambda: M.unknown_turn(1.0, 1.0).transition(jnp.ones(4), 1.0), ("x", "(5,)", "(4,)")),
    "no stationary state": (lambda: M.constant_velocity(1.0).stationary_covariance(), ("stationary", "grows")),
    "steps of rk4": (lambda: M.rk4(0), ("num_steps", "0")),
    "negative rtol": (lambda: M.adaptive(rtol=-1.0), ("rtol", "-1.0")),
    "drift of another shape": (lambda: continuous(lambda x: x[:1]), ("drift", "(2,)", "(1,)")),
    "drift as a matrix": (lambda: continuous(A), ("drift",)),
    "diffusion of other rows": (
        lambda: continuous(diffusion=jnp.ones((3, 1))),
        ("diffusion", "(2, any width)", "(3, 1)"),
    ),
    "diffusion from a function": (
        lambda: continuous(diffusion=lambda x: jnp.ones((3, 1))),
        ("the result of diffusion", "(3, 1)"),
    ),
    "no intervals": (lambda: continuous(num_intervals=0), ("num_intervals", "0")),
    "negative radius": (lambda: jf.ensemble.gaspari_cohn(1.0, -1.0), ("radius", "-1.0")),
    "coordinates of points": (
        lambda: jf.ensemble.localization(jnp.ones(3), jnp.ones((2, 1)), 1.0),
        ("state_coordinates", "(n, k)", "(3,)"),
    ),
    "localization of other sizes": (
        lambda: ensemble(n=4, localization=ONES),
        ("localization.state", "(4, 2)", "(3, 2)"),
    ),
    "localization of other observations": (
        lambda: ensemble(localization=ONES._replace(observation=jnp.ones((3, 3)))),
        ("localization.observation", "(2, 2)", "(3, 3)"),
    ),
    "localization beyond one": (
        lambda: ensemble(localization=ONES._replace(state=2 * jnp.ones((3, 2)))),
        ("localization.state", "from 0 to 1", "2"),
    ),
    "localization as a matrix": (lambda: ensemble(localization=jnp.ones((3, 2))), ("localization", "Localization")),
    "correlated noise, serial": (lambda: ensemble(CORRELATED, analysis=jf.ensemble.serial), ("R", "diagonal", "0.5")),
    "correlated noise, local": (
        lambda: ensemble(CORRELATED, analysis=jf.ensemble.transform, localization=ONES),
        ("R", "diagonal", "0.5"),
    ),
    "relaxation beyond one": (lambda: ensemble(relaxation=1.5), ("relaxation", "from 0 to 1", "1.5")),
    "analysis as a word": (lambda: ensemble(analysis="serial"), ("analysis", "callable", "serial")),
    "truth of another shape": (lambda: D.nees(jnp.zeros(3), PRIOR), ("truth", "(2,)", "(3,)")),
    "beliefs as an array": (lambda: D.nees(jnp.zeros(2), jnp.eye(2)), ("beliefs", "Gaussian")),
    "covariances of another shape": (lambda: D.nis(jnp.zeros(2), jnp.eye(3)), ("covariances", "(2, 2)", "(3, 3)")),
    "probability of a band": (lambda: D.chi_square_band(2, probability=95.0), ("probability", "95")),
    "no dof": (lambda: D.chi_square_quantile(0.5, 0.0), ("dof", "0.0")),
    "lag beyond the end": (lambda: D.autocorrelation(jnp.ones((5, 1)), 5), ("max_lag", "0 to 4", "5")),
    "innovations as a vector": (lambda: D.whiteness(jnp.ones(5), 2), ("innovations", "(t, m)", "(5,)")),
    "std of zero": (lambda: D.crps(jnp.zeros(2), 0.0, 0.0), ("std", "positive", "0.0")),
    "samples of another shape": (
        lambda: D.crps_ensemble(jnp.zeros(3), jnp.zeros((2, 4))),
        ("samples", "(3,)", "(2, 4)"),
    ),
    "weights of other samples": (
        lambda: D.pit_ensemble(jnp.zeros(()), jnp.zeros(4), jnp.zeros(3)),
        ("log_weights", "(4,)", "(3,)"),
    ),
    "values as a matrix": (lambda: D.uniformity(jnp.zeros((2, 2))), ("values", "(n,)", "(2, 2)")),
    "short chains": (lambda: D.r_hat(jnp.zeros((4, 3))), ("chains", "(4, 3)")),
    "weights as a matrix": (lambda: D.pareto_k(jnp.zeros((4, 3))), ("log_weights", "(4, 3)")),
    "negative sigmas": (lambda: D.sigma_coverage(jnp.zeros(2), 0.0, 1.0, sigmas=(-1.0,)), ("sigmas", "-1.0")),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_rejected_with_the_name_of_the_argument(check_rejected, name):
    call, words = CASES[name]
    check_rejected(call, words)


def test_negative_steps_that_are_traced_are_announced():
    """A filter whose steps are negative reports an impossible evidence, not a number that looks right."""
    motion = M.constant_velocity(1.0)
    filter = jf.extended_kalman(PRIOR, motion.transition, motion.process_noise, lambda x: x[:1], jnp.eye(1))
    _, infos = jf.run(filter, KEY, jnp.zeros((2, 1)), jnp.array([0.1, -0.1]), collect=jf.keep_info)
    assert jnp.isfinite(infos.log_evidence[0])
    assert infos.log_evidence[1] == -jnp.inf
