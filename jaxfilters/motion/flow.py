"""Integrators of ordinary differential equations, for filters of models in continuous time.

An integrator takes `(field, start, duration)` with `field: y -> dy/dt`, all pytrees of arrays, and returns y
at the end. It is a frozen object that is compared by its numbers, so that filters made alike share their programs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree


@runtime_checkable
class Integrate(Protocol):
    """Solve `dy/dt = field(y)` from `start` for some time."""

    def __call__(self, field: Callable[[PyTree], PyTree], start: PyTree, duration: Float[Array, ""], /) -> PyTree: ...


@dataclass(frozen=True)
class _RungeKutta:
    num_steps: int

    def __call__(self, field: Callable[[PyTree], PyTree], start: PyTree, duration: Float[Array, ""]) -> PyTree:
        h = duration / self.num_steps

        def step(y: PyTree, _: None) -> tuple[PyTree, None]:
            k1 = field(y)
            k2 = field(_moved(y, 0.5 * h, k1))
            k3 = field(_moved(y, 0.5 * h, k2))
            k4 = field(_moved(y, h, k3))
            slope = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
            return _moved(y, h, slope), None

        return step(start, None)[0] if self.num_steps == 1 else jax.lax.scan(step, start, length=self.num_steps)[0]


def _moved(y, h, slope):
    return jax.tree.map(lambda value, rate: value + (h * rate).astype(value.dtype), y, slope)


@dataclass(frozen=True)
class _Adaptive:
    rtol: float
    atol: float
    max_steps: int

    def __call__(self, field: Callable[[PyTree], PyTree], start: PyTree, duration: Float[Array, ""]) -> PyTree:
        diffrax: Any = import_module("diffrax")
        # In units of the duration, which may be zero.
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda _t, y, _args: jax.tree.map(lambda rate: duration * rate, field(y))),
            diffrax.Tsit5(),
            t0=0.0,
            t1=1.0,
            dt0=None,
            y0=start,
            stepsize_controller=diffrax.PIDController(rtol=self.rtol, atol=self.atol),
            max_steps=self.max_steps,
            throw=False,
        )
        reached = solution.result == diffrax.RESULTS.successful
        return jax.tree.map(lambda y: jnp.where(reached, y[-1], jnp.nan), solution.ys)


def rk4(num_steps: int = 1) -> Integrate:
    """Classical Runge-Kutta method of order 4, with steps of equal length; nothing but JAX.

    Args:
        num_steps: Steps of every integration.

    Returns:
        An integrator.

    Raises:
        ValueError: If `num_steps` is not an integer of at least 1.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> y = jf.motion.rk4(10)(lambda y: -y, jnp.float32(1.0), jnp.float32(1.0))
        >>> round(float(y), 4)
        0.3679
    """
    _at_least_one("num_steps", num_steps)
    return _RungeKutta(num_steps)


def adaptive(*, rtol: float = 1e-4, atol: float = 1e-6, max_steps: int = 4096) -> Integrate:
    """Tsitouras' method of order 5 with steps of adapted length, by diffrax: `pip install 'jaxfilters[ode]'`.

    Derivatives are those of reverse mode. Where `max_steps` are not enough, the result is NaN.

    Args:
        rtol: Relative error of a step; below 1e-6 only in double precision.
        atol: Absolute error of a step, in the unit of the state.
        max_steps: Most steps of one integration.

    Returns:
        An integrator.

    Raises:
        ValueError: If a tolerance is not positive, or `max_steps` no integer of at least 1.
        ModuleNotFoundError: If diffrax is not installed.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> y = jf.motion.adaptive()(lambda y: -y, jnp.float32(1.0), jnp.float32(1.0))
        >>> round(float(y), 3)
        0.368
    """
    for name, value in (("rtol", rtol), ("atol", atol)):
        if not value > 0:
            raise ValueError(f"{name} must be positive; got {value!r}.")
    _at_least_one("max_steps", max_steps)
    if find_spec("diffrax") is None:
        raise ModuleNotFoundError("adaptive needs diffrax: pip install 'jaxfilters[ode]'. rk4 needs nothing.")
    return _Adaptive(rtol, atol, max_steps)


def _at_least_one(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1; got {value!r}.")
