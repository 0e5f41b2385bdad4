"""JSON of unknown origin: text that would exhaust the parser, or numbers that no float holds, is an error at once."""

import json
from pathlib import Path
from typing import Any

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.input_files import check_regular

MOST_BYTES = 256 * 2**20
_MOST_DIGITS = 18
"""Integers of so many digits fit into 64 bits."""


def read_json_text(path: Path, wanted: str) -> Any:
    """The value in a JSON file.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.

    Raises:
        InputError: a file that cannot be read or is no JSON, nested too deeply, or larger than 256 MiB.
    """
    if check_regular(path, wanted) > MOST_BYTES:
        raise InputError(f"{path}: larger than {MOST_BYTES >> 20} MiB; {wanted}.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {wanted}.") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not JSON ({error.reason}); {wanted}.") from None
    return parse_json(text, str(path), wanted)


def parse_json(text: str, place: str, wanted: str) -> Any:
    """The value of a JSON text.

    Args:
        text: The text.
        place: Where it comes from, for messages.
        wanted: Describes a right one, for messages.

    Raises:
        InputError: no JSON, integers that do not fit into 64 bits, or nested too deeply.
    """
    try:
        return json.loads(text, parse_int=_integer)
    except RecursionError:
        raise InputError(f"{place}: not JSON that can be read (nested too deeply); {wanted}.") from None
    except ValueError as error:
        raise InputError(f"{place}: not JSON ({error}); {wanted}.") from None


def _integer(digits: str) -> int:
    if len(digits.lstrip("-")) > _MOST_DIGITS:
        raise ValueError(f"an integer of {len(digits.lstrip('-'))} digits")
    return int(digits)
