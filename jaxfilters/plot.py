"""Pictures of what filters found, by matplotlib: `pip install 'jaxfilters[viz]'`.

Each function draws into the axes that it is given, or into new ones, and returns them.
"""

from importlib import import_module
from importlib.util import find_spec
from math import erf, sqrt
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import ArrayLike
from scipy.stats import kstest, kstwo

Axes: TypeAlias = Any
"""`matplotlib.axes.Axes`, which is not imported before it is used."""


def track(
    means: ArrayLike,
    covariances: ArrayLike | None = None,
    *,
    truth: ArrayLike | None = None,
    observations: ArrayLike | None = None,
    sigmas: float = 2.0,
    every: int = 1,
    ax: Axes | None = None,
) -> Axes:
    """Draw a track in the plane with ellipses of its covariances.

    Args:
        means: Estimated places, (t, 2).
        covariances: Their covariances, (t, 2, 2); `None` draws no ellipses.
        truth: True places, (t, 2).
        observations: Observed places, (t, 2); NaN where there is none.
        sigmas: Size of the ellipses in standard deviations, positive; 2 holds 86 percent of a Gaussian in the plane.
        every: Distance in time between ellipses, at least 1.
        ax: Axes to draw into.

    Returns:
        The axes.

    Raises:
        ValueError: If a shape does not fit, or `sigmas` or `every` is not positive.
        ModuleNotFoundError: If matplotlib is not installed.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> means = jnp.stack([jnp.arange(5.0), jnp.arange(5.0) ** 2], axis=1)
        >>> axes = jf.plot.track(means, 0.1 * jnp.broadcast_to(jnp.eye(2), (5, 2, 2)), every=2)
        >>> len(axes.collections) + len(axes.patches) > 0
        True
    """
    means = _shaped("means", means, (None, 2))
    if not sigmas > 0 or every < 1:
        raise ValueError(f"sigmas must be positive and every at least 1; got {sigmas} and {every}.")
    length = len(means)
    others = {"truth": truth, "observations": observations}
    given = {name: _shaped(name, places, (length, 2)) for name, places in others.items() if places is not None}
    spread = None if covariances is None else _shaped("covariances", covariances, (length, 2, 2))
    ax = _axes(ax)
    if "truth" in given:
        ax.plot(*given["truth"].T, color="0.6", linewidth=2.5, label="truth")
    if "observations" in given:
        ax.plot(*given["observations"].T, ".", color="tab:orange", markersize=5, label="observations")
    ax.plot(*means.T, color="tab:blue", linewidth=1.5, label="estimate")
    if spread is not None:
        turn = np.linspace(0, 2 * np.pi, 61)
        circle = sigmas * np.stack([np.cos(turn), np.sin(turn)])
        for index in range(0, length, every):
            values, vectors = np.linalg.eigh(spread[index])
            outline = means[index] + (vectors * np.sqrt(np.maximum(values, 0)) @ circle).T
            label = f"{sigmas:g} standard deviations" if index == 0 else None
            ax.fill(*outline.T, facecolor="tab:blue", edgecolor="tab:blue", alpha=0.15, linewidth=0.8, label=label)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x", ylabel="y")
    ax.legend()
    return ax


def innovations(
    innovations: ArrayLike,
    std: ArrayLike,
    *,
    times: ArrayLike | None = None,
    sigmas: float = 2.0,
    ax: Axes | None = None,
) -> Axes:
    """Draw one component of the innovations over time, with the band in which they should lie.

    Args:
        innovations: One component, (t,).
        std: Its standard deviations, (t,): `infos.innovation_root[:, 0, 0]` is that of the first component.
        times: Times, (t,); the numbers of the steps by default.
        sigmas: Half the width of the band in standard deviations, positive.
        ax: Axes to draw into.

    Returns:
        The axes; the title says how many lie inside, and how many should.

    Raises:
        ValueError: If a shape does not fit, or `sigmas` is not positive.
        ModuleNotFoundError: If matplotlib is not installed.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> errors = jax.random.normal(jax.random.key(0), (200,))
        >>> axes = jf.plot.innovations(errors, 0.0 * errors + 1.0)
        >>> axes.get_title()
        '95 % inside, 95 % expected'
    """
    e = _shaped("innovations", innovations, (None,))
    s = _shaped("std", std, e.shape)
    t = np.arange(len(e)) if times is None else _shaped("times", times, e.shape)
    if not sigmas > 0:
        raise ValueError(f"sigmas must be positive; got {sigmas}.")
    ax = _axes(ax)
    ax.fill_between(t, -sigmas * s, sigmas * s, color="tab:blue", alpha=0.2, label=f"{sigmas:g} standard deviations")
    ax.axhline(0, color="0.6", linewidth=0.8)
    ax.plot(t, e, ".-", color="tab:blue", linewidth=0.8, markersize=4, label="innovation")
    inside = np.mean(np.abs(e) <= sigmas * s)
    ax.set(xlabel="step" if times is None else "time", ylabel="innovation")
    ax.set_title(f"{100 * inside:.0f} % inside, {100 * erf(sigmas / sqrt(2)):.0f} % expected")
    ax.legend()
    return ax


