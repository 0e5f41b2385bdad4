from .images import track as track
from .session import FingertipSession as FingertipSession
from .state import FingertipConfig as FingertipConfig
