"""Arrays from `.npz` files that people hand over: whatever is wrong with one is said with its name."""

import json
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.recording import InputError


def read_arrays(path: Path, wanted: str, known: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of a file by name.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.
        known: Names to read, those that are there; all of them without. Others may hold anything.

    Raises:
        InputError: a file that cannot be read, is damaged, or holds objects.
    """
    try:
        with path.open("rb") as content:
            archive = np.load(content, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise InputError(f"{path}: a single array; {wanted}.")
            return {name: archive[name] for name in archive.files if known is None or name in known}
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); {wanted}.") from None
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a complete .npz file ({error}); {wanted}.") from None


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
    try:
        header = json.loads(str(arrays["header"]))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: header is not JSON ({error}).") from None
    if not isinstance(header, dict) or header.get("format") != format or header.get("units") != "mm":
        raise InputError(f'{path}: header must say format "{format}" and units "mm".')
    if header.get("version") != version:
        raise InputError(f"{path}: version {header.get('version')}; this program reads version {version}.")
    return header
