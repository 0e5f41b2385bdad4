from .config import ArticulatedConfig as ArticulatedConfig
from .recording import FeatureSequence as FeatureSequence
from .recording import from_keypoints as from_keypoints
from .tracker import build as build
from .tracker import synthetic_sequence as synthetic_sequence
from .tracker import track as track
from .tracker import track_sequence as track_sequence
