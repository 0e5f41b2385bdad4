"""Parameters learnt from data: maximum likelihood through any filter, with constraints, errors and a report.

def filter_of(theta):
    return extended(prior, move, theta["drift"] * jnp.eye(2), observe, theta["noise"] * jnp.eye(1))

density = fit.log_evidence(key, filter_of, observations)
found = fit.maximize(density, {"drift": 1.0, "noise": 1.0}, fit.positive)
print(found)
"""

from jaxfilters.fit.constraints import Constraint as Constraint
from jaxfilters.fit.constraints import fixed as fixed
from jaxfilters.fit.constraints import free as free
from jaxfilters.fit.constraints import interval as interval
from jaxfilters.fit.constraints import positive as positive
from jaxfilters.fit.constraints import rotation as rotation
from jaxfilters.fit.constraints import simplex as simplex
from jaxfilters.fit.constraints import spd as spd
from jaxfilters.fit.density import check_observations as check_observations
from jaxfilters.fit.density import common_random_numbers as common_random_numbers
from jaxfilters.fit.density import fresh_keys as fresh_keys
from jaxfilters.fit.density import log_evidence as log_evidence
from jaxfilters.fit.density import over_sequences as over_sequences
from jaxfilters.fit.density import with_prior as with_prior
from jaxfilters.fit.maximum import Fit as Fit
from jaxfilters.fit.maximum import maximize as maximize
from jaxfilters.fit.methods import adam as adam
from jaxfilters.fit.methods import bfgs as bfgs
from jaxfilters.fit.methods import first_order as first_order
from jaxfilters.fit.methods import lbfgsb as lbfgsb
from jaxfilters.fit.methods import least_squares as least_squares
from jaxfilters.fit.methods import residuals as residuals
from jaxfilters.fit.report import report as report
from jaxfilters.fit.uncertainty import GradientCheck as GradientCheck
from jaxfilters.fit.uncertainty import check_gradient as check_gradient
from jaxfilters.fit.uncertainty import no_errors as no_errors
from jaxfilters.fit.uncertainty import observed_information as observed_information
