"""Nonlinear least squares within bounds: a solver for optimistix, and one for many frames that share variables."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
