"""Filters whose belief is a Gaussian, a sum of Gaussians or an ensemble that stands for one."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
