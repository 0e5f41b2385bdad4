"""The batch on the last axis: the same numbers and derivatives as `jax.vmap`, for every kind of operation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters._xla import last_axis
from jaxfilters._xla.last_axis import batch_last
from jaxfilters._xla.materialize import materialized
from jaxfilters.filter import log_evidence
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import extended_kalman

BATCH = 5


@jax.custom_jvp
def halved_slope(x):
    return jnp.sin(x)


halved_slope.defjvp(lambda primals, tangents: (jnp.sin(primals[0]), 0.5 * jnp.cos(primals[0]) * tangents[0]))


@jax.custom_jvp
def scaled(x, times):
    return x * times, times + 1


scaled.defjvp(
    lambda primals, tangents: (
        scaled(*primals),
        (3.0 * tangents[0] * primals[1], np.zeros(np.shape(primals[1]), jax.dtypes.float0)),
    )
)


@jax.custom_vjp
def tripled_back(x):
    return 2 * x


tripled_back.defvjp(lambda x: (2 * x, None), lambda _, cotangent: (3 * cotangent,))

A = jnp.arange(12.0).reshape(3, 4) / 7
WIDE = jnp.sin(jnp.arange(40.0).reshape(10, 4))

OF_VECTOR = {
    "numbers beside arrays": lambda x: jnp.where(x > 0.1, x, x[0]) + jnp.clip(x, x[1] - 1, 2.0) * 3,
    "shared arrays": lambda x: jnp.arctan2(x, jnp.arange(4.0)) + jnp.maximum(jnp.ones(4), x),
    "shared choice": lambda x: jnp.where(jnp.array([True, False, True, True]), x, -(x**2)),
    "own choice of a whole array": lambda x: jnp.where(x[0] > 0, x, 2 * x),
    "outer products": lambda x: x[:, None] * A[0] + jnp.outer(x, x) - jnp.eye(4) * x,
    "matrix and vector": lambda x: (A @ x, x @ A.T, A @ jnp.outer(x, x), jnp.outer(x, x) @ x, x @ x),
    "large products": lambda x: WIDE @ x,
    "einsum": lambda x: jnp.einsum("i,jk->kij", x, A[:, :2]),
    "no terms": lambda x: jnp.zeros((2, 0)) @ jnp.zeros((0, 4)) + x,
    "reductions": lambda x: (
        jnp.sum(jnp.outer(x, x), axis=(0, 1)),
        jnp.prod(x),
        jnp.max(x),
        jnp.any(x > 0),
        jnp.argmax(x),
    ),
    "long sums": lambda x: jnp.sum(jnp.tile(x, 4)[:, None] * A[0], axis=0),
    "shapes": lambda x: jnp.pad(jnp.outer(x, A[0]).reshape(2, 8).T[::-1], ((1, 0), (0, 2))),
    "joined": lambda x: (jnp.concatenate([x, jnp.ones(2), x[1:3]]), jnp.stack([x, A[0]], axis=1)),
    "picked": lambda x: (x[::2], x[-1], x[jnp.array([2, 0, 0])], x.at[1].set(7.0), jnp.cumsum(x), jnp.sort(x)),
    "picked by the element": lambda x: A[jnp.argmax(x[:3])] * x,
    "filled by the element": lambda x: jax.lax.pad(x, x[0], ((1, 1, 0),)),
    "factors": lambda x: jnp.linalg.cholesky(jnp.eye(4) * 9 + jnp.outer(x, x)),
    "loops": lambda x: jax.lax.fori_loop(0, 3, lambda i, y: jnp.sin(y) + i, x),
    "branches": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "compiled parts": lambda x: jax.jit(lambda y: y * 2)(x) + jax.checkpoint(jnp.tanh)(x),
    "own derivatives": lambda x: (halved_slope(x), scaled(x, jnp.argmax(x[:3]))[0], tripled_back(x)),
    "derivatives inside": lambda x: (jax.jacfwd(lambda y: jnp.sin(y) * y[0])(x), jax.grad(lambda y: jnp.sum(y**3))(x)),
    "integers": lambda x: (jnp.round(x * 10).astype(jnp.int32) % 3, jnp.arange(4) + 1),
    "random numbers": lambda x: x * jax.random.normal(jax.random.key(0), (4,)),
    "materialized": lambda x: materialized(jnp.outer(x, x)) @ x,
    "inside itself": lambda x: batch_last(lambda y: jnp.outer(y, x))(2 * x),
    "trees": lambda x: {"a": x, "b": (x[0], None)},
}


def batch() -> jax.Array:
    return jax.random.normal(jax.random.key(3), (BATCH, 4))


def assert_same(found, expected, rtol=2e-5, atol=2e-6):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol, atol)


@pytest.mark.system
@pytest.mark.parametrize("name", OF_VECTOR)
def test_values_are_those_of_vmap(name: str) -> None:
    function = OF_VECTOR[name]

    @jax.jit
    def values(x):
        alone = batch_last(function)(x[0]), function(x[0])
        last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), last_axis.vmap(function)(x.T))
        return alone, jax.vmap(function)(x), jax.vmap(batch_last(function))(x), last

    (alone, unchanged), expected, inner, last = values(batch())
    assert_same(alone, unchanged, rtol=0, atol=0)
    assert_same(inner, expected)
    assert_same(last, expected)


def smooth_sum(tree) -> jax.Array:
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return sum(jnp.sum(jnp.sin(leaf)) for leaf in leaves) + 0.0


@pytest.mark.system
@pytest.mark.parametrize("name", OF_VECTOR)
def test_derivatives_are_those_of_vmap_in_either_order(name: str) -> None:
    function = OF_VECTOR[name]

    @jax.jit
    def slopes(x):
        of = lambda mapped: jax.grad(lambda x: smooth_sum(mapped(x)))(x)
        inside = jax.vmap(jax.grad(lambda x: smooth_sum(batch_last(function)(x))))(x)
        last = of(lambda x: last_axis.vmap(function)(x.T))
        return of(jax.vmap(function)), of(jax.vmap(batch_last(function))), last, inside

    expected, *found = slopes(batch())
    for one in found:
        assert_same(one, expected)


def test_second_derivatives_are_those_of_the_custom_rule() -> None:
    # The rule halves the slope of the sine, and plain differentiation that of the rule: -sin / 2.
    x = batch()[:, 0]
    mapped = jax.vmap(batch_last(halved_slope))
    along = lambda f: jax.jvp(f, (x,), (jnp.ones(BATCH),))[1]
    second = jax.jvp(lambda x: jax.jvp(mapped, (x,), (jnp.ones(BATCH),))[1], (x,), (jnp.ones(BATCH),))[1]
    np.testing.assert_allclose(along(mapped), 0.5 * jnp.cos(x), 1e-6)
    np.testing.assert_allclose(second, -0.5 * jnp.sin(x), 1e-5)


@pytest.mark.system
def test_maps_within_maps_and_other_axes() -> None:
    function = lambda x, y: jnp.outer(x, y) @ y
    x, y = jax.random.normal(jax.random.key(0), (4, 2)), jax.random.normal(jax.random.key(1), (4, 3))
    nested = lambda f: jax.vmap(jax.vmap(f, (None, 1)), (1, None), 1)(x, y)
    assert_same(nested(batch_last(function)), nested(function))
    keys = jax.random.split(jax.random.key(2), 4)
    drawn = lambda key, x: x * jax.random.normal(key, (2,))
    assert_same(jax.vmap(batch_last(drawn))(keys, x), jax.vmap(drawn)(keys, x))


def test_results_and_arguments_may_be_shared() -> None:
    function = lambda x, tree: {"own": x * tree["b"], "all": tree["a"] + 1, "none": None}
    tree = {"a": jnp.arange(3.0), "b": jnp.arange(4.0), "c": None}
    found = last_axis.vmap(function, (-1, None), {"own": -1, "all": None, "none": None})(batch().T, tree)
    assert found["all"].shape == (3,)
    np.testing.assert_allclose(found["own"], batch().T * jnp.arange(4.0)[:, None])
    repeated = last_axis.vmap(function, (-1, None))(batch().T, tree)
    np.testing.assert_allclose(repeated["all"], np.tile(np.arange(1.0, 4.0)[:, None], BATCH))


def test_what_an_own_derivative_leaves_shared_stays_shared() -> None:
    @jax.custom_jvp
    def both(x, y):
        return jnp.sin(x), x * y

    @both.defjvp
    def _both_jvp(primals, tangents):
        (x, y), (dx, dy) = primals, tangents
        return both(x, y), (jnp.cos(x) * dx + 0 * dy, y * dx + x * dy)

    function = lambda x: last_axis.vmap(both, (None, -1), (None, -1))(x, jnp.arange(3.0))
    (shared, own), changes = jax.jvp(function, (0.5,), (1.0,))
    assert shared.shape == changes[0].shape == ()
    np.testing.assert_allclose(changes[0], np.cos(0.5), 1e-6)
    np.testing.assert_allclose(own, 0.5 * np.arange(3.0))


def test_what_cannot_be_mapped_is_refused() -> None:
    with pytest.raises(ValueError, match="out_axes must be -1"):
        last_axis.vmap(jnp.sin, -1, None)(batch().T)
    with pytest.raises(ValueError, match="one length"):
        last_axis.vmap(jnp.add)(jnp.ones(3), jnp.ones(4))
    with pytest.raises(ValueError, match="one length"):
        last_axis.vmap(jnp.sin, None)(jnp.ones(3))


def test_prints_survive(capfd: pytest.CaptureFixture) -> None:
    def talking(x):
        jax.debug.print("seen {}", x)
        return 2 * x

    assert_same(jax.vmap(batch_last(talking))(jnp.arange(2.0)), 2 * jnp.arange(2.0))
    jax.effects_barrier()
    assert capfd.readouterr().out.count("seen") == 2


def turning(x, inputs):
    del inputs
    angle = 0.1 * x[4]
    along = jnp.array([jnp.cos(angle) * x[2] - jnp.sin(angle) * x[3], jnp.sin(angle) * x[2] + jnp.cos(angle) * x[3]])
    return jnp.concatenate([x[:2] + 0.1 * x[2:4], along, x[4:]])


def bearing(x):
    return jnp.array([jnp.hypot(x[0] - 9.0, x[1]), jnp.arctan2(x[1] + 8.0, x[0])])


def tracked(readings, arithmetic, scale=1.0):
    start = Gaussian(jnp.array([1.0, 2.0, 0.5, -0.5, 0.1]), 0.3 * jnp.eye(5))
    if arithmetic is arithmetics.square_root:
        start = arithmetic.Belief(start.mean, jnp.sqrt(start.covariance))
    noises = 0.05 * scale * jnp.eye(5), 0.1 * jnp.eye(2)
    filter = extended_kalman(start, turning, noises[0], bearing, noises[1], arithmetic=arithmetic)
    return log_evidence(filter, jax.random.key(0), readings)


@pytest.mark.system
@pytest.mark.parametrize("arithmetic", [arithmetics.joseph, arithmetics.square_root], ids=["joseph", "root"])
def test_a_batch_of_tracks_is_each_track_alone(arithmetic) -> None:
    readings = jnp.array([9.0, 1.4]) + 0.3 * jax.random.normal(jax.random.key(5), (70, 4, 2))
    readings = readings.at[1, 2, 0].set(jnp.nan)
    of = jax.value_and_grad(lambda scale, readings: tracked(readings, arithmetic, scale))
    # Seventy tracks are more than what is left alone by `materialized`.
    values, slopes = jax.jit(jax.vmap(of, (None, 0)))(1.0, readings)
    together = lambda scale: jnp.sum(jax.vmap(lambda y: tracked(y, arithmetic, scale))(readings))
    total = jax.jit(jax.grad(together))(1.0)
    alone = [jax.jit(of)(1.0, readings[i]) for i in (0, 1, 69)]
    for i, (value, slope) in zip((0, 1, 69), alone, strict=True):
        np.testing.assert_allclose(values[i], value, 1e-4)
        np.testing.assert_allclose(slopes[i], slope, 1e-3, 1e-4)
    np.testing.assert_allclose(total, jnp.sum(slopes), 1e-3)


def test_materialized_results_are_computed_once() -> None:
    def chain(x):
        return materialized(jnp.sin(x)) * 2

    compiled = jax.jit(jax.vmap(chain)).lower(jnp.ones((100, 4))).compile().as_text()
    assert (" call(" in compiled) == (jax.default_backend() == "cpu")
    assert " call(" not in jax.jit(chain).lower(jnp.ones(4)).compile().as_text()
    x, change = jnp.linspace(-1, 1, 100), jnp.ones(100)
    assert_same(jax.jvp(chain, (x,), (change,)), jax.jvp(lambda x: jnp.sin(x) * 2, (x,), (change,)))
    assert_same(jax.grad(lambda x: chain(x).sum())(x), 2 * jnp.cos(x))
