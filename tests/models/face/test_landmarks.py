"""The table of landmarks: symmetric, centred, each landmark in one group."""

import numpy as np

from jaxfilters.models.face.landmarks import (
    BROWS,
    EYES,
    FROM_68,
    MEAN_SHAPE,
    MIRROR,
    MOUTH,
    NAMES,
    NOSTRILS,
    NUM_LANDMARKS,
    RIGID_WEIGHTS,
)


def test_the_mean_face_is_centred_and_its_own_mirror_image():
    np.testing.assert_allclose(MEAN_SHAPE.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(MEAN_SHAPE[list(MIRROR)], MEAN_SHAPE * [-1, 1, 1], atol=1e-12)


def test_mirrored_landmarks_change_sides_and_nothing_else():
    for name, mirrored in zip(NAMES, (NAMES[i] for i in MIRROR), strict=True):
        assert {name.split()[0], mirrored.split()[0]} == {"left", "right"}
        assert name.split()[1:] == mirrored.split()[1:]


def test_every_landmark_belongs_to_the_group_of_its_name():
    groups = {"eye": EYES, "mouth": MOUTH, "nostril": NOSTRILS, "brow": BROWS}
    assert sorted(sum(groups.values(), ())) == list(range(NUM_LANDMARKS))
    for word, group in groups.items():
        assert all(word in NAMES[i] for i in group)


def test_distances_are_those_of_the_specification():
    assert MEAN_SHAPE.shape == (NUM_LANDMARKS, 3)
    np.testing.assert_allclose(MEAN_SHAPE[2] - MEAN_SHAPE[1], [34, 0, 0], atol=1e-12)
    np.testing.assert_allclose(MEAN_SHAPE[4] - MEAN_SHAPE[8], [-12, 90, 5], atol=1e-12)


def test_the_landmarks_of_68_and_the_weights_name_the_stable_points():
    assert len(set(FROM_68)) == NUM_LANDMARKS
    assert [FROM_68[i] for i in EYES] == [36, 39, 42, 45]
    assert all(RIGID_WEIGHTS[list(EYES + NOSTRILS)] == 1)
    assert all(RIGID_WEIGHTS[list(BROWS)] < 1)
    assert all(RIGID_WEIGHTS[list(MOUTH)] < RIGID_WEIGHTS[list(BROWS)])
