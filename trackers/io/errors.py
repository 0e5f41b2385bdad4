"""Errors that end a command in one line: what cannot be read, written or continued, and why."""

from collections.abc import Callable
from typing import TypeVar

Made = TypeVar("Made")


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
