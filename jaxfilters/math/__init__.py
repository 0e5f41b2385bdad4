"""Mathematics for filters and trackers: rotations, small matrices, tensors, assignment, and online statistics."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
