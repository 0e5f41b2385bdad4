"""Discriminative training of models of symbols: maximum mutual information by gradient through the forward recursion.

Maximum likelihood fits every model to its own strokes alone. Here the means and variances of all states maximise the
conditional log-likelihood log p(symbol | stroke), as a softmax over the models' tempered log evidences (L. Bahl et al.,
"Maximum mutual information estimation of hidden Markov model parameters for speech recognition", ICASSP 1986). The
sum over rival models is over those that explain a stroke best, the N-best list of D. Povey and P. Woodland ("Minimum
phone error and I-smoothing", ICASSP 2002); it is renewed while models move. Every stroke is distorted anew in half of
the steps, to stand for other people's.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int
from scipy.linalg import expm

from jaxfilters import hmm
from jaxfilters.models.gesture.stroke import shape_features
from jaxfilters.models.gesture.symbols import Symbols

NUM_EPOCHS, BATCH = 4, 256
FEWEST_STEPS = 60
"""Of few strokes there are more epochs."""
LEARNING_RATE = 0.01
SHARPNESS = 0.15
"""Share of a log-likelihood that counts: neighbouring points of a stroke say nearly the same."""
NUM_OWN, NUM_RIVALS = 2, 6
"""Models of a stroke's own symbol and of other symbols that are compared."""
REFRESH_EPOCHS = 2
LEAST_SHARE = 0.5
"""Of the floor of the variances in training by maximum likelihood, down to which they may go."""
TURN_RAD, STRETCH = 0.2, 0.15
"""Standard deviations of a distortion: of a turn about each axis, and of each element of the matrix that follows."""
CHUNK = 1024
_ADAM = optax.scale_by_adam()


class _Data(NamedTuple):
    features: Float[np.ndarray, "n p f"]
    classes: Int[np.ndarray, " n"]
    dimensions: int


