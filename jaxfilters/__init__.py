"""Differentiable Bayesian filters in JAX: `import jaxfilters as jf`.

Everything public is one dot away and is imported when it is first used. Builders return a `Filter`: `kalman`,
`extended_kalman`, `unscented_kalman`, `cubature_kalman`, `ensemble_kalman`, `gaussian_sum`, `robust`, `schmidt_kalman`,
`constrained`, `student_t`, `posterior_linearization`, `continuous_extended_kalman`, `imm`, `bootstrap`, `guided`,
`auxiliary`, `locally_optimal`, `rao_blackwell`, `rao_blackwell_shared`, `guided_rao_blackwell`, `switching`,
`adaptive_diffusion`. The functions `run`, `step`, `log_evidence` and the namespaces `smoothing`, `fit`, `mcmc` and
`sharding` take them.
"""

from pathlib import Path as _Path

import lazy_loader as _lazy_loader

from jaxfilters._renamed import current_name as _current_name

__version__ = "0.2.0"

_load, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)

# In a source checkout `models/`, `trackers/` and `benchmarks/` lie beside this folder; an installed
# wheel has them inside it. Without this, `python -m pytest` in a checkout would not find them.
_checkout = _Path(__file__).resolve().parent.parent
if not (_checkout / "jaxfilters" / "models").is_dir() and (_checkout / "models").is_dir():
    __path__.append(str(_checkout))


def __getattr__(name: str) -> object:
    """The public name, or an error that says what it is called now."""
    if name not in __all__ and (current := _current_name(name)):
        raise AttributeError(f"jaxfilters.{name} was renamed to {current} in version 0.2.")
    return _load(name)
