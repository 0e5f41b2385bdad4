"""Kalman filter atoms in three arithmetics with the same verbs: `predict`, `update`, `rts`, `backward`, `noise_root`.

`joseph` keeps covariances and is the default; `square_root` keeps roots of them and stays right in float32 where a
covariance is too ill-conditioned to be written down; `fast` keeps covariances and subtracts. Choose by passing the
module.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from jaxfilters.gaussian.arithmetic import fast as fast
from jaxfilters.gaussian.arithmetic import joseph as joseph
from jaxfilters.gaussian.arithmetic import square_root as square_root
from jaxfilters.gaussian.arithmetic.info import KalmanInfo as KalmanInfo


@runtime_checkable
class Arithmetic(Protocol):
    """A module like `joseph`: how beliefs and noises are written down, and the verbs on them."""

    @property
    def Belief(self) -> type: ...

    @property
    def predict(self) -> Callable[..., Any]: ...

    @property
    def update(self) -> Callable[..., Any]: ...

    @property
    def rts(self) -> Callable[..., Any]: ...

    @property
    def backward(self) -> Callable[..., Any]: ...

    @property
    def noise_root(self) -> Callable[..., Any]: ...
