"""Boxes around people in a video, as detectors write them: text of the MOT challenge, and JSON of COCO results."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.input_files import LARGEST, read_text
from jaxfilters.trackers.io.json_files import read_json_value

WANTED = (
    "expected lines `frame,id,left,top,width,height,score` with frames from 1 (MOT challenge), or COCO results, "
    '[{"image_id": 0, "bbox": [left, top, width, height], "score": 0.9, "category_id": 1}, ...] with images from 0'
)
_PERSON = 1
"""Category of people in COCO."""
_MOST_FRAMES = 2**31


def read_detections(path: Path) -> dict[int, np.ndarray]:
    """Boxes by frame, counted from 0: (n, 5) left, top, right, bottom in pixels of the video, and score from 0 to 1.

    A file `.json` holds COCO results: a list of detections, or an object with `annotations` and perhaps `images`, whose
    `id` in increasing order are then the frames. Only people (category 1) are kept. Every other file is text of the
    MOT challenge; a line of six numbers has the score 1, and lines of score -1 (not given) too.

    Raises:
        InputError: a file that cannot be read or is no such file; the message names the line or the entry.
    """
    rows = list(_from_json(path) if path.suffix.lower() == ".json" else _from_text(path))
    found: dict[int, list[np.ndarray]] = {}
    for place, frame, (left, top, width, height, score) in rows:
        numbers = np.array([left, top, width, height, score])
        if not np.all(np.abs(numbers) < LARGEST) or width <= 0 or height <= 0:
            raise InputError(f"{place}: a box must be finite, with positive width and height; {WANTED}.")
        if not (0 <= frame < _MOST_FRAMES and frame == int(frame)):
            raise InputError(f"{place}: frame must be a whole number from the first frame on; {WANTED}.")
        box = np.array([left, top, left + width, top + height, 1.0 if score == -1 else score])
        if not 0 <= box[4] <= 1:
            raise InputError(f"{place}: score must be from 0 to 1; got {score:g}.")
        found.setdefault(int(frame), []).append(box)
    return {frame: np.stack(boxes) for frame, boxes in found.items()}


def _from_text(path: Path) -> Iterable[tuple[str, float, list[float]]]:
    for number, line in enumerate(read_text(path, WANTED).splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words:
            continue
        place = f"{path}, line {number}"
        try:
            frame, _, *box = map(float, words)
        except ValueError:
            raise InputError(f"{place}: not numbers: {shortened(line)}; {WANTED}.") from None
        if len(box) < 4:
            raise InputError(f"{place}: {len(words)} numbers, expected at least 6; {WANTED}.")
        yield place, frame - 1, [*box[:4], box[4] if len(box) > 4 else 1.0]


def _from_json(path: Path) -> Iterable[tuple[str, float, list[float]]]:
    value = read_json_value(path, WANTED)
    images = None
    if isinstance(value, dict):
        if isinstance(listed := value.get("images"), list):
            names = [_number(image, "id", f"{path}, images {i}") for i, image in enumerate(listed)]
            images = {name: frame for frame, name in enumerate(sorted(names))}
        value = value.get("annotations")
    if not isinstance(value, list):
        raise InputError(f"{path}: holds no list of detections; {WANTED}.")
    for i, one in enumerate(value):
        place = f"{path}, detection {i}"
        name = _number(one, "image_id", place)
        if images is not None and name not in images:
            raise InputError(f"{place}: image_id {name:g} is not among the images of the file.")
        box = one.get("bbox")
        if not isinstance(box, list) or len(box) != 4 or not all(type(number) in (int, float) for number in box):
            raise InputError(f"{place}: bbox must be 4 numbers; got {shown(box)}; {WANTED}.")
        score = _number(one, "score", place) if "score" in one else 1.0
        if one.get("category_id", _PERSON) == _PERSON:
            yield place, name if images is None else images[name], [*map(float, box), score]


def _number(one: Any, entry: str, place: str) -> float:
    if not isinstance(one, dict) or type(one.get(entry)) not in (int, float):
        raise InputError(f"{place}: {entry} must be a number; got {shown(one)}; {WANTED}.")
    return float(one[entry])
