"""Least squares within bounds: the box Levenberg-Marquardt against SciPy, jaxopt, optimistix, Ceres and NLopt.

300 random problems of 2 to 4 variables and 8 residuals, in double precision: solutions have to be feasible and
stationary, and are compared with those of SciPy's trust-region reflective method from the same starts. Where SciPy,
started again at a solution that is worse than its own, stays there, the problem has several minima, which is counted
apart. Then 256 of them at once: this library and the peers that know bounds (`jaxopt_lbfgsb` and `jaxopt_projected`,
L-BFGS-B and projected gradients, under vmap; `scipy`, and with `pip install 'jaxfilters[peers]'` `pyceres`, the
Levenberg-Marquardt of Ceres, and `nlopt`, its SLSQP, one after the other with residuals in numpy), and optimistix's own
Levenberg-Marquardt, which takes bounds without a word and leaves them, on the same problems without bounds. All stop at
a projected gradient of 1e-6. At last the adjustment of frames that share variables, dense and by the Schur complement:
`shared_exponent_*` is the slope of the logarithm of time by that of the number of frames.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import scipy.optimize
from jaxtyping import Array

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _least_squares_peers as peers
from jaxfilters.benchmarks.timing import interleaved
from jaxfilters.optimize.least_squares import BoxLevenbergMarquardt
from jaxfilters.optimize.shared_least_squares import Split, solve_shared

NUM_PROBLEMS, QUICK_NUM_PROBLEMS, BATCH = 300, 30, 256
SIZE, NUM_RESIDUALS, MOST_STEPS = 4, 8, 400
STATIONARY = 1e-6
FRAMES, QUICK_FRAMES = (5, 10, 20, 40, 80, 160, 320, 640), (5, 10, 20)
MOST_DENSE = 80
FEWEST = 20
"""Frames from which on the growth of time is fitted: with fewer, what does not depend on them counts."""
SAME = 1e-6
"""Relative difference of two costs that are the same."""
NUM_POINTS, NUM_SHARED = 10, 12
MEAN = np.random.default_rng(0).normal(0, 1, 3 * NUM_POINTS)
BASIS = np.random.default_rng(1).normal(0, 0.3, (3 * NUM_POINTS, NUM_SHARED))
"""Of the shape that frames share."""
ROUNDS, QUICK_ROUNDS = 15, 2


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Check the answers, then time them; `out` is not used."""
    del out
    rounds = QUICK_ROUNDS if quick else ROUNDS
    with jax.enable_x64(True):
        problems = random_problems(seed, QUICK_NUM_PROBLEMS if quick else NUM_PROBLEMS)
        metrics = answer_metrics(problems)
        metrics |= batch_metrics(tuple(a[:BATCH] for a in problems), rounds)
        return metrics | shared_metrics(seed, QUICK_FRAMES if quick else FRAMES, rounds)


def residuals(y: Array, args: tuple) -> Array:
    """Smooth, with several minima now and then."""
    A, b, c = args
    turned = A @ y
    return 2 * jnp.tanh(turned) + 0.3 * turned - b + 0.1 * jnp.sum(y * y) * c


def energy(y: Array, args: tuple) -> Array:
    """Half the sum of squares."""
    return 0.5 * jnp.sum(residuals(y, args) ** 2)


def random_problems(seed: int, count: int) -> tuple[np.ndarray, ...]:
    """(A, b, c, lower, upper, start), a third each of two, three and four variables that matter."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, NUM_RESIDUALS, SIZE))
    A[: count // 3, :, 2:], A[count // 3 : 2 * count // 3, :, 3:] = 0, 0
    b, c = 2 * rng.normal(size=(count, NUM_RESIDUALS)), rng.normal(size=(count, NUM_RESIDUALS))
    lower, upper = -rng.uniform(0.1, 1.5, (count, SIZE)), rng.uniform(0.1, 1.5, (count, SIZE))
    return A, b, c, lower, upper, rng.uniform(lower, upper)


@jax.jit
@partial(jax.vmap, in_axes=(0,) * 6)
def box_solve(A: Array, b: Array, c: Array, lower: Array, upper: Array, start: Array) -> tuple[Array, Array]:
    """Solutions and steps of this library."""
    solver = BoxLevenbergMarquardt(rtol=1e-12, atol=STATIONARY)
    options = {"lower": lower, "upper": upper}
    solve = partial(optimistix.least_squares, max_steps=MOST_STEPS, throw=False)
    found: Any = solve(residuals, solver, start, (A, b, c), options)
    return found.value, found.stats["num_steps"]


def answer_metrics(problems: tuple[np.ndarray, ...]) -> dict[str, Metric]:
    """Are the answers right, and as good as SciPy's?"""
    A, b, c, lower, upper, _ = problems
    y, steps = (np.asarray(part) for part in box_solve(*problems))
    others = [scipy_solve(*one) for one in zip(*problems, strict=True)]
    cost, stationary = np.asarray(jax.vmap(energy)(jnp.asarray(y), (A, b, c))), projected_gradient(y, problems)
    ratio = cost / np.array([other.cost for other in others])
    worse = np.flatnonzero(ratio > 1 + SAME)
    again = [scipy_solve(*(a[i] for a in problems[:5]), y[i]).cost for i in worse]
    elsewhere = np.array(again) >= cost[worse] * (1 - SAME)
    return {
        "infeasible": Metric(float(np.sum((y < lower) | (y > upper))), "", "lower"),
        "projected_gradient_worst": Metric(float(stationary.max()), "", "lower"),
        "worse_than_scipy": Metric(float(np.sum(~elsewhere)), "problems", "lower"),
        "worse_than_scipy_in_another_minimum": Metric(float(np.sum(elsewhere)), "problems", "lower"),
        "better_than_scipy": Metric(float(np.sum(ratio < 1 - SAME)), "problems", "higher"),
        "steps_median": Metric(float(np.median(steps)), "", "lower"),
        "scipy_evaluations_median": Metric(float(np.median([other.nfev for other in others])), "", "lower"),
    }


