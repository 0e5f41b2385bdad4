"""The room behind people who never leave: flat figures in given boxes before a room of which every pixel is known."""

import cv2
import numpy as np
import pytest

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.people import standing
from jaxfilters.trackers.people.standing import emptied

SHAPE = (120, 160)
K = np.array([[160.0, 0, 79.5], [0, 160.0, 59.5], [0, 0, 1.0]])
R = cv2.Rodrigues(np.array([np.pi / 2 + 0.35, 0.0, 0.0]))[0]
CAMERA = FloorCamera.from_matrix(K @ np.column_stack([R, -R @ [0.0, -6.0, 3.0]]), SHAPE)
ALL_SHOWN = [np.zeros(SHAPE, np.uint8)] * 20
FLOOR = np.array([[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]])


def box_of(x, y, height=1.7):
    """Left, top, right and bottom of a person at a place."""
    (u, foot), _ = CAMERA.project(np.array([x, y, 0.0]))
    (_, head), _ = CAMERA.project(np.array([x, y, height]))
    half = 0.2 * float(foot - head)
    return [float(u) - half, float(head), float(u) + half, float(foot)]


@pytest.fixture
def room():
    """A wall and a floor, smooth enough to be interpolated."""
    image = np.zeros((*SHAPE, 3), np.float32)
    image += np.linspace(90, 150, SHAPE[0])[:, None, None] + np.linspace(0, 20, SHAPE[1])[None, :, None]
    return image.astype(np.uint8)


def with_person(room, box, level):
    image = room.copy()
    left, top, right, bottom = np.round(box).astype(int)
    image[top + 1 : bottom, left + 2 : right - 1] = level
    return image


def test_a_person_who_sways_for_the_whole_recording_is_not_part_of_the_room(room, monkeypatch):
    boxes = [np.array([box_of(0.08 * np.sin(i), 0.0)]) for i in range(20)]
    images = [with_person(room, boxes[i][0], 20 + 40 * (i % 2)) for i in range(20)]
    queue = iter(boxes)
    monkeypatch.setattr(standing, "standing_boxes", lambda camera, floor, image: next(queue))
    empty = np.median(emptied(CAMERA, FLOOR, images, ALL_SHOWN), axis=0)
    plain = np.median(images, axis=0)
    assert np.abs(plain - room).max() > 60
    assert np.abs(empty - room).max() < 12


def test_a_person_who_leaves_late_is_replaced_by_what_was_behind(room, monkeypatch):
    """Fourteen of twenty images show the person: the six others show the room, to the level."""
    box = np.array([box_of(0.5, 1.0)])
    images = [with_person(room, box[0], 30) if i < 14 else room for i in range(20)]
    queue = iter([box] * 14 + [np.zeros((0, 4))] * 6)
    monkeypatch.setattr(standing, "standing_boxes", lambda camera, floor, image: next(queue))
    for image in emptied(CAMERA, FLOOR, images, ALL_SHOWN):
        np.testing.assert_array_equal(image, room)


def test_a_room_that_boxes_cover_is_what_images_show_beside_people(room, monkeypatch):
    """A dark stripe behind somebody who shuffles, in a box of all places: no interpolation knows of it, images do."""
    room[40:80, 74:82] -= 40
    box = np.array([box_of(0.0, 0.0)])
    left, top, right, bottom = np.round(box[0]).astype(int)
    images, third = [], (right - left) // 3
    for i in range(24):
        at = left + third * (i % 3)
        images.append(with_person(room, [at, top, at + third + 3, bottom], 10 + 60 * (i % 2)))
    monkeypatch.setattr(standing, "standing_boxes", lambda camera, floor, image: box)
    guessed = cv2.inpaint(room, standing._mask(SHAPE, box).astype(np.uint8), 5.0, cv2.INPAINT_TELEA)
    assert np.abs(guessed.astype(int) - room).max() > 30
    for image in emptied(CAMERA, FLOOR, images, [np.zeros(SHAPE, np.uint8)] * 24):
        np.testing.assert_allclose(image.astype(int), room, atol=3)


def test_a_thing_that_looks_like_a_person_stays(room, monkeypatch):
    box = np.array([box_of(-1.0, 0.0)])
    image = with_person(room, box[0], 40)
    monkeypatch.setattr(standing, "standing_boxes", lambda camera, floor, image: box)
    for found in emptied(CAMERA, FLOOR, [image] * 10, ALL_SHOWN[:10]):
        np.testing.assert_array_equal(found, image)


def test_only_boxes_of_the_size_of_people_on_the_floor_count():
    def counts(x, y, height, floor=FLOOR):
        left, top, right, bottom = (np.array([edge]) for edge in box_of(x, y, height))
        return bool(standing._is_on_floor(CAMERA, floor, (left + right) / 2, top, bottom)[0])

    assert counts(0.0, 0.0, 1.7)
    assert counts(1.0, 2.0, 1.5)
    assert not counts(0.0, 0.0, 1.1)
    assert not counts(0.0, 0.0, 2.4)
    assert not counts(0.0, 0.0, 1.7, floor=FLOOR + np.array([10.0, 0.0]))


def test_a_room_without_people_is_left_as_it_is(room):
    for image, found in zip([room] * 3, emptied(CAMERA, FLOOR, [room] * 3, ALL_SHOWN[:3]), strict=True):
        np.testing.assert_array_equal(image, found)


def test_what_a_turned_camera_did_not_show_comes_from_the_other_images(room):
    """A strip of twelve of twenty images is made up."""
    images, blank = [room.copy() for _ in range(20)], [np.zeros(SHAPE, np.uint8) for _ in range(20)]
    for i in range(12):
        images[i][:, 140:], blank[i][:, 140:] = 255, 255
    for image in emptied(CAMERA, FLOOR, images, blank):
        np.testing.assert_array_equal(image, room)
