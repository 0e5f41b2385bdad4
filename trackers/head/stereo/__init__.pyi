from .session import HeadSession as HeadSession
from .session import track as track
