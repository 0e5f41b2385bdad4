"""Hidden Markov models: inference, training, networks of models, and finding symbols in a stream.

A model is a chain, `HiddenMarkovModel`, and what its states let one observe, an emission. `model.log_likelihoods` makes
an array (T, Q) of observations, which any other source may replace; the recursions go on from there.
"""

from jaxfilters.hmm.emissions import Codes as Codes
from jaxfilters.hmm.emissions import DiagonalGaussian as DiagonalGaussian
from jaxfilters.hmm.emissions import Emission as Emission
from jaxfilters.hmm.emissions import FullGaussian as FullGaussian
from jaxfilters.hmm.emissions import Independent as Independent
from jaxfilters.hmm.model import HiddenMarkovModel as HiddenMarkovModel
from jaxfilters.hmm.model import ergodic as ergodic
from jaxfilters.hmm.model import first_only as first_only
from jaxfilters.hmm.model import from_probabilities as from_probabilities
from jaxfilters.hmm.model import from_topology as from_topology
from jaxfilters.hmm.model import left_right as left_right
from jaxfilters.hmm.model import sample as sample
from jaxfilters.hmm.networks import Network as Network
from jaxfilters.hmm.networks import Segment as Segment
from jaxfilters.hmm.networks import loop as loop
from jaxfilters.hmm.networks import segments as segments
from jaxfilters.hmm.networks import side_by_side as side_by_side
from jaxfilters.hmm.networks import threshold as threshold
from jaxfilters.hmm.online import ChainInfo as ChainInfo
from jaxfilters.hmm.online import ChainState as ChainState
from jaxfilters.hmm.online import online as online
from jaxfilters.hmm.recursions import Filtered as Filtered
from jaxfilters.hmm.recursions import Path as Path
from jaxfilters.hmm.recursions import Posterior as Posterior
from jaxfilters.hmm.recursions import backward as backward
from jaxfilters.hmm.recursions import forward as forward
from jaxfilters.hmm.recursions import log_evidence as log_evidence
from jaxfilters.hmm.recursions import posterior as posterior
from jaxfilters.hmm.recursions import viterbi as viterbi
from jaxfilters.hmm.spotting import Candidate as Candidate
from jaxfilters.hmm.spotting import SpotterInfo as SpotterInfo
from jaxfilters.hmm.spotting import SpotterState as SpotterState
from jaxfilters.hmm.spotting import spotter as spotter
from jaxfilters.hmm.training import Training as Training
from jaxfilters.hmm.training import baum_welch as baum_welch
from jaxfilters.hmm.training import best_of_restarts as best_of_restarts
from jaxfilters.hmm.training import in_turn as in_turn
from jaxfilters.hmm.training import pad as pad
from jaxfilters.hmm.training import scattered as scattered
from jaxfilters.hmm.training import with_states as with_states
