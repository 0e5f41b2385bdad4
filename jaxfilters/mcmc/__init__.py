"""Parameters by sampling: Markov chains and sequential Monte Carlo on the parameters of state-space models.

| sampler | needs | gives |
|---|---|---|
| `pmmh` | any filter, exact or of particles; `correlated` for fewer particles | chains of parameters |
| `particle_gibbs` | a bootstrap filter, and draws of parameters given a trajectory | chains of both |
| `tempered_smc`, `waste_free_smc` | any log-likelihood | weighted parameters, the evidence of the model |
| `smc2` | any filter | the same, after every observation |

Chains are the last axis of every leaf, as ensembles are: `init`, `warm_up` and `sample` run many side by side.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
