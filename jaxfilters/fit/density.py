r"""Log densities to be maximised: log evidence of filters, priors, and what particle filters draw at every step.

A log density is a function `theta -> log p`. One that draws random numbers is `(key, theta) -> log p`, and becomes one
to be maximised by either of two choices: `common_random_numbers` or `fresh_keys`.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxfilters import filter as filters
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.extended import Observation
from jaxfilters.typing import AnyKey, as_pytree

LogDensity = Callable[[PyTree], Float[Array, ""]]
RandomLogDensity = Callable[[AnyKey, PyTree], Float[Array, ""]]


@pytree_dataclass
class CommonRandomNumbers:
    """A random log density with one key for all parameters."""

    key: AnyKey
    log_density: RandomLogDensity

    def __call__(self, theta: PyTree) -> Float[Array, ""]:
        return self.log_density(self.key, theta)


@pytree_dataclass
class FreshKeys:
    """A random log density with a new key at every step of the search."""

    key: AnyKey
    log_density: RandomLogDensity

    def __call__(self, theta: PyTree) -> Float[Array, ""]:
        return self.at(jnp.zeros((), jnp.int32), theta)

    def at(self, step: Int[Array, ""], theta: PyTree) -> Float[Array, ""]:
        """The log density with the key of a step."""
        return self.log_density(jax.random.fold_in(self.key, step), theta)


@pytree_dataclass
class WithPrior:
    """A log density and a log prior."""

    log_density: Callable
    log_prior: LogDensity

    def __call__(self, theta: PyTree) -> Float[Array, ""]:
        return self.at(jnp.zeros((), jnp.int32), theta)

    def at(self, step: Int[Array, ""], theta: PyTree) -> Float[Array, ""]:
        """Their sum, as seen at a step."""
        return at_step(self.log_density, step, theta) + self.log_prior(theta)


def common_random_numbers(key: AnyKey, log_density: RandomLogDensity) -> CommonRandomNumbers:
    """The log density with the same random numbers for all parameters: a search sees one function.

    For every method. A particle filter's estimate jumps where resampling chooses otherwise, and its maximum is that
    of one draw: take many particles.
    """
    return CommonRandomNumbers(key, as_pytree(log_density))


def fresh_keys(key: AnyKey, log_density: RandomLogDensity) -> FreshKeys:
    """The log density with new random numbers at every step, for first-order methods: no draw is fitted.

    The steps must be small enough to average the noise.
    """
    return FreshKeys(key, as_pytree(log_density))


def with_prior(log_density: Callable, log_prior: LogDensity) -> WithPrior:
    """Log posterior but for a constant: its maximum is the most probable `theta`, in the coordinates of `theta`."""
    return WithPrior(as_pytree(log_density), as_pytree(log_prior))


def is_noisy(log_density: Callable) -> bool:
    """Whether the log density changes from step to step."""
    if isinstance(log_density, WithPrior):
        return is_noisy(log_density.log_density)
    return isinstance(log_density, FreshKeys)


def at_step(log_density: Callable, step: Int[Array, ""], theta: PyTree) -> Float[Array, ""]:
    """The log density as seen at a step."""
    if isinstance(log_density, FreshKeys | WithPrior):
        return log_density.at(step, theta)
    return log_density(theta)


@pytree_dataclass
class LogEvidence:
    """Log evidence of a sequence, or the sum over several, as a function of the parameters."""

    filter_of: Callable[[PyTree], Filter]
    observations: PyTree
    controls: PyTree
    mask: Array | np.ndarray | None
    sequences: bool = field(default=False, metadata={"static": True})
    """Whether the leaves hold several sequences along their last axis."""

    def __call__(self, key: AnyKey, theta: PyTree) -> Float[Array, ""]:
        filter = self.filter_of(theta)

        def one(key: AnyKey, *data: PyTree) -> Float[Array, ""]:
            observations, controls, mask = data
            return filters.log_evidence(filter, key, observations, controls, mask=mask)

        data = (self.observations, self.controls, self.mask)
        if not self.sequences:
            return one(key, *data)
        count = jax.tree.leaves(self.observations)[0].shape[-1]
        return jnp.sum(jax.vmap(one, in_axes=(0, -1, -1, -1))(jax.random.split(key, count), *data))


def log_evidence(
    key: AnyKey,
    filter_of: Callable[[PyTree], Filter],
    observations: PyTree,
    controls: PyTree = None,
    *,
    mask: Array | np.ndarray | None = None,
    draws: Callable[[AnyKey, RandomLogDensity], Any] = common_random_numbers,
) -> Any:
    """Log evidence log p(y_1:T | theta) of one sequence, to be maximised.

    Args:
        key: Random key; deterministic filters ignore it.
        filter_of: `theta -> Filter`. Compared by identity: a function made anew compiles anew.
        observations: As for `jaxfilters.run`, time first.
        controls: As for `jaxfilters.run`.
        mask: `False` where a frame was not seen.
        draws: What a particle filter draws at each step of the search: `common_random_numbers` or `fresh_keys`.

    Raises:
        ValueError: If an observation is NaN and no mask says that it is missing.
    """
    check_observations(observations, mask)
    return draws(key, LogEvidence(as_pytree(filter_of), observations, controls, mask))


def over_sequences(
    key: AnyKey,
    filter_of: Callable[[PyTree], Filter],
    observations: PyTree,
    controls: PyTree = None,
    *,
    mask: Array | np.ndarray | None = None,
    draws: Callable[[AnyKey, RandomLogDensity], Any] = common_random_numbers,
) -> Any:
    """Log evidence of several sequences with the same parameters, to be maximised; arguments as `log_evidence`.

    Sequences lie along the last axis of every leaf, of the mask `(t, n)` and of the controls too, and are filtered
    together. Shorter ones are padded, and the padding masked: `jaxfilters.hmm.pad` does it.
    """
    check_observations(observations, mask)
    return draws(key, LogEvidence(as_pytree(filter_of), observations, controls, mask, sequences=True))


def check_observations(observations: PyTree, mask: Array | np.ndarray | None = None) -> None:
    """Reject NaN that nothing declares as missing; under `vmap` and `jit`, where values are not known, do nothing.

    Args:
        observations: Leaves with time first; of a `Measured`, the components that its own mask leaves out may be NaN.
        mask: `(t,)`, or `(t, n)` for sequences along the last axis: False where nothing was seen.

    Raises:
        ValueError: Naming the leaf and the first such frame.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((observations, mask))):
        return
    found = jax.tree_util.tree_leaves_with_path(observations, is_leaf=lambda node: isinstance(node, Observation))
    for path, leaf in found:
        y, own_mask = (leaf.y, leaf.mask) if isinstance(leaf, Observation) else (leaf, None)
        y = np.asarray(y)
        if not np.issubdtype(y.dtype, np.floating):
            continue
        missing = np.isnan(y)
        if own_mask is not None:
            missing = missing & np.asarray(own_mask)
        if mask is not None:
            seen = np.asarray(mask)
            missing = missing & seen.reshape(seen.shape[0], *[1] * (y.ndim - seen.ndim), *seen.shape[1:])
        if missing.any():
            name = f"observations{jax.tree_util.keystr(path)}"
            frame = int(np.argwhere(missing)[0, 0])
            raise ValueError(
                f"{name} must not be NaN where mask does not say that it is missing; got NaN in frame {frame}, "
                f"and in {int(missing.sum())} numbers altogether."
            )
