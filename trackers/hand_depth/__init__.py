"""Hand pose from a depth camera: a Rao-Blackwellized particle filter and what its command reads and draws."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
