"""Differentiable filters for people who track things with cameras."""

from pathlib import Path as _Path

from jaxfilters.filter import Filter as Filter
from jaxfilters.filter import init as init
from jaxfilters.filter import keep_all as keep_all
from jaxfilters.filter import keep_info as keep_info
from jaxfilters.filter import loglikelihood as loglikelihood
from jaxfilters.filter import predict as predict
from jaxfilters.filter import run as run
from jaxfilters.filter import step as step
from jaxfilters.filter import update as update
from jaxfilters.gaussian import Gaussian as Gaussian
from jaxfilters.guided import Guidance as Guidance
from jaxfilters.guided import guided as guided
from jaxfilters.marginal import LinearObservation as LinearObservation
from jaxfilters.marginal import MixedDynamics as MixedDynamics
from jaxfilters.marginal import rao_blackwell as rao_blackwell
from jaxfilters.marginal import rao_blackwell_shared as rao_blackwell_shared
from jaxfilters.particle import StandardNormal as StandardNormal
from jaxfilters.particle import TemperToShare as TemperToShare
from jaxfilters.particle import bootstrap as bootstrap

# In a source checkout `models/`, `trackers/` and `benchmarks/` lie beside this folder; an installed
# wheel has them inside it. Without this, `python -m pytest` in a checkout would not find them.
_checkout = _Path(__file__).resolve().parent.parent
if not (_checkout / "jaxfilters" / "models").is_dir() and (_checkout / "models").is_dir():
    __path__.append(str(_checkout))
