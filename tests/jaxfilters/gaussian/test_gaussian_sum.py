"""A bank of filters against exact Gaussian mixtures, and the fate of every kind of candidate."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import jaxfilters
from jaxfilters import Filter, Gaussian, keep_all, log_evidence
from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian import gaussian_sum
from jaxfilters.gaussian.arithmetic import joseph

F = np.array([[1.0, 0.5], [0.0, 0.9]])
Q = np.diag([0.1, 0.2])
H = np.array([[1.0, 0.0]])
R = np.array([[0.3]])


@pytree_dataclass
class Line:
    mean: jax.Array
    covariance: jax.Array


def line_filter(mean=(0.0, 0.0), variance=1.0):
    return Filter(
        Line(jnp.asarray(mean, dtype=float), variance * jnp.eye(2)),
        lambda model, key: Gaussian(model.mean, model.covariance),
        predict_line,
        update_line,
    )


def predict_line(model, key, state, inputs):
    return joseph.predict(state, jnp.asarray(F, dtype=float), jnp.asarray(Q, dtype=float))


def update_line(model, key, state, y, inputs):
    return joseph.update(state, y, jnp.asarray(H, dtype=float), jnp.asarray(R, dtype=float))


def priors(means, log_weights):
    means = jnp.asarray(means, dtype=float)
    components = Gaussian(means, jnp.broadcast_to(jnp.eye(2), (len(means), 2, 2)))
    return gaussian_sum.GaussianSumState(components, jnp.asarray(log_weights, dtype=float))


def exact(means, log_weights, ys):
    """Gaussian mixture posterior and log evidence by textbook Kalman filters."""
    beliefs = [(np.array(m, float), np.eye(2)) for m in means]
    log_weights = np.array(log_weights) - np.logaddexp.reduce(log_weights)
    total = 0.0
    for y in ys:
        gains = []
        for i, (m, P) in enumerate(beliefs):
            m, P = F @ m, F @ P @ F.T + Q
            S = H @ P @ H.T + R
            gains.append(stats.multivariate_normal.logpdf(y, H @ m, S))
            K = P @ H.T @ np.linalg.inv(S)
            beliefs[i] = (m + K @ (y - H @ m), P - K @ H @ P)
        log_weights = log_weights + gains
        total += np.logaddexp.reduce(log_weights)
        log_weights = log_weights - np.logaddexp.reduce(log_weights)
    return beliefs, log_weights, total


YS = np.array([[0.4], [1.3], [0.9], [2.2]])


def test_a_bank_is_the_exact_mixture_posterior(x64):
    means, log_weights = [(0.0, 0.0), (2.0, 1.0), (-1.0, 0.5)], np.log([0.5, 0.3, 0.2])
    bank = gaussian_sum.gaussian_sum(line_filter(), capacity=4, start=priors(means, log_weights))
    state, (_, infos) = jaxfilters.run(bank, jax.random.key(0), jnp.asarray(YS), collect=keep_all)
    beliefs, log_weights, total = exact(means, log_weights, YS)
    order = np.argsort(-log_weights)
    np.testing.assert_allclose(state.log_weights[:3], log_weights[order], rtol=1e-9)
    np.testing.assert_allclose(state.components.mean[:3], [beliefs[i][0] for i in order], rtol=1e-9)
    np.testing.assert_allclose(state.components.covariance[:3], [beliefs[i][1] for i in order], rtol=1e-9)
    np.testing.assert_allclose(infos.log_evidence.sum(), total, rtol=1e-9)
    assert np.all(np.asarray(infos.num_hypotheses) == 3)
    assert state.log_weights[3] == -np.inf
    np.testing.assert_array_equal(gaussian_sum.map_component(state).mean, state.components.mean[0])


def test_a_bank_of_banks_is_the_bank(x64):
    means, log_weights = [(0.0, 0.0), (2.0, 1.0)], np.log([0.5, 0.5])
    inner = gaussian_sum.gaussian_sum(line_filter(), capacity=2, start=priors(means, log_weights))
    outer = gaussian_sum.gaussian_sum(inner, capacity=1)
    evidence = log_evidence(outer, jax.random.key(0), jnp.asarray(YS))
    np.testing.assert_allclose(evidence, exact(means, log_weights, YS)[2], rtol=1e-9)


def close(a, b):
    return jnp.all(jnp.abs(a.mean - b.mean) < 1e-3)


def test_equal_hypotheses_become_one_with_their_weights_added(x64):
    means, log_weights = [(0.0, 0.0), (2.0, 1.0), (0.0, 0.0)], np.log([0.2, 0.5, 0.3])
    bank = gaussian_sum.gaussian_sum(line_filter(), capacity=3, start=priors(means, log_weights), same=close)
    state, (_, infos) = jaxfilters.run(bank, jax.random.key(0), jnp.asarray(YS), collect=keep_all)
    _, weights, total = exact(means[:2], np.log([0.5, 0.5]), YS)
    np.testing.assert_allclose(infos.log_evidence.sum(), total, rtol=1e-9)
    np.testing.assert_allclose(np.sort(state.log_weights[:2]), np.sort(weights), rtol=1e-9)
    np.testing.assert_array_equal(infos.num_hypotheses, 2)
    np.testing.assert_array_equal(
        infos.fates[0].reshape(-1), [gaussian_sum.MERGED, gaussian_sum.KEPT, gaussian_sum.KEPT]
    )


class Looked(NamedTuple):
    y: jax.Array
    at: jax.Array


class Fit(NamedTuple):
    log_evidence: jax.Array


NOISE = 0.05


def update_square(model, key, state, observation, inputs):
    """One variable of which the square is seen, by Laplace's method from a starting point."""
    y, x = observation
    m, P = state.mean[0], state.covariance[0, 0]
    for _ in range(30):
        slope = 2 * x
        S = slope * slope * P + NOISE**2
        x = m + P * slope / S * (y - x * x - slope * (m - x))
    precision = 4 * x * x / NOISE**2 + 1 / P
    log_evidence = (
        -0.5 * ((y - x * x) / NOISE) ** 2
        - 0.5 * (x - m) ** 2 / P
        - 0.5 * jnp.log(2 * jnp.pi * NOISE**2 * P * precision)
    )
    return Gaussian(x[None], (1 / precision)[None, None]), Fit(log_evidence)


