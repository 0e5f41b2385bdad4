"""XML of unknown origin."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from jaxfilters.trackers.io.errors import InputError, shortened
from jaxfilters.trackers.io.input_files import MOST_BYTES, read_bytes


def read_xml(path: Path, wanted: str) -> ElementTree.Element:
    """The outermost element of a file.

    Args:
        path: The file.
        wanted: Describes a right one, for messages.

    Raises:
        InputError: a file that cannot be read, is no XML, or defines entities, which may stand for any amount of text.
    """
    content = read_bytes(path, wanted, MOST_BYTES)
    if b"<!ENTITY" in content:
        raise InputError(f"{path}: defines entities; {wanted}.")
    try:
        return ElementTree.fromstring(content)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(f"{path}: not XML ({shortened(str(error))}); {wanted}.") from None
