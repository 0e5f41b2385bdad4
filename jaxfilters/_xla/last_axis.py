"""A `vmap` that keeps the batch on the last axis of all intermediate results.

The batching rules of `jax.vmap` move the batch axis to the front where arrays are broadcast, reshaped or concatenated,
so that the innermost loop runs over the few elements of a small matrix. With the batch on the last axis of every array
the innermost loop runs over the batch and uses vector instructions. Functions are traced; operations without a rule in
this module are left to `jax.vmap`, with correct results that may be slow to compute.
"""

from collections.abc import Callable
from functools import partial, reduce, wraps
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Primitive, jaxpr_as_fun
from jax.extend.source_info_util import current_name_stack, user_context
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from jaxfilters._xla.product import LARGEST, small_product

_ELEMENTWISE = """abs acos acosh add add_any and asin asinh atan atan2 atanh bessel_i0e bessel_i1e cbrt ceil clamp
    complex conj convert_element_type copy cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge gt igamma
    igammac imag integer_pow is_finite le lgamma log log1p logistic lt max min mul ne neg nextafter not or polygamma
    pow real reduce_precision rem round rsqrt select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor"""
_LEADING_AXES_ONLY = """argmax argmin cumlogsumexp cummax cummin cumprod cumsum materialized reduce_and reduce_max
    reduce_min reduce_or reduce_prod reduce_xor rev squeeze"""
"""Operations on one array whose parameters count axes from the front, so that they admit a further last axis."""


class _Value(NamedTuple):
    array: Any
    batched: bool
    """Whether the last axis is the batch axis."""


def vmap(fun: Callable, in_axes: PyTree = -1, out_axes: PyTree = -1) -> Callable:
    """As `jax.vmap`, with the batch on the last axis of arguments, results and all intermediate results.

    Args:
        fun: Function of one element of the batch.
        in_axes: For each argument, as a prefix of its pytree: -1, or `None` where all elements share it.
        out_axes: -1, or `None` for results that do not depend on the element.

    Raises:
        ValueError: If no argument has a batch axis, if batch sizes differ, or if a result with the axis `None` depends
            on the element.
    """

    @wraps(fun)
    def mapped(*args: PyTree) -> PyTree:
        axes = in_axes if isinstance(in_axes, tuple) else (in_axes,) * len(args)
        leaves, tree = jax.tree.flatten(args)
        flags = _mapped_leaves(axes, args)
        values = [_Value(jnp.asarray(leaf), flag) for leaf, flag in zip(leaves, flags, strict=True)]
        sizes = {value.array.shape[-1] for value in values if value.batched}
        if len(sizes) != 1:
            raise ValueError(f"in_axes must give arguments one length along their last axis; got {sorted(sizes)}.")
        size = sizes.pop()
        result, structure = _mapped(lambda *flat: fun(*jax.tree.unflatten(tree, flat)), size, values)
        whole = jax.tree.unflatten(structure, [value.array for value in result])
        expected = _mapped_leaves(out_axes, whole)
        for (path, _), value, flag in zip(jax.tree.leaves_with_path(whole), result, expected, strict=True):
            if value.batched and not flag:
                raise ValueError(
                    f"out_axes must be -1 for results that depend on the element; got None for the result"
                    f"{jax.tree_util.keystr(path)}, which does."
                )
        arrays = [_full(value, size) if flag else value.array for value, flag in zip(result, expected, strict=True)]
        return jax.tree.unflatten(structure, arrays)

    return mapped


def batch_last(fun: Callable) -> Callable:
    """The same function, whose intermediate results under `jax.vmap` have the batch on their last axis.

    It is meant for functions of small arrays, up to about eight rows; `jax.vmap` is faster for larger ones.
    """

    @wraps(fun)
    def same(*args: PyTree) -> PyTree:
        leaves, tree = jax.tree.flatten(args)
        leaves = [leaf if isinstance(leaf, jax.Array) else jnp.asarray(leaf) for leaf in leaves]
        closed, shapes = jax.make_jaxpr(lambda *flat: fun(*jax.tree.unflatten(tree, flat)), return_shape=True)(*leaves)
        if closed.effects:
            return fun(*args)
        # Constants that the function closes over may be tracers, so they become arguments.
        jaxpr = closed.jaxpr.replace(constvars=[], invars=[*closed.jaxpr.constvars, *closed.jaxpr.invars])
        result = _batch_last_p.bind(*closed.consts, *leaves, jaxpr=ClosedJaxpr(jaxpr, ()))
        return jax.tree.unflatten(jax.tree.structure(shapes), result)

    return same


def _mapped_leaves(axes, tree):
    """Whether each leaf has a batch axis, where `axes` is a prefix of the tree."""
    flags = jax.tree.map(
        lambda axis, branch: jax.tree.map(lambda _: axis is not None, branch),
        axes,
        tree,
        is_leaf=lambda axis: axis is None,
    )
    return jax.tree.leaves(flags)


