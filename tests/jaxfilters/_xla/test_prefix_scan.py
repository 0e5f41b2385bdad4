"""Prefixes in blocks against a plain loop over an operator that does not commute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters._xla.prefix_scan import prefix_scan


def composed(first, then):
    """Maps x -> A x + b of the plane, one after the other."""
    return then[0] @ first[0], then[0] @ first[1] + then[1]


@pytest.mark.parametrize("axis", [0, -1])
@pytest.mark.parametrize("count", [1, 16, 17, 273])
def test_it_is_the_loop_from_either_end(x64, count, axis):
    rng = np.random.default_rng(count)
    maps = list(zip(np.linalg.qr(rng.normal(size=(count, 2, 2)))[0], rng.normal(size=(count, 2)), strict=True))
    elements = tuple(jnp.moveaxis(jnp.asarray(np.array(part)), 0, axis) for part in zip(*maps, strict=True))
    operator = jax.vmap(composed, axis, axis)
    for reverse in (False, True):
        expected, so_far = [], None
        for one in maps[::-1] if reverse else maps:
            so_far = one if so_far is None else composed(so_far, one)
            expected.append(so_far)
        found = prefix_scan(operator, elements, axis=axis, reverse=reverse)
        for leaf, wanted in zip(found, zip(*expected[:: -1 if reverse else 1], strict=True), strict=True):
            np.testing.assert_allclose(jnp.moveaxis(leaf, axis, 0), np.array(wanted), atol=1e-12)