def trained_apart(
    symbols: Symbols, features: Float[Array, "n p f"], labels: Sequence[str], *, num_epochs: int = NUM_EPOCHS
) -> Symbols:
    """Models that separate the symbols of a set of strokes; transitions stay as they are.

    Args:
        symbols: Of `symbols.learn`, the start; of a single symbol they are returned as they are.
        features: Of `stroke.stacked`.
        labels: The symbol of each stroke.
        num_epochs: Passes over the strokes; more where that makes fewer than `FEWEST_STEPS` steps.

    Raises:
        ValueError: If a label is none of the symbols', or there are not as many labels as strokes.
    """
    if len(labels) != len(features) or not set(labels) <= set(symbols.names):
        raise ValueError(
            f"labels must name a symbol for each of {len(features)} strokes; got {len(labels)} of "
            f"{sorted(set(labels) - set(symbols.names))} beside known ones."
        )
    if len(symbols.names) < 2:
        return symbols
    classes = np.array([symbols.names.index(label) for label in labels])
    data = _Data(np.asarray(features), classes, (features.shape[-1] - 2) // 3)
    batch = min(BATCH, len(features))
    num_batches = len(features) // batch
    num_epochs = max(num_epochs, -(-FEWEST_STEPS // num_batches))
    emission: Any = symbols.models.emission
    params = (emission.mean, jnp.log(emission.variance))
    decay = optax.cosine_decay_schedule(LEARNING_RATE, num_epochs * num_batches)
    state, rng = _ADAM.init(params), np.random.default_rng(0)
    owner = np.asarray(symbols.owner)
    for epoch in range(num_epochs):
        if epoch % REFRESH_EPOCHS == 0:
            rivals = _rivals(_with(symbols, params), data)
        order = rng.permutation(len(features))
        for i in range(num_batches):
            step = epoch * num_batches + i
            own = order[i * batch : (i + 1) * batch]
            shown = jnp.asarray(data.features[own])
            if step % 2:
                shown = distorted(shown, jnp.asarray(distortions(rng, len(own), data.dimensions), shown.dtype))
            is_own = owner[rivals[own]] == classes[own, None]
            params, state = _step(_with(symbols, params), state, shown, rivals[own], is_own, decay(step))
    return _with(symbols, params)


def distortions(rng: np.random.Generator, num_strokes: int, dimensions: int) -> Float[np.ndarray, "n d d"]:
    """Random matrices: a turn and a stretch for each stroke."""
    shape = (num_strokes, dimensions, dimensions)
    upper = np.triu(TURN_RAD * rng.normal(size=shape), 1)
    return expm(upper - np.swapaxes(upper, 1, 2)) @ (np.eye(dimensions) + STRETCH * rng.normal(size=shape))


@jax.jit
def distorted(features: Float[Array, "n p f"], change: Float[Array, "n d d"]) -> Float[Array, "n p f"]:
    """Features of strokes whose points went through a linear map each, as if other people had drawn them."""
    dimensions = change.shape[-1]
    # Features of the shape do not depend on place and size, so that positions among them stand for the points.
    points = jnp.einsum("npd,ned->npe", features[..., :dimensions], change, precision="highest")
    return jnp.concatenate([jax.vmap(shape_features)(points), features[..., 3 * dimensions :]], axis=-1)


def _with(symbols: Symbols, params: tuple[Array, Array]) -> Symbols:
    emission: Any = symbols.models.emission
    floor = LEAST_SHARE * emission.min_variance
    changed = replace(emission, mean=params[0], variance=jnp.maximum(jnp.exp(params[1]), floor))
    return replace(symbols, models=replace(symbols.models, emission=changed))


def _rivals(symbols: Symbols, data: _Data) -> Int[np.ndarray, "n c"]:
    """For every stroke the models of its own symbol, and those of others, that explain it best."""
    owner = np.asarray(symbols.owner)
    num_own = min(NUM_OWN, int(np.bincount(owner).min()))
    num_rivals = min(NUM_RIVALS, len(owner) - int(np.bincount(owner).max()))
    found = []
    for i in range(0, len(data.features), CHUNK):
        part = data.features[i : i + CHUNK]
        filled = np.pad(part, ((0, CHUNK - len(part)), (0, 0), (0, 0)))
        scores = np.asarray(_scores(symbols, jnp.asarray(filled)))[: len(part)]
        is_own = owner == data.classes[i : i + CHUNK, None]
        own = np.argsort(np.where(is_own, -scores, np.inf), axis=1, kind="stable")[:, :num_own]
        others = np.argsort(np.where(is_own, np.inf, -scores), axis=1, kind="stable")[:, :num_rivals]
        found.append(np.concatenate([own, others], axis=1))
    return np.concatenate(found)


@jax.jit
def _scores(symbols: Symbols, features: Float[Array, "n p f"]) -> Float[Array, "n m"]:
    observations = jnp.moveaxis(features, 0, -1)
    one = lambda model: hmm.log_evidence(model, jax.vmap(model.log_likelihoods, -1, -1)(observations))
    return jax.lax.map(one, symbols.models).T


@jax.jit
def _step(symbols, state, features, rivals, is_own, rate):
    emission = symbols.models.emission
    params = (emission.mean, jnp.log(emission.variance))

    def loss(params: tuple[Array, Array]) -> Array:
        models = _with(symbols, params).models

        def evidence(own: Array, index: Array) -> Array:
            model = jax.tree.map(lambda leaf: leaf[index], models)
            return hmm.log_evidence(model, model.log_likelihoods(own))

        scores = SHARPNESS * jax.vmap(jax.vmap(evidence, (None, 0)))(features, rivals)
        right = jax.nn.logsumexp(jnp.where(is_own, scores, -jnp.inf), axis=1)
        return jnp.mean(jax.nn.logsumexp(scores, axis=1) - right)

    changes, state = _ADAM.update(jax.grad(loss)(params), state)
    return jax.tree.map(lambda value, change: value - rate * change, params, changes), state
