"""Headers of `.npz` files in millimetres."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.json_text import parse_json


def read_header(arrays: dict[str, np.ndarray], path: Path, format: str, version: int) -> dict[str, Any]:
    """The text `header` of arrays in millimetres, in JSON.

    Args:
        arrays: With `header`.
        path: Of the file, for messages.
        format: What the header must say that the file is.
        version: Of that format.

    Raises:
        InputError: no JSON, another format or version, or other units.
    """
    header = parse_json(str(arrays["header"]), f"{path}: header", f'expected format "{format}"')
    if not isinstance(header, dict) or header.get("format") != format or header.get("units") != "mm":
        raise InputError(f'{path}: header must say format "{format}" and units "mm".')
    if header.get("version") != version:
        raise InputError(f"{path}: version {header.get('version')}; this program reads version {version}.")
    return header
