"""Errors that end a command in one line: what cannot be read, written or continued, and why."""

from collections.abc import Callable
from typing import Any, TypeVar

Made = TypeVar("Made")
_LONGEST = 80


class InputError(ValueError):
    """An input that cannot be used; the message says what was found and what was expected."""


class OutputError(OSError):
    """Results that cannot be written; the message says what is kept."""


class CheckpointError(ValueError):
    """A saved state that cannot be continued; the message says why."""


def as_input_error(make: Callable[[], Made]) -> Made:
    """The result of `make`, which checks what a user passed.

    Raises:
        InputError: for a `ValueError`, with its message.
    """
    try:
        return make()
    except ValueError as error:
        raise InputError(str(error)) from None


def shown(value: Any, longest: int = _LONGEST) -> str:
    """A value of unknown origin for a message, in Python's notation: on one line, and no longer than a line.

    Args:
        value: What was found.
        longest: Number of characters.
    """
    return shortened(repr(value[: longest + 1] if isinstance(value, str) else value), longest)


def shortened(text: str, longest: int = _LONGEST) -> str:
    """Text of unknown origin for a message: without its end, which nobody reads, where it is longer than a line.

    Args:
        text: What was found.
        longest: Number of characters.
    """
    line = "".join(letter if letter.isprintable() else "?" for letter in text[: longest + 1])
    return line if len(line) <= longest else line[: longest - 3] + "..."
