"""Products of small matrices as sums of outer products, with derivatives of the same form."""

from functools import reduce
from operator import add

import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

LARGEST = 8
"""Number of rows or columns up to which a sum that is written out is faster than a call of a matrix library."""


def small_product(a: Array, b: Array, leading: int = 0) -> Array:
    """The products of matrices (*batch, n, k, *more) and (*batch, k, m, *more): an array (*batch, n, m, *more).

    The batch has as many axes as `leading` says, and all axes but those of the matrices are equal in both. Each product
    is the sum of its k outer products, which becomes one loop of multiplications and additions. If JAX were to
    differentiate these, it would transpose each outer product to a sum along an axis of a few elements, and XLA gives
    each such sum to a library call of its own, which takes five times as long. As one operation it has the derivatives
    of a matrix product, which are matrix products.
    """
    return _product_p.bind(a, b, leading=leading)


def _sum_of_outer_products(a, b, *, leading):
    columns = (lax.index_in_dim(a, i, leading + 1) for i in range(a.shape[leading + 1]))
    rows = (lax.index_in_dim(b, i, leading) for i in range(b.shape[leading]))
    return reduce(add, (column * row for column, row in zip(columns, rows, strict=True)))


def _abstract(a, b, *, leading):
    batch, (n, k), more = a.shape[:leading], a.shape[leading : leading + 2], a.shape[leading + 2 :]
    m = b.shape[leading + 1]
    if b.shape != (*batch, k, m, *more) or a.dtype != b.dtype or k == 0:
        raise ValueError(f"a and b must be (*batch, n, k, *more) and (*batch, k, m, *more); got {a} and {b}.")
    return ShapedArray((*batch, n, m, *more), a.dtype)


def _transposed(x, leading):
    return jnp.swapaxes(x, leading, leading + 1)


def _cotangent_of_left(cotangent, a, b, *, leading):
    del a
    return small_product(cotangent, _transposed(b, leading), leading)


def _cotangent_of_right(cotangent, a, b, *, leading):
    del b
    return small_product(_transposed(a, leading), cotangent, leading)


def _batch(args, axes, *, leading):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    a, b = (
        lax.broadcast(x, (size,)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(args, axes, strict=True)
    )
    return small_product(a, b, leading + 1), 0


_product_p = Primitive("small_product")
_product_p.def_impl(_sum_of_outer_products)
_product_p.def_abstract_eval(_abstract)
mlir.register_lowering(_product_p, mlir.lower_fun(_sum_of_outer_products, multiple_results=False))
ad.defbilinear(_product_p, _cotangent_of_left, _cotangent_of_right)
batching.primitive_batchers[_product_p] = _batch