def both_roots(state, y):
    starts = jnp.array([1.0, -1.0, 0.8])
    return Looked(jnp.full(3, y), starts), jnp.ones(3, bool)


def square_filter():
    return Filter(
        Line(jnp.array([0.2]), jnp.eye(1)),
        lambda model, key: Gaussian(model.mean, model.covariance),
        lambda model, key, state, inputs: state,
        update_square,
    )


def test_branches_find_both_modes_and_the_same_mode_counts_once(x64):
    bank = gaussian_sum.gaussian_sum(square_filter(), capacity=4, branch=both_roots, same=close)
    state, info = jaxfilters.step(bank, jax.random.key(0), jaxfilters.init(bank, jax.random.key(0)), jnp.asarray(1.0))
    assert int(info.num_hypotheses) == 2
    # The first and the third arrive at one mode, equally heavy to rounding.
    assert sorted(map(int, info.fates[0, ::2])) == [gaussian_sum.KEPT, gaussian_sum.MERGED]
    np.testing.assert_array_equal(info.fates[1:], gaussian_sum.UNUSED)
    joint = lambda x: stats.norm.pdf(1.0, x * x, NOISE) * stats.norm.pdf(x, 0.2, 1.0)
    plus, minus = (integrate.quad(joint, *ends, epsabs=1e-13)[0] for ends in ((0, 2), (-2, 0)))
    # Laplace's method is off by the order of the relative width of the modes squared, 6e-4.
    np.testing.assert_allclose(info.log_evidence, np.log(plus + minus), atol=2e-3)
    np.testing.assert_allclose(
        np.exp(state.log_weights[:2]), [plus / (plus + minus), minus / (plus + minus)], atol=1e-3
    )
    np.testing.assert_allclose(state.components.mean[:2, 0], [1.0, -1.0], atol=0.01)


