from .config import HandDepthConfig as HandDepthConfig
from .recording import DepthSequence as DepthSequence
from .recording import from_array as from_array
from .tracker import build as build
from .tracker import synthetic_sequence as synthetic_sequence
from .tracker import track as track
