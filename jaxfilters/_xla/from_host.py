"""Arrays of the host on the device, without a program for each of their shapes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array


def from_host(values: Any, dtype: DTypeLike = float) -> Array:
    """`jnp.asarray(values, dtype)`, where NumPy converts what is not on the device yet.

    JAX converts numbers of another type by a program for each shape, which takes some hundredth of a second to trace
    and compile in every run; a tracker begins with dozens of such arrays.

    Args:
        values: Numbers, sequences of numbers, or an array. What is traced, or on the device, is left to JAX.
        dtype: As of `jnp.asarray`: `float` is single precision, unless `jax_enable_x64` is set.
    """
    if not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(values)):
        values = np.asarray(values, jax.dtypes.canonicalize_dtype(dtype))
    return jnp.asarray(values, dtype)