def _mapped(fun, size, values):
    """The flat results of a function of flat arguments, and their tree structure."""
    one = [jax.ShapeDtypeStruct(_shape(value), value.array.dtype) for value in values]
    closed, shapes = jax.make_jaxpr(fun, return_shape=True)(*one)
    return _evaluate(closed, size, values), jax.tree.structure(shapes)


def _shape(value):
    """The shape of one element of the batch."""
    return np.shape(value.array)[: np.ndim(value.array) - value.batched]


def _full(value, size):
    """The array with a batch axis, broadcast if all elements share it."""
    if value.batched:
        return value.array
    return lax.broadcast_in_dim(value.array, (*np.shape(value.array), size), range(np.ndim(value.array)))


def _evaluate(closed: ClosedJaxpr, size: int, values: list[_Value]) -> list[_Value]:
    jaxpr = closed.jaxpr
    known = {var: _Value(const, False) for var, const in zip(jaxpr.constvars, closed.consts, strict=True)}
    known |= dict(zip(jaxpr.invars, values, strict=True))

    def read(var):
        return _Value(var.val, False) if isinstance(var, Literal) else known[var]

    for eqn in jaxpr.eqns:
        # Messages and profiles name the line of the model, not this one.
        names = current_name_stack() + eqn.source_info.name_stack
        with user_context(eqn.source_info.traceback, name_stack=names):
            known |= dict(zip(eqn.outvars, _apply(eqn, size, [read(var) for var in eqn.invars]), strict=True))
    return [read(var) for var in jaxpr.outvars]


def _apply(eqn: JaxprEqn, size: int, values: list[_Value]) -> list[_Value]:
    name = eqn.primitive.name
    if any(value.batched for value in values):
        if name in _CALLS:
            return _CALLS[name](eqn, size, values)
        result = _RULES.get(name, _no_rule)(eqn, size, values)
        if result is NotImplemented:
            axes = [-1 if value.batched else None for value in values]
            result = jax.vmap(partial(_bind, eqn), axes, -1)(*(value.array for value in values))
    else:
        result = _bind(eqn, *(value.array for value in values))
    batched = any(value.batched for value in values)
    return [_Value(array, batched) for array in (result if eqn.primitive.multiple_results else [result])]


def _bind(eqn, *args):
    return eqn.primitive.bind(*args, **eqn.primitive.get_bind_params(eqn.params))


def _no_rule(eqn, size, values):
    del eqn, size, values
    return NotImplemented


def _elementwise(eqn, size, values):
    shape = eqn.outvars[0].aval.shape

    def fitted(value):
        if len(_shape(value)) == len(shape):
            return _full(value, size)
        # A scalar operand among arrays.
        return lax.broadcast_in_dim(value.array, (*shape, size), (len(shape),)) if value.batched else value.array

    return _bind(eqn, *map(fitted, values))


def _leading_axes_only(eqn, size, values):
    del size
    return _bind(eqn, *(value.array for value in values))


def _broadcast_in_dim(eqn, size, values):
    shape, axes = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    return lax.broadcast_in_dim(values[0].array, (*shape, size), (*axes, len(shape)))


def _reshape(eqn, size, values):
    return lax.reshape(values[0].array, (*eqn.params["new_sizes"], size))


def _transpose(eqn, size, values):
    del size
    order = eqn.params["permutation"]
    return lax.transpose(values[0].array, (*order, len(order)))


def _slice(eqn, size, values):
    first, last, steps = (eqn.params[name] for name in ("start_indices", "limit_indices", "strides"))
    return lax.slice(values[0].array, (*first, 0), (*last, size), None if steps is None else (*steps, 1))


def _pad(eqn, size, values):
    del size
    x, filling = values
    if filling.batched:
        return NotImplemented
    return lax.pad(x.array, filling.array, (*eqn.params["padding_config"], (0, 0, 0)))


def _concatenate(eqn, size, values):
    return lax.concatenate([_full(value, size) for value in values], eqn.params["dimension"])


def _stack(eqn, size, values):
    return jnp.stack([_full(value, size) for value in values], eqn.params["axis"])


def _reduce_sum(eqn, size, values):
    axes, x = sorted(eqn.params["axes"], reverse=True), values[0].array
    if not 0 < np.prod([x.shape[axis] for axis in axes], dtype=int) <= LARGEST:
        return _leading_axes_only(eqn, size, values)
    for axis in axes:
        x = reduce(add, (lax.index_in_dim(x, i, axis, keepdims=False) for i in range(x.shape[axis])))
    return x


def _dot_general(eqn, size, values):
    contracted, batch = eqn.params["dimension_numbers"]
    shapes = [_shape(value) for value in values]
    sizes = (*shapes[0], *shapes[1])
    # Of empty matrices the product has no outer products, or its derivative none.
    if batch != ((), ()) or len(contracted[0]) != 1 or min(sizes) == 0 or max(sizes) > LARGEST:
        return NotImplemented
    (left,), (right,) = contracted
    count = shapes[0][left]
    a, b = (_full(value, size).astype(eqn.outvars[0].aval.dtype) for value in values)
    a = jnp.moveaxis(a, left, -2).reshape(-1, count, size)
    b = jnp.moveaxis(b, right, 0).reshape(count, -1, size)
    return small_product(a, b).reshape(*eqn.outvars[0].aval.shape, size)


