r"""Resampling given one of the ancestors, for conditional sequential Monte Carlo.

A conditional scheme takes `(key, log_weights (n,), parent)` and returns n int32 ancestors of which the first is
`parent`. It draws from the law of an unconditional scheme, under which each place has the ancestor m with probability
$W_m$, given that the first place has that ancestor; a sweep of conditional sequential Monte Carlo leaves its target
invariant for such schemes only (C. Andrieu, A. Doucet and R. Holenstein, "Particle Markov chain Monte Carlo methods",
Journal of the Royal Statistical Society B 72, 2010, section 4.3).
"""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

from jaxfilters import weights
from jaxfilters._xla import prefix
from jaxfilters.particle import checks, resampling
from jaxfilters.typing import AnyKey


@runtime_checkable
class ConditionalScheme(Protocol):
    """Draw ancestors given that the first of them is `parent`."""

    def __call__(
        self, key: AnyKey, log_weights: Float[Array, " n"], parent: int | Int32[Array, ""], /
    ) -> Int32[Array, " n"]: ...


def conditional_multinomial(
    key: AnyKey, log_weights: Float[Array, " n"], parent: int | Int32[Array, ""]
) -> Int32[Array, " n"]:
    """Draw n - 1 ancestors independently; the first is given.

    Args:
        key: Random key.
        log_weights: Log weights `(n,)`, not necessarily normalised.
        parent: The first ancestor, in [0, n).

    Returns:
        Ancestors `(n,)`.

    Raises:
        ValueError: If `log_weights` is not a vector.
        TypeError: If it does not hold floating-point numbers.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> jf.mcmc.conditional_multinomial(jax.random.key(0), jnp.log(jnp.array([0.0, 1.0, 0.0, 0.0])), 0).tolist()
        [0, 1, 1, 1]
    """
    draw_key, omit_key = jax.random.split(key)
    drawn = resampling.multinomial(draw_key, log_weights)
    # The draws come in ascending order: the one that makes way is any of them with the same probability.
    omitted = jax.random.randint(omit_key, (), 0, log_weights.size)
    return drawn.at[omitted].set(drawn[0]).at[0].set(parent)


def conditional_systematic(
    key: AnyKey, log_weights: Float[Array, " n"], parent: int | Int32[Array, ""]
) -> Int32[Array, " n"]:
    r"""Draw ancestors by a grid of n points with a common offset; the first is given.

    The unconditional scheme is systematic resampling with the offset $U$, uniform in [0, 1), followed by a rotation of
    the n places by a uniform number of them. The weights lie on a circle of circumference n, which may begin with
    those of `parent`, m. Given $U$, it has $n_m(U)$ descendants, $\lfloor n W_m \rfloor$ or one more, side by side, and
    the first place is one of them under $n_m(U)$ of the n rotations. Given that it is, $U$ has a density proportional
    to $n_m(U)$, and the rotation is one of those, each equally probable (N. Chopin and S. S. Singh, "On particle Gibbs
    sampling", Bernoulli 21, 2015, section 4).

    Args:
        key: Random key.
        log_weights: Log weights `(n,)`, not necessarily normalised.
        parent: The first ancestor, in [0, n).

    Returns:
        Ancestors `(n,)`.

    Raises:
        ValueError: If `log_weights` is not a vector.
        TypeError: If it does not hold floating-point numbers.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> jf.mcmc.conditional_systematic(jax.random.key(0), jnp.zeros(4), 2).tolist()
        [2, 3, 0, 1]
    """
    checks.check_log_weights(log_weights)
    n = log_weights.size
    around = (jnp.arange(n, dtype=jnp.int32) + parent) % n
    whole, fraction = _positions(log_weights[around], n)
    certain, extra = whole[0, 0], jnp.where(whole[0, 0] < n, fraction[0, 0], 0.0)
    which, within, rotation = jax.random.uniform(key, (3,), log_weights.dtype)
    below = which * (certain + extra) < extra * (certain + 1)
    offset = jnp.where(below, extra * within, extra + (1 - extra) * within)
    descendants = jnp.minimum(certain + (extra > offset), n)
    turned = jnp.minimum(jnp.floor(rotation * descendants).astype(jnp.int32), jnp.maximum(descendants - 1, 0))
    places = (jnp.arange(n, dtype=jnp.int32) + turned) % n
    # A weight below the resolution of the grid has no descendant there, but is the parent nevertheless.
    return around[_filled(whole, fraction, offset, n)[places]].at[0].set(parent)


def systematic_at(
    offset: Float[Array, ""], log_weights: Float[Array, " n"], count: int | None = None
) -> Int32[Array, " count"]:
    """Ancestors by a grid of points with a known offset: systematic resampling as a function of its random number.

    Args:
        offset: Position of the points between the ends of their intervals, in [0, 1).
        log_weights: Log weights `(n,)`, not necessarily normalised.
        count: Number of ancestors, at most n, which is the default.

    Returns:
        Ancestors in ascending order, `(count,)`.

    Raises:
        ValueError: If `log_weights` is not a vector.
        TypeError: If it does not hold floating-point numbers.
    """
    count = log_weights.size if count is None else count
    return _filled(*_positions(log_weights, count), offset, count)


def _positions(log_weights: Array, count: int) -> tuple[Array, Array]:
    """Cumulative weights that end at `count`, in rows, as integers and fractions."""
    checks.check_log_weights(log_weights)
    return prefix.positions(prefix.in_rows(weights.relative(jax.lax.stop_gradient(log_weights))), count)


def _filled(whole: Array, fraction: Array, offset: Array, count: int) -> Int32[Array, " count"]:
    """The ancestor of each of `count` places, which lie at `offset` in the intervals between integers."""
    ends = (whole + (fraction > offset)).reshape(-1)
    ended = jnp.zeros(ends.size, jnp.int32).at[ends].add(1, mode="drop")
    return prefix.running_count(prefix.in_rows(ended)).reshape(-1)[:count]
