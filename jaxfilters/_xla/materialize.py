"""Results that are written to memory once, for all that use them."""

import math

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

_SINGLE = 64
"""Elements of the largest matrix without an ensemble, of which writing it costs more than computing it again."""


def materialized(x: Array) -> Array:
    """`x` itself, which the compiler may not compute again in each of its uses.

    XLA merges a chain of small matrix products into one loop over the last of them, and computes each element of the
    others as often as it is used: on a CPU, over an ensemble of matrices with six rows, ten times the arithmetic.
    Nothing happens to arrays of no more than 64 elements, nor on other devices.
    """
    return _materialized_p.bind(x)


@jax.jit
def _itself(x):
    return x


def _on_cpu(x):
    if math.prod(x.shape) <= _SINGLE:
        return x
    # Nothing is merged across the border of a call, and this attribute of XLA's keeps it one.
    with set_xla_metadata(inlineable="false"):
        return _itself(x)


_materialized_p = Primitive("materialized")
_materialized_p.def_impl(lambda x: x)
_materialized_p.def_abstract_eval(lambda x: x)
mlir.register_lowering(_materialized_p, mlir.lower_fun(lambda x: x, multiple_results=False))
mlir.register_lowering(_materialized_p, mlir.lower_fun(_on_cpu, multiple_results=False), platform="cpu")
ad.deflinear(_materialized_p, lambda cotangent: [_materialized_p.bind(cotangent)])
batching.defvectorized(_materialized_p)
