"""What `jf.ensemble_kalman` can be built from: analysis schemes, and localisation.

| analysis | what it does | cost of an update of n states, m observations, N samples |
|---|---|---|
| `perturbed_observations` | stochastic, the default: every sample is moved by an observation with noise of its own | N (n + m) m |
| `transform` | deterministic square root (ETKF); with localisation one transform a state variable (LETKF) | N^2 (n + m) + min(m, N)^3; n min(m, N)^3 with localisation |
| `serial` | deterministic, one observation after the other (EnSRF), for uncorrelated observation noise | N (n + m) m |
"""  # noqa: E501

from jaxfilters.gaussian.ensemble_analysis import Analysis as Analysis
from jaxfilters.gaussian.ensemble_analysis import Forecast as Forecast
from jaxfilters.gaussian.ensemble_analysis import perturbed_observations as perturbed_observations
from jaxfilters.gaussian.ensemble_analysis import serial as serial
from jaxfilters.gaussian.ensemble_analysis import transform as transform
from jaxfilters.gaussian.localization import Localization as Localization
from jaxfilters.gaussian.localization import gaspari_cohn as gaspari_cohn
from jaxfilters.gaussian.localization import localization as localization
