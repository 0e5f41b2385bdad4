"""Known inputs of a step: which functions receive them, and that a moving observer needs no place in the state."""

from functools import partial, wraps

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf
from jaxfilters.typing import asks_for_inputs, depends_on_state

KEY = jax.random.key(3)
PRIOR = jf.Gaussian(jnp.array([3.0, 4.0]), 0.3 * jnp.eye(2))
Q, R = 0.01 * jnp.eye(2), 0.02 * jnp.eye(1)
OBSERVER = jnp.asarray(np.random.default_rng(0).normal(size=(5, 2)), jnp.float32)
"""Where the observer is in each frame."""


def bearing(x, place):
    offset = x - place
    return jnp.arctan2(offset[1:], offset[:1])


YS = jax.vmap(bearing, (None, 0))(jnp.array([3.5, 3.5]), OBSERVER) + 0.05


def log_likelihood(x, y, place):
    return -0.5 * jnp.sum((y - bearing(x, place)) ** 2) / R[0, 0]


def bearing_at(place, x):
    return bearing(x, place)


def log_likelihood_at(place, x, y):
    return log_likelihood(x, y, place)


def walk(noise, x):
    return x + 0.1 * noise


def linear_part(x):
    one = jnp.eye(2)
    return jf.MixedDynamics(x, 0.1 * one, 0.01 * one, jnp.zeros(2), one, 0.01 * one)


def rao_blackwell(builder, likelihood):
    velocity = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
    prior = jf.priors.gaussian_prior(PRIOR)
    return builder(prior, velocity, linear_part, likelihood, num_particles=20, noise_dim=2)


def linear_observation(x, place):
    return jf.LinearObservation(bearing(x, place), jnp.ones((1, 2)), R)


def linear_observation_at(place, x):
    return linear_observation(x, place)


def guide(particles, log_weights, y, place):
    return jf.Guidance(place + jnp.ones(2), jnp.eye(2))


def guide_at(place, particles, log_weights, y):
    return guide(particles, log_weights, y, place)


def branch(state, y, place):
    return jnp.stack([y, y + 0.1 * place[0]]), jnp.ones(2, bool)


def branch_at(place, state, y):
    return branch(state, y, place)


def extended(observe, _likelihood=None):
    return jf.extended_kalman(PRIOR, lambda x: x, Q, observe, R)


SPACIOUS = jf.constraints.linear_constraints(jnp.eye(2), lower=jnp.full(2, -1e3), upper=jnp.full(2, 1e3))
RULE = jf.TruncateEachStep(SPACIOUS, jf.constraints.cut.sequential_intervals)
SAMPLES = dict(num_particles=20, noise=jf.StandardNormal(2))
FILTERS = {
    "extended": lambda of: extended(of(bearing, bearing_at)),
    "bootstrap": lambda of: jf.bootstrap(
        jf.priors.gaussian_prior(PRIOR), walk, of(log_likelihood, log_likelihood_at), **SAMPLES
    ),
    "unscented": lambda of: jf.unscented_kalman(PRIOR, lambda x: x, Q, of(bearing, bearing_at), R),
    "ensemble": lambda of: jf.ensemble_kalman(
        jf.priors.gaussian_prior(PRIOR), walk, of(bearing, bearing_at), R, **SAMPLES
    ),
    "rao_blackwell": lambda of: rao_blackwell(jf.rao_blackwell, of(log_likelihood, log_likelihood_at)),
    "rao_blackwell_shared": lambda of: rao_blackwell(
        partial(jf.rao_blackwell_shared, observe=of(linear_observation, linear_observation_at)), None
    ),
    "guided": lambda of: jf.guided_rao_blackwell(
        rao_blackwell(jf.rao_blackwell_shared, of(log_likelihood, log_likelihood_at)), of(guide, guide_at)
    ),
    "gaussian_sum": lambda of: jf.gaussian_sum(
        extended(of(bearing, bearing_at)), capacity=2, branch=of(branch, branch_at)
    ),
    "robust": lambda of: jf.robust(extended(of(bearing, bearing_at)), 0.1, 4.0 * R),
    "schmidt": lambda of: jf.schmidt_kalman(
        extended(of(bearing, bearing_at)), lambda mean: mean[:1], jnp.array([True, False]), 0.1
    ),
    "constrained": lambda of: jf.constrained(extended(of(bearing, bearing_at)), RULE),
    "fixed_lag": lambda of: jf.smoothing.fixed_lag_rts(extended(of(bearing, bearing_at)), 2, inputs=OBSERVER[0]),
}
QUICK = ("bootstrap",)


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.system) for name in FILTERS]
)
def test_a_moving_observer_given_as_input_is_one_whose_place_is_part_of_the_model_of_each_frame(name):
    """The same numbers, to rounding: another filter for each frame, whose functions hold the place of that frame."""
    state = None
    for key, y, place in zip(jax.random.split(KEY, 5), YS, OBSERVER, strict=True):
        with_inputs = FILTERS[name](lambda function, _: function)
        closed_over = FILTERS[name](lambda _, function, place=place: jax.tree_util.Partial(function, place))
        state = jf.init(with_inputs, KEY) if state is None else state
        wanted = jf.step(closed_over, key, state, y, place if name == "fixed_lag" else None)
        state, info = jf.step(with_inputs, key, state, y, place)
        for found, expected in zip(jax.tree.leaves((state, info)), jax.tree.leaves(wanted), strict=True):
            if jnp.issubdtype(found.dtype, jnp.floating):
                np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-5)
            else:
                np.testing.assert_array_equal(found, expected)
    assert np.isfinite(info.log_evidence)


