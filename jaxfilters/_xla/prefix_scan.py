"""Prefixes of an associative operator in few rounds, with few copies of the operator in the program.

`jax.lax.associative_scan` contains the operator once for each of its 2 log2 T rounds, every time with another size of
batch: compiling it takes minutes where the operator is a dozen matrix operations. Here the elements are cut into blocks
of 16. All blocks are scanned side by side, one element after the other; the totals of the blocks are scanned in the
same way; and each block is joined with what precedes it. There are two copies of the operator for every factor of 16 in
the length, the number of operations is that of `associative_scan`, and the number of dependent rounds is 32 log16 T
(G. E. Blelloch, "Prefix sums and their applications", 1990, section 1.3).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

_BLOCK = 16


def prefix_scan(
    operator: Callable[[PyTree, PyTree], PyTree], elements: PyTree, *, axis: int = 0, reverse: bool = False
) -> PyTree:
    """As `jax.lax.associative_scan`: the elements e1, e1 * e2, e1 * e2 * e3 and so on.

    Args:
        operator: `(a, b) -> a * b`, associative, on batches of elements.
        elements: Pytree of arrays, with the elements along `axis`.
        axis: The axis of the batch, 0 or -1, of the elements and of what the operator gets and returns.
        reverse: Whether to start with the last element: the results are those of the reversed sequence, reversed.
    """
    if reverse:
        turned = prefix_scan(operator, jax.tree.map(lambda leaf: jnp.flip(leaf, axis), elements), axis=axis)
        return jax.tree.map(lambda leaf: jnp.flip(leaf, axis), turned)
    count = jax.tree.leaves(elements)[0].shape[axis]
    if not count:
        return elements
    blocks = jax.tree.map(lambda leaf: _in_blocks(leaf, axis, _BLOCK if count > _BLOCK else count), elements)
    first, others = jax.tree.map(lambda leaf: leaf[0], blocks), jax.tree.map(lambda leaf: leaf[1:], blocks)

    def joined(before: PyTree, element: PyTree) -> tuple[PyTree, PyTree]:
        through = operator(before, element)
        return through, through

    totals, later = jax.lax.scan(joined, first, others)
    local = jax.tree.map(lambda one, many: jnp.concatenate([one[None], many]), first, later)
    if count > _BLOCK:
        before = prefix_scan(operator, jax.tree.map(lambda leaf: _part(leaf, axis, slice(-1)), totals), axis=axis)
        following = jax.tree.map(lambda leaf: _part(leaf, axis, slice(1, None), 1), local)
        whole = jax.lax.map(lambda element: operator(before, element), following)
        local = jax.tree.map(
            lambda all, rest: jnp.concatenate([_part(all, axis, slice(1), 1), rest], axis % (all.ndim - 1) + 1),
            local,
            whole,
        )
    return jax.tree.map(lambda leaf: _in_a_row(leaf, axis, count), local)


def _in_blocks(leaf: Array, axis: int, size: int) -> Array:
    """Elements along `axis`, as an array with the place in a block first and the blocks along `axis` of the rest."""
    rows = jnp.moveaxis(leaf, axis, 0)
    # What the last block lacks are copies of the last element, whose results are dropped.
    padded = jnp.concatenate([rows, jnp.repeat(rows[-1:], -len(rows) % size, axis=0)])
    blocks = padded.reshape(-1, size, *rows.shape[1:]).swapaxes(0, 1)
    return jnp.moveaxis(blocks, 1, axis % leaf.ndim + 1)


def _in_a_row(leaf: Array, axis: int, count: int) -> Array:
    rows = jnp.moveaxis(leaf, axis % (leaf.ndim - 1) + 1, 0)
    return jnp.moveaxis(rows.reshape(-1, *rows.shape[2:])[:count], 0, axis)


def _part(leaf: Array, axis: int, which: slice, leading: int = 0) -> Array:
    """A part of `leaf` along `axis`, behind further leading axes."""
    place = axis % (leaf.ndim - leading) + leading
    return leaf[(slice(None),) * place + (which,)]
