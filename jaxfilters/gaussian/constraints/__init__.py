"""Gaussian beliefs cut by linear inequalities: moments of what is left, as a Gaussian again.

`cut` applies one inequality, or a list of them in order; `expectation_propagation` applies all of them together and
does not count one twice that is applied again. All take a belief by covariance or by root, and give back the same.
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
