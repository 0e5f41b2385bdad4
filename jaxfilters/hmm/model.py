"""Hidden Markov models: their parameters, common topologies, and sampling."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.hmm.emissions import Emission, check_values
from jaxfilters.typing import AnyKey, only_inputs


@pytree_dataclass
class HiddenMarkovModel:
    """A Markov chain of Q hidden states with an emission distribution for each of them.

    Probabilities are logarithms; `from_probabilities` makes a model from probabilities.

    Examples:
        A coin that is fair, or always shows heads (code 0).

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> emission = jf.hmm.Codes(jnp.log(jnp.array([[0.5, 0.5], [1.0, 0.0]])))
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.1, 0.9]], emission)
        >>> print(np.exp(model.log_likelihoods(jnp.array([0, 1]))).round(2))
        [[0.5 1. ]
         [0.5 0. ]]
    """

    log_initial: Float[Array, "..."]
    """(Q,): log p(s_1), for the state in the first frame."""
    log_transition: Any
    """(Q, Q): log p(s_t+1 = j | s_t = i) at [i, j]; `-inf` for a transition that is ruled out, also in training.
    (T - 1, Q, Q) where it changes with time: element t leads from frame t to frame t + 1. A function of the inputs of a
    step for `jf.hmm.online`, and for `with_inputs`, which evaluates it for a whole sequence."""
    emission: Emission | None = None
    """p(y | s); `None` if log-likelihoods (T, Q) come from another source."""

    def with_inputs(self, inputs: PyTree) -> "HiddenMarkovModel":
        """The model of one sequence whose transitions depend on known inputs.

        Args:
            inputs: Inputs of the T frames, leaves with time first, as for `jf.run`: those of a frame belong to the
                transition to it, and those of the first frame to none.

        Returns:
            The model with `log_transition` (T - 1, Q, Q).

        Raises:
            ValueError: If `log_transition` is no function; if the leaves of `inputs` do not share one length; if the
                function returns another shape than (Q, Q), or rows that do not sum to 1 where they are known.

        Examples:
            >>> import jax.numpy as jnp
            >>> import numpy as np
            >>> import jaxfilters as jf
            >>> stay = lambda u: jnp.array([[u, 1 - u], [1 - u, u]])
            >>> model = jf.hmm.from_probabilities([0.5, 0.5], stay).with_inputs(jnp.array([0.9, 0.8, 0.7]))
            >>> print(np.exp(model.log_transition[:, 0, 0]).round(2))
            [0.8 0.7]
        """
        if not callable(self.log_transition):
            raise ValueError("model must have a function of the inputs for its transitions; it has an array.")
        lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(inputs)}
        if len(lengths) != 1 or () in lengths:
            raise ValueError(f"inputs must have leaves that share one length, time first; got {sorted(lengths)}.")
        found = jax.vmap(self.transition_of)(jax.tree.map(lambda leaf: leaf[1:], inputs))
        if not isinstance(found, jax.core.Tracer) and found.size:
            _check_probabilities("transition", np.exp(np.asarray(found, float)).reshape(-1, found.shape[-1]))
        return replace(self, log_transition=found)

    def transition_of(self, inputs: PyTree) -> Float[Array, "q q"]:
        """Log transition probabilities (Q, Q) of one step."""
        if not callable(self.log_transition):
            array: Array = self.log_transition
            return array
        found: Array = self.log_transition(inputs)
        if jnp.shape(found) != self.log_initial.shape * 2:
            raise ValueError(
                f"the transition function must return {self.log_initial.shape * 2}, (Q, Q); got {jnp.shape(found)}."
            )
        return found

    def log_likelihoods(self, observations: PyTree, mask: Bool[Array, " t"] | None = None) -> Float[Array, "t q"]:
        """Log p(y_t | s_t) of every frame and state of one sequence.

        For n sequences along the last axis: `jax.vmap(model.log_likelihoods, -1, -1)(observations)`.

        Args:
            observations: Pytree whose leaves have time as their first axis.
            mask: `False` for frames without an observation: their log-likelihood is 0 in every state.

        Returns:
            (T, Q); NaN and codes out of range have `-inf` where they are not known before compilation.

        Raises:
            ValueError: If there is no emission, shapes do not match, or a value is NaN or a code out of range.
            TypeError: If codes are not integers.
        """
        check_model(self)
        if self.emission is None:
            raise ValueError("model has no emission: pass log-likelihoods (T, Q) to the recursions instead.")
        lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves((observations, mask))}
        if len(lengths) != 1 or () in lengths:
            raise ValueError(
                f"observations and mask must share one length along their first axis, time; got {sorted(lengths)}."
            )
        if not isinstance(mask, jax.core.Tracer):
            observed = np.ones(lengths.pop(), bool) if mask is None else np.asarray(mask)
            check_values(self.emission, observations, observed)
        if mask is not None:
            # Missing observations are often NaN, and NaN times zero would make gradients NaN.
            fill = lambda leaf: jnp.where(mask.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, jnp.zeros_like(leaf))
            observations = jax.tree.map(fill, observations)
        found = jax.vmap(self.emission.log_likelihood)(observations)
        if found.shape[1:] != self.log_initial.shape:
            raise ValueError(
                f"emission must have the {self.log_initial.shape[0]} states of log_initial; it gives log-likelihoods "
                f"{found.shape}, expected (T, {self.log_initial.shape[0]})."
            )
        return found if mask is None else jnp.where(mask[:, None], found, 0.0)


def check_model(model: HiddenMarkovModel, num_frames: int | None = None) -> None:
    """Reject parameters whose shapes do not match, at trace time.

    Args:
        model: The model.
        num_frames: Length T of the sequence where transitions may change with time; `None` where they may not.

    Raises:
        ValueError: If `log_initial` is not (Q,), or `log_transition` is neither (Q, Q) nor, where it may be,
            (T - 1, Q, Q).
    """
    if callable(model.log_transition):
        raise ValueError(
            "log_transition must be an array here; got a function of the inputs: pass model.with_inputs(inputs)."
        )
    shapes = jnp.shape(model.log_initial), jnp.shape(model.log_transition)
    square = shapes[0] * 2
    if num_frames and len(shapes[0]) == 1 and shapes[1] == (num_frames - 1, *square):
        return
    if len(shapes[0]) != 1 or shapes[1] != square:
        varying = "" if not num_frames else f" (or {(num_frames - 1, *square)}, one for each step)"
        raise ValueError(
            f"log_initial and log_transition must be (Q,) and (Q, Q){varying}; got {shapes[0]} and {shapes[1]}."
        )


def of_each_frame(log_transition: Float[Array, "..."], *, after: bool) -> Float[Array, "t q q"] | None:
    """The transitions from each frame (`after`), or to each frame; None where all are the same.

    That from the last frame, or to the first, is one of certainty to stay, and stands for none.
    """
    if jnp.ndim(log_transition) == 2:
        return None
    size = log_transition.shape[-1]
    none = jnp.log(jnp.eye(size, dtype=log_transition.dtype))[None]
    parts = (log_transition, none) if after else (none, log_transition)
    return jnp.concatenate(parts)


def from_probabilities(initial: Any, transition: Any, emission: Emission | None = None) -> HiddenMarkovModel:
    """A model from probabilities rather than their logarithms.

    Args:
        initial: (Q,): p(s_1), summing to 1.
        transition: (Q, Q): p(s_t+1 = j | s_t = i) at [i, j]; every row sums to 1. Or (T - 1, Q, Q), one for each step
            of a sequence of T frames; or a function `inputs -> (Q, Q)` of the known inputs of a step, for
            `jf.hmm.online` and `HiddenMarkovModel.with_inputs`.
        emission: p(y | s) of the Q states.

    Raises:
        ValueError: If shapes do not match, a number is not a probability, or a sum differs from 1 by more than 1e-4.
        TypeError: If a function takes other arguments than the inputs.

    Examples:
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]])
        >>> model.log_transition.shape
        (2, 2)
    """
    initial = np.asarray(initial, float)
    steps = np.zeros((0, 0)) if callable(transition) else np.asarray(transition, float)
    shape = (len(initial), len(initial)) if initial.ndim == 1 else ()
    if initial.ndim != 1 or not len(initial) or (not callable(transition) and steps.shape[-2:] != shape):
        raise ValueError(
            f"initial and transition must be (Q,) and (Q, Q), Q > 0; got {initial.shape} and {steps.shape}."
        )
    if steps.ndim > 3:
        raise ValueError(f"transition must be (Q, Q), or (T - 1, Q, Q) for each step; got {steps.shape}.")
    _check_probabilities("initial", initial[None])
    _check_num_states(emission, len(initial))
    with np.errstate(divide="ignore"):
        log_initial = jnp.asarray(np.log(initial), dtype=float)
    if callable(transition):
        return HiddenMarkovModel(log_initial, _LogOf(only_inputs("transition", transition)), emission)
    _check_probabilities("transition", steps.reshape(-1, len(initial)))
    with np.errstate(divide="ignore"):
        return HiddenMarkovModel(log_initial, jnp.asarray(np.log(steps), dtype=float), emission)


@pytree_dataclass
class _LogOf:
    """Logarithm of the probabilities that a function of the inputs gives."""

    transition: Callable

    def __call__(self, inputs: PyTree) -> Array:
        found = self.transition(inputs)
        positive = found > 0
        # The derivative of a probability of zero is zero, not infinite.
        return jnp.where(positive, jnp.log(jnp.where(positive, found, 1.0)), jnp.where(found < 0, jnp.nan, -jnp.inf))


def from_topology(
    allowed: Bool[np.ndarray, "q q"],
    emission: Emission | None = None,
    *,
    initial: Bool[np.ndarray, " q"] | None = None,
) -> HiddenMarkovModel:
    """A model in which all allowed transitions of a state, and all allowed initial states, are equally probable.

    Args:
        allowed: (Q, Q): whether there is a transition from i to j, for example `left_right(8)`.
        emission: p(y | s) of the Q states.
        initial: (Q,): states in which the chain may start; `None` allows all of them.

    Raises:
        ValueError: If shapes do not match, a state has no transition, or there is no initial state.

    Examples:
        >>> import numpy as np
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_topology(jf.hmm.left_right(2), initial=jf.hmm.left_right_initial(2))
        >>> print(np.exp(model.log_transition).round(2))
        [[0.5 0.5]
         [0.  1. ]]
    """
    allowed = np.asarray(allowed, bool)
    starts = np.ones(len(allowed), bool) if initial is None else np.asarray(initial, bool)
    if allowed.shape != (len(allowed), len(allowed)) or starts.shape != (len(allowed),):
        raise ValueError(f"allowed and initial must be (Q, Q) and (Q,); got {allowed.shape} and {starts.shape}.")
    if not np.all(np.any(allowed, axis=1)) or not np.any(starts):
        raise ValueError(f"allowed must have a transition in every row, and initial a state; got {allowed}, {starts}.")
    return from_probabilities(starts / starts.sum(), allowed / np.sum(allowed, axis=1, keepdims=True), emission)


def left_right(num_states: int, *, max_jump: int = 2) -> Bool[np.ndarray, "q q"]:
    """The left-right (Bakis) topology: transitions to the same state and to the next `max_jump` states.

    See L. Rabiner, "A tutorial on hidden Markov models", Proc. IEEE 77(2), 1989, section IV.B.

    Returns:
        (Q, Q), for `from_topology`.

    Raises:
        ValueError: If `num_states` or `max_jump` is less than 1.

    Examples:
        >>> import jaxfilters as jf
        >>> print(jf.hmm.left_right(3, max_jump=1).astype(int))
        [[1 1 0]
         [0 1 1]
         [0 0 1]]
    """
    if num_states < 1 or max_jump < 1:
        raise ValueError(f"num_states and max_jump must be at least 1; got {num_states} and {max_jump}.")
    ahead = np.arange(num_states) - np.arange(num_states)[:, None]
    return (ahead >= 0) & (ahead <= max_jump)


def ergodic(num_states: int) -> Bool[np.ndarray, "q q"]:
    """The ergodic topology: transitions from every state to every state.

    Returns:
        (Q, Q), for `from_topology`.

    Raises:
        ValueError: If `num_states` is less than 1.

    Examples:
        >>> import jaxfilters as jf
        >>> bool(jf.hmm.ergodic(3).all())
        True
    """
    if num_states < 1:
        raise ValueError(f"num_states must be at least 1; got {num_states}.")
    return np.ones((num_states, num_states), bool)


def left_right_initial(num_states: int) -> Bool[np.ndarray, " q"]:
    """The initial states of a left-right model, (Q,) for `from_topology`: state 0 only.

    Examples:
        >>> import jaxfilters as jf
        >>> print(jf.hmm.left_right_initial(3))
        [ True False False]
    """
    return np.arange(num_states) == 0


@partial(jax.jit, static_argnames="num_frames")
def sample(key: AnyKey, model: HiddenMarkovModel, num_frames: int) -> tuple[Int32[Array, " t"], PyTree]:
    """A sample of the states and observations of one sequence.

    Args:
        key: Random key.
        model: The model.
        num_frames: Length T of the sequence.

    Returns:
        States (T,) and observations, leaves with time first; `None` without an emission.

    Examples:
        A chain that starts in state 0 and always changes its state.

        >>> import jax
        >>> import jaxfilters as jf
        >>> model = jf.hmm.from_probabilities([1.0, 0.0], [[0.0, 1.0], [1.0, 0.0]])
        >>> states, _ = jf.hmm.sample(jax.random.key(0), model, 4)
        >>> print(states)
        [0 1 0 1]
    """
    check_model(model, num_frames)
    state_key, emission_key = jax.random.split(key)

    def step(state: Array, frame: tuple[AnyKey, Array | None]) -> tuple[Array, Array]:
        step_key, log_transition = frame
        log_transition = model.log_transition if log_transition is None else log_transition
        following = jax.random.categorical(step_key, log_transition[state]).astype(jnp.int32)
        return following, state

    keys = jax.random.split(state_key, num_frames + 1)
    first = jax.random.categorical(keys[0], model.log_initial).astype(jnp.int32)
    # The state that follows the last frame is drawn, and not used.
    _, states = jax.lax.scan(step, first, (keys[1:], of_each_frame(model.log_transition, after=True)))
    if model.emission is None:
        return states, None
    return states, jax.vmap(model.emission.sample)(jax.random.split(emission_key, num_frames), states)


def _check_probabilities(name: str, rows: np.ndarray) -> None:
    sums = rows.sum(axis=-1)
    wrong = np.flatnonzero(~(np.all(rows >= 0, axis=-1) & (abs(sums - 1) < 1e-4)))
    if not len(wrong):
        return
    if name == "initial":
        raise ValueError(f"initial must be probabilities that sum to 1; got {rows[0]} with the sum {sums[0]:g}.")
    columns = rows.shape[0] > 1 and np.all(abs(rows.sum(axis=0) - 1) < 1e-4)
    hint = " Its columns (axis 0) sum to 1: pass its transpose." if columns else ""
    raise ValueError(
        f"transition must be probabilities whose rows (axis 1) sum to 1; got row {wrong[0]}, {rows[wrong[0]]}, "
        f"with the sum {sums[wrong[0]]:g}.{hint}"
    )


def _check_num_states(emission: Emission | None, num_states: int) -> None:
    for leaf in jax.tree.leaves(emission):
        if jnp.shape(leaf)[:1] != (num_states,):
            raise ValueError(
                f"emission must have arrays whose first axis is that of the {num_states} states of initial; "
                f"got shape {jnp.shape(leaf)}."
            )
