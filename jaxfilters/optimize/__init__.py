"""Nonlinear least squares within bounds: Levenberg-Marquardt for optimistix, and problems with shared variables."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
