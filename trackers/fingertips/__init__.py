"""The fingertips of a hand over a desk, each followed under a name of its own, and what they do."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
