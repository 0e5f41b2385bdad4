"""Products of arrays in full precision on every device.

Accelerators round the factors of float32 products to 10 bits of mantissa where a program does not ask for more. Here
every product does, and so do its derivatives. On a CPU the compiled programs are the same.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

PRECISION = "highest"

dot = partial(jnp.matmul, precision=PRECISION)
"""`a @ b` of vectors, matrices, and batches of matrices."""
einsum = partial(jnp.einsum, precision=PRECISION)
tensordot = partial(jnp.tensordot, precision=PRECISION)


@jax.custom_jvp
def qr(A: Float[Array, "*batch n m"]) -> tuple[Float[Array, "*batch n k"], Float[Array, "*batch k m"]]:
    """As `jnp.linalg.qr`, with derivatives in full precision: JAX computes them from products that ask for none."""
    Q, R = jnp.linalg.qr(A)
    return Q, R


@qr.defjvp
def _qr_jvp(primals, tangents):
    with jax.default_matmul_precision(PRECISION):
        return jax.jvp(lambda A: tuple(jnp.linalg.qr(A)), primals, tangents)
