from .config import MonoConfig as MonoConfig
from .session import MonoSession as MonoSession
from .session import track as track
