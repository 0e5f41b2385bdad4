"""Types of command-line arguments: each turns a text into a value, or says what it expected."""

import argparse
import math
import re

_MOST_DIGITS = 18
"""Of an integer that fits into 64 bits."""
_MOST_PIXELS = 128 * 2**20
_LONGEST = 40
"""Characters of a wrong argument that its error repeats."""


def positive_number(text: str) -> float:
    """A rate, a duration or a size: finite and above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"expected a finite number above 0; got {_shown(text)}")
    return value


def finite_number(text: str) -> float:
    """A number of either sign."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a finite number; got {_shown(text)}")
    return value


def positive_integer(text: str) -> int:
    """A count of at least 1."""
    value = _integer(text)
    if value is None or value < 1:
        raise argparse.ArgumentTypeError(f"expected a positive integer; got {_shown(text)}")
    return value


def seed(text: str) -> int:
    """The seed of a random key."""
    # Of larger numbers, JAX takes the last 32 bits only.
    value = int(text) if re.fullmatch(r"\+?\d{1,10}", text.strip(), re.ASCII) else None
    if value is None or value >= 2**32:
        raise argparse.ArgumentTypeError(f"a seed must be from 0 to {2**32 - 1}; got {_shown(text)}")
    return value


def image_size(text: str) -> tuple[int, int]:
    """Columns and rows of an image, in pixels."""
    width, _, height = text.lower().partition("x")
    sides = _integer(width), _integer(height)
    if sides[0] is None or sides[1] is None or min(sides[0], sides[1]) < 1:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, such as 640x480; got {_shown(text)}")
    if sides[0] * sides[1] > _MOST_PIXELS:
        raise argparse.ArgumentTypeError(f"expected at most {_MOST_PIXELS >> 20} million pixels; got {_shown(text)}")
    return sides[0], sides[1]


def _integer(text: str) -> int | None:
    return int(text) if re.fullmatch(rf"\d{{1,{_MOST_DIGITS}}}", text, re.ASCII) else None


def _shown(text: str) -> str:
    printable = "".join(letter if letter.isprintable() else "?" for letter in text[: _LONGEST + 1])
    return printable if len(printable) <= _LONGEST else printable[: _LONGEST - 3] + "..."
