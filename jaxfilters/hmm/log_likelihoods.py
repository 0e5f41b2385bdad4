"""The input that all recursions share, log-likelihoods (T, Q) or (T, Q, n): checks of shapes, padding and NaN."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxfilters.hmm.model import HiddenMarkovModel, check_model

Lengths = Int[Array, "*batch"] | None
"""Numbers of frames of the sequences; `None` if all have T."""


def check_shapes(model: HiddenMarkovModel, log_likelihoods: Array, lengths: Array | None) -> None:
    """Reject shapes that do not match, at trace time."""
    shape = jnp.shape(log_likelihoods)
    check_model(model, shape[0] if shape else None)
    num_states = model.log_initial.shape[0]
    if len(shape) < 2 or shape[1] != num_states:
        raise ValueError(
            f"log_likelihoods must be (T, Q) or (T, Q, n) with the {num_states} states of the model; got {shape}."
        )
    if lengths is None:
        return
    if jnp.shape(lengths) != shape[2:] or not jnp.issubdtype(jnp.result_type(lengths), jnp.integer):
        raise ValueError(
            f"lengths must be integers {shape[2:]}, one for each sequence of log_likelihoods {shape}; "
            f"got {jnp.result_type(lengths)} {jnp.shape(lengths)}."
        )


def usable(log_likelihoods: Array) -> Array:
    """The log-likelihoods without NaN and infinity: NaN counts as `-inf`."""
    return jnp.where(
        jnp.isnan(log_likelihoods), -jnp.inf, jnp.minimum(log_likelihoods, jnp.finfo(log_likelihoods.dtype).max)
    )


def inside_sequences(log_likelihoods: Array, lengths: Array | None) -> Bool[Array, "t *batch"]:
    """Whether each frame of each sequence is before its end."""
    num_frames, batch = len(log_likelihoods), log_likelihoods.shape[2:]
    if lengths is None:
        return jnp.ones((num_frames, *batch), bool)
    frames = jnp.arange(num_frames).reshape(-1, *[1] * len(batch))
    return jnp.broadcast_to(frames < lengths, (num_frames, *batch))


def as_column(log_initial: Array, log_likelihoods: Array) -> Array:
    """The initial log probabilities with one further axis for each axis of sequences."""
    return log_initial.reshape(-1, *[1] * (log_likelihoods.ndim - 2))
