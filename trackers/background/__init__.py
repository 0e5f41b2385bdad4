"""The probability that a pixel of a fixed camera shows something other than the background."""
