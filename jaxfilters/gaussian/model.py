"""What smoothers and wrappers need of a Gaussian filter: one step of its model as a linear function.

The parameters of the filters made by `kalman`, `extended_kalman`, `unscented_kalman` and `cubature_kalman` are such
models.
"""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, PyTree

from jaxfilters.filter import Filter
from jaxfilters.gaussian.arithmetic import Arithmetic
from jaxfilters.gaussian.linearize import Linearization
from jaxfilters.gaussian.manifold import Belief, Manifold


@runtime_checkable
class GaussianModel(Protocol):
    """Parameters of a filter whose belief is one Gaussian."""

    prior: Belief

    @property
    def manifold(self) -> Manifold:
        """What the state lives on."""
        ...

    @property
    def arithmetic(self) -> Arithmetic:
        """Whether beliefs are written as covariances or as roots of them."""
        ...

    def linear_transition(self, belief: Belief, inputs: PyTree) -> tuple[Array, Linearization]:
        """Where the mean goes, and the transition as a linear function of increments, from the mean to there."""
        ...

    def process_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """Covariance of the additive process noise of one step, or a root of it, as the arithmetic has it.

        It is expected over the belief before the step where it depends on the state. Noise that is not additive is
        part of the `residual_root` of `linear_transition`, and this is zero.
        """
        ...

    def observation_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """Covariance of the observation noise of one step, or a root of it, as the arithmetic has it."""
        ...


def model_of(filter: Filter, name: str) -> Any:
    """The model of a Gaussian filter.

    Raises:
        ValueError: If the filter is of another kind; the message names the argument, `name`.
    """
    params = filter.params
    if not all(hasattr(params, attribute) for attribute in ("linear_transition", "process_noise_of")):
        raise ValueError(
            f"{name} must be made by kalman or extended_kalman (or unscented_kalman, cubature_kalman); "
            f"its parameters are {type(params).__name__}."
        )
    return params
