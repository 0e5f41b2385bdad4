"""Earlier information about parameters that are still estimated: a Gaussian, perhaps of some directions only.

It is kept by a root of its information and not by the information (G. J. Bierman, "Factorization Methods for Discrete
Sequential Estimation", 1977, chapter V). Frames leave many directions open: a head that is longer and farther away
looks the same. In single precision the sum of the information of many frames is then not positive, and has no root.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxfilters.math.linalg import tria


class SquareRootPrior(NamedTuple):
    """Minus its logarithm is `|root p - towards|^2 / 2` for the parameters p."""

    root: Float[Array, "d d"]
    towards: Float[Array, " d"]

    @property
    def information(self) -> Float[Array, "d d"]:
        """Inverse covariance, where it has one."""
        return _product(self.root.T, self.root)


def nothing(num_parameters: int, dtype: DTypeLike) -> SquareRootPrior:
    """Of parameters about which there is no information."""
    return SquareRootPrior(jnp.zeros((num_parameters, num_parameters), dtype), jnp.zeros(num_parameters, dtype))


def of_measurements(J: Float[Array, "m d"], values: Float[Array, " m"]) -> SquareRootPrior:
    """Of at most d measurements of standard deviation one: `J p` was measured to be `values`."""
    rows = J.shape[1] - len(values)
    return SquareRootPrior(jnp.pad(J, ((0, rows), (0, 0))), jnp.pad(values, (0, rows)))


def of_energy(
    information: Float[Array, "d d"],
    gradient: Float[Array, " d"],
    at: Float[Array, " d"],
    unit: Float[Array, " d"],
) -> SquareRootPrior:
    """Of an energy with that gradient at some parameters, and that second derivative.

    Args:
        information: In units of the parameters; may be a rounding error short of positive semidefinite. A direction of
            which it tells less than such an error says nothing.
        gradient: In the same units.
        at: The parameters.
        unit: Of each; there is no information about a parameter whose unit is 0.
    """
    values, vectors = jnp.linalg.eigh((information + information.T) / 2)
    rounding = values.size * jnp.finfo(values.dtype).eps * values[-1]
    is_known = values > rounding
    deviation = jnp.sqrt(jnp.where(is_known, values, 1.0))
    inverse = jnp.where(unit > 0, 1 / jnp.where(unit > 0, unit, 1.0), 0.0)
    root = jnp.where(is_known[:, None], deviation[:, None] * vectors.T, 0.0) * inverse
    downhill = jnp.where(is_known, _product(vectors.T, gradient) / deviation, 0.0)
    return SquareRootPrior(root, _product(root, at) - downhill)


def joined(past: SquareRootPrior, more: SquareRootPrior) -> SquareRootPrior:
    """The product of both, which are independent."""
    rows = jnp.concatenate([jnp.column_stack(past), jnp.column_stack(more)])
    root = tria(rows.T).T[:-1]
    return SquareRootPrior(root[:, :-1], root[:, -1])


def shifted(past: SquareRootPrior, shift: Float[Array, " d"]) -> SquareRootPrior:
    """The same about what parameters are beyond a shift."""
    return past._replace(towards=past.towards - _product(past.root, shift))


def residuals(past: SquareRootPrior, parameters: Float[Array, " d"]) -> Float[Array, " d"]:
    """In standard deviations."""
    return _product(past.root, parameters) - past.towards


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")