def projected_gradient(y: np.ndarray, problems: tuple[np.ndarray, ...]) -> np.ndarray:
    """Of each problem, the largest component."""
    A, b, c, lower, upper, _ = problems
    gradient = np.asarray(jax.vmap(jax.grad(energy))(y, (A, b, c)))
    return np.abs(y - np.clip(y - gradient, lower, upper)).max(axis=1)


def written(
    A: np.ndarray, b: np.ndarray, c: np.ndarray, lower: np.ndarray, upper: np.ndarray, start: np.ndarray
) -> peers.Written:
    """One problem with its exact Jacobian, for solvers that are not of JAX."""

    def value(y: np.ndarray) -> np.ndarray:
        turned = A @ y
        return 2 * np.tanh(turned) + 0.3 * turned - b + 0.1 * np.sum(y * y) * c

    def jacobian(y: np.ndarray) -> np.ndarray:
        slope = 2 / np.cosh(A @ y) ** 2 + 0.3
        return slope[:, None] * A + 0.2 * c[:, None] * y

    return peers.Written(value, jacobian, lower, upper, start, NUM_RESIDUALS)


def scipy_solve(*problem: np.ndarray) -> scipy.optimize.OptimizeResult:
    """One problem, as `written` takes it, by the trust-region reflective method."""
    one = written(*problem)
    return scipy.optimize.least_squares(
        one.value,
        one.start,
        one.jacobian,
        (one.lower, one.upper),
        gtol=STATIONARY,
        xtol=1e-14,
        ftol=1e-14,
        max_nfev=MOST_STEPS,
    )


def batch_metrics(problems: tuple[np.ndarray, ...], rounds: int) -> dict[str, Metric]:
    """Milliseconds for the whole batch, and how many each solved."""
    arrays = tuple(jnp.asarray(a) for a in problems)
    calls: dict[str, Callable[[], Any]] = {
        "box": lambda: box_solve(*arrays)[0],
        "jaxopt_lbfgsb": lambda: lbfgsb_solve(*arrays),
        "jaxopt_projected": lambda: projected_solve(*arrays),
        "optimistix_unbounded": lambda: unbounded_solve(*arrays),
        "scipy": lambda: np.stack([scipy_solve(*one).x for one in zip(*problems, strict=True)]),
    }
    by_name: dict[str, Callable] = {"pyceres": peers.pyceres, "nlopt": peers.nlopt}
    for name in peers.installed():
        calls[name] = partial(_one_by_one, by_name[name], [written(*one) for one in zip(*problems, strict=True)])
    absent = set(by_name) - set(calls)
    if absent:
        sys.stdout.write(f"not installed, and missing below: {', '.join(sorted(absent))}\n")
    seconds = interleaved(calls, rounds)
    metrics = {f"batch_ms_{name}": Metric(1e3 * value, "ms", "lower") for name, value in seconds.items()}
    for name, call in calls.items():
        if name == "optimistix_unbounded":
            continue
        y = np.asarray(call())
        solved = (projected_gradient(y, problems) < 1e-4) & np.all((y >= problems[3]) & (y <= problems[4]), axis=1)
        metrics[f"batch_solved_{name}"] = Metric(100 * float(solved.mean()), "%", "higher")
    for name in calls:
        if name != "box":
            metrics[f"ratio_batch_to_{name}"] = Metric(seconds["box"] / seconds[name], "", "lower")
    return metrics


def _one_by_one(solve: Callable[..., np.ndarray], problems: list[peers.Written]) -> np.ndarray:
    return np.stack([solve(problem, STATIONARY, MOST_STEPS) for problem in problems])


@jax.jit
@partial(jax.vmap, in_axes=(0,) * 6)
def lbfgsb_solve(A: Array, b: Array, c: Array, lower: Array, upper: Array, start: Array) -> Array:
    """By jaxopt's L-BFGS-B."""
    import jaxopt

    solver = jaxopt.LBFGSB(fun=energy, tol=STATIONARY, maxiter=MOST_STEPS)
    return solver.run(start, bounds=(lower, upper), args=(A, b, c)).params


