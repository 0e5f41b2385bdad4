"""What names of version 0.1 are called now. Kept for the releases 0.2.x, so that old code fails with an answer."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_CURRENT = {
    "TemperToShare": "jf.AdaptiveTempering",
    "adaptive": "jf.adaptive_diffusion (a function)",
    "assignment": "jf.math.assignment",
    "contaminated": "jf.robust (a function)",
    "diffusion": "jf.math.diffusion",
    "extended": "jf.extended_kalman (a function)",
    "fixed_lag": "jf.smoothing.fixed_lag",
    "layered": "jf.Partitions",
    "least_squares": "jf.optimize",
    "lie": "jf.math.lie",
    "linalg": "jf.math.linalg",
    "loglikelihood": "jf.log_evidence",
    "marginal": "jf.rao_blackwell (a function)",
    "mixture": "jf.gaussian_sum (a function)",
    "multilinear": "jf.math.multilinear",
    "parallel_in_time": "jf.smoothing",
    "particle_smoothing": "jf.smoothing",
    "shared_least_squares": "jf.optimize",
    "subspace": "jf.math.incremental_pca",
    "tensor_completion": "jf.math.tensor_completion",
    "truncation": "jf.constraints",
    "views": "jf.schmidt_kalman (a function)",
}
"""Old public name one dot below `jaxfilters` -> how to reach the same thing."""


def current_name(name: str) -> str | None:
    """What a public name of version 0.1 is called now, or None where it was none."""
    return _CURRENT.get(name)


def takes_inputs(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Wrap a function whose argument `inputs` was called `control` or `controls`, so that an error says so."""

    @wraps(function)
    def wrapper(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        for old in ("control", "controls"):
            if old in kwargs:
                raise TypeError(f"{function.__name__} has no argument {old!r}: it is called 'inputs' now.")
        return function(*args, **kwargs)

    return wrapper
