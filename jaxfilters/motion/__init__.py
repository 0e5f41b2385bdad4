"""Models of motion in continuous time, and the matrices of their steps of any length.

A model is a pytree of its parameters. `model.discretize(dt)` gives F and Q of one step or of many; `model.transition`
and `model.process_noise` are what `jf.extended_kalman` takes, with the length of the step as its input.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
