"""Boxes of detectors: both formats give the same boxes, and what is wrong is named with its place."""

import json

import numpy as np
import pytest

from jaxfilters.trackers.io.detections import read_detections
from jaxfilters.trackers.io.errors import InputError

MOT = "1,-1,10,20,30,60,0.9\n\n3 -1 11 21 30.5 60 -1 5 6 0\n3,7,1,2,3,4\n"
COCO = [
    {"image_id": 0, "bbox": [10, 20, 30, 60], "score": 0.9, "category_id": 1},
    {"image_id": 2, "bbox": [11, 21, 30.5, 60]},
    {"image_id": 2, "bbox": [1, 2, 3, 4], "category_id": 1},
    {"image_id": 2, "bbox": [5, 5, 5, 5], "category_id": 17},
]
EXPECTED = {0: [[10, 20, 40, 80, 0.9]], 2: [[11, 21, 41.5, 81, 1.0], [1, 2, 4, 6, 1.0]]}
NAMED = {"images": [{"id": i} for i in (40, 7, 21)], "annotations": [one | {"image_id": 40} for one in COCO[:1]]}


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("boxes.txt", MOT, EXPECTED),
        ("boxes.json", json.dumps(COCO), EXPECTED),
        ("boxes.json", json.dumps(NAMED), {2: EXPECTED[0]}),
        ("boxes.txt", "", {}),
    ],
)
def test_both_formats_are_read(tmp_path, name, text, expected):
    (tmp_path / name).write_text(text)
    found = read_detections(tmp_path / name)
    assert found.keys() == expected.keys()
    for frame, boxes in expected.items():
        np.testing.assert_allclose(found[frame], boxes)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "1,-1,10,20,30\n", "line 1: 5 numbers, expected at least 6"),
        ("a.txt", "1,-1,1,2,3,4\n1,-1,1,2,x,4\n", "line 2: not numbers"),
        ("a.txt", "0,-1,1,2,3,4\n", "frame must be a whole number"),
        ("a.txt", "1.5,-1,1,2,3,4\n", "frame must be a whole number"),
        ("a.txt", "1,-1,1,2,0,4\n", "positive width"),
        ("a.txt", "1,-1,nan,2,3,4\n", "must be finite"),
        ("a.txt", "1,-1,1,2,3,4,95\n", "score must be from 0 to 1; got 95"),
        ("a.json", "{}", "no list of detections"),
        ("a.json", '[{"bbox": [1, 2, 3, 4]}]', "detection 0: image_id must be a number"),
        ("a.json", '[{"image_id": 0, "bbox": [1, 2, 3]}]', "bbox must be 4 numbers"),
        ("a.json", '{"images": [{"id": 3}], "annotations": [{"image_id": 4, "bbox": [1, 2, 3, 4]}]}', "not among"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_detections(tmp_path / name)
