"""Folding the parts of one pose into one image, each within its window."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.models.rendering.parts import Parts, Surface
from jaxfilters.models.rendering.windows import Plan, Window

_PIECES = 8
"""Pieces of a part whose gradients are computed at once: what bounds the memory of parts with many faces."""
Turn = Callable[..., Array]
"""`(part, window, start, x, y, image) -> image` with one part drawn in the window that begins at (row, column)."""


def over_parts(parts: Parts, plan: Plan | None, shape: tuple[int, ...], turn: Turn, image: Array) -> Array:
    """`image` after the turn of every part that is visible; each in the whole image when there is no plan."""

    def with_offsets(part, window, start, image):
        return turn(part, window, start, *_offsets(start, parts.anchor[part], window), image)

    if plan is None:
        start = jnp.zeros(2, jnp.int32)
        count = parts.coefficients.shape[0]
        return jax.lax.fori_loop(0, count, lambda part, image: with_offsets(part, shape, start, image), image)
    for index, window in enumerate(plan.sizes):

        def step(place, image, window=window):
            part = plan.order[place]
            return with_offsets(part, window, plan.start[part], image)

        image = jax.lax.fori_loop(plan.bounds[index], plan.bounds[index + 1], step, image)
    return image


def nearest_inverse(parts: Parts, plan: Plan | None, surface: Surface, shape: Window) -> Float[Array, "rows cols"]:
    """Inverse depth of the nearest part at each pixel, 0 for none; not for differentiation."""

    def turn(part, window, start, x, y, nearest):
        observed, before = surface.inverse_depth(parts.coefficients[part], x, y), cut(nearest, start, window)
        return put(nearest, jnp.where(observed > before, observed, before), start)

    return over_parts(parts, plan, shape, turn, jnp.zeros(shape, parts.coefficients.dtype))


def winning_pieces(
    parts: Parts, plan: Plan | None, surface: Surface, nearest: Float[Array, "rows cols"]
) -> Int[Array, "rows cols"]:
    """Which piece is the nearest at each pixel, counted through all parts; -1 for none.

    A pass of its own: one that keeps depth and index together is ten times slower in XLA.
    """
    # The same arithmetic may round differently in another kernel; who wins within that margin does not matter.
    least = nearest * (1 - 64 * jnp.finfo(nearest.dtype).eps)

    def turn(part, window, start, x, y, winner):
        limit, winning = cut(least, start, window), cut(winner, start, window)
        pieces = surface.pieces(parts.coefficients[part], x, y)
        for index, observed in enumerate(pieces):
            wins = (observed > 0) & (observed >= limit)
            winning = jnp.where(wins, (part * len(pieces) + index).astype(jnp.int32), winning)
        return put(winner, winning, start)

    return over_parts(parts, plan, nearest.shape, turn, jnp.full(nearest.shape, -1, jnp.int32))


def smooth_inverse(parts: Parts, surface: Surface, winner: Int[Array, "rows cols"]) -> Float[Array, "rows cols"]:
    """Inverse depth of the given pieces, 0 for none: exact derivative in the coefficients, with the winners held."""
    rows = surface.rows(parts.coefficients)
    # Row and anchor in one table, hence one gather.
    anchors = jnp.broadcast_to(parts.anchor[:, None], (*rows.shape[:2], 2))
    table = jnp.concatenate([rows, anchors], axis=-1).reshape(-1, rows.shape[2] + 2)
    *row, anchor_u, anchor_v = jnp.moveaxis(table[jnp.maximum(winner, 0)], -1, 0)
    v, u = (jax.lax.broadcasted_iota(table.dtype, winner.shape, axis) for axis in (0, 1))
    return jnp.where(winner >= 0, surface.smooth(row, u - anchor_u, v - anchor_v), 0.0)


def pull_back(
    parts: Parts,
    plan: Plan | None,
    surface: Surface,
    winner: Int[Array, "rows cols"],
    cotangent: Float[Array, "rows cols"],
) -> Float[Array, "k c"]:
    """The transpose of the derivative of `smooth_inverse`, by sums over windows: scatters are serial on CPUs.

    The gradient in the coefficients of a polynomial in (x, y) is the moments of an image of slopes: a product of small
    matrices for each polynomial, however many coefficients it has.
    """
    rows, to_coefficients = jax.vjp(surface.rows, parts.coefficients)
    constants = jnp.eye(rows.shape[2], dtype=rows.dtype)[::3][: 1 + surface.has_root]

    def turn(part, window, start, x, y, gradient):
        observed, weight = cut(winner, start, window), cut(cotangent, start, window)

        def of_piece(piece):
            index, row = piece
            mine = jnp.where(observed == part * rows.shape[1] + index, weight, 0.0)
            slopes = [jax.jvp(lambda r: surface.smooth(r, x, y), (row,), (constant,))[1] for constant in constants]
            # Images of the two polynomials stay apart: XLA computes a stack of both element by element.
            affine, *under_root = [_moments(mine * slope, x[0], y[:, 0]) for slope in slopes]
            return jnp.concatenate([affine[:3], *under_root])

        pieces = jnp.arange(rows.shape[1], dtype=jnp.int32), rows[part]
        moments = jax.lax.map(of_piece, pieces, batch_size=min(rows.shape[1], _PIECES))
        return jax.lax.dynamic_update_index_in_dim(gradient, moments, part, 0)

    return to_coefficients(over_parts(parts, plan, winner.shape, turn, jnp.zeros_like(rows)))[0]


def _moments(
    image: Float[Array, "rows cols"], x: Float[Array, " cols"], y: Float[Array, " rows"]
) -> Float[Array, " 6"]:
    """Sums of the image times 1, x, y, x^2, x y and y^2."""
    X, Y = (jnp.stack([jnp.ones_like(z), z, z * z]) for z in (x, y))
    product = partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)
    return product("ir,rj->ij", Y, product("rc,jc->rj", image, X))[[0, 0, 1, 0, 1, 2], [0, 1, 0, 2, 1, 0]]


def cut(image: Array, start: Int[Array, " 2"], window: Window) -> Array:
    """The window of an image that begins at (row, column) `start`."""
    # A window as large as the image has one place; slices at batched places would be gathers on accelerators.
    return image if window == image.shape else jax.lax.dynamic_slice(image, start, window)


def put(image: Array, piece: Array, start: Int[Array, " 2"]) -> Array:
    """The image with one window replaced."""
    return piece if piece.shape == image.shape else jax.lax.dynamic_update_slice(image, piece, start)


def _offsets(start, anchor, window):
    """Offsets (x, y) from the anchor of a window's columns and rows."""
    y, x = ((start[axis] - anchor[1 - axis]) + jax.lax.broadcasted_iota(anchor.dtype, window, axis) for axis in (0, 1))
    return x, y