@jax.jit
@partial(jax.vmap, in_axes=(0,) * 6)
def projected_solve(A: Array, b: Array, c: Array, lower: Array, upper: Array, start: Array) -> Array:
    """By jaxopt's accelerated projected gradients."""
    import jaxopt

    solver = jaxopt.ProjectedGradient(
        fun=energy, projection=jaxopt.projection.projection_box, tol=STATIONARY, maxiter=MOST_STEPS
    )
    return solver.run(start, hyperparams_proj=(lower, upper), args=(A, b, c)).params


@jax.jit
@partial(jax.vmap, in_axes=(0,) * 6)
def unbounded_solve(A: Array, b: Array, c: Array, lower: Array, upper: Array, start: Array) -> Array:
    """By optimistix's Levenberg-Marquardt, without the bounds."""
    del lower, upper
    solver: Any = optimistix.LevenbergMarquardt(rtol=1e-8, atol=STATIONARY)
    return optimistix.least_squares(residuals, solver, start, (A, b, c), max_steps=MOST_STEPS, throw=False).value


def shared_metrics(seed: int, counts: tuple[int, ...], rounds: int) -> dict[str, Metric]:
    """Milliseconds of ten steps by the number of frames, and how far the two ways are apart."""
    calls: dict[str, Callable[[], Any]] = {}
    apart = 0.0
    for count in counts:
        start, data = shared_problem(seed, count)
        calls[f"schur_{count}_frames"] = partial(shared_solve, start, data)
        if count <= MOST_DENSE:
            calls[f"dense_{count}_frames"] = partial(dense_solve, start, data)
            ends = [jax.flatten_util.ravel_pytree(solve(start, data))[0] for solve in (converged, dense_converged)]
            apart = max(apart, float(jnp.max(jnp.abs(ends[0] - ends[1]))))
    seconds = interleaved(calls, rounds)
    metrics = {f"shared_ms_{name}": Metric(1e3 * value, "ms", "lower") for name, value in seconds.items()}
    for kind in ("schur", "dense"):
        timed = [n for n in counts if n >= min(FEWEST, counts[-2]) and f"{kind}_{n}_frames" in calls]
        times = [seconds[f"{kind}_{n}_frames"] for n in timed]
        exponent = np.polyfit(np.log(timed), np.log(times), 1)[0]
        metrics[f"shared_exponent_{kind}"] = Metric(float(exponent), "", "lower")
    return metrics | {"shared_apart_from_dense": Metric(apart, "", "lower")}


def shared_problem(seed: int, count: int) -> tuple[Split, Array]:
    """Frames of a shape of ten points with `NUM_SHARED` parameters, each turned and moved its own way; and a start."""
    rng = np.random.default_rng(seed)
    shared, frames = 0.5 * rng.normal(size=NUM_SHARED), 0.2 * rng.normal(size=(count, 6))
    observed = jax.vmap(of_frame, (None, 0, 0))(
        jnp.asarray(shared), jnp.asarray(frames), jnp.zeros((count, NUM_POINTS, 3))
    )
    data = observed.reshape(count, NUM_POINTS, 3) + 0.01 * rng.normal(size=(count, NUM_POINTS, 3))
    start = Split(shared + 0.1 * rng.normal(size=NUM_SHARED), frames + 0.05 * rng.normal(size=(count, 6)))
    return jax.tree.map(jnp.asarray, start), data


def of_frame(shared: Array, frame: Array, data: Array) -> Array:
    """Points of a shape that all frames share, turned by small angles and moved."""
    points = jnp.asarray(MEAN + BASIS @ shared, shared.dtype).reshape(NUM_POINTS, 3)
    turned = points + jnp.cross(jnp.sin(frame[:3]), points)
    return (turned + frame[3:] - data).ravel()


def prior(shared: Array) -> Array:
    """A little of it."""
    return 0.1 * shared


def everything(split: Split, data: Array) -> Array:
    """All residuals."""
    of_frames = jax.vmap(of_frame, (None, 0, 0))(split.shared, split.frames, data)
    return jnp.concatenate([of_frames.ravel(), prior(split.shared)])


@jax.jit
def shared_solve(start: Split, data: Array) -> Split:
    """Ten steps by the Schur complement."""
    return solve_shared(of_frame, start, data, prior=prior, steps=10, rtol=0.0, atol=0.0).value


@jax.jit
def dense_solve(start: Split, data: Array) -> Split:
    """Ten dense steps."""
    solver = BoxLevenbergMarquardt(rtol=0.0, atol=0.0)
    return optimistix.least_squares(everything, solver, start, data, max_steps=10, throw=False).value


@jax.jit
def converged(start: Split, data: Array) -> Split:
    """By the Schur complement, to the end."""
    return solve_shared(of_frame, start, data, prior=prior, steps=300, rtol=1e-14, atol=1e-11).value


@jax.jit
def dense_converged(start: Split, data: Array) -> Split:
    """By dense steps, to the end."""
    solver = BoxLevenbergMarquardt(rtol=1e-14, atol=1e-11)
    return optimistix.least_squares(everything, solver, start, data, max_steps=300, throw=False).value
