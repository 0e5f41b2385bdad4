"""Gaussian beliefs under linear inequalities: moments of the truncated belief, as a Gaussian again.

`cut` truncates by one inequality, or by a list of them in order; `expectation_propagation` truncates by all of them
together, and can replace the effect of an earlier truncation. All take a belief by covariance or by root, and return
the same kind. `jf.constrained` applies them to a filter in every step.
"""

from jaxfilters.gaussian.constraints import cut as cut
from jaxfilters.gaussian.constraints import expectation_propagation as expectation_propagation
from jaxfilters.gaussian.constraints import moments as moments
from jaxfilters.gaussian.constraints.info import CutInfo as CutInfo
from jaxfilters.gaussian.constraints.info import TruncationInfo as TruncationInfo
from jaxfilters.gaussian.constraints.info import constraint_distances as constraint_distances
from jaxfilters.gaussian.constraints.linear import LinearConstraints as LinearConstraints
from jaxfilters.gaussian.constraints.linear import check_feasible as check_feasible
from jaxfilters.gaussian.constraints.linear import feasible as feasible
from jaxfilters.gaussian.constraints.linear import linear_constraints as linear_constraints
from jaxfilters.gaussian.constraints.moments import Moments as Moments
from jaxfilters.gaussian.constraints.sites import Sites as Sites
from jaxfilters.gaussian.constraints.sites import initial_sites as initial_sites
