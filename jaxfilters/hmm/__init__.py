"""Hidden Markov models: inference, training, networks of models, and online spotting of symbols in a stream.

A `HiddenMarkovModel` is a Markov chain with an emission distribution. `model.log_likelihoods` turns observations into
log-likelihoods (T, Q) of the states, on which all recursions work; they may come from any other source as well.

Examples:
    >>> import jax.numpy as jnp
    >>> import jaxfilters as jf
    >>> emission = jf.hmm.DiagonalGaussian(jnp.array([[0.0], [5.0]]), jnp.ones((2, 1)))
    >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.1, 0.9]], emission)
    >>> log_likelihoods = model.log_likelihoods(jnp.array([[0.1], [-0.2], [4.8]]))
    >>> print(jf.hmm.viterbi(model, log_likelihoods).states)
    [0 0 1]
"""

from jaxfilters.hmm.decoding import Path as Path
from jaxfilters.hmm.decoding import viterbi as viterbi
from jaxfilters.hmm.durations import SemiMarkovModel as SemiMarkovModel
from jaxfilters.hmm.durations import SemiMarkovPath as SemiMarkovPath
from jaxfilters.hmm.durations import semi_markov as semi_markov
from jaxfilters.hmm.durations import semi_markov_log_evidence as semi_markov_log_evidence
from jaxfilters.hmm.durations import semi_markov_posterior as semi_markov_posterior
from jaxfilters.hmm.durations import semi_markov_viterbi as semi_markov_viterbi
from jaxfilters.hmm.durations_online import SemiMarkovInfo as SemiMarkovInfo
from jaxfilters.hmm.durations_online import SemiMarkovSpotterInfo as SemiMarkovSpotterInfo
from jaxfilters.hmm.durations_online import SemiMarkovSpotterState as SemiMarkovSpotterState
from jaxfilters.hmm.durations_online import SemiMarkovState as SemiMarkovState
from jaxfilters.hmm.durations_online import semi_markov_online as semi_markov_online
from jaxfilters.hmm.durations_online import semi_markov_spotter as semi_markov_spotter
from jaxfilters.hmm.emissions import Codes as Codes
from jaxfilters.hmm.emissions import DiagonalGaussian as DiagonalGaussian
from jaxfilters.hmm.emissions import Emission as Emission
from jaxfilters.hmm.emissions import FullGaussian as FullGaussian
from jaxfilters.hmm.emissions import Independent as Independent
from jaxfilters.hmm.model import HiddenMarkovModel as HiddenMarkovModel
from jaxfilters.hmm.model import ergodic as ergodic
from jaxfilters.hmm.model import from_probabilities as from_probabilities
from jaxfilters.hmm.model import from_topology as from_topology
from jaxfilters.hmm.model import left_right as left_right
from jaxfilters.hmm.model import left_right_initial as left_right_initial
from jaxfilters.hmm.model import sample as sample
from jaxfilters.hmm.networks import Network as Network
from jaxfilters.hmm.networks import Segment as Segment
from jaxfilters.hmm.networks import loop as loop
from jaxfilters.hmm.networks import parallel_composition as parallel_composition
from jaxfilters.hmm.networks import segments as segments
from jaxfilters.hmm.networks import threshold_model as threshold_model
from jaxfilters.hmm.online_filter import ChainInfo as ChainInfo
from jaxfilters.hmm.online_filter import ChainState as ChainState
from jaxfilters.hmm.online_filter import online as online
from jaxfilters.hmm.parallel_in_time import parallel_forward as parallel_forward
from jaxfilters.hmm.parallel_in_time import parallel_posterior as parallel_posterior
from jaxfilters.hmm.parallel_in_time import parallel_viterbi as parallel_viterbi
from jaxfilters.hmm.recursions import Filtered as Filtered
from jaxfilters.hmm.recursions import Posterior as Posterior
from jaxfilters.hmm.recursions import backward as backward
from jaxfilters.hmm.recursions import forward as forward
from jaxfilters.hmm.recursions import log_evidence as log_evidence
from jaxfilters.hmm.recursions import posterior as posterior
from jaxfilters.hmm.spotting import Candidate as Candidate
from jaxfilters.hmm.spotting import SpotterInfo as SpotterInfo
from jaxfilters.hmm.spotting import SpotterState as SpotterState
from jaxfilters.hmm.spotting import spotter as spotter
from jaxfilters.hmm.training import Training as Training
from jaxfilters.hmm.training import baum_welch as baum_welch
from jaxfilters.hmm.training import best_of_restarts as best_of_restarts
from jaxfilters.hmm.training import pad as pad
from jaxfilters.hmm.training import random_responsibilities as random_responsibilities
from jaxfilters.hmm.training import uniform_segmentation as uniform_segmentation
from jaxfilters.hmm.training import with_responsibilities as with_responsibilities
