"""Kalman filter atoms in two arithmetics with the same verbs, `predict` and `update`.

`joseph` keeps covariances and is the default; `square_root` keeps roots of them and stays right in float32 where a
covariance is too ill-conditioned to be written down. Choose by passing the module.
"""

from jaxfilters.kalman import joseph as joseph
from jaxfilters.kalman import square_root as square_root
from jaxfilters.kalman.info import KalmanInfo as KalmanInfo
