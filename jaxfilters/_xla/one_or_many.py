"""Functions with one algorithm for a single argument and another for a batch."""

from collections.abc import Callable
from functools import wraps

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree


def one_or_many(one: Callable, many: Callable) -> Callable:
    """The function `one`, whose batch `jax.vmap` computes as `many`.

    Derivatives are those of `one`, or of `many` where the batch is taken first. Libraries of linear algebra are fast
    for one matrix. For a batch, jaxlib 0.10 splits their calls among the threads of XLA and waits for the parts in one
    of these threads, so that as many calls at a time as there are threads wait for ever: two on a processor with two
    cores.

    Args:
        one: Function of arrays whose results are a pytree of arrays.
        many: The same of arrays with a further first axis, of equal length in all arguments and results.
    """

    @wraps(one)
    def function(*args: jax.Array) -> PyTree:
        closed, shapes = jax.make_jaxpr(one, return_shape=True)(*args)
        # Constants that the function closes over may be tracers, and `many` does not have them as arguments.
        assert not closed.consts
        return jax.tree.unflatten(jax.tree.structure(shapes), _one_or_many_p.bind(*args, jaxpr=closed, many=many))

    return function


def _one(*args, jaxpr: ClosedJaxpr, many):
    del many
    return jaxpr_as_fun(jaxpr)(*args)


def _jvp(primals, tangents, *, jaxpr, many):
    del many
    tangents = tuple(map(ad.instantiate_zeros, tangents))
    return jax.jvp(jaxpr_as_fun(jaxpr), tuple(primals), tangents)


def _batch(args, axes, *, jaxpr, many):
    del jaxpr
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    found = many(
        *(
            lax.broadcast(x, (size,)) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(args, axes, strict=True)
        )
    )
    leaves = jax.tree.leaves(found)
    return leaves, [0] * len(leaves)


_one_or_many_p = Primitive("one_or_many")
_one_or_many_p.multiple_results = True
_one_or_many_p.def_impl(_one)
_one_or_many_p.def_abstract_eval(lambda *_, jaxpr, **__: jaxpr.out_avals)
mlir.register_lowering(_one_or_many_p, mlir.lower_fun(_one, multiple_results=True))
ad.primitive_jvps[_one_or_many_p] = _jvp
batching.primitive_batchers[_one_or_many_p] = _batch
