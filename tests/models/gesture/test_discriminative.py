"""Discriminative training: what the gradient does to them, and how they recognise strokes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import hmm
from jaxfilters.models.gesture import discriminative, symbols
from jaxfilters.models.gesture.stroke import shape_features
from jaxfilters.models.gesture.symbols import recognise_all


def paths(num_strokes, bump, seed):
    """Waves that differ in the place of a small bump, with the same much larger nuisance."""
    rng = np.random.default_rng(seed)
    at = np.linspace(0, 1, 20)
    phase = rng.uniform(-0.6, 0.6, num_strokes)[:, None]
    y = np.sin(2 * np.pi * at + phase) + 0.35 * np.exp(-0.5 * ((at - bump) / 0.06) ** 2)
    points = np.stack([np.broadcast_to(at * 4, y.shape), y + rng.normal(0, 0.05, y.shape)], axis=-1)
    shapes = jax.vmap(shape_features)(jnp.asarray(points, jnp.float32))
    return np.concatenate([shapes, np.ones((num_strokes, 20, 2), np.float32)], axis=-1)


@pytest.mark.system
def test_strokes_of_a_small_difference_are_separated_better(monkeypatch):
    """Of 400 strokes; by maximum likelihood 90 % are right, and a deviation is 1.5 %."""
    monkeypatch.setattr(discriminative, "CHUNK", 128)
    monkeypatch.setattr(symbols, "CHUNK", 512)
    data = [jnp.concatenate([paths(n, 0.42, seed), paths(n, 0.5, seed + 1)]) for n, seed in ((60, 0), (200, 2))]
    labels = [["a"] * (len(own) // 2) + ["b"] * (len(own) // 2) for own in data]
    before = symbols.learn(data[0], labels[0], num_states=4)
    after = discriminative.trained_apart(before, data[0], labels[0], num_epochs=20)
    right = []
    for models in (before, after):
        found = recognise_all(models, jnp.moveaxis(data[1], 0, -1))
        best = np.array(models.names)[np.argmax(found.log_likelihood, axis=0)]
        right.append(np.mean(best == np.array(labels[1])))
    assert right[1] > right[0] + 0.03
    jax.tree.map(np.testing.assert_array_equal, before.models.log_transition, after.models.log_transition)
    assert np.asarray(after.models.emission.variance).min() >= 0.5 * before.models.emission.min_variance - 1e-6


def test_distortions_of_features_are_linear_maps_of_the_points(monkeypatch):
    """Without a stretch they are turns, which change directions and positions alike."""
    monkeypatch.setattr(discriminative, "STRETCH", 0.0)
    features = jnp.asarray(paths(3, 0.4, 0))
    turns = discriminative.distortions(np.random.default_rng(0), 3, 2)
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), np.tile(np.eye(2), (3, 1, 1)), atol=1e-12)
    turned = np.asarray(discriminative.distorted(features, jnp.asarray(turns, jnp.float32)))
    for before, after, turn in zip(np.asarray(features), turned, turns, strict=True):
        np.testing.assert_allclose(after[:, :2], before[:, :2] @ turn.T, atol=1e-4)
        np.testing.assert_allclose(after[:, 2:4], before[:, 2:4] @ turn.T, atol=2e-3)
        np.testing.assert_array_equal(after[:, 6:], before[:, 6:])


def test_wrong_labels_are_named():
    model = hmm.from_topology(hmm.left_right(2), hmm.DiagonalGaussian(jnp.zeros((2, 8)), jnp.ones((2, 8))))
    only = symbols.Symbols(jax.tree.map(lambda leaf: leaf[None], model), jnp.zeros(1, jnp.int32), ("a",))
    with pytest.raises(ValueError, match="labels must name a symbol for each of 2 strokes"):
        discriminative.trained_apart(only, jnp.zeros((2, 20, 8)), ["a", "b"])
    assert discriminative.trained_apart(only, jnp.zeros((2, 20, 8)), ["a", "a"]) is only
