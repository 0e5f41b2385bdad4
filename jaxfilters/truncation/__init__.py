"""Gaussian beliefs cut by linear inequalities: moments of what is left, as a Gaussian again.

`cut` applies one inequality, or a list of them in order; `expectation_propagation` applies all of them together and
does not count one twice that is applied again. All take a belief by covariance or by root, and give back the same.
"""

from jaxfilters.truncation import cut as cut
from jaxfilters.truncation import expectation_propagation as expectation_propagation
from jaxfilters.truncation import moments as moments
from jaxfilters.truncation.constraints import LinearConstraints as LinearConstraints
from jaxfilters.truncation.constraints import check_feasible as check_feasible
from jaxfilters.truncation.constraints import feasible as feasible
from jaxfilters.truncation.constraints import linear_constraints as linear_constraints
from jaxfilters.truncation.info import CutInfo as CutInfo
from jaxfilters.truncation.info import TruncationInfo as TruncationInfo
from jaxfilters.truncation.info import constraint_distances as constraint_distances
from jaxfilters.truncation.moments import Moments as Moments
from jaxfilters.truncation.sites import Sites as Sites
from jaxfilters.truncation.sites import no_sites as no_sites
