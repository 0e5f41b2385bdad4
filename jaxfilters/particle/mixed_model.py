"""The parts of a mixed linear/nonlinear model for one particle: what callbacks of Rao-Blackwellized filters return."""

from typing import NamedTuple

from jaxtyping import Array, Float, PyTree


class MixedDynamics(NamedTuple):
    """One step of the model for one particle, linearised about its nonlinear state x.

    With n the dimension of the tangent space of x (`noise_dim`) and l the size of the linear state.
    """

    f_n: PyTree
    """The next nonlinear state for a zero increment, a point like x."""
    A_n: Float[Array, "n l"]
    """How the linear state drives the increment of x."""
    Q_n: Float[Array, "n n"]
    """Covariance of the noise of the increment of x."""
    f_l: Float[Array, " l"]
    """The part of the next linear state that does not depend on the linear state."""
    A_l: Float[Array, "l l"]
    """Transition matrix of the linear state."""
    Q_l: Float[Array, "l l"]
    """Covariance of the process noise of the linear state, independent of the other noise."""


class LinearObservation(NamedTuple):
    """The observation model y = h + C l + e with e ~ N(0, R), for one particle."""

    h: Float[Array, " m"]
    C: Float[Array, "m l"]
    R: Float[Array, "m m"]
