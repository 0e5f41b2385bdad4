"""Intermediate results that XLA must not compute again in each of their uses."""

import math

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

_MAX_RECOMPUTED = 64
"""Largest number of elements for which computing a result again costs less than storing it."""


def materialized(x: Array) -> Array:
    """The array `x`, stored in memory once, so that the compiler does not compute it again in each of its uses.

    XLA fuses a chain of small matrix products into one loop over the elements of the last one and recomputes each
    element of the others as often as it is used: on a CPU, for an ensemble of matrices with six rows, ten times the
    arithmetic. Arrays of at most 64 elements are unaffected, and so are other devices.
    """
    return _materialized_p.bind(x)


@jax.jit
def _identity(x):
    return x


def _on_cpu(x):
    if math.prod(x.shape) <= _MAX_RECOMPUTED:
        return x
    # XLA fuses nothing across the boundary of a call, and this attribute prevents that the call is inlined.
    with set_xla_metadata(inlineable="false"):
        return _identity(x)


_materialized_p = Primitive("materialized")
_materialized_p.def_impl(lambda x: x)
_materialized_p.def_abstract_eval(lambda x: x)
mlir.register_lowering(_materialized_p, mlir.lower_fun(lambda x: x, multiple_results=False))
mlir.register_lowering(_materialized_p, mlir.lower_fun(_on_cpu, multiple_results=False), platform="cpu")
ad.deflinear(_materialized_p, lambda cotangent: [_materialized_p.bind(cotangent)])
batching.defvectorized(_materialized_p)
