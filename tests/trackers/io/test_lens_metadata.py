"""Focal lengths in the metadata of files: pictures by Pillow, videos with boxes added by hand, damaged files."""

import os
import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from jaxfilters.trackers.io.lens_metadata import QUICKTIME_KEY, equivalent_focal_mm, focal_px


def write_picture(path, focal=None):
    """A picture with EXIF by Pillow: 0xA405 is FocalLengthIn35mmFilm, in the directory 0x8769."""
    exif = Image.Exif()
    if focal is not None:
        exif.get_ifd(0x8769)[0xA405] = focal
    if path.suffix == ".tif":
        # Without its mark, EXIF is a TIFF of no image.
        path.write_bytes(exif.tobytes()[6:])
    else:
        Image.fromarray(np.full((48, 64, 3), 120, np.uint8)).save(path, exif=exif)


def box(kind, *content):
    body = b"".join(content)
    return struct.pack(">I4s", 8 + len(body), kind) + body


def keys_and_values(kind, value, *, before=b""):
    """A `meta` of two items, the second of which is the lens."""
    names = [b"com.apple.quicktime.make", QUICKTIME_KEY]
    keys = box(b"keys", struct.pack(">II", 0, len(names)), *(box(b"mdta", name) for name in names))
    item = lambda number, kind, value: box(struct.pack(">I", number), box(b"data", struct.pack(">II", kind, 0), value))
    values = box(b"ilst", item(1, 1, b"Apple"), item(2, kind, value))
    return box(b"meta", before, box(b"hdlr", bytes(24)), keys, values)


def write_video(path, added):
    """A video of OpenCV, whose box `moov` comes last and gets more content."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 48))
    for i in range(3):
        writer.write(np.full((48, 64, 3), 50 * i, np.uint8))
    writer.release()
    data = path.read_bytes()
    start = data.rindex(b"moov") - 4
    (size,) = struct.unpack(">I", data[start : start + 4])
    assert start + size == len(data)
    path.write_bytes(data[:start] + struct.pack(">I", size + len(added)) + data[start + 4 :] + added)


VALUES = {
    "two bytes": (21, struct.pack(">h", 26)),
    "four bytes": (22, struct.pack(">I", 26)),
    "float": (23, struct.pack(">f", 26)),
    "text": (1, b"26.00mm"),
    "number in text": (1, b"26"),
}


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize("place", ["movie", "track", "user data of MP4"])
def test_videos_say_the_lens_in_all_forms(tmp_path, name, place):
    kind, value = VALUES[name]
    meta = keys_and_values(kind, value, before=bytes(4) if place == "user data of MP4" else b"")
    added = {"movie": meta, "track": box(b"trak", meta), "user data of MP4": box(b"udta", meta)}[place]
    write_video(tmp_path / "a.mp4", added)
    assert equivalent_focal_mm(tmp_path / "a.mp4") == 26
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).read()[0]


@pytest.mark.parametrize("suffix", ["jpg", "tif"])
def test_pictures_say_it_in_exif_and_the_first_of_a_folder_counts(tmp_path, suffix):
    write_picture(tmp_path / f"1.{suffix}", focal=28)
    write_picture(tmp_path / f"2.{suffix}", focal=50)
    assert equivalent_focal_mm(tmp_path / f"2.{suffix}") == 50
    assert equivalent_focal_mm(tmp_path) == 28


def test_the_diagonal_of_film_is_that_of_the_image():
    """A lens of 43.27 mm has a focal length as long as the diagonal of film; 18 mm is a half of 36 mm."""
    assert focal_px(43.2666, (300, 400)) == pytest.approx(500, rel=1e-5)
    assert focal_px(18.0, (3600, 2400)) == pytest.approx(1800)
    assert focal_px(26.0, (1920, 1080)) == focal_px(26.0, (1080, 1920))


def test_files_that_do_not_say_it_say_nothing(tmp_path):
    write_picture(tmp_path / "plain.jpg")
    write_picture(tmp_path / "zero.jpg", focal=0)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint8))
    write_video(tmp_path / "plain.mp4", b"")
    write_video(tmp_path / "nonsense.mp4", keys_and_values(1, b"a long lens"))
    write_video(tmp_path / "infinite.mp4", keys_and_values(23, struct.pack(">f", np.inf)))
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for path in tmp_path.iterdir():
        assert equivalent_focal_mm(path) is None, path.name
    assert equivalent_focal_mm(tmp_path / "no such file") is None


@pytest.mark.parametrize("suffix", ["jpg", "tif", "mp4"])
def test_damaged_files_say_nothing_or_a_lens(tmp_path, suffix):
    """Cut anywhere, and with single bytes changed: never an error."""
    path = tmp_path / f"a.{suffix}"
    if suffix == "mp4":
        path.write_bytes(box(b"ftyp", b"isom") + box(b"moov", box(b"trak", keys_and_values(21, b"\0\x1a"))))
    else:
        write_picture(path, focal=26)
    whole, rng = path.read_bytes()[:600], np.random.default_rng(0)
    for cut in range(0, len(whole), 3):
        path.write_bytes(whole[:cut])
        assert equivalent_focal_mm(path) in (None, 26)
    for _ in range(600):
        changed = bytearray(whole)
        changed[rng.integers(len(whole))] = rng.integers(256)
        path.write_bytes(changed)
        found = equivalent_focal_mm(path)
        assert found is None or 8 <= found <= 400
