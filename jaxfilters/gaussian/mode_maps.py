"""Maps between the states of models of different size, for filters that switch between them, such as `jf.imm`.

A point that moves at constant velocity has no acceleration in its state, and one that accelerates has. When the mode
changes, a belief about one state has to become one about the other. The maps take a belief (`Gaussian` or
`GaussianRoot`) and return one of the same kind.
"""

from collections.abc import Callable, Sequence
from dataclasses import field
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.math import linalg
from jaxfilters.typing import as_pytree


@runtime_checkable
class ModeMaps(Protocol):
    """How beliefs about the state of one mode become beliefs about that of another, and about a common state."""

    def convert(self, source: int, target: int, belief: Belief, /) -> Belief: ...

    def to_common(self, source: int, belief: Belief, /) -> Belief: ...


@pytree_dataclass
class CommonSpace:
    """Maps through one common state; made by `common_space` and `components`.

    Examples:
        Metres are common; the second mode measures in kilometres.

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> scaled = lambda s: lambda belief: jf.Gaussian(s * belief.mean, s * s * belief.covariance)
        >>> maps = jf.mode_maps.common_space([scaled(1.0), scaled(1e3)], [scaled(1.0), scaled(1e-3)])
        >>> maps.to_common(1, jf.Gaussian(jnp.array([2.0]), jnp.eye(1))).mean.tolist()
        [2000.0]
    """

    to: tuple[Callable[[Belief], Belief], ...]
    back: tuple[Callable[[Belief], Belief], ...]

    def convert(self, source: int, target: int, belief: Belief) -> Belief:
        """Belief about the state of mode `target`, given that about the state of mode `source`."""
        return belief if source == target else _square(self.back[target](self.to[source](belief)))

    def to_common(self, source: int, belief: Belief) -> Belief:
        """Belief about the common state, given that about the state of mode `source`."""
        return _square(self.to[source](belief))


@pytree_dataclass
class Pairwise:
    """Maps from each mode to each other; made by `pairwise`.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> shifted = lambda source, target, belief: jf.Gaussian(belief.mean + target - source, belief.covariance)
        >>> maps = jf.mode_maps.pairwise(shifted)
        >>> maps.convert(0, 1, jf.Gaussian(jnp.array([5.0]), jnp.eye(1))).mean.tolist()
        [6.0]
    """

    function: Callable[[int, int, Belief], Belief]
    common: int = field(metadata={"static": True})

    def convert(self, source: int, target: int, belief: Belief) -> Belief:
        """Belief about the state of mode `target`, given that about the state of mode `source`."""
        return belief if source == target else _square(self.function(source, target, belief))

    def to_common(self, source: int, belief: Belief) -> Belief:
        """Belief about the state of the mode that is the common one."""
        return self.convert(source, self.common, belief)


def common_space(to: Sequence[Callable[[Any], Any]], back: Sequence[Callable[[Any], Any]]) -> CommonSpace:
    """Maps to a state that all modes have in common, and back.

    Args:
        to: For each mode a function from a belief about its state to one about the common state.
        back: For each mode a function from a belief about the common state to one about its state. A belief that
            stays in its mode takes no map.

    Returns:
        The maps, for the argument `maps` of `jf.imm`.

    Raises:
        ValueError: If there are not as many functions back as to, or none.
        TypeError: If one of them is no function.

    Examples:
        The second mode measures in kilometres what the first measures in metres.

        >>> import jaxfilters as jf
        >>> scaled = lambda s: lambda belief: jf.Gaussian(s * belief.mean, s * s * belief.covariance)
        >>> maps = jf.mode_maps.common_space([scaled(1.0), scaled(1e3)], [scaled(1.0), scaled(1e-3)])
    """
    if len(to) != len(back) or not to:
        raise ValueError(f"to and back must hold one function for each mode; got {len(to)} and {len(back)}.")
    for name, functions in (("to", to), ("back", back)):
        for i, function in enumerate(functions):
            checks.function(f"{name}[{i}]", function)
    return CommonSpace(tuple(map(as_pytree, to)), tuple(map(as_pytree, back)))


def pairwise(function: Callable[[int, int, Any], Any], *, common: int = 0) -> Pairwise:
    """Maps from the state of each mode to that of each other.

    Args:
        function: `(source, target, belief) -> belief` about the state of mode `target`; the modes are Python integers.
        common: Mode in whose state the combined belief is expressed.

    Returns:
        The maps, for the argument `maps` of `jf.imm`.

    Raises:
        TypeError: If `function` is no function.
        ValueError: If `common` is negative or no integer.

    Examples:
        >>> import jaxfilters as jf
        >>> def between(source, target, belief):
        ...     factor = (1e3, 1e-3)[source < target]
        ...     return jf.Gaussian(factor * belief.mean, factor**2 * belief.covariance)
        >>> maps = jf.mode_maps.pairwise(between)
    """
    checks.function("function", function)
    if not isinstance(common, int) or common < 0:
        raise ValueError(f"common must be the number of a mode, from 0; got {common!r}.")
    return Pairwise(as_pytree(function), common)


