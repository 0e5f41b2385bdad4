"""A check that constrained quantities are constant in time, where the model of the filter is known."""

from typing import Any

import jax
import numpy as np

from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.constraints.linear import LinearConstraints
from jaxfilters.gaussian.extended import ExtendedKalman
from jaxfilters.gaussian.linear import Kalman
from jaxfilters.gaussian.noise_models import NonAdditiveNoise


def check_constant(inner: Filter, constraints: LinearConstraints, lasting: Any) -> None:
    """Reject rows that are declared lasting although their values move.

    A row moves where the process noise has variance along its normal, or where the transition changes its value. The
    transition is evaluated at the mean of the prior and one standard deviation away from it. Nothing is checked for
    filters of another kind, on manifolds, where values are not known yet, and where a transition needs inputs.

    Args:
        inner: The filter of the state.
        constraints: k rows.
        lasting: (k,), True for rows that are declared constant in time.

    Raises:
        ValueError: A row moves; the message names the row and the reason.
    """
    model = inner.params
    if not isinstance(model, ExtendedKalman | Kalman) or not model.manifold.flat:
        return
    known = known_values((constraints.normals, lasting))
    if known is None or not known[1].any():
        return
    normals, names = known[0][known[1]], np.asarray(constraints.names)[known[1]]
    additive = not isinstance(model.transition, NonAdditiveNoise)
    noise = known_values(model.process_noise) if additive and hasattr(model.process_noise, "shape") else None
    if noise is not None and noise.shape[:1] == normals.shape[1:]:
        _refuse_moving(names, *_noise_along(model.prior, normals, noise))
    _refuse_moving(names, *_transition_along(model, normals))


def _noise_along(prior, normals, noise):
    """Standard deviations of the process noise along the normals, and what would be rounding."""
    if isinstance(prior, Gaussian):
        along = np.sqrt(np.maximum(np.sum(normals @ noise * normals, axis=1), 0.0))
        scales = np.sqrt(np.maximum(np.diagonal(noise), 0.0))
    else:
        along, scales = np.linalg.norm(normals @ noise, axis=1), np.linalg.norm(noise, axis=1)
    return along, 1e-3 * abs(normals) @ scales, "process_noise has the standard deviation {:g} along its normal"


def _transition_along(model, normals):
    """Changes of the values by the transition, and what would be rounding."""
    message = "transition changes its value by {:g}"
    with jax.ensure_compile_time_eval():
        belief = known_values(model.prior)
        if belief is None:
            return None, None, message
        mean = belief.mean
        variance = np.diagonal(belief.covariance) if isinstance(belief, Gaussian) else np.sum(belief.root**2, axis=1)
        points = [mean, mean + np.sqrt(np.maximum(variance, 0.0))]
        try:
            moved = known_values([model.transition(jax.numpy.asarray(x, mean.dtype), None) for x in points])
        except Exception:  # A transition that needs inputs, or another one that only the filter can call.
            return None, None, message
    if moved is None or any(np.shape(y) != mean.shape for y in moved):
        return None, None, message
    changes = np.max([abs(normals @ (y - x)) for x, y in zip(points, moved, strict=True)], axis=0)
    return changes, 1e-4 * abs(normals) @ (abs(points[0]) + abs(points[1])), message


def _refuse_moving(names, change, rounding, reason):
    if change is None or not (change > rounding).any():
        return
    k = int(np.argmax(change > rounding))
    raise ValueError(
        f"lasting: {names[k]} is declared constant in time, but {reason.format(change[k])}. Expected False for a row "
        "on a quantity that moves; its sites then start anew in each step."
    )


def known_values(tree: Any) -> Any:
    """The arrays of a pytree as NumPy arrays, or None where one of them is traced."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree)):
        return None
    return jax.tree.map(np.asarray, tree)
