"""Bad input: Gaussian filters and their wrappers reject it at trace time or before, and name the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


PRIOR = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
ROOT_PRIOR = jf.GaussianRoot(jnp.zeros(2), jnp.eye(2))
Q, R = 0.1 * jnp.eye(2), jnp.eye(1)
YS = jnp.zeros((5, 1))
INDEFINITE = jnp.array([[1.0, 2.0], [2.0, 1.0]])
ASYMMETRIC = jnp.array([[1.0, 0.5], [0.0, 1.0]])
ROTATION = jf.manifold.product(jf.manifold.rotation)
IDENTITY = jnp.array([1.0, 0.0, 0.0, 0.0])


def extended(transition=lambda x, u: x, Q=Q, observe=lambda x: x[:1], R=R, prior=PRIOR, **options):
    return jf.extended_kalman(prior, transition, Q, observe, R, **options)


def run_extended(ys=YS, inputs=None, mask=None, state=None, **options):
    return jf.run(extended(**options), KEY, ys, inputs, mask=mask, state=state)


def rooted(**options):
    return run_extended(prior=ROOT_PRIOR, arithmetic=jf.arithmetic.square_root, **options)


def observation(mask=None, noise=None):
    return jf.Observation(YS, mask, noise)


def gaussian_sum(components=None, log_weights=None, **options):
    """Two hypotheses, and an update with them."""
    components = jf.Gaussian(jnp.zeros((2, 2)), jnp.stack([jnp.eye(2)] * 2)) if components is None else components
    start = jf.GaussianSumState(components, jnp.zeros(2) if log_weights is None else log_weights)
    return jf.run(jf.gaussian_sum(extended(), **{"capacity": 3, "start": start} | options), KEY, YS)


def robust(probability=0.1, noise=10.0 * R, inner=None):
    return jf.robust(extended() if inner is None else inner, probability, noise)


def schmidt(constant=None, signature=lambda mean: mean, inner=None, tolerance=1.0, **options):
    constant = jnp.array([True, False]) if constant is None else constant
    inner = extended() if inner is None else inner
    return jf.run(jf.schmidt_kalman(inner, signature, constant, tolerance, **options), KEY, YS)


def process(tau=2.0, B=None):
    return jf.GaussMarkov(jnp.asarray(tau), jnp.ones(1) if B is None else B)


def lasting(noise=None, inner=None, ys=YS, **options):
    inner = extended() if inner is None else inner
    return jf.run(jf.correlated_noise(inner, process() if noise is None else noise, **options), KEY, ys)


def differenced(noise=None, R=0.0 * R, ys=YS, **options):
    inner = extended(R=R, **options)
    return jf.run(jf.measurement_differencing(inner, process() if noise is None else noise), KEY, ys)


def rts(beliefs=None, inputs=None, filter=None):
    beliefs = jf.Gaussian(jnp.zeros((5, 2)), jnp.stack([jnp.eye(2)] * 5)) if beliefs is None else beliefs
    return jf.smoothing.rts(extended() if filter is None else filter, beliefs, inputs)


def parallel(prior=ROOT_PRIOR, ys=YS, mask=None, **changes):
    model = dict(F=jnp.eye(2), root_Q=jnp.eye(2), H=jnp.eye(2)[:1], root_R=jnp.eye(1)) | changes
    return jf.smoothing.parallel_kalman(prior, jf.smoothing.LinearModel(**model), ys, mask)


EXTENDED = {
    "wide y": (lambda: run_extended(jnp.zeros((5, 3))), ("observation y", "(3,)", "(1,)")),
    "narrow y": (
        lambda: run_extended(observe=lambda x: x, R=jnp.eye(2)),
        ("observation y", "(1,)", "(2,)"),
    ),
    "wide y, custom residual": (
        lambda: run_extended(jnp.zeros((5, 3)), residual=lambda y, y_hat: y - y_hat),
        ("observation y", "(3,)", "(1,)"),
    ),
    "wide y, unscented": (
        lambda: run_extended(jnp.zeros((5, 3)), linearize=jf.linearize.unscented()),
        ("observation y", "(3,)", "(1,)"),
    ),
    "scalar y": (lambda: run_extended(jnp.zeros(5)), ("observation y", "(m,)", "()")),
    "y in a dictionary": (lambda: run_extended({"y": YS}), ("observation y", "dict")),
    "scalar observe": (lambda: run_extended(observe=lambda x: x[0]), ("observe", "(m,)", "()")),
    "matrix from observe": (lambda: run_extended(observe=lambda x: x[None]), ("observe", "(m,)", "(1, 2)")),
    "integers from observe": (lambda: run_extended(observe=lambda x: x[:1].astype(int)), ("observe", "int32")),
    "list from observe": (lambda: run_extended(observe=lambda x: [x[0]]), ("observe", "array", "list")),
    "residual of another shape": (
        lambda: run_extended(residual=lambda y, y_hat: (y - y_hat)[0]),
        ("residual", "(1,)", "()"),
    ),
    "large observation_noise": (lambda: run_extended(R=jnp.eye(2)), ("observation_noise", "(1, 1)", "(2, 2)")),
    "small observation_noise": (
        lambda: run_extended(jnp.zeros((5, 2)), observe=lambda x: x),
        ("observation_noise", "(2, 2)", "(1, 1)"),
    ),
    "root of another observation_noise": (
        lambda: rooted(R=jnp.ones((2, 3))),
        ("observation_noise", "(1, any width)", "(2, 3)"),
    ),
    "scalar observation_noise": (lambda: extended(R=0.1), ("observation_noise", "array", "float")),
    "vector observation_noise": (lambda: extended(R=jnp.ones(1)), ("observation_noise", "(m, m)", "(1,)")),
    "Observation.noise of another size": (
        lambda: run_extended(observation(noise=jnp.ones((5, 2, 2)))),
        ("Observation.noise", "(1, 1)", "(2, 2)"),
    ),
    "Observation.noise of another root": (
        lambda: rooted(ys=observation(noise=jnp.ones((5, 2, 2)))),
        ("Observation.noise", "(1, any width)", "(2, 2)"),
    ),
    "mask of another shape": (
        lambda: run_extended(observation(mask=jnp.ones((5, 2), bool))),
        ("Observation.mask", "(1,)", "(2,)"),
    ),
    "mask of a frame in Observation": (
        lambda: run_extended(observation(mask=jnp.ones(5, bool))),
        ("Observation.mask", "(1,)", "()"),
    ),
    "mask of numbers": (lambda: run_extended(observation(mask=jnp.ones((5, 1)))), ("Observation.mask", "float32")),
    "large process_noise": (lambda: extended(Q=jnp.eye(3)), ("process_noise", "(2, 2)", "(3, 3)")),
    "small process_noise": (lambda: extended(Q=jnp.eye(1)), ("process_noise", "(2, 2)", "(1, 1)")),
    "small process_noise, root": (lambda: rooted(Q=jnp.eye(1)), ("process_noise", "(2, any width)", "(1, 1)")),
    "scalar process_noise": (lambda: extended(Q=0.1), ("process_noise", "array", "float")),
    "small result of process_noise": (
        lambda: run_extended(Q=lambda u: jnp.eye(1)),
        ("process_noise", "(2, 2)", "(1, 1)"),
    ),
    "scalar result of process_noise": (
        lambda: run_extended(Q=lambda u: jnp.ones(())),
        ("process_noise", "(2, 2)", "()"),
    ),
    "transition of another shape": (
        lambda: run_extended(transition=lambda x, u: x[:1]),
        ("transition", "(2,)", "(1,)"),
    ),
    "transition to a matrix": (
        lambda: run_extended(transition=lambda x, u: x[None]),
        ("transition", "(2,)", "(1, 2)"),
    ),
    "transition to a list": (
        lambda: run_extended(transition=lambda x, u: [x[0], x[1]]),
        ("transition", "array", "list"),
    ),
    "transition to nothing": (lambda: run_extended(transition=lambda x, u: None), ("transition", "NoneType")),
    "negative process_noise": (lambda: extended(Q=-Q), ("process_noise", "negative", "-0.1")),
    "indefinite process_noise": (lambda: extended(Q=INDEFINITE), ("process_noise", "positive semidefinite", "-1")),
    "asymmetric process_noise": (lambda: extended(Q=ASYMMETRIC), ("process_noise", "symmetric", "0.5")),
    "process_noise that is not finite": (lambda: extended(Q=jnp.nan * Q), ("process_noise", "finite", "nan")),
    "negative observation_noise": (lambda: extended(R=-R), ("observation_noise", "negative", "-1")),
    "integer noise": (lambda: extended(Q=jnp.eye(2, dtype=int)), ("process_noise", "floating", "int32")),
    "prior of two sizes": (
        lambda: extended(prior=jf.Gaussian(jnp.zeros(3), jnp.eye(2))),
        ("prior.mean", "(3,)", "(2, 2)"),
    ),
    "prior of two sizes, root": (
        lambda: extended(prior=jf.GaussianRoot(jnp.zeros(3), jnp.eye(2)), arithmetic=jf.arithmetic.square_root),
        ("prior.mean", "(3,)", "(2, 2)"),
    ),
    "indefinite prior": (
        lambda: extended(prior=jf.Gaussian(jnp.zeros(2), INDEFINITE)),
        ("prior.covariance", "positive semidefinite"),
    ),
    "asymmetric prior": (
        lambda: extended(prior=jf.Gaussian(jnp.zeros(2), ASYMMETRIC)),
        ("prior.covariance", "symmetric"),
    ),
    "integer prior": (
        lambda: extended(prior=jf.Gaussian(jnp.zeros(2, int), jnp.eye(2))),
        ("prior.mean", "floating", "int32"),
    ),
    "integer covariance": (
        lambda: extended(prior=jf.Gaussian(jnp.zeros(2), jnp.eye(2, dtype=int))),
        ("prior.covariance", "floating", "int32"),
    ),
    "prior of another kind": (lambda: extended(prior=(jnp.zeros(2), jnp.eye(2))), ("prior", "Gaussian", "tuple")),
    "prior that is not finite": (
        lambda: extended(prior=jf.Gaussian(jnp.array([0.0, jnp.inf]), jnp.eye(2))),
        ("prior.mean", "finite", "inf"),
    ),
    "transition that is an array": (lambda: extended(transition=jnp.eye(2)), ("transition", "function")),
    "observe that is an array": (lambda: extended(observe=jnp.eye(2)), ("observe", "function")),
    "iterate_to another word": (lambda: extended(iterate_to="map"), ("iterate_to", "mean", "mode", "map")),
    "state of another size": (
        lambda: run_extended(state=jf.Gaussian(jnp.zeros(3), jnp.eye(3))),
        ("state", "(2,)", "(3,)"),
    ),
    "state of another kind": (lambda: run_extended(state=ROOT_PRIOR), ("state", "Gaussian", "GaussianRoot")),
    "quaternion with four variances": (
        lambda: extended(Q=jnp.eye(4), prior=jf.Gaussian(IDENTITY, jnp.eye(4)), manifold=ROTATION),
        ("prior.covariance", "(3,)", "(4, 4)"),
    ),
    "quaternion of three numbers": (
        lambda: extended(Q=jnp.eye(3), prior=jf.Gaussian(jnp.zeros(3), jnp.eye(3)), manifold=ROTATION),
        ("state", "(4,)", "(3,)"),
    ),
    "process_noise of a quaternion": (
        lambda: extended(Q=jnp.eye(4), prior=jf.Gaussian(IDENTITY, jnp.eye(3)), manifold=ROTATION),
        ("process_noise", "(3, 3)", "(4, 4)"),
    ),
    "unscented, wide y": (
        lambda: jf.run(jf.unscented_kalman(PRIOR, lambda x, u: x, Q, lambda x: x[:1], R), KEY, jnp.zeros((5, 3))),
        ("observation y", "(3,)", "(1,)"),
    ),
    "unscented, alpha": (
        lambda: jf.unscented_kalman(PRIOR, lambda x, u: x, Q, lambda x: x[:1], R, alpha=0.0),
        ("alpha", "0.0"),
    ),
    "cubature, process_noise": (
        lambda: jf.cubature_kalman(PRIOR, lambda x, u: x, jnp.eye(1), lambda x: x[:1], R),
        ("process_noise", "(2, 2)", "(1, 1)"),
    ),
}

WRAPPERS = {
    "gaussian_sum, inner": (lambda: jf.gaussian_sum(PRIOR, capacity=2), ("inner", "Filter", "Gaussian")),
    "gaussian_sum, capacity": (lambda: gaussian_sum(capacity=0), ("capacity", "0")),
    "gaussian_sum, start too large": (lambda: gaussian_sum(capacity=1), ("start", "capacity = 1", "2")),
    "gaussian_sum, start of another kind": (lambda: gaussian_sum(start=PRIOR), ("start", "GaussianSumState")),
    "gaussian_sum, log_weights": (
        lambda: gaussian_sum(log_weights=jnp.zeros((2, 1))),
        ("start.log_weights", "(k,)", "(2, 1)"),
    ),
    "gaussian_sum, log_weights of nothing": (
        lambda: gaussian_sum(log_weights=jnp.full(2, -jnp.inf)),
        ("start.log_weights", "-inf"),
    ),
    "gaussian_sum, integer log_weights": (
        lambda: gaussian_sum(log_weights=jnp.zeros(2, int)),
        ("start.log_weights", "int32"),
    ),
    "gaussian_sum, more weights than components": (
        lambda: gaussian_sum(log_weights=jnp.zeros(3)),
        ("start.components", "(3, 2)", "(2, 2)"),
    ),
    "gaussian_sum, components of another size": (
        lambda: gaussian_sum(jf.Gaussian(jnp.zeros((2, 3)), jnp.stack([jnp.eye(3)] * 2))),
        ("start.components", "(2, 2)", "(2, 3)"),
    ),
    "gaussian_sum, components of another kind": (
        lambda: gaussian_sum(jf.GaussianRoot(jnp.zeros((2, 2)), jnp.stack([jnp.eye(2)] * 2))),
        ("start.components", "states of inner"),
    ),
    "gaussian_sum, margin": (
        lambda: gaussian_sum(margin=lambda state, info: state.mean),
        ("margin", "one number", "(2,)"),
    ),
    "gaussian_sum, same": (
        lambda: gaussian_sum(same=lambda one, other: one.mean == other.mean),
        ("same", "one boolean", "(2,)"),
    ),
    "gaussian_sum, branch": (lambda: gaussian_sum(branch=3), ("branch", "function", "int")),
    "robust, probability 0": (lambda: robust(0.0), ("outlier_probability", "(0, 1)", "0.0")),
    "robust, probability 2": (lambda: robust(2.0), ("outlier_probability", "(0, 1)", "2.0")),
    "robust, two probabilities": (lambda: robust(jnp.array([0.1, 0.2])), ("outlier_probability", "(2,)")),
    "robust, large noise": (lambda: robust(noise=jnp.eye(2)), ("outlier_noise", "(1, 1)", "(2, 2)")),
    "robust, negative noise": (lambda: robust(noise=-R), ("outlier_noise", "negative", "-1")),
    "robust, scalar noise": (lambda: robust(noise=1.0), ("outlier_noise", "array", "float")),
    "robust, inner of another kind": (lambda: robust(inner=robust()), ("inner", "extended_kalman", "Robust")),
    "robust, wide y": (lambda: jf.run(robust(), KEY, jnp.zeros((5, 3))), ("observation y", "(3,)", "(1,)")),
    "schmidt_kalman, long constant": (lambda: schmidt(jnp.ones(3, bool)), ("constant", "(2,)", "(3,)")),
    "schmidt_kalman, scalar constant": (lambda: schmidt(jnp.array(True)), ("constant", "(n,)", "()")),
    "schmidt_kalman, constant by index": (lambda: schmidt(jnp.array([0, 1])), ("constant", "boolean", "int32")),
    "schmidt_kalman, scalar signature": (lambda: schmidt(signature=lambda mean: mean[0]), ("signature", "(d,)", "()")),
    "schmidt_kalman, signature": (lambda: schmidt(signature=3), ("signature", "function", "int")),
    "schmidt_kalman, tolerance": (lambda: schmidt(tolerance=-1.0), ("tolerance", "positive", "-1.0")),
    "schmidt_kalman, no signature": (lambda: schmidt(signature=None), ("signature", "None", "1.0")),
    "schmidt_kalman, inner": (lambda: schmidt(inner=PRIOR), ("inner", "Filter", "Gaussian")),
    "schmidt_kalman, inner with roots": (
        lambda: schmidt(inner=extended(prior=ROOT_PRIOR, arithmetic=jf.arithmetic.square_root)),
        ("inner", "Gaussian", "GaussianRoot"),
    ),
    "correlated_noise, inner": (lambda: lasting(inner=robust()), ("inner", "kalman", "Robust")),
    "correlated_noise, iterations": (lambda: lasting(inner=extended(iterations=3)), ("inner", "iterations=3")),
    "correlated_noise, noise": (lambda: lasting(R), ("noise", "GaussMarkov", "Array")),
    "correlated_noise, time constant": (lambda: lasting(process(-2.0)), ("time_constant", "positive", "-2.0")),
    "correlated_noise, time constants": (lambda: lasting(process([1.0, 2.0])), ("time_constant", "(1,)", "(2,)")),
    "correlated_noise, matrix of time": (
        lambda: lasting(process([[-1.0]])),
        ("time_constant", "positive real parts", "-1"),
    ),
    "correlated_noise, variance": (lambda: lasting(process(B=-jnp.ones(1))), ("covariance", "at least 0", "-1.0")),
    "correlated_noise, covariance": (lambda: lasting(process(B=INDEFINITE)), ("covariance", "semidefinite", "-1")),
    "correlated_noise, impossible process": (
        lambda: lasting(process([0.01, 100.0], 0.05 * jnp.eye(2) + 0.95), loading=jnp.ones((1, 2))),
        ("covariance", "time constants", "negative variance"),
    ),
    "correlated_noise, rows": (lambda: lasting(process(B=jnp.ones(2))), ("loading", "(1, 2)", "(2, 2)")),
    "correlated_noise, loading": (lambda: lasting(loading=jnp.ones((1, 3))), ("loading", "1 columns", "(1, 3)")),
    "correlated_noise, dt": (lambda: lasting(dt=-1.0), ("dt", "positive", "-1.0")),
    "correlated_noise, dt of each row": (lambda: lasting(dt=jnp.ones(2)), ("dt", "one number", "(2,)")),
    "correlated_noise, wide y": (lambda: lasting(ys=jnp.zeros((5, 3))), ("observation y", "(1,)", "(3,)")),
    "measurement_differencing, white noise": (lambda: differenced(R=R), ("observation noise", "zeros", "1.0")),
    "measurement_differencing, noise": (
        lambda: differenced(process(B=jnp.eye(1))),
        ("noise", "independent", "(1, 1)"),
    ),
    "measurement_differencing, sigma points": (
        lambda: differenced(linearize=jf.linearize.cubature),
        ("inner", "taylor"),
    ),
    "measurement_differencing, wide y": (lambda: differenced(ys=jnp.zeros((5, 3))), ("observation y", "(1,)", "(3,)")),
    "rts, one belief": (lambda: rts(PRIOR), ("beliefs", "time first", "(2,)")),
    "rts, beliefs of another size": (
        lambda: rts(jf.Gaussian(jnp.zeros((5, 3)), jnp.zeros((5, 3, 3)))),
        ("beliefs", "(2,)", "(5, 3)"),
    ),
    "rts, beliefs of two lengths": (
        lambda: rts(jf.Gaussian(jnp.zeros((5, 2)), jnp.zeros((4, 2, 2)))),
        ("beliefs", "(5, 2)", "(4, 2, 2)"),
    ),
    "rts, beliefs of another kind": (lambda: rts((jnp.zeros((5, 2)),)), ("beliefs", "Gaussian", "tuple")),
    "rts, long inputs": (lambda: rts(inputs=jnp.zeros(6)), ("inputs", "5", "6")),
    "rts, filter of another kind": (lambda: rts(filter=robust()), ("filter", "extended_kalman", "Robust")),
    "rts, no filter": (lambda: rts(filter=PRIOR), ("filter", "Filter", "Gaussian")),
    "fixed_lag_rts, lag": (lambda: jf.smoothing.fixed_lag_rts(extended(), 0), ("lag", "0")),
    "fixed_lag_rts, inner": (lambda: jf.smoothing.fixed_lag_rts(PRIOR, 3), ("inner", "Filter", "Gaussian")),
    "parallel_kalman, prior": (lambda: parallel(PRIOR), ("prior", "GaussianRoot", "got a Gaussian")),
    "parallel_kalman, F": (lambda: parallel(F=jnp.eye(3)), ("model.F", "(2, 2)", "(3, 3)")),
    "parallel_kalman, root_Q": (lambda: parallel(root_Q=jnp.eye(1)), ("model.root_Q", "(2, any width)", "(1, 1)")),
    "parallel_kalman, H": (lambda: parallel(H=jnp.eye(2)), ("model.H", "(1, 2)", "(2, 2)")),
    "parallel_kalman, root_R": (lambda: parallel(root_R=jnp.eye(2)), ("model.root_R", "(1, any width)", "(2, 2)")),
    "parallel_kalman, b": (lambda: parallel(b=jnp.zeros(3)), ("model.b", "(2,)", "(3,)")),
    "parallel_kalman, ys": (lambda: parallel(ys=jnp.zeros(5)), ("ys", "(t, m)", "(5,)")),
    "parallel_kalman, mask": (lambda: parallel(mask=jnp.ones(5, bool)), ("mask", "(5, 1)", "(5,)")),
    "parallel_kalman, length": (lambda: parallel(F=jnp.stack([jnp.eye(2)] * 4)), ("model.F", "5", "4")),
    "parallel_rts, beliefs": (
        lambda: jf.smoothing.parallel_rts(
            ROOT_PRIOR, jf.smoothing.LinearModel(jnp.eye(2), jnp.eye(2), jnp.eye(2)[:1], jnp.eye(1))
        ),
        ("beliefs", "(t, n)", "(2,)"),
    ),
    "product, no block": (lambda: jf.manifold.product(), ("product", "block")),
    "product, block of another kind": (lambda: jf.manifold.product(3), ("product", "Block", "int")),
}

RUN = {
    "run, filter": (lambda: jf.run(PRIOR, KEY, YS), ("filter", "Filter", "Gaussian")),
    "run, inputs": (lambda: run_extended(inputs=jnp.zeros(4)), ("inputs", "4", "5")),
    "run, scalar inputs": (lambda: run_extended(inputs=0.1), ("inputs", "scalar")),
    "run, mask of another length": (lambda: run_extended(mask=jnp.ones(4, bool)), ("mask", "4", "5")),
    "run, mask of components": (lambda: run_extended(mask=jnp.ones((5, 1), bool)), ("mask", "(t,)", "(5, 1)")),
    "run, mask of numbers": (lambda: run_extended(mask=jnp.ones(5)), ("mask", "boolean", "float32")),
    "run, nothing observed": (lambda: jf.run(extended(), KEY, ()), ("observations", "none")),
    "log_evidence, filter": (lambda: jf.log_evidence(PRIOR, KEY, YS), ("filter", "Filter", "Gaussian")),
    "log_evidence, inputs": (
        lambda: jf.log_evidence(extended(), KEY, YS, jnp.zeros(4)),
        ("inputs", "4", "5"),
    ),
}


def linear(**changed):
    given = {"F": np.eye(2), "Q": np.eye(2), "H": np.ones((1, 2)), "R": np.eye(1)}
    return jf.kalman(PRIOR, **{**given, **changed})


LINEAR = [
    Case("kalman, narrow F", lambda: linear(F=np.ones((2, 1))), ("F", "(2, 2)", "(2, 1)")),
    Case("kalman, wide H", lambda: linear(H=np.ones((1, 3))), ("H", "(1, 2)", "(1, 3)")),
    Case("kalman, flat H", lambda: linear(H=np.ones(2)), ("H", "(2,)")),
    Case("kalman, other Q", lambda: linear(Q=np.eye(3)), ("Q", "(2, 2)", "(3, 3)")),
    Case("kalman, other R", lambda: linear(R=np.eye(2)), ("R", "(1, 1)", "(2, 2)")),
    Case("kalman, negative R", lambda: linear(R=-np.eye(1)), ("R", "negative variance", "-1")),
    Case("kalman, asymmetric Q", lambda: linear(Q=np.array([[1.0, 0.5], [0.0, 1.0]])), ("Q", "symmetric")),
    Case("kalman, NaN in Q", lambda: linear(Q=np.full((2, 2), np.nan)), ("Q", "finite")),
    Case("kalman, long b", lambda: linear(b=np.zeros(3)), ("b", "(2,)", "(3,)")),
    Case("kalman, long d", lambda: linear(d=np.zeros(3)), ("d", "(1,)", "(3,)")),
    Case("kalman, arithmetic", lambda: linear(arithmetic=jf.arithmetic.square_root), ("prior", "GaussianRoot")),
    Case("kalman, wide y", lambda: jf.run(linear(), KEY, jnp.zeros((5, 3))), ("observation", "(3,)", "(1,)")),
    Case("kalman, F for each frame", lambda: linear(F=np.ones((5, 2, 2))), ("F", "(5, 2, 2)", "the inputs")),
    Case("kalman, F of two arguments", lambda: linear(F=lambda x, u: np.eye(2)), ("F must take (inputs)", "(x, u)")),
    Case(
        "kalman, F of inputs, narrow",
        lambda: jf.run(linear(F=lambda u: jnp.ones((2, 1))), KEY, jnp.zeros((5, 1)), jnp.zeros(5)),
        ("F", "(2, 2)", "(2, 1)"),
    ),
    Case("kalman, inputs", lambda: jf.run(linear(), KEY, jnp.zeros((5, 1)), jnp.zeros(5)), ("inputs", "None")),
]

STILL = lambda x: x


def counted(emission, y=None, **options):
    """An extended filter with an emission, run on one observation if there is one."""
    filter = jf.extended_kalman(PRIOR, STILL, Q, emission, **options)
    return filter if y is None else jf.update(filter, KEY, PRIOR, y)


COUNTS = jf.emissions.poisson(lambda x: x)
NOISES = [
    Case("emission with a noise", lambda: counted(COUNTS, observation_noise=R), ("observation_noise", "None")),
    Case("emission to the mean", lambda: counted(COUNTS, iterations=3), ("iterate_to", "mode")),
    Case("emission with a residual", lambda: counted(COUNTS, residual=lambda y, z: y - z), ("residual",)),
    Case(
        "observation of nothing",
        lambda: jf.update(jf.kalman(PRIOR, Q, Q, Q[:0], Q[:0, :0]), KEY, PRIOR, jnp.zeros(0)),
        ("observation y", "component", "none"),
    ),
    Case("counts, wide", lambda: counted(COUNTS, jnp.zeros(3)), ("observation y", "(2,)", "(3,)")),
    Case(
        "counts, noise", lambda: counted(COUNTS, jf.Observation(jnp.zeros(2), None, R)), ("Observation.noise", "None")
    ),
    Case("counts, mask", lambda: counted(COUNTS, jf.Observation(jnp.zeros(2), jnp.ones(3, bool))), ("mask", "(2,)")),
    Case("labels", lambda: counted(jf.emissions.categorical(STILL), jnp.zeros(2)), ("label", "()", "(2,)")),
    Case("rate, scalar", lambda: counted(jf.emissions.poisson(lambda x: x[0]), jnp.zeros(1)), ("(m,)", "()")),
    Case("rate, no function", lambda: jf.emissions.poisson(3.0), ("log_rate", "function", "float")),
    Case("no trials", lambda: jf.emissions.binomial(STILL, 0), ("num_trials", "at least 1", "0")),
    Case("half a trial", lambda: jf.emissions.binomial(STILL, 1.5), ("num_trials", "1.5")),
    Case("no noise", lambda: jf.extended_kalman(PRIOR, STILL, Q, STILL), ("observation_noise", "None")),
    Case("robust, emission", lambda: jf.robust(counted(COUNTS), 0.1, R), ("inner", "emission")),
    Case("student_t, emission", lambda: jf.student_t(counted(COUNTS), 4.0), ("inner", "emission")),
    Case("student_t, no dof", lambda: jf.student_t(linear(), None), ("observation_dof", "None")),
    Case("student_t, zero dof", lambda: jf.student_t(linear(), 0.0), ("observation_dof", "above 0", "0.0")),
    Case("student_t, infinite dof", lambda: jf.student_t(linear(), np.inf), ("observation_dof", "finite", "inf")),
    Case("student_t, process", lambda: jf.student_t(linear(), None, process_dof=2.0), ("process_dof", "above 2")),
    Case("student_t, scales", lambda: jf.student_t(linear(), 4.0, num_scales=2), ("num_scales", "at least 4", "2")),
    Case("student_t, inner", lambda: jf.student_t(jf.robust(linear(), 0.1, np.eye(1)), 4.0), ("inner", "Robust")),
    Case(
        "noise of the state, not additive",
        lambda: jf.extended_kalman(PRIOR, jf.NonAdditiveNoise(lambda x, w: x), lambda x, u: Q, STILL, Q),
        ("process_noise", "NonAdditiveNoise"),
    ),
    Case(
        "not additive, one argument",
        lambda: jf.extended_kalman(PRIOR, jf.NonAdditiveNoise(STILL), Q, STILL, Q),
        ("the function of transition must take (x, noise)", "(x)"),
    ),
    Case(
        "noise of the state, shape",
        lambda: jf.predict(jf.extended_kalman(PRIOR, STILL, lambda x, u: jnp.eye(1), STILL, Q), KEY, PRIOR),
        ("the result of process_noise", "(2, 2)", "(1, 1)"),
    ),
]

GAUSSIAN = [*LINEAR, *NOISES] + [Case(name, *case) for name, case in (EXTENDED | WRAPPERS | RUN).items()]


@pytest.mark.parametrize("case", GAUSSIAN, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case, check_rejected):
    check_rejected(case.call, case.words)
