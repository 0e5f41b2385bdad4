"""Types of command-line arguments: each turns a text into a value, or says what it expected."""

import argparse
import math


def positive_number(text: str) -> float:
    """A rate, a duration or a size: finite and above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"expected a finite number above 0; got {text}")
    return value


def positive_integer(text: str) -> int:
    """A count of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a positive integer; got {text}")
    return int(text)


def seed(text: str) -> int:
    """The seed of a random key."""
    if not -(2**63) <= int(text) < 2**63:
        raise argparse.ArgumentTypeError(f"a seed must fit into 64 bits; got {text}")
    return int(text)


def image_size(text: str) -> tuple[int, int]:
    """Columns and rows of an image, in pixels."""
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, such as 640x480; got {text}")
    return int(width), int(height)
