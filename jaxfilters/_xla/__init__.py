"""Formulations of programs that XLA compiles to faster code. This package is private and changes no results."""
