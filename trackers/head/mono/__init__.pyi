from .session import MonoSession as MonoSession
from .session import track as track
from .state import MonoOptions as MonoOptions
