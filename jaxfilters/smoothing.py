"""Smoothing: the distribution of earlier states given later observations, for every kind of filter.

| belief | whole sequences | with a fixed delay |
|---|---|---|
| Gaussian | `rts`, `filter_and_smooth`, `two_filter` | `fixed_lag_rts` |
| Gaussian, neighbouring states and samples | `lag_one_covariances`, `posterior_samples` | |
| Gaussian, strongly nonlinear models | `iterated`, `sequential` or `parallel` in time | |
| linear Gaussian, parallel in time | `parallel_kalman` with `parallel_rts` | |
| particles | `trajectories`, `backward_sampling` | `fixed_lag` |
| particles, sums over time | | `paris`, as frames arrive |
"""

from jaxfilters.gaussian.affine import parallel as parallel
from jaxfilters.gaussian.affine import sequential as sequential
from jaxfilters.gaussian.iterated_smoothing import IterationInfo as IterationInfo
from jaxfilters.gaussian.iterated_smoothing import iterated as iterated
from jaxfilters.gaussian.parallel_in_time import LinearModel as LinearModel
from jaxfilters.gaussian.parallel_in_time import parallel_kalman as parallel_kalman
from jaxfilters.gaussian.parallel_in_time import parallel_rts as parallel_rts
from jaxfilters.gaussian.smoothing import filter_and_smooth as filter_and_smooth
from jaxfilters.gaussian.smoothing import lag_one_covariances as lag_one_covariances
from jaxfilters.gaussian.smoothing import posterior_samples as posterior_samples
from jaxfilters.gaussian.smoothing import rts as rts
from jaxfilters.gaussian.two_filter import two_filter as two_filter
from jaxfilters.particle.fixed_lag import fixed_lag as fixed_lag
from jaxfilters.particle.fixed_lag import fixed_lag_rts as fixed_lag_rts
from jaxfilters.particle.paris import ParisState as ParisState
from jaxfilters.particle.paris import paris as paris
from jaxfilters.particle.smoothing import History as History
from jaxfilters.particle.smoothing import backward_sampling as backward_sampling
from jaxfilters.particle.smoothing import keep_history as keep_history
from jaxfilters.particle.smoothing import trajectories as trajectories
