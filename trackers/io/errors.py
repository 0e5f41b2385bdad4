"""Errors that end a command in one line: what cannot be read, written or continued, and why."""


class InputError(ValueError):
    """An input that cannot be used; the message says what was found and what was expected."""


class OutputError(OSError):
    """Results that cannot be written; the message says what is kept."""


class CheckpointError(ValueError):
    """A saved state that cannot be continued; the message says why."""