def ancestry(values: ArrayLike, ancestors: ArrayLike, log_weights: ArrayLike, *, ax: Axes | None = None) -> Axes:
    """Draw particles over time, joined with their ancestors; the area of a particle is its weight.

    Lines of particles that survive to the last step are dark: where few are, the particles are impoverished.

    Args:
        values: One number of each particle, (t, n).
        ancestors: Index of each particle's ancestor in the row before, (t, n); the first row is not used.
        log_weights: Log weights, (t, n), normalised or not.
        ax: Axes to draw into.

    Returns:
        The axes.

    Raises:
        ValueError: If the shapes differ, or an ancestor is no index.
        ModuleNotFoundError: If matplotlib is not installed.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> values, ancestors = jnp.array([[0.0, 1.0], [0.1, 0.9]]), jnp.array([[0, 1], [1, 1]])
        >>> axes = jf.plot.ancestry(values, ancestors, jnp.zeros((2, 2)))
        >>> axes.get_xlabel()
        'step'
    """
    x = _shaped("values", values, (None, None))
    length, count = x.shape
    parents = np.asarray(ancestors)
    if parents.shape != x.shape or not np.issubdtype(parents.dtype, np.integer):
        raise ValueError(f"ancestors must be integers of the shape {x.shape}; got {parents.dtype}, {parents.shape}.")
    if np.any((parents[1:] < 0) | (parents[1:] >= count)):
        raise ValueError(f"ancestors must be from 0 to {count - 1}; got {parents[1:].min()} to {parents[1:].max()}.")
    logs = _shaped("log_weights", log_weights, x.shape)
    collections = _matplotlib("collections")
    ax = _axes(ax)
    alive = np.ones((length, count), bool)
    for t in range(length - 1, 0, -1):
        alive[t - 1] = np.isin(np.arange(count), parents[t][alive[t]])
    steps = np.arange(1, length)[:, None]
    begins = np.stack([np.broadcast_to(steps - 1, parents[1:].shape), np.take_along_axis(x[:-1], parents[1:], 1)], -1)
    ends = np.stack([np.broadcast_to(steps, parents[1:].shape), x[1:]], -1)
    segments, survives = np.stack([begins, ends], -2).reshape(-1, 2, 2), alive[1:].ravel()
    for chosen, color, label in ((~survives, "0.8", "died out"), (survives, "tab:blue", "ancestors of the last step")):
        ax.add_collection(collections.LineCollection(segments[chosen], colors=color, linewidths=0.8, label=label))
    w = np.exp(logs - logs.max(axis=1, keepdims=True))
    area = 200 * w / w.sum(axis=1, keepdims=True)
    times = np.broadcast_to(np.arange(length)[:, None], x.shape)
    ax.scatter(times.ravel(), x.ravel(), s=area.ravel(), color="tab:orange", zorder=3, linewidths=0, label="weight")
    ax.set(xlabel="step", ylabel="value")
    ax.legend()
    return ax


def calibration(transforms: ArrayLike, *, probability: float = 0.95, ax: Axes | None = None) -> Axes:
    """Draw a calibration curve: the share of observations below each predicted quantile.

    A curve above the diagonal where it begins and below it where it ends is that of predictions that are too narrow.

    Args:
        transforms: Probability integral transforms, (n,), as `jf.diagnostics.pit` gives.
        probability: Of the band about the diagonal in which the whole curve of calibrated predictions lies.
        ax: Axes to draw into.

    Returns:
        The axes; the title has the p-value of `jf.diagnostics.uniformity`.

    Raises:
        ValueError: If `transforms` is no vector of numbers in [0, 1], or `probability` is outside (0, 1).
        ModuleNotFoundError: If matplotlib is not installed.

    Examples:
        >>> import jax
        >>> import jaxfilters as jf
        >>> axes = jf.plot.calibration(jax.random.uniform(jax.random.key(0), (200,)))
        >>> axes.get_title()
        '200 predictions, p = 0.77'
    """
    u = np.sort(_shaped("transforms", transforms, (None,)))
    if u.size == 0 or u[0] < 0 or u[-1] > 1:
        raise ValueError(f"transforms must be one number or more from 0 to 1; got {u}.")
    if not 0 < probability < 1:
        raise ValueError(f"probability must be in (0, 1); got {probability}.")
    width = kstwo.ppf(probability, u.size)
    ax = _axes(ax)
    diagonal = np.linspace(0, 1, 101)
    low, high = np.clip(diagonal - width, 0, 1), np.clip(diagonal + width, 0, 1)
    ax.fill_between(diagonal, low, high, color="0.85", label=f"{100 * probability:g} % if calibrated")
    ax.plot([0, 1], [0, 1], color="0.5", linewidth=0.8)
    shares = np.arange(u.size + 1) / u.size
    ax.step(np.concatenate([[0], u, [1]]), np.append(shares, 1.0), where="post", color="tab:blue", label="observed")
    ax.set(xlabel="predicted probability", ylabel="observed share", xlim=(0, 1), ylim=(0, 1))
    ax.set_title(f"{u.size} predictions, p = {kstest(u, 'uniform').pvalue:.2g}")
    ax.legend(loc="upper left")
    return ax


def _matplotlib(module: str) -> Any:
    if find_spec("matplotlib") is None:
        raise ModuleNotFoundError("jaxfilters.plot needs matplotlib: pip install 'jaxfilters[viz]'.")
    return import_module(f"matplotlib.{module}")


def _axes(ax: Axes | None) -> Axes:
    return _matplotlib("pyplot").subplots(layout="constrained")[1] if ax is None else ax


def _shaped(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> np.ndarray:
    """The values as float64, of a shape in which None is any length."""
    array = np.asarray(value, dtype=float)
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits:
        expected = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name} must have the shape {expected}; got {array.shape}.")
    return array
