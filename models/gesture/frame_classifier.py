"""What a frame of a stream shows, from the features of the frames around it: a small temporal convolutional network.

Three layers of dilated convolutions with residual connections (S. Bai et al., "An empirical evaluation of generic
convolutional and recurrent networks for sequence modeling", 2018), centred on the frame. Its posteriors, divided by the
frequencies of the classes, stand for the likelihoods of a hidden Markov model's states (H. Bourlard, N. Morgan,
"Connectionist speech recognition", 1994).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PyTree

from jaxfilters._full_precision import PRECISION, dot
from jaxfilters.typing import AnyKey

WIDTH = 64
KERNEL, DILATIONS = 5, (1, 2, 3)
REACH = (KERNEL - 1) // 2 * sum(DILATIONS)
"""Frames before and after one that its classification depends on."""
NUM_STEPS, BATCH, WINDOW = 400, 32, 160
LEARNING_RATE, WEIGHT_DECAY = 3e-3, 1e-2
DROPOUT, NOISE, SMOOTHING = 0.3, 0.1, 0.05
"""Share of channels left out in training, standard deviation added to features, and share of label smoothing."""
UNLABELLED = -1
"""Class of a frame that does not count in training."""
_LEAST_SD = 0.05


class FrameClassifier(NamedTuple):
    """Parameters of the network."""

    mean: Float[Array, " f"]
    """Of the features, which are standardised."""
    sd: Float[Array, " f"]
    layers: tuple[tuple[Float[Array, "k c w"], Float[Array, " w"]], ...]
    """Kernels and offsets of each convolution."""
    readout: tuple[Float[Array, "w q"], Float[Array, " q"]]


class Example(NamedTuple):
    """A stream with the class of every frame."""

    features: Float[np.ndarray, "t f"]
    classes: Int[np.ndarray, " t"]


def train(
    key: AnyKey, examples: list[list[Example]], weights: Float[np.ndarray, " n"], num_classes: int, *, num_steps: int
) -> FrameClassifier:
    """A network that maximises the conditional log-likelihood of classes in random windows.

    Args:
        key: Random key, of windows, dropout, noise and start.
        examples: Of each stream, several that stand for it, distorted in different ways.
        weights: How often each stream is drawn, summing to 1.
        num_classes: Classes of frames are from 0 to this, or `UNLABELLED`.
        num_steps: Steps of Adam with decoupled weight decay.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    features = np.concatenate([versions[0].features for versions in examples])
    mean, sd = features.mean(axis=0), features.std(axis=0) + _LEAST_SD
    params = _start(key, features.shape[1], num_classes)
    rate = optax.cosine_decay_schedule(LEARNING_RATE, num_steps)
    state = _ADAM.init(params)
    for step in range(num_steps):
        shown = [
            _window(rng, versions[rng.integers(len(versions))], mean, sd)
            for versions in (examples[i] for i in rng.choice(len(examples), BATCH, p=weights))
        ]
        windows, classes = (np.stack(values) for values in zip(*shown, strict=True))
        params, state = _step(params, state, windows, classes, jax.random.fold_in(key, step), rate(step))
    return FrameClassifier(jnp.asarray(mean), jnp.asarray(sd), *params)


@jax.jit
def log_posteriors(classifier: FrameClassifier, features: Float[Array, "t f"]) -> Float[Array, "t q"]:
    """Log probabilities of the classes in every frame; before and after the stream it stands still."""
    params = (classifier.layers, classifier.readout)
    standardised = (features - classifier.mean) / classifier.sd
    padded = jnp.pad(standardised, ((REACH, REACH), (0, 0)), mode="edge")
    return jax.nn.log_softmax(_logits(params, padded[None], None)[0, REACH:-REACH])


_ADAM = optax.scale_by_adam()


def _start(key: AnyKey, num_features: int, num_classes: int) -> tuple[Any, Any]:
    sizes = [num_features] + [WIDTH] * len(DILATIONS)
    layers = []
    for i in range(len(DILATIONS)):
        shape = (KERNEL, sizes[i], WIDTH)
        scale = np.sqrt(2 / (KERNEL * sizes[i]))
        layers.append((scale * jax.random.normal(jax.random.fold_in(key, i), shape), jnp.zeros(WIDTH)))
    last = 0.1 * jax.random.normal(jax.random.fold_in(key, len(DILATIONS)), (WIDTH, num_classes))
    return tuple(layers), (last, jnp.zeros(num_classes))


def _logits(params: tuple[Any, Any], windows: Float[Array, "n t f"], key: AnyKey | None) -> Float[Array, "n t q"]:
    """With dropout of whole channels where there is a key."""
    layers, (weights, offset) = params
    values = windows
    for i, ((kernel, bias), dilation) in enumerate(zip(layers, DILATIONS, strict=True)):
        found = jax.lax.conv_general_dilated(
            values,
            kernel,
            (1,),
            "SAME",
            rhs_dilation=(dilation,),
            dimension_numbers=("NWC", "WIO", "NWC"),
            precision=PRECISION,
        )
        found = jax.nn.gelu(found + bias)
        if key is not None:
            kept = jax.random.bernoulli(jax.random.fold_in(key, i), 1 - DROPOUT, (len(found), 1, WIDTH))
            found = jnp.where(kept, found / (1 - DROPOUT), 0.0)
        values = found if i == 0 else values + found
    logits: Array = dot(values, weights) + offset
    return logits


@jax.jit
def _step(params: PyTree, state: Any, windows: Array, classes: Array, key: AnyKey, rate: Array) -> tuple[PyTree, Any]:
    noise_key, dropout_key = jax.random.split(key)
    windows = windows + NOISE * jax.random.normal(noise_key, windows.shape)

    def loss(params: PyTree) -> Array:
        logs = jax.nn.log_softmax(_logits(params, windows, dropout_key))
        counts = classes != UNLABELLED
        right = jnp.take_along_axis(logs, jnp.maximum(classes, 0)[..., None], axis=-1)[..., 0]
        each = (1 - SMOOTHING) * right + SMOOTHING * jnp.mean(logs, axis=-1)
        return -jnp.sum(jnp.where(counts, each, 0.0)) / jnp.maximum(jnp.sum(counts), 1)

    changes, state = _ADAM.update(jax.grad(loss)(params), state)
    return jax.tree.map(lambda value, change: value - rate * (change + WEIGHT_DECAY * value), params, changes), state


def _window(
    rng: np.random.Generator, example: Example, mean: np.ndarray, sd: np.ndarray
) -> tuple[Float[np.ndarray, "t f"], Int[np.ndarray, " t"]]:
    """A random part of a stream, or all of it at a random place, beyond which it stands still without a class."""
    features, classes = (example.features - mean) / sd, example.classes
    missing = WINDOW - len(features)
    if missing <= 0:
        first = rng.integers(1 - missing)
        return features[first : first + WINDOW], classes[first : first + WINDOW]
    around = (before := int(rng.integers(missing + 1)), missing - before)
    return np.pad(features, (around, (0, 0)), mode="edge"), np.pad(classes, around, constant_values=UNLABELLED)