def _small_product(eqn, size, values):
    return small_product(*(_full(value, size) for value in values), **eqn.params)


def _call(eqn, size, values):
    return _evaluate(eqn.params["jaxpr"], size, values)


def _custom_jvp_call(eqn, size, values):
    """The batched function, with the custom derivative of one element batched likewise."""
    inexact = [jnp.issubdtype(var.aval.dtype, jnp.inexact) for var in eqn.invars]
    smooth = [jnp.issubdtype(var.aval.dtype, jnp.inexact) for var in eqn.outvars]
    flags = [value.batched for value in values]
    batched = _depends(eqn.params["call_jaxpr"], flags)

    @jax.custom_jvp
    def function(*arrays):
        return [value.array for value in _evaluate(eqn.params["call_jaxpr"], size, list(map(_Value, arrays, flags)))]

    @function.defjvp
    def _derivative(primals, tangents):
        def along(*flat):
            primals, changing = flat[: len(inexact)], iter(flat[len(inexact) :])
            none = [np.zeros(np.shape(primal), jax.dtypes.float0) for primal in primals]
            tangents = tuple(next(changing) if moves else zero for moves, zero in zip(inexact, none, strict=True))
            values, changes = jax.jvp(partial(_bind, eqn), primals, tangents)
            return [*values, *(change for change, moves in zip(changes, smooth, strict=True) if moves)]

        moving = [_Value(*pair) for *pair, moves in zip(tangents, flags, inexact, strict=True) if moves]
        found = _mapped(along, size, [*map(_Value, primals, flags), *moving])[0]
        values = [_like(value, depends, size) for value, depends in zip(found, batched, strict=False)]
        changes = iter(found[len(smooth) :])
        none = [np.zeros(value.shape, jax.dtypes.float0) for value in values]
        kinds = zip(smooth, batched, none, strict=True)
        return values, [_like(next(changes), depends, size) if moves else zero for moves, depends, zero in kinds]

    return list(map(_Value, function(*(value.array for value in values)), batched))


def _like(value, batched, size):
    """The array with or without a batch axis; without one, all elements are equal and the first is taken."""
    return _full(value, size) if batched else value.array[..., 0] if value.batched else value.array


def _depends(closed, flags):
    """Whether each result depends on the element of the batch, as `_evaluate` determines it."""
    known = dict(zip(closed.jaxpr.invars, flags, strict=True))
    read = lambda var: not isinstance(var, Literal) and known.get(var, False)
    for eqn in closed.jaxpr.eqns:
        inputs = [read(var) for var in eqn.invars]
        inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr")) if eqn.primitive.name in _CALLS else None
        known |= dict(
            zip(eqn.outvars, _depends(inner, inputs) if inner else [any(inputs)] * len(eqn.outvars), strict=True)
        )
    return [read(var) for var in closed.jaxpr.outvars]


_RULES = dict.fromkeys(_ELEMENTWISE.split(), _elementwise) | dict.fromkeys(
    _LEADING_AXES_ONLY.split(), _leading_axes_only
)
_RULES |= {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": _concatenate,
    "dot_general": _dot_general,
    "pad": _pad,
    "reduce_sum": _reduce_sum,
    "reshape": _reshape,
    "slice": _slice,
    "small_product": _small_product,
    "stack": _stack,
    "transpose": _transpose,
}
"""Batching rules by the name of the operation; a rule that returns `NotImplemented` leaves it to `jax.vmap`."""
_CALLS = {"batch_last": _call, "custom_jvp_call": _custom_jvp_call, "jit": _call, "pjit": _call}
"""Rules of operations that contain others."""


def _unbatched(*args, jaxpr):
    return jaxpr_as_fun(jaxpr)(*args)


def _jvp(primals, tangents, *, jaxpr):
    moves = [not isinstance(tangent, ad.Zero) for tangent in tangents]

    def function(*moving):
        moving = iter(moving)
        return _unbatched(*(next(moving) if m else x for x, m in zip(primals, moves, strict=True)), jaxpr=jaxpr)

    chosen = [[x for x, m in zip(of, moves, strict=True) if m] for of in (primals, tangents)]
    return jax.jvp(function, *chosen)


def _batch(args, axes, *, jaxpr):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    values = [
        _Value(x, False) if axis is None else _Value(jnp.moveaxis(x, axis, -1), True)
        for x, axis in zip(args, axes, strict=True)
    ]
    found = _evaluate(jaxpr, size, values)
    return [value.array for value in found], [value.array.ndim - 1 if value.batched else None for value in found]


_batch_last_p = Primitive("batch_last")
_batch_last_p.multiple_results = True
_batch_last_p.def_impl(_unbatched)
_batch_last_p.def_abstract_eval(lambda *_, jaxpr: jaxpr.out_avals)
mlir.register_lowering(_batch_last_p, mlir.lower_fun(_unbatched, multiple_results=True))
ad.primitive_jvps[_batch_last_p] = _jvp
batching.primitive_batchers[_batch_last_p] = _batch
