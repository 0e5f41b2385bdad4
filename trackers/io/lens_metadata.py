"""The focal length that a camera wrote into its file: QuickTime keys of a phone's video, EXIF of a picture.

Both name the lens by the focal length that shows as much on 35 mm film. What is damaged says nothing: the metadata of a
file never keep it from being read.
"""

import math
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.images import images_in
from jaxfilters.trackers.io.input_files import is_folder, open_bytes

QUICKTIME_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
"""In a video's or a track's metadata: an integer, or text such as `26.00mm` (Apple, "QuickTime metadata keys")."""
LEAST_MM, MOST_MM = 8.0, 400.0
"""Of lenses; other values are taken for none."""
FILM_DIAGONAL_MM = math.hypot(36, 24)
"""A lens that shows as much across the diagonal of this is meant (CIPA DCG-001, section 3)."""
_MOST_BYTES = 64 * 2**20
"""Of a box `moov`, which has the metadata and no images, and of a picture."""
_EXIF_DIRECTORY, _FOCAL_LENGTH_IN_35MM = 0x8769, 0xA405
_SHORT, _LONG = 3, 4
"""Tags, and types of their values (CIPA DC-008, section 4.6)."""
_UTF8 = 1
_NUMBERS = {
    (kind, size): ">" + code
    for kind, codes in ((21, "bhiq"), (22, "BHIQ"), (23, "f"), (24, "d"))
    for code in codes
    for size in (struct.calcsize(code),)
}
"""How a value of a QuickTime type and a number of bytes is stored ("QuickTime file format", well-known types)."""


def equivalent_focal_mm(path: Path) -> float | None:
    """Focal length of the lens that shows as much on 35 mm film, millimetres; None where the file does not say it.

    Args:
        path: A video (MP4 or QuickTime), a picture (JPEG or TIFF), or a folder of pictures, of which the first counts.
    """
    try:
        file = images_in(path)[0] if is_folder(path) else path
        with open_bytes(file, "expected a video or a picture") as stream:
            start = stream.read(12)
            stream.seek(0)
            found = _of_movie(stream) if start[4:8] == b"ftyp" else _of_picture(stream.read(_MOST_BYTES))
    except (OSError, InputError, struct.error):
        return None
    return found if found is not None and LEAST_MM <= found <= MOST_MM else None


def focal_px(equivalent_mm: float, image_size: tuple[int, int]) -> float:
    """Focal length in pixels of an uncropped image (columns, rows), from that on 35 mm film in millimetres."""
    return equivalent_mm / FILM_DIAGONAL_MM * math.hypot(*image_size)


def _of_movie(stream: BinaryIO) -> float | None:
    """The first one that the video or one of its tracks has."""
    movie = _movie(stream)
    metas = [body for kind, body in _boxes(movie) if kind == b"meta"]
    for kind, body in _boxes(movie):
        if kind in (b"trak", b"udta"):
            metas += [inner for name, inner in _boxes(body) if name == b"meta"]
    return next((found for found in map(_of_meta, metas) if found is not None), None)


def _movie(stream: BinaryIO) -> bytes:
    """What is in the box `moov`; nothing where there is none, or a larger one than is credible."""
    end = stream.seek(0, 2)
    place = 0
    while place + 8 <= end:
        stream.seek(place)
        head = stream.read(16)
        size, kind, header = _box_head(head, end - place)
        if size < header:
            break
        if kind == b"moov":
            stream.seek(place + header)
            return stream.read(size - header) if size <= _MOST_BYTES else b""
        place += size
    return b""


def _box_head(head: bytes, left: int) -> tuple[int, bytes, int]:
    """Bytes of a box with its header (0 if it does not fit into the rest), its kind, and bytes of its header."""
    size, kind = struct.unpack(">I4s", head[:8])
    header = 8
    if size == 1 and len(head) >= 16:
        (size,), header = struct.unpack(">Q", head[8:16]), 16
    elif size == 0:
        size = left
    return (size if size <= left else 0), kind, header


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of all boxes up to the first that is damaged."""
    place = 0
    while place + 8 <= len(data):
        size, kind, header = _box_head(data[place : place + 16], len(data) - place)
        if size < header:
            return
        yield kind, data[place + header : place + size]
        place += size


def _of_meta(body: bytes) -> float | None:
    """By the index of its key; the box has a version before its content in MP4, and none in QuickTime."""
    for skipped in (0, 4):
        inner = dict(_boxes(body[skipped:]))
        if b"keys" not in inner or b"ilst" not in inner:
            continue
        names = [name for _, name in _boxes(inner[b"keys"][8:])]
        for number, item in _boxes(inner[b"ilst"]):
            index = int.from_bytes(number, "big") - 1
            if 0 <= index < len(names) and names[index] == QUICKTIME_KEY:
                return _number(dict(_boxes(item)).get(b"data", b""))
    return None


def _number(data: bytes) -> float | None:
    """Of a value with its type and its language before it."""
    kind, value = int.from_bytes(data[:4], "big"), data[8:]
    if kind == _UTF8:
        found = re.match(rb"\s*(\d{1,6}(?:\.\d*)?)\s*(?:mm)?\s*\0?$", value)
        return float(found[1]) if found else None
    code = _NUMBERS.get((kind, len(value)))
    number = float(struct.unpack(code, value)[0]) if code else math.nan
    return number if math.isfinite(number) else None


def _of_picture(data: bytes) -> float | None:
    """Of a JPEG's first segments, or of a TIFF."""
    if data[:2] != b"\xff\xd8":
        return _of_exif(data)
    place = 2
    while data[place : place + 1] == b"\xff" and data[place + 1 : place + 2] != b"\xda":
        (size,) = struct.unpack(">H", data[place + 2 : place + 4])
        if data[place + 1] == 0xE1 and data[place + 4 : place + 10] == b"Exif\0\0":
            return _of_exif(data[place + 10 : place + 2 + size])
        place += 2 + size
    return None


def _of_exif(data: bytes) -> float | None:
    """Of a TIFF structure: its first directory names that of EXIF."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        return None
    (start,) = struct.unpack(order + "I", data[4:8])
    place = _entry(data, order, start, _EXIF_DIRECTORY)
    found = None if place is None else _entry(data, order, place, _FOCAL_LENGTH_IN_35MM)
    return None if found is None else float(found)


def _entry(data: bytes, order: str, start: int, wanted: int) -> int | None:
    """The integer of a tag in the directory at `start`."""
    (count,) = struct.unpack(order + "H", data[start : start + 2])
    for place in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind = struct.unpack(order + "HH", data[place : place + 4])
        if tag == wanted and kind in (_SHORT, _LONG):
            code = order + ("H" if kind == _SHORT else "I")
            return struct.unpack_from(code, data, place + 8)[0]
    return None
