"""Parameter estimation: maximum likelihood through any filter, with constraints, standard errors and a report.

Examples:
    >>> import jax, jax.numpy as jnp
    >>> import jaxfilters as jf
    >>> def filter_of(theta):
    ...     prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
    ...     R = theta["noise"] ** 2 * jnp.eye(1)
    ...     return jf.extended_kalman(prior, lambda x, u: x, 1e-4 * jnp.eye(1), lambda x: x, R)
    >>> observations = 0.5 * jax.random.normal(jax.random.key(1), (200, 1))
    >>> log_density = jf.fit.log_evidence(jax.random.key(0), filter_of, observations)
    >>> fit = jf.fit.maximize(log_density, {"noise": 1.0}, jf.fit.positive)
    >>> bool(fit.converged), bool(abs(fit.theta["noise"] - 0.5) < 0.1)
    (True, True)
"""

from jaxfilters.fit.calibration import Calibration as Calibration
from jaxfilters.fit.calibration import Recording as Recording
from jaxfilters.fit.calibration import calibrate as calibrate
from jaxfilters.fit.composite import Godambe as Godambe
from jaxfilters.fit.composite import correlation_lags as correlation_lags
from jaxfilters.fit.composite import godambe as godambe
from jaxfilters.fit.composite import score_covariance as score_covariance
from jaxfilters.fit.constraints import Constraint as Constraint
from jaxfilters.fit.constraints import fixed as fixed
from jaxfilters.fit.constraints import free as free
from jaxfilters.fit.constraints import interval as interval
from jaxfilters.fit.constraints import positive as positive
from jaxfilters.fit.constraints import rotation as rotation
from jaxfilters.fit.constraints import simplex as simplex
from jaxfilters.fit.constraints import spd as spd
from jaxfilters.fit.density import common_random_numbers as common_random_numbers
from jaxfilters.fit.density import fresh_keys as fresh_keys
from jaxfilters.fit.density import log_evidence as log_evidence
from jaxfilters.fit.density import over_sequences as over_sequences
from jaxfilters.fit.density import with_prior as with_prior
from jaxfilters.fit.expectation_maximization import EM as EM
from jaxfilters.fit.expectation_maximization import em as em
from jaxfilters.fit.maximum import maximize as maximize
from jaxfilters.fit.methods import adam as adam
from jaxfilters.fit.methods import bfgs as bfgs
from jaxfilters.fit.methods import first_order as first_order
from jaxfilters.fit.methods import lbfgsb as lbfgsb
from jaxfilters.fit.methods import least_squares as least_squares
from jaxfilters.fit.methods import residuals as residuals
from jaxfilters.fit.result import Fit as Fit
from jaxfilters.fit.result import report as report
from jaxfilters.fit.uncertainty import ErrorStatus as ErrorStatus
from jaxfilters.fit.uncertainty import GradientCheck as GradientCheck
from jaxfilters.fit.uncertainty import Uncertainty as Uncertainty
from jaxfilters.fit.uncertainty import check_gradient as check_gradient
from jaxfilters.fit.uncertainty import no_errors as no_errors
from jaxfilters.fit.uncertainty import observed_information as observed_information