def upper_half(state, info):
    return state.mean[0] - 1.0


def test_hypotheses_with_a_negative_margin_are_rejected():
    means = [(0.0, 0.0), (4.0, 0.0), (-4.0, 0.0)]
    bank = gaussian_sum.gaussian_sum(
        line_filter(), capacity=3, start=priors(means, np.zeros(3)), margin=upper_half, log_ratio=90.0
    )
    state, info = jaxfilters.step(bank, jax.random.key(0), jaxfilters.init(bank, jax.random.key(0)), jnp.asarray([0.5]))
    np.testing.assert_array_equal(
        info.fates.reshape(-1), [gaussian_sum.REJECTED, gaussian_sum.KEPT, gaussian_sum.REJECTED]
    )
    assert not info.all_rejected
    alone, kept = exact(means[1:2], [0.0], [[0.5]]), state.components.mean[0]
    np.testing.assert_allclose(kept, alone[0][0][0], rtol=1e-5)
    # The evidence is that of the prior's mass that was not rejected.
    np.testing.assert_allclose(info.log_evidence, alone[2] - np.log(3), rtol=1e-5)


def test_the_least_bad_stays_where_all_are_rejected():
    bank = gaussian_sum.gaussian_sum(
        line_filter(), capacity=2, start=priors([(-4.0, 0.0), (-1.0, 0.0)], np.zeros(2)), margin=upper_half
    )
    _, info = jaxfilters.step(bank, jax.random.key(0), jaxfilters.init(bank, jax.random.key(0)), jnp.asarray([-2.0]))
    assert info.all_rejected
    np.testing.assert_array_equal(info.fates.reshape(-1), [gaussian_sum.REJECTED, gaussian_sum.KEPT])


def test_light_and_surplus_hypotheses_go():
    means = [(0.0, 0.0), (0.5, 0.0), (0.2, 0.0), (9.0, 0.0)]
    bank = gaussian_sum.gaussian_sum(
        line_filter(), capacity=4, start=priors(means, np.zeros(4)), branch=twice, log_ratio=5.0
    )
    _, info = jaxfilters.step(bank, jax.random.key(0), jaxfilters.init(bank, jax.random.key(0)), jnp.asarray([0.3]))
    fates = np.asarray(info.fates)
    assert np.all(fates[3] == gaussian_sum.PRUNED)
    assert np.sum(fates[:3] == gaussian_sum.KEPT) == 4
    assert np.sum(fates[:3] == gaussian_sum.CROWDED_OUT) == 2


def twice(state, y):
    return jnp.stack([y, y]), jnp.ones(2, bool)


def test_an_update_that_breaks_leaves_the_others_alone():
    def update(model, key, state, y, inputs):
        state, info = update_line(model, key, state, y, inputs)
        broken = state.mean[0] < 0
        return state, Fit(jnp.where(broken, jnp.nan, info.log_evidence))

    inner = line_filter()
    inner = Filter(inner.params, inner.init, inner.predict, update)
    bank = gaussian_sum.gaussian_sum(inner, capacity=2, start=priors([(-3.0, 0.0), (3.0, 0.0)], np.zeros(2)))
    start = jaxfilters.init(bank, jax.random.key(0))
    state, info = jaxfilters.step(bank, jax.random.key(0), start, jnp.asarray([0.5]))
    np.testing.assert_array_equal(info.fates.reshape(-1), [gaussian_sum.INVALID, gaussian_sum.KEPT])
    assert np.isfinite(info.log_evidence)
    np.testing.assert_allclose(np.exp(state.log_weights), [1, 0])

    every = gaussian_sum.gaussian_sum(inner, capacity=2, start=priors([(-3.0, 0.0), (-2.0, 0.0)], np.log([0.3, 0.7])))
    start = jaxfilters.init(every, jax.random.key(0))
    state, info = jaxfilters.step(every, jax.random.key(0), start, jnp.asarray([-2.0]))
    assert info.log_evidence == -np.inf
    assert int(info.num_hypotheses) == 0
    # What was predicted is kept.
    np.testing.assert_allclose(np.exp(state.log_weights), [0.3, 0.7], rtol=1e-6)
    np.testing.assert_allclose(state.components.mean, np.array([(-3.0, 0.0), (-2.0, 0.0)]) @ F.T, rtol=1e-6)


