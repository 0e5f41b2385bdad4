"""Every public builder rejects input that it cannot use: at trace time or before, naming the argument.

A case is a call that must not return. Its words are all found in the message: the argument's name, and what came.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import optimistix
import pytest

import jaxfilters as jf

KEY = jax.random.key(0)


class Case(NamedTuple):
    """A call that must fail, and the words of its message."""

    name: str
    call: Callable[[], Any]
    words: tuple[str, ...]


# Gaussian filters.
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


def run_extended(ys=YS, controls=None, mask=None, state=None, **options):
    return jf.run(extended(**options), KEY, ys, controls, mask=mask, state=state)


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


def rts(beliefs=None, controls=None, filter=None):
    beliefs = jf.Gaussian(jnp.zeros((5, 2)), jnp.stack([jnp.eye(2)] * 5)) if beliefs is None else beliefs
    return jf.smoothing.rts(extended() if filter is None else filter, beliefs, controls)


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
    "schmidt_kalman, inner": (lambda: schmidt(inner=PRIOR), ("inner", "Filter", "Gaussian")),
    "schmidt_kalman, inner with roots": (
        lambda: schmidt(inner=extended(prior=ROOT_PRIOR, arithmetic=jf.arithmetic.square_root)),
        ("inner", "Gaussian", "GaussianRoot"),
    ),
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
    "rts, long controls": (lambda: rts(controls=jnp.zeros(6)), ("controls", "5", "6")),
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
    "run, controls": (lambda: run_extended(controls=jnp.zeros(4)), ("controls", "4", "5")),
    "run, scalar control": (lambda: run_extended(controls=0.1), ("controls", "scalar")),
    "run, mask of another length": (lambda: run_extended(mask=jnp.ones(4, bool)), ("mask", "4", "5")),
    "run, mask of components": (lambda: run_extended(mask=jnp.ones((5, 1), bool)), ("mask", "(t,)", "(5, 1)")),
    "run, mask of numbers": (lambda: run_extended(mask=jnp.ones(5)), ("mask", "boolean", "float32")),
    "run, nothing observed": (lambda: jf.run(extended(), KEY, ()), ("observations", "none")),
    "log_evidence, filter": (lambda: jf.log_evidence(PRIOR, KEY, YS), ("filter", "Filter", "Gaussian")),
    "log_evidence, controls": (
        lambda: jf.log_evidence(extended(), KEY, YS, jnp.zeros(4)),
        ("controls", "4", "5"),
    ),
}

GAUSSIAN = [Case(name, *case) for name, case in (EXTENDED | WRAPPERS | RUN).items()]

# Linear inequalities.
ROWS = jf.constraints.linear_constraints(jnp.eye(2), -1.0, 2.0, ["left", "right"])
STILL = jnp.zeros((2, 2))


def rows_with(**fields):
    return replace(ROWS, **{name: jnp.asarray(value) for name, value in fields.items()})


def lasting(inner, rows=ROWS, flags=(False, True)):
    return jf.constrained(inner, jf.EPConstraints(rows, jnp.asarray(flags)))


def each_step(rows):
    return jf.constrained(extended(), jf.TruncateEachStep(rows, jf.constraints.cut.sequential_intervals))


EYE = jnp.eye(2)


def linear(F=EYE, Q=STILL, prior=PRIOR, **options):
    return jf.kalman(prior, F, Q, jnp.eye(1, 2), R, **options)


def walk_root():
    root = jf.GaussianRoot(jnp.zeros(2), jnp.eye(2))
    return linear(Q=jnp.diag(jnp.array([0.0, 0.3])), prior=root, arithmetic=jf.arithmetic.square_root)


def bootstrap():
    from jaxfilters import bootstrap

    draw, move = lambda key: jax.random.normal(key, (2,)), lambda key, x, u: x
    return bootstrap(draw, move, lambda x, y: -jnp.sum(x**2), num_particles=8)


TURN = jnp.array([[1.0, 0.0], [0.1, 1.0]])
linear_constraints, EP = jf.constraints.linear_constraints, jf.constraints.expectation_propagation.truncate
CUT = jf.constraints.cut
CONSTRAINTS = [
    Case("lasting, noise", lambda: lasting(extended()), ("lasting", "right", "process_noise", "0.316", "False")),
    Case("lasting, noise by root", lambda: lasting(walk_root()), ("lasting", "right", "process_noise", "0.3")),
    Case("lasting, transition", lambda: lasting(linear(F=TURN)), ("lasting", "right", "transition")),
    Case("lasting, drift", lambda: lasting(extended(lambda x, u: x + 1, STILL)), ("lasting", "right", "transition")),
    Case("lasting, one flag", lambda: lasting(linear(), flags=True), ("lasting", "(2,)", "()")),
    Case("lasting, three flags", lambda: lasting(linear(), flags=[True] * 3), ("lasting", "(2,)", "(3,)")),
    Case("lasting, numbers", lambda: lasting(linear(), flags=[0, 1]), ("lasting", "Booleans", "int32")),
    Case("constrained, particles", lambda: lasting(bootstrap()), ("inner", "Gaussian")),
    Case("constrained, no filter", lambda: lasting(PRIOR), ("inner", "Filter", "Gaussian")),
    Case("constrained, bare rows", lambda: jf.constrained(linear(), ROWS), ("constrain", "LinearConstraints")),
    Case("constrained, wide normals", lambda: each_step(rows_with(normals=jnp.ones((2, 3)))), ("(k, 2)", "(2, 3)")),
    Case("constrained, flat normals", lambda: each_step(rows_with(normals=jnp.ones(2))), ("normals", "(2, n)", "(2,)")),
    Case("constrained, short bound", lambda: each_step(rows_with(lower=[0.0])), ("lower", "(2,)", "(1,)")),
    Case("constrained, reversed", lambda: each_step(rows_with(upper=[3.0, -4.0])), ("lower, upper", "right", "-4")),
    Case("constrained, NaN", lambda: each_step(rows_with(lower=[jnp.nan, 0.0])), ("lower", "left", "nan")),
    Case("constrained, no rows", lambda: each_step([[1.0, 0.0]]), ("constraints", "LinearConstraints")),
    Case("rows, reversed", lambda: linear_constraints(jnp.eye(2), 1.0, 0.0), ("lower, upper", "row 0", "[1. 0.]")),
    Case("rows, NaN", lambda: linear_constraints(jnp.eye(2), 0.0, jnp.nan), ("upper", "row 0", "nan")),
    Case("rows, empty", lambda: linear_constraints(jnp.zeros((0, 2)), 0.0, 1.0), ("normals", "(k, n)", "(0, 2)")),
    Case("EP, wide normals", lambda: EP(PRIOR, rows_with(normals=jnp.ones((2, 3)))), ("(k, 2)", "(2, 3)")),
    Case("EP, array", lambda: EP(jnp.zeros(2), ROWS), ("belief",)),
    Case("EP, damping", lambda: EP(PRIOR, ROWS, damping=0.0), ("damping", "(0, 1]", "0.0")),
    Case("EP, sweeps", lambda: EP(PRIOR, ROWS, max_sweeps=0), ("max_sweeps", "1", "0")),
    Case("interval, normal", lambda: CUT.interval(PRIOR, jnp.ones(3), 0.0, 1.0), ("normal", "(2,)", "(3,)")),
    Case("interval, reversed", lambda: CUT.interval(PRIOR, jnp.ones(2), 1.0, 0.0), ("lower <= upper", "1.0", "0.0")),
    Case("half-space, normal", lambda: CUT.halfspace(PRIOR, jnp.ones(1), 0.0), ("normal", "(2,)", "(1,)")),
]

# Particle and ensemble filters.
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
    return jf.run(jf.guided(marginal(jf.rao_blackwell_shared), guide, **options), KEY, YS)


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


def one_device():
    return jax.sharding.Mesh(jax.devices()[:1], ("particles",))


def filter_of(**options):
    return jf.bootstrap(prior, move, log_likelihood, num_particles=8, noise=jf.StandardNormal(1), **options)


def bad_dynamics():
    return jf.rao_blackwell(prior, VELOCITY, lambda x, u: x, log_likelihood, num_particles=8, noise_dim=1)


def not_shared():
    return jf.rao_blackwell_shared(prior, VELOCITY, depends_on_x, log_likelihood, num_particles=8, noise_dim=1)


def unguided():
    return jf.guided(marginal(jf.rao_blackwell_shared), lambda particles, log_weights, y: y)


NAN = float("nan")
INDEFINITE = jnp.array([[1.0, 2.0], [2.0, 1.0]])
ASYMMETRIC = jnp.array([[1.0, 0.5], [0.0, 1.0]])

PARTICLE = [
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
    Case("resampling, square", lambda: jf.resampling.systematic(KEY, jnp.zeros((3, 3))), ("log_weights", "3")),
    Case("soft share 1", lambda: jf.differentiable_resampling.soft(1.0), ("share", "1.0")),
    Case("transport 0", lambda: jf.differentiable_resampling.transport(0.0), ("regularization", "0.0")),
    Case("prior indefinite", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), INDEFINITE)), ("belief", "-1")),
    Case("prior lopsided", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), ASYMMETRIC)), ("belief", "0.5")),
    Case("prior NaN", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2), NAN * Q)), ("belief", "nan")),
    Case("prior (3,)", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(3), Q)), ("belief", "(3,)", "(2, 2)")),
    Case("prior ints", lambda: jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(2, int), Q)), ("belief.mean", "int32")),
    Case("prior of noise", lambda: jf.priors.from_noise(lambda e: e, 3), ("noise", "3")),
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
    Case("guide information", lambda: run_guided(information=jnp.eye(2)), ("information", "(2, 2)", "(1, 1)")),
    Case("guide sign", lambda: run_guided(information=-jnp.eye(1)), ("information", "-1")),
    Case("guide local", lambda: run_guided(local=lambda x, other: 0.0), ("local", "()", "(1,)")),
    Case("guide share", lambda: run_guided(prior_share=1.0), ("prior_share", "1.0")),
    Case("guide kind", lambda: jf.guided(marginal(), lambda *a: None), ("inner", "rao_blackwell_shared")),
    Case("guide no function", lambda: jf.guided(marginal(jf.rao_blackwell_shared), 0), ("guide", "0")),
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
    Case("long controls", lambda: sample_paths(controls=jnp.zeros(4)), ("controls", "3", "(4,)")),
    Case("scalar controls", lambda: sample_paths(controls=jnp.zeros(())), ("controls", "()")),
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
    Case("placement, Gaussian", lambda: jf.sharding.placement(extended(), one_device()), ("filter", "ExtendedKalman")),
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


# Hidden Markov models.
def as_called_by_users(cases: list[Case]) -> list[Case]:
    """The cases without the checks of shapes that jaxtyping adds while testing."""

    def unchecked(call: Callable[[], Any]) -> Callable[[], Any]:
        def made() -> Any:
            jaxtyping.config.update("jaxtyping_disable", True)
            try:
                return call()
            finally:
                jaxtyping.config.update("jaxtyping_disable", False)

        return made

    return [case._replace(call=unchecked(case.call)) for case in cases]


LOGS = jnp.zeros((5, 2))
CHAIN = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
CODED = jf.hmm.from_probabilities([0.5, 0.5], np.eye(2), jf.hmm.Codes(jnp.log(jnp.full((2, 3), 1 / 3))))
VECTORS = jf.hmm.from_probabilities([0.5, 0.5], np.eye(2), jf.hmm.DiagonalGaussian(jnp.zeros((2, 1)), jnp.ones((2, 1))))
WRONG_VARIANCE = jf.hmm.DiagonalGaussian(jnp.zeros((2, 3)), jnp.ones((2, 1)))
MISMATCHED = jf.hmm.HiddenMarkovModel(jnp.zeros(3), jnp.zeros((2, 2)))
THREE_STATES = jf.hmm.Codes(jnp.zeros((3, 4)))


def network():
    return jf.hmm.parallel_composition([CHAIN, CHAIN])


def trained(observations=None, lengths=None, model=CODED, **options):
    observations = jnp.zeros((4, 2), int) if observations is None else observations
    return jf.hmm.baum_welch(model, observations, lengths, **options)


HMM = [
    Case("hmm, wrong sizes", lambda: jf.hmm.forward(MISMATCHED, LOGS), ("log_initial", "(3,)", "(2, 2)")),
    Case(
        "hmm, wrong Q", lambda: jf.hmm.log_evidence(CHAIN, jnp.zeros((5, 3))), ("log_likelihoods", "2 states", "(5, 3)")
    ),
    Case("hmm, wrong Q backward", lambda: jf.hmm.backward(CHAIN, jnp.zeros((5, 3))), ("log_likelihoods", "(5, 3)")),
    Case("hmm, wrong Q posterior", lambda: jf.hmm.posterior(CHAIN, jnp.zeros((5, 3))), ("log_likelihoods", "(5, 3)")),
    Case("hmm, wrong Q viterbi", lambda: jf.hmm.viterbi(CHAIN, jnp.zeros((5, 3))), ("log_likelihoods", "(5, 3)")),
    Case("hmm, lengths of one sequence", lambda: jf.hmm.forward(CHAIN, LOGS, jnp.array([5, 5])), ("lengths",)),
    Case(
        "hmm, initial and transition",
        lambda: jf.hmm.from_probabilities([1.0], np.eye(2)),
        ("initial", "(1,)", "(2, 2)"),
    ),
    Case(
        "hmm, transposed transition",
        lambda: jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.2], [0.1, 0.8]]),
        ("transition", "rows (axis 1)", "row 0", "1.1", "axis 0", "transpose"),
    ),
    Case("hmm, initial sum", lambda: jf.hmm.from_probabilities([0.5, 0.6], np.eye(2)), ("initial", "1.1")),
    Case(
        "hmm, emission states",
        lambda: jf.hmm.from_probabilities([0.5, 0.5], np.eye(2), THREE_STATES),
        ("emission", "2"),
    ),
    Case(
        "hmm, emission states of a model",
        lambda: jf.hmm.HiddenMarkovModel(jnp.zeros(2), jnp.zeros((2, 2)), THREE_STATES).log_likelihoods(
            jnp.zeros(4, int)
        ),
        ("emission", "2 states", "(4, 3)"),
    ),
    Case("hmm, topology", lambda: jf.hmm.from_topology(np.ones((2, 3), bool)), ("allowed", "(2, 3)")),
    Case(
        "hmm, topology, initial",
        lambda: jf.hmm.from_topology(np.eye(2, dtype=bool), initial=np.ones(3, bool)),
        ("initial",),
    ),
    Case("codes, float", lambda: CODED.log_likelihoods(jnp.zeros(4)), ("observations", "integers", "float32")),
    Case(
        "codes, out of range",
        lambda: CODED.log_likelihoods(jnp.array([0, 3])),
        ("observations", "0 to 2", "3", "frame 1"),
    ),
    Case("codes, two columns", lambda: CODED.log_likelihoods(jnp.zeros((4, 2), int)), ("observation", "(2,)")),
    Case(
        "gaussian, 1-D data", lambda: VECTORS.log_likelihoods(jnp.zeros(4)), ("observation", "(1,)", "()", "last axis")
    ),
    Case("gaussian, wide data", lambda: VECTORS.log_likelihoods(jnp.zeros((4, 3))), ("observation", "(1,)", "(3,)")),
    Case(
        "gaussian, NaN",
        lambda: VECTORS.log_likelihoods(jnp.array([[0.0], [jnp.nan]])),
        ("observations", "nan", "frame 1"),
    ),
    Case("gaussian, variance", lambda: WRONG_VARIANCE.log_likelihood(jnp.zeros(3)), ("variance", "(2, 3)", "(2, 1)")),
    Case(
        "gaussian, covariance",
        lambda: jf.hmm.FullGaussian(jnp.zeros((2, 3)), jnp.ones((2, 3))).log_likelihood(jnp.zeros(3)),
        ("covariance", "(2, 3, 3)", "(2, 3)"),
    ),
    Case(
        "hmm, mask length",
        lambda: CODED.log_likelihoods(jnp.zeros(4, int), jnp.ones(3, bool)),
        ("mask", "(3,)", "(4,)"),
    ),
    Case("hmm, online", lambda: jf.run(jf.hmm.online(CHAIN), KEY, jnp.zeros((5, 3))), ("observation", "(2,)", "(3,)")),
    Case("hmm, online model", lambda: jf.hmm.online(MISMATCHED), ("log_initial", "(3,)", "(2, 2)")),
    Case("baum_welch, lengths", lambda: trained(lengths=jnp.array([4, 5])), ("lengths", "0 to 4", "5")),
    Case("baum_welch, number of lengths", lambda: trained(lengths=jnp.array([4])), ("lengths", "(2,)", "(1,)")),
    Case("baum_welch, mask", lambda: trained(mask=jnp.ones((4, 1), bool)), ("mask", "(4, 2)", "(4, 1)")),
    Case("baum_welch, one sequence", lambda: trained(jnp.zeros(4, int)), ("observations", "(T, ..., n)", "(4,)")),
    Case("baum_welch, iterations", lambda: trained(max_iterations=0), ("max_iterations", "0")),
    Case("baum_welch, codes", lambda: trained(jnp.array([[0, 0], [7, 0]])), ("observations", "7", "frame 1")),
    Case("baum_welch, no emission", lambda: trained(model=CHAIN), ("emission",)),
    Case(
        "hmm, responsibilities",
        lambda: jf.hmm.with_responsibilities(CODED, jnp.zeros((4, 2), int), jnp.ones((4, 3, 2))),
        ("responsibilities", "(4, 2, 2)", "(4, 3, 2)"),
    ),
    Case(
        "hmm, no final state", lambda: jf.hmm.parallel_composition([CHAIN], [np.zeros(2, bool)]), ("final", "model 0")
    ),
    Case(
        "hmm, loop",
        lambda: jf.hmm.loop(network(), part_transition=np.ones((2, 2))),
        ("part_transition", "rows (axis 1)", "2"),
    ),
    Case("hmm, segments", lambda: jf.hmm.segments(np.array([0, 4]), network()), ("states", "3", "4")),
    Case(
        "hmm, spotter prior", lambda: jf.hmm.spotter(network(), log_prior=jnp.zeros(4)), ("log_prior", "(2,)", "(4,)")
    ),
]
HMM = as_called_by_users(HMM)

# Fitting.
YS = jnp.ones((6, 1))


def filter_of(noise):
    return jf.extended_kalman(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), lambda x, u: x, noise * jnp.eye(1), lambda x: x, R)


def particle_filter_of(noise):
    return jf.bootstrap(
        lambda key: jax.random.normal(key, (1,)),
        lambda key, x, u: x + noise * jax.random.normal(key, (1,)),
        lambda x, y: -0.5 * jnp.sum((y - x) ** 2),
        num_particles=8,
    )


def maximized(log_density=lambda x: -jnp.sum(x**2), start=1.0, constraints=jf.fit.free, **options):
    return jf.fit.maximize(log_density, start, constraints, **options)


FIT = [
    Case(
        "fit, NaN to a particle filter",
        lambda: maximized(jf.fit.log_evidence(KEY, particle_filter_of, YS.at[2].set(jnp.nan)), 1.0, jf.fit.positive),
        ("log_density", "start", "observations", "NaN", "frame 2", "mask"),
    ),
    Case("fit, infinite at the start", lambda: maximized(lambda x: jnp.log(x), 0.0), ("log_density", "start", "-inf")),
    Case(
        "fit, prior excludes the start",
        lambda: maximized(jf.fit.with_prior(lambda x: -(x**2), lambda x: jnp.log(x)), 0.0),
        ("log_density", "log prior", "-inf"),
    ),
    Case(
        "fit, mask length",
        lambda: jf.fit.log_evidence(KEY, filter_of, YS, mask=jnp.ones(5, bool)),
        ("observations", "mask", "(6, 1)", "(5,)"),
    ),
    Case(
        "fit, controls length",
        lambda: jf.fit.log_evidence(KEY, filter_of, YS, jnp.ones((4, 1))),
        ("observations", "controls", "(6, 1)", "(4, 1)"),
    ),
    Case("fit, no observations", lambda: jf.fit.log_evidence(KEY, filter_of, None), ("observations", "none")),
    Case(
        "fit, mask of other sequences",
        lambda: jf.fit.over_sequences(KEY, filter_of, jnp.ones((6, 1, 3)), mask=jnp.ones((6, 2), bool)),
        ("observations", "mask", "(6, 1, 3)", "(6, 2)"),
    ),
    Case(
        "fit, mask without sequences",
        lambda: jf.fit.over_sequences(KEY, filter_of, jnp.ones((6, 1, 6)), mask=jnp.ones(6, bool)),
        ("mask", "last axis", "(6,)"),
    ),
    Case("fit, start outside", lambda: maximized(start={"a": -1.0}, constraints=jf.fit.positive), ("start['a']", "-1")),
    Case("fit, start NaN", lambda: maximized(start=jnp.nan), ("start", "finite", "nan")),
    Case(
        "fit, other constraints",
        lambda: maximized(start={"a": 1.0}, constraints={"b": jf.fit.free}),
        ("constraints", "structure of start"),
    ),
    Case("fit, no constraint", lambda: maximized(constraints=3.0), ("constraints", "fit.positive", "3.0")),
    Case("fit, interval", lambda: jf.fit.interval(2.0, 1.0), ("interval", "2.0", "1.0")),
    Case(
        "fit, fresh keys with bfgs",
        lambda: maximized(jf.fit.fresh_keys(KEY, lambda key, x: -(x**2))),
        ("method", "fresh keys", "Bfgs"),
    ),
    Case("fit, least squares", lambda: maximized(method=jf.fit.least_squares()), ("log_density", "fit.residuals")),
    Case("fit, adam rate", lambda: jf.fit.adam(0.0), ("learning_rate", "0.0")),
    Case("fit, no steps", lambda: jf.fit.bfgs(max_steps=0), ("max_steps", "0")),
    Case("fit, tolerance", lambda: jf.fit.lbfgsb(tolerance=-1.0), ("tolerance", "-1.0")),
    Case("fit, patience", lambda: jf.fit.adam(patience=0), ("patience", "0")),
    Case(
        "check_gradient outside",
        lambda: jf.fit.check_gradient(lambda x: jnp.log(x), -1.0, jf.fit.positive),
        ("theta", "positive", "-1"),
    ),
]
FIT = as_called_by_users(FIT)

# Optimisation and mathematics.
COST = jnp.ones((2, 3))
PCA = jf.math.incremental_pca.start(3, 2)
TENSOR = jnp.ones((3, 4, 2))
SPLIT = jf.optimize.Split(jnp.zeros(1), jnp.zeros((4, 2)))


def solved(options=None, fn=lambda y, args: y - 3.0):
    solver = jf.optimize.BoxLevenbergMarquardt(rtol=1e-4, atol=1e-4)
    return optimistix.least_squares(fn, solver, jnp.zeros(2), None, options)


def shared(start=SPLIT, data=None, **options):
    data = jnp.zeros((4, 2)) if data is None else data
    return jf.optimize.solve_shared(lambda shared, frame, data: shared + frame - data, start, data, **options)


MATH = [
    Case("least squares, bound of another shape", lambda: solved({"lower": jnp.zeros(3)}), ("lower", "shapes of y")),
    Case("least squares, bound of another tree", lambda: solved({"upper": {"a": 0.0}}), ("upper", "structure")),
    Case("least squares, crossed bounds", lambda: solved({"lower": 2.0, "upper": 1.0}), ("lower", "2.0", "1.0")),
    Case("least squares, NaN bound", lambda: solved({"lower": float("nan")}), ("lower", "nan")),
    Case(
        "bounds, crossed",
        lambda: jf.optimize.bounds_of({"lower": jnp.array([0.0, 2.0]), "upper": 1.0}, jnp.zeros(2)),
        ("lower", "variable 1", "2.0", "1.0"),
    ),
    Case("least squares, no residuals", lambda: solved(fn=lambda y, args: y[:0]), ("fn", "residual", "none")),
    Case("huber, scale", lambda: jf.optimize.huber(jnp.ones(2), 0.0), ("scale", "0.0")),
    Case("cauchy, scale", lambda: jf.optimize.cauchy(jnp.ones(2), -1.0), ("scale", "-1.0")),
    Case("solve_shared, frames of data", lambda: shared(data=jnp.zeros((5, 2))), ("data", "(4, 2)", "(5, 2)")),
    Case("solve_shared, no frames", lambda: shared(jf.optimize.Split(jnp.zeros(1), None)), ("start.frames", "none")),
    Case(
        "solve_shared, crossed bounds",
        lambda: shared(lower=SPLIT._replace(shared=jnp.ones(1)), upper=SPLIT),
        ("lower",),
    ),
    Case("solve_shared, bound of another shape", lambda: shared(lower=SPLIT._replace(shared=jnp.ones(2))), ("lower",)),
    Case("assignment, vector", lambda: jf.math.assignment.match(jnp.ones(3)), ("cost", "(3,)")),
    Case("assignment, NaN", lambda: jf.math.assignment.match(COST.at[0, 1].set(jnp.nan)), ("cost", "NaN", "1 of 6")),
    Case("assignment, mask", lambda: jf.math.assignment.match(COST, jnp.ones(3, bool)), ("rows", "(2,)", "(3,)")),
    Case("assignment, gate", lambda: jf.math.assignment.match_noncrossing_gated(COST, -1.0), ("gate", "-1.0")),
    Case("assignment, columns", lambda: jf.math.assignment.match(jnp.ones((2, 13))), ("cost", "12", "13")),
    Case("pca, components", lambda: jf.math.incremental_pca.start(3, 4), ("num_components", "3", "4")),
    Case("pca, sample", lambda: jf.math.incremental_pca.update(PCA, jnp.ones(2)), ("deviation", "(3,)", "(2,)")),
    Case(
        "pca, sample of moments",
        lambda: jf.math.incremental_pca.update_moments(jf.math.incremental_pca.start_moments(3), jnp.ones(1)),
        ("x", "(3,)", "(1,)"),
    ),
    Case("pca, mean", lambda: jf.math.incremental_pca.running_mean(jnp.ones(3), jnp.ones(1), 2), ("x", "(3,)", "(1,)")),
    Case(
        "pca, basis",
        lambda: jf.math.incremental_pca.change_basis(
            jnp.ones((2, 5)), jnp.zeros(3), jnp.eye(3), jnp.zeros(3), jnp.eye(3)
        ),
        ("coordinates", "(2, 5)", "(3, 3)"),
    ),
    Case("diffusion, scale", lambda: jf.math.diffusion.start(jnp.array([1.0, 0.0])), ("scale", "positive")),
    Case(
        "diffusion, velocity",
        lambda: jf.math.diffusion.update(jf.math.diffusion.start(jnp.ones(2)), jnp.ones(1), jnp.ones(1)),
        ("velocity", "(2,)", "(1,)"),
    ),
    Case("lie, quaternion", lambda: jf.math.lie.quaternion_to_matrix(jnp.ones(3)), ("q", "(3,)")),
    Case("lie, product", lambda: jf.math.lie.quaternion_multiply(jnp.ones(4), jnp.ones(3)), ("q", "(3,)")),
    Case("lie, rotation vector", lambda: jf.math.lie.so3_exp(jnp.ones(4)), ("rotvec", "(4,)")),
    Case("lie, matrix", lambda: jf.math.lie.quaternion_from_matrix(jnp.ones((4, 4))), ("R", "(4, 4)")),
    Case("lie, points", lambda: jf.math.lie.RigidTransform.identity().apply(jnp.ones((5, 2))), ("points", "(5, 2)")),
    Case(
        "linalg, product", lambda: jf.math.linalg.matmul(jnp.ones((2, 3)), jnp.ones((2, 2))), ("a", "(2, 3)", "(2, 2)")
    ),
    Case("linalg, cholesky", lambda: jf.math.linalg.cholesky(jnp.ones((3, 2))), ("S", "(3, 2)")),
    Case(
        "linalg, triangular",
        lambda: jf.math.linalg.solve_triangular(jnp.eye(2), jnp.ones(3)),
        ("L", "b", "(2, 2)", "(3,)"),
    ),
    Case("tensor, rank", lambda: jf.math.multilinear.hosvd(TENSOR, {1: 5}), ("ranks", "mode 1", "5")),
    Case("tensor, mode", lambda: jf.math.multilinear.unfold(TENSOR, 3), ("mode", "3")),
    Case("tensor, NaN", lambda: jf.math.multilinear.hooi(TENSOR * jnp.nan, {0: 1}), ("X", "finite", "24")),
    Case(
        "tensor, product",
        lambda: jf.math.multilinear.mode_product(TENSOR, jnp.ones((2, 2)), 0),
        ("C", "3 columns", "(2, 2)"),
    ),
    Case(
        "tensor, observed",
        lambda: jf.math.tensor_completion.complete(TENSOR, jnp.ones((3, 4), bool), {0: 1}),
        ("observed", "(3, 4, 2)", "(3, 4)"),
    ),
]
MATH = as_called_by_users(MATH)

CASES = [*GAUSSIAN, *CONSTRAINTS, *PARTICLE, *HMM, *FIT, *MATH]


@pytest.fixture
def _as_users_run_it():
    """Without the run-time type checker of the test suite, whose errors would come first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.usefixtures("_as_users_run_it")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input_is_an_error_that_names_the_argument(case):
    with pytest.raises((ValueError, TypeError)) as caught:
        case.call()
    missing = [word for word in case.words if word not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"
