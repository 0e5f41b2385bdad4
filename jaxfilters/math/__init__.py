"""The mathematics that filters and trackers stand on: rotations, small matrices, tensors, assignment, statistics."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