def test_inputs_reach_the_observation_through_the_log_evidence_and_fit():
    filter = extended(bearing)
    total = float(jf.log_evidence(filter, KEY, YS, inputs=OBSERVER))
    np.testing.assert_allclose(jf.fit.log_evidence(KEY, lambda _: filter, YS, OBSERVER)(0.0), total, rtol=1e-6)
    assert abs(float(jf.log_evidence(filter, KEY, YS, OBSERVER + 1.0)) - total) > 0.1


class Model:
    """Callbacks of each kind that a user may have."""

    def observe(self, x, inputs=None):
        return x

    @staticmethod
    def plain(x):
        return x

    def __call__(self, x, place):
        return x


def logged(function):
    @wraps(function)
    def wrapper(*args, **kwargs):
        return function(*args, **kwargs)

    return wrapper


@pytest.mark.parametrize(
    ("callback", "asks"),
    [
        (lambda x: x, False),
        (lambda x, place: x, True),
        (lambda x, inputs=None: x, True),
        (lambda x, *, scale=2.0: x, False),
        (lambda x, u, scale=2.0: x, True),
        (Model().observe, True),
        (Model.plain, False),
        (Model(), True),
        (partial(lambda scale, x: x, 2.0), False),
        (partial(lambda x, scale: x, scale=2.0), False),
        (jax.tree_util.Partial(lambda scale, x, u: x, 2.0), True),
        (logged(lambda x, u: x), True),
        (jax.jit(lambda x, u: x), True),
        (jnp.sin, False),
    ],
)
def test_the_signature_says_whether_a_function_gets_the_inputs(callback, asks):
    assert asks_for_inputs("observe", callback, "x") is asks


@pytest.mark.parametrize(
    ("callback", "named"),
    [
        (lambda x, scale=2.0: x, "'scale' has a default value"),
        (lambda *args: args, "functools.wraps"),
        (lambda: 1.0, r"observe must take \(x\) or \(x, inputs\); got \(\)"),
        (lambda x, u, v: x, r"got \(x, u, v\)"),
        (lambda x, *, u: x, "by position"),
    ],
)
def test_a_function_that_leaves_it_open_is_an_error(callback, named):
    with pytest.raises(TypeError, match=named):
        asks_for_inputs("observe", callback, "x")


def test_a_noise_of_two_arguments_depends_on_the_state():
    assert not depends_on_state("process_noise", lambda dt: Q)
    assert depends_on_state("process_noise", lambda x, dt: Q)
    with pytest.raises(TypeError, match=r"process_noise must take \(inputs\) or \(x, inputs\)"):
        jf.extended_kalman(PRIOR, lambda x: x, lambda: Q, bearing, R)


def test_the_old_name_is_answered_by_the_new_one():
    with pytest.raises(TypeError, match="'controls': it is called 'inputs' now"):
        jf.run(extended(bearing), KEY, YS, controls=OBSERVER)
    with pytest.raises(TypeError, match="'control': it is called 'inputs' now"):
        jf.step(extended(bearing), KEY, PRIOR, YS[0], control=OBSERVER[0])