def components(indices: Sequence[Sequence[int]], fill: Gaussian | GaussianRoot) -> CommonSpace:
    """Maps between states that are components of one common state.

    A component that a mode lacks is taken from `fill` when the mode changes, independent of the others: zero with a
    large variance lets the next observations determine it.

    Args:
        indices: For each mode the components of the common state, in the order of its own state.
        fill: Belief about the common state from which missing components are taken, with a mean (n,): a `Gaussian`,
            or a `GaussianRoot` for filters with `jf.arithmetic.square_root`.

    Returns:
        The maps, for the argument `maps` of `jf.imm`.

    Raises:
        ValueError: If an index is repeated or outside the state of `fill`, or `fill` is no possible belief.
        TypeError: If `fill` is of another kind.

    Examples:
        Place and velocity in the first mode; place, velocity and acceleration in the second.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> fill = jf.Gaussian(jnp.zeros(3), jnp.diag(jnp.array([1.0, 1.0, 4.0])))
        >>> maps = jf.mode_maps.components([[0, 1], [0, 1, 2]], fill)
        >>> maps.convert(0, 1, jf.Gaussian(jnp.ones(2), jnp.eye(2))).covariance.diagonal().tolist()
        [1.0, 1.0, 4.0]
    """
    if not isinstance(fill, Gaussian | GaussianRoot):
        raise TypeError(f"fill must be a Gaussian or a GaussianRoot; got a {type(fill).__name__}.")
    checks.belief("fill", fill, type(fill))
    size = fill.mean.size
    rows = [tuple(map(int, of)) for of in indices]
    for i, row in enumerate(rows):
        if len(set(row)) != len(row) or not row or min(row) < 0 or max(row) >= size:
            raise ValueError(f"indices[{i}] must be different components from 0 to {size - 1}; got {list(row)}.")
    to = [jax.tree_util.Partial(partial(_embedded, row), fill) for row in rows]
    return common_space(to, [jax.tree_util.Partial(partial(_picked, row)) for row in rows])


def _embedded(row: tuple[int, ...], fill: Belief, belief: Belief) -> Belief:
    known = np.asarray(row)
    rest = np.setdiff1d(np.arange(fill.mean.size), known)
    mean = fill.mean.at[known].set(belief.mean)
    if isinstance(fill, Gaussian) and isinstance(belief, Gaussian):
        blocks = jnp.zeros_like(fill.covariance).at[np.ix_(rest, rest)].set(fill.covariance[np.ix_(rest, rest)])
        return Gaussian(mean, blocks.at[np.ix_(known, known)].set(belief.covariance))
    if isinstance(fill, GaussianRoot) and isinstance(belief, GaussianRoot):
        own = jnp.zeros((fill.mean.size, belief.root.shape[1]), mean.dtype).at[known].set(belief.root)
        return GaussianRoot(mean, jnp.hstack([own, fill.root.at[known].set(0.0)]))
    raise ValueError(
        f"fill must be a {type(belief).__name__}, as the states of filters are; got a {type(fill).__name__}."
    )


def _picked(row: tuple[int, ...], belief: Belief) -> Belief:
    return belief.marginal(row)


def _square(belief: Belief) -> Belief:
    """The belief with a square root, whatever its width was."""
    if not isinstance(belief, GaussianRoot) or belief.root.shape[0] == belief.root.shape[1]:
        return belief
    return GaussianRoot(belief.mean, linalg.tria(belief.root))


def check_maps(maps: Any, states: Sequence[Belief]) -> None:
    """Require maps that lead from the state of each mode to that of each other, and to one common state."""
    if not isinstance(maps, ModeMaps):
        raise TypeError(f"maps must be made by a function of jf.mode_maps; got a {type(maps).__name__}.")
    count = len(states)
    if isinstance(maps, CommonSpace) and len(maps.to) != count:
        raise ValueError(f"maps must have one map for each of the {count} filters; got {len(maps.to)}.")
    if isinstance(maps, Pairwise) and maps.common >= count:
        raise ValueError(f"maps must have a common mode from 0 to {count - 1}; got {maps.common}.")
    for i in range(count):
        for j in range(count):
            found = jax.eval_shape(partial(maps.convert, i, j), states[i])
            _check_result(f"maps.convert({i}, {j}, ...)", found, states[j])
    commons = [jax.eval_shape(partial(maps.to_common, i), states[i]) for i in range(count)]
    for i, common in enumerate(commons):
        _check_result(f"maps.to_common({i}, ...)", common, commons[0])


def _check_result(name: str, found: Any, wanted: Belief) -> None:
    if type(found) is not type(wanted):
        raise TypeError(f"{name} must return a {type(wanted).__name__}; got a {type(found).__name__}.")
    shapes: list[list[Array]] = [jax.tree.leaves(belief) for belief in (found, wanted)]
    got, expected = ([leaf.shape for leaf in leaves] for leaves in shapes)
    if got != expected:
        raise ValueError(f"{name} must return a belief of the shapes {expected}; got {got}.")
