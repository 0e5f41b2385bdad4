"""Tests of `jaxfilters._xla.product`."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfilters import Gaussian, kalman, log_evidence
from jaxfilters._xla.last_axis import batch_last
from jaxfilters._xla.product import small_product

# Sums of at most eight products of standard normal numbers in float32.
TOLERANCE = {"rtol": 1e-5, "atol": 1e-5}


def matrices(*shapes):
    return [
        jax.random.normal(key, shape) for key, shape in zip(jax.random.split(jax.random.key(0)), shapes, strict=True)
    ]


@pytest.mark.parametrize("sizes", [(3, 2, 4), (1, 8, 1), (8, 1, 8)])
def test_product_equals_matmul_with_all_batches(sizes):
    n, k, m = sizes
    a, b = matrices((5, 6, n, k), (5, k, m))

    @jax.jit
    def products(a, b):
        many = jax.vmap(small_product, (0, None))
        batch_at_the_end = jnp.moveaxis(small_product(jnp.moveaxis(a[:, 0], 0, -1), jnp.moveaxis(b, 0, -1)), -1, 0)
        one = jax.vmap(batch_last(lambda a, b: a[0] @ b))(a, b)
        return [jax.vmap(many)(a, b), jax.vmap(batch_last(many))(a, b)], [one, batch_at_the_end]

    expected = np.matmul(np.asarray(a, float), np.asarray(b, float)[:, None])
    of_all, of_first = products(a, b)
    for found in of_all:
        np.testing.assert_allclose(found, expected, **TOLERANCE)
    for found in of_first:
        np.testing.assert_allclose(found, expected[:, 0], **TOLERANCE)


def test_derivatives_of_first_and_second_order_in_both_modes():
    a, b = matrices((3, 2), (2, 4))
    check_grads(jax.jit(lambda a, b: jnp.sin(small_product(a, b))), (a, b), order=2, modes=["fwd", "rev"], rtol=0.02)
    batch = jnp.stack([b, 2 * b])
    loss = lambda product: lambda a: jnp.sum(jnp.sin(jax.vmap(lambda b: product(a, b))(batch)))
    np.testing.assert_allclose(
        jax.grad(loss(small_product))(a), jax.grad(loss(partial(jnp.matmul, precision="highest")))(a), **TOLERANCE
    )


@pytest.mark.parametrize("shapes", [((3, 2), (3, 4)), ((3, 0), (0, 4))])
def test_sizes_that_do_not_fit_are_refused(shapes):
    with pytest.raises(ValueError, match="a and b must be"):
        jax.eval_shape(small_product, *map(jnp.zeros, shapes))


def test_gradient_of_many_filters_sums_along_no_axis_of_a_few_elements():
    """XLA calls a library for each such sum of a large batch, and 50 of them took most of the time."""
    readings, eye = jnp.zeros((200, 2, 3)), jnp.eye(3)

    def one(F, y):
        # A transition that differs between the tracks, so that their covariances do.
        filter = kalman(Gaussian(jnp.zeros(3), eye), F + y[0], eye, eye, eye)
        return log_evidence(filter, jax.random.key(0), y)

    def evidence(F):
        return jax.vmap(one, (None, 0))(F, readings).sum()

    program = jax.jit(jax.grad(evidence)).lower(0.9 * eye).as_text()
    sums = re.findall(r"stablehlo.reduce\(.* dimensions = \[(\d)\] : \(tensor<([\dx]+)x200xf32>", program)
    lengths = [int(axes.split("x")[int(axis)]) for axis, axes in sums if int(axis) < len(axes.split("x"))]
    assert set(lengths) <= {1}
