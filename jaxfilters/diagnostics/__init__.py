"""Is a filter right? Consistency of its covariances, whiteness of its innovations, calibration, scores, sample sizes.

All functions are pure and take arrays with any number of leading axes unless they say otherwise.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
