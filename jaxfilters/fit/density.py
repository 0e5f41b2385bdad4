r"""Log densities to maximise: the log evidence of a filter, priors, and the randomness of particle filters.

A log density is a function `theta -> log p`. A random one, such as the estimate of a particle filter, is a function
`(key, theta) -> log p`; `common_random_numbers` or `fresh_keys` turn it into a log density.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxfilters import filter as filters
from jaxfilters._renamed import takes_inputs
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.extended import Observation
from jaxfilters.typing import AnyKey, as_pytree

LogDensity = Callable[[PyTree], Float[Array, ""]]
RandomLogDensity = Callable[[AnyKey, PyTree], Float[Array, ""]]


@pytree_dataclass
class CommonRandomNumbers:
    """A random log density, evaluated with one key for all parameters."""

    key: AnyKey
    log_density: RandomLogDensity

    def __call__(self, theta: PyTree) -> Float[Array, ""]:
        return self.log_density(self.key, theta)


@pytree_dataclass
class FreshKeys:
    """A random log density, evaluated with a new key in every step of a search."""

    key: AnyKey
    log_density: RandomLogDensity

    def __call__(self, theta: PyTree) -> Float[Array, ""]:
        return self.at(jnp.zeros((), jnp.int32), theta)

    def at(self, step: Int[Array, ""], theta: PyTree) -> Float[Array, ""]:
        """The log density with the key of a step."""
        return self.log_density(jax.random.fold_in(self.key, step), theta)


@pytree_dataclass
class WithPrior:
    """The sum of a log density and a log prior."""

    log_density: Callable
    log_prior: LogDensity

    def __call__(self, theta: PyTree) -> Float[Array, ""]:
        return self.at(jnp.zeros((), jnp.int32), theta)

    def at(self, step: Int[Array, ""], theta: PyTree) -> Float[Array, ""]:
        """The sum with the random numbers of a step."""
        return at_step(self.log_density, step, theta) + self.log_prior(theta)


def common_random_numbers(key: AnyKey, log_density: RandomLogDensity) -> CommonRandomNumbers:
    """The log density with the same random numbers for all parameters, so that a search sees a fixed function.

    It suits every method. The estimate of a particle filter is discontinuous where resampling selects other particles,
    and its maximum is that of one realisation: use many particles.

    Args:
        key: Random key.
        log_density: `(key, theta) -> log p`.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> log_density = jf.fit.common_random_numbers(jax.random.key(0), lambda key, x: x + jax.random.normal(key))
        >>> round(float(log_density(3.0) - log_density(1.0)), 3)
        2.0
    """
    return CommonRandomNumbers(key, as_pytree(log_density))


def fresh_keys(key: AnyKey, log_density: RandomLogDensity) -> FreshKeys:
    """The log density with new random numbers in every step: stochastic approximation, for first-order methods.

    The learning rate must be small enough to average the noise (H. Robbins and S. Monro, "A stochastic approximation
    method", Annals of Mathematical Statistics 22, 1951).

    Args:
        key: Random key.
        log_density: `(key, theta) -> log p`.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> log_density = jf.fit.fresh_keys(jax.random.key(0), lambda key, x: x + jax.random.normal(key))
        >>> bool(log_density.at(jnp.array(0), 1.0) == log_density.at(jnp.array(1), 1.0))
        False
    """
    return FreshKeys(key, as_pytree(log_density))


def with_prior(log_density: Callable, log_prior: LogDensity) -> WithPrior:
    """The unnormalised log posterior: its maximum is the maximum a posteriori estimate of `theta`.

    Args:
        log_density: A log density, or what `common_random_numbers` or `fresh_keys` return.
        log_prior: `theta -> log p(theta)`, a density with respect to `theta` itself, not to its coordinates.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> log_posterior = jf.fit.with_prior(lambda x: -0.5 * (x - 4.0) ** 2, lambda x: -0.5 * x**2)
        >>> float(log_posterior(jnp.array(2.0)))
        -4.0
    """
    return WithPrior(as_pytree(log_density), as_pytree(log_prior))


def is_noisy(log_density: Callable) -> bool:
    """Whether the log density uses new random numbers in every step."""
    if isinstance(log_density, WithPrior):
        return is_noisy(log_density.log_density)
    return isinstance(log_density, FreshKeys)


def at_step(log_density: Callable, step: Int[Array, ""], theta: PyTree) -> Float[Array, ""]:
    """The log density with the random numbers of a step, if it uses any."""
    if isinstance(log_density, FreshKeys | WithPrior):
        return log_density.at(step, theta)
    return log_density(theta)


@pytree_dataclass
class LogEvidence:
    """The log evidence of a sequence, or its sum over several sequences, as a function of the parameters."""

    filter_of: Callable[[PyTree], Filter]
    observations: PyTree
    inputs: PyTree
    mask: Any
    sequences: bool = field(default=False, metadata={"static": True})
    """Whether the leaves hold several sequences along their last axis."""

    def __call__(self, key: AnyKey, theta: PyTree) -> Float[Array, ""]:
        filter = self.filter_of(theta)

        def one(key: AnyKey, *data: PyTree) -> Float[Array, ""]:
            observations, inputs, mask = data
            return filters.log_evidence(filter, key, observations, inputs, mask=mask)

        data = (self.observations, self.inputs, self.mask)
        if not self.sequences:
            return one(key, *data)
        count = jax.tree.leaves(self.observations)[0].shape[-1]
        return jnp.sum(jax.vmap(one, in_axes=(0, -1, -1, -1))(jax.random.split(key, count), *data))


@takes_inputs
def log_evidence(
    key: AnyKey,
    filter_of: Callable[[PyTree], Filter],
    observations: PyTree,
    inputs: PyTree = None,
    *,
    mask: Array | np.ndarray | None = None,
    draws: Callable[[AnyKey, RandomLogDensity], Any] = common_random_numbers,
) -> Any:
    """The marginal log-likelihood log p(y_1:T | theta) of one sequence as a function of theta, for `maximize`.

    NaN in the observations means what the filter takes it for, as in `jaxfilters.run`: a Gaussian filter treats it as
    a missing component, a particle filter's likelihood usually becomes NaN. `maximize` reports a log evidence that is
    not finite at the start.

    Args:
        key: Random key; deterministic filters ignore it.
        filter_of: `theta -> Filter`. Functions are compared by identity: a new function object compiles anew.
        observations: Pytree of arrays with time as their first axis, as for `jaxfilters.run`.
        inputs: Known inputs, time first, as for `jaxfilters.run`.
        mask: (T,), `False` for frames without an observation.
        draws: `common_random_numbers` or `fresh_keys`: the random numbers of a particle filter in a search.

    Returns:
        A callable pytree `theta -> log p(y_1:T | theta)`.

    Raises:
        ValueError: If `observations` has no array, or `observations`, `inputs` and `mask` differ in length.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> def filter_of(noise):
        ...     prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        ...     return jf.extended_kalman(prior, lambda x: x, jnp.eye(1), lambda x: x, noise**2 * jnp.eye(1))
        >>> log_density = jf.fit.log_evidence(jax.random.key(0), filter_of, jnp.zeros((10, 1)))
        >>> log_density(1.0).shape
        ()
    """
    _check_lengths(observations, inputs, mask)
    return draws(key, LogEvidence(as_pytree(filter_of), observations, inputs, mask))


@takes_inputs
def over_sequences(
    key: AnyKey,
    filter_of: Callable[[PyTree], Filter],
    observations: PyTree,
    inputs: PyTree = None,
    *,
    mask: Array | np.ndarray | None = None,
    draws: Callable[[AnyKey, RandomLogDensity], Any] = common_random_numbers,
) -> Any:
    """The marginal log-likelihood of n sequences that share their parameters: the sum of those of all sequences.

    Arguments are those of `log_evidence`, with the sequences along the last axis of every leaf of `observations` and
    `inputs` and of `mask` (T, n). Shorter sequences are padded, and the padding is masked: see `jaxfilters.hmm.pad`.

    Returns:
        A callable pytree `theta -> sum of log p(y_1:T | theta)`.

    Raises:
        ValueError: If `observations` has no array, or lengths or numbers of sequences differ.

    Examples:
        Two sequences of one frame, whose observation 0 has the mean 0 and the variance 1 + 1 + 1.

        >>> import jax, jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> def filter_of(noise):
        ...     prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        ...     return jf.extended_kalman(prior, lambda x: x, jnp.eye(1), lambda x: x, noise**2 * jnp.eye(1))
        >>> log_density = jf.fit.over_sequences(jax.random.key(0), filter_of, jnp.zeros((1, 1, 2)))
        >>> round(float(jax.jit(lambda noise: log_density(noise))(1.0)), 3)  # -log(2 pi 3)
        -2.936
    """
    _check_lengths(observations, inputs, mask)
    counts = {
        f"{name}{jax.tree_util.keystr(path)}": jnp.shape(leaf)
        for name, tree in (("observations", observations), ("inputs", inputs), ("mask", mask))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
    if any(len(shape) < 2 for shape in counts.values()) or len({shape[-1] for shape in counts.values()}) != 1:
        raise ValueError(
            f"observations, inputs and mask must share one number of sequences along their last axis, which is not "
            f"the axis of time; got shapes {counts}."
        )
    return draws(key, LogEvidence(as_pytree(filter_of), observations, inputs, mask, sequences=True))


def _check_lengths(observations: PyTree, inputs: PyTree, mask: Array | np.ndarray | None) -> None:
    shapes = {
        f"{name}{jax.tree_util.keystr(path)}": jnp.shape(leaf)
        for name, tree in (("observations", observations), ("inputs", inputs), ("mask", mask))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
    if not jax.tree.leaves(observations):
        raise ValueError("observations must have at least one array with time as its first axis; got none.")
    if () in shapes.values() or len({shape[0] for shape in shapes.values()}) != 1:
        raise ValueError(
            f"observations, inputs and mask must share one length along their first axis, time; got shapes {shapes}."
        )


def explain_not_finite(log_density: Callable, theta: PyTree) -> str:
    """Why a log density is not finite at `theta`: a clause for an error message, or '' if the cause is unknown."""
    if isinstance(log_density, WithPrior):
        prior = float(log_density.log_prior(theta))
        return (
            f"the log prior is {prior}"
            if not np.isfinite(prior)
            else explain_not_finite(log_density.log_density, theta)
        )
    if not isinstance(log_density, CommonRandomNumbers | FreshKeys):
        return ""
    evidence = log_density.log_density
    if not isinstance(evidence, LogEvidence):
        return ""
    undeclared = _undeclared_nan(evidence.observations, evidence.mask)
    if undeclared:
        return f"{undeclared}, which this filter does not treat as missing: pass mask"
    return f"the log evidence {_first_bad_frame(log_density.key, evidence, theta)}"


def _first_bad_frame(key: AnyKey, evidence: LogEvidence, theta: PyTree) -> str:
    if evidence.sequences:
        return "of at least one sequence is not finite: the parameters at the start may rule the observations out"
    run = filters.run(
        evidence.filter_of(theta),
        key,
        evidence.observations,
        evidence.inputs,
        mask=evidence.mask,
        collect=filters.keep_info,
    )
    per_frame = np.asarray(run[1].log_evidence)
    frames = np.flatnonzero(~np.isfinite(per_frame))
    if not len(frames):
        return "is not finite with the random numbers of the search, but is with others"
    return f"of frame {frames[0]} is {per_frame[frames[0]]}: the parameters at the start may rule the observation out"


def _undeclared_nan(observations: PyTree, mask: Array | np.ndarray | None) -> str:
    """Names the first NaN that no mask marks as missing, e.g. "observations['y'] is NaN in frame 3"; '' if none."""
    found = jax.tree_util.tree_leaves_with_path(observations, is_leaf=lambda node: isinstance(node, Observation))
    for path, leaf in found:
        y, own_mask = (leaf.y, leaf.mask) if isinstance(leaf, Observation) else (leaf, None)
        y = np.asarray(y)
        if not np.issubdtype(y.dtype, np.floating):
            continue
        undeclared = np.isnan(y)
        if own_mask is not None:
            undeclared = undeclared & np.asarray(own_mask)
        if mask is not None:
            observed = np.asarray(mask)
            shape = (observed.shape[0], *[1] * (y.ndim - observed.ndim), *observed.shape[1:])
            undeclared = undeclared & observed.reshape(shape)
        if undeclared.any():
            name, frame = f"observations{jax.tree_util.keystr(path)}", int(np.argwhere(undeclared)[0, 0])
            return f"{name} is NaN in frame {frame} ({int(undeclared.sum())} NaN in all)"
    return ""
