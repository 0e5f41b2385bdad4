"""Products of arrays in full precision on every device.

Accelerators round the factors of float32 products to 10 bits of mantissa where a program does not ask for more. Here
every product does, and so do its derivatives. On a CPU the compiled programs are the same.
"""

from functools import partial

import jax.numpy as jnp

PRECISION = "highest"

dot = partial(jnp.matmul, precision=PRECISION)
"""`a @ b` of vectors, matrices, and batches of matrices."""
einsum = partial(jnp.einsum, precision=PRECISION)
tensordot = partial(jnp.tensordot, precision=PRECISION)