@pytest.mark.system
def test_one_program_for_all_frames_and_sequences_and_a_right_gradient(x64):
    traces = []

    def update(model, key, state, y, inputs):
        traces.append(None)
        return update_line(model, key, state, y, inputs)

    def evidence(shift, ys):
        inner = Filter(line_filter().params, line_filter().init, predict_line, update)
        start = priors([(0.0, 0.0), (2.0, 1.0)], np.log([0.5, 0.5]))
        moved = Gaussian(start.components.mean + shift, start.components.covariance)
        bank = gaussian_sum.gaussian_sum(inner, capacity=3, start=start._replace(components=moved))
        return log_evidence(bank, jax.random.key(0), ys)

    many = jnp.stack([jnp.asarray(YS), jnp.asarray(YS) + 0.1])
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(evidence), in_axes=(None, 0)))(0.0, many)
    assert len(traces) <= 2  # once for its value, once to see its shape
    up, down = (exact([(s, s), (2.0 + s, 1.0 + s)], np.log([0.5, 0.5]), YS)[2] for s in (1e-5, -1e-5))
    np.testing.assert_allclose(values[0], exact([(0, 0), (2.0, 1.0)], np.log([0.5, 0.5]), YS)[2], rtol=1e-9)
    np.testing.assert_allclose(gradients[0], (up - down) / 2e-5, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"capacity": 0}, "capacity must be an integer of at least 1; got 0"),
        ({"capacity": 2, "log_ratio": 0.0}, "log_ratio must be positive; got 0.0"),
        (
            {"capacity": 1, "start": priors([(0.0, 0.0), (1.0, 1.0)], np.zeros(2))},
            "at most capacity = 1 hypotheses; got 2",
        ),
    ],
)
def test_impossible_banks_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        gaussian_sum.gaussian_sum(line_filter(), **arguments)


@pytest.mark.system
def test_branches_of_a_parent_that_merge_with_another_hypothesis_count_once(x64):
    """Both parents branch into the same state twice: evidence and weights are those without branches."""
    one = jnp.eye(1)
    inner = jaxfilters.kalman(Gaussian(jnp.zeros(1), one), one, 0.0 * one, one, one)
    means, weights = jnp.array([[0.0], [0.0], [3.0]]), jnp.array([0.3, 0.2, 0.5])
    start = gaussian_sum.GaussianSumState(Gaussian(means, jnp.ones((3, 1, 1))), jnp.log(weights))
    twice = lambda state, y: (jnp.stack([y, y]), jnp.ones(2, bool))
    same = lambda a, b: jnp.all(jnp.abs(a.mean - b.mean) < 1e-9)
    results = [
        jaxfilters.run(
            gaussian_sum.gaussian_sum(inner, capacity=6, start=start, same=same, **branch),
            jax.random.key(0),
            jnp.array([[1.5]]),
        )
        for branch in ({}, {"branch": twice})
    ]
    (plain, (_, of_plain)), (branched, (_, of_branched)) = results
    np.testing.assert_allclose(of_branched.log_evidence, of_plain.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(branched.log_weights[:2], plain.log_weights[:2], rtol=1e-12)
