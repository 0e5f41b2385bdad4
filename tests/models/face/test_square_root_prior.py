"""Gaussians by a root of their information, against the information form in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.square_root_prior import (
    SquareRootPrior,
    joined,
    nothing,
    of_energy,
    of_measurements,
    residuals,
    shifted,
)

SIZE = 12
STD = np.logspace(-3, 1, SIZE)
"""Of the parameters, whose units differ."""


def energy(past: SquareRootPrior, p: np.ndarray) -> float:
    return 0.5 * float(np.sum(np.square(residuals(past, jnp.asarray(p)))))


def told_of_few(rng, rank=5):
    """Information in units of `STD` of a few directions, a gradient that lies in them, and where."""
    J = rng.normal(size=(rank, SIZE))
    return J.T @ J, J.T @ rng.normal(size=rank), STD * rng.normal(size=SIZE)


@pytest.mark.system
def test_an_energy_is_kept_but_for_a_constant(x64):
    rng = np.random.default_rng(0)
    information, gradient, at = told_of_few(rng)
    past = of_energy(*map(jnp.asarray, (information, gradient, at, STD)))
    for p in STD * rng.normal(size=(4, SIZE)):
        moved = (p - at) / STD
        expected = gradient @ moved + 0.5 * moved @ information @ moved
        assert energy(past, p) - energy(past, at) == pytest.approx(expected, rel=1e-9)


def test_information_and_mean_are_those_of_the_energy(x64):
    information, gradient, at = told_of_few(np.random.default_rng(1))
    past = of_energy(*map(jnp.asarray, (information, gradient, at, STD)))
    raw = information / STD[:, None] / STD
    np.testing.assert_allclose(past.information, raw, rtol=1e-9, atol=1e-9 * np.abs(raw).max())
    np.testing.assert_allclose(past.root.T @ past.towards, raw @ at - gradient / STD, rtol=1e-8)


@pytest.mark.system
def test_joined_energies_add_up(x64):
    rng = np.random.default_rng(2)
    one, other = (of_energy(*map(jnp.asarray, (*told_of_few(rng), STD))) for _ in range(2))
    both = joined(one, other)
    p, q = STD * rng.normal(size=(2, SIZE))
    expected = energy(one, p) + energy(other, p) - energy(one, q) - energy(other, q)
    assert energy(both, p) - energy(both, q) == pytest.approx(expected, rel=1e-9)
    alone = joined(nothing(SIZE, float), one)
    np.testing.assert_allclose(alone.information, one.information, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(alone.root.T @ alone.towards, one.root.T @ one.towards, rtol=1e-8)


def test_a_shift_moves_the_energy(x64):
    rng = np.random.default_rng(3)
    past = of_energy(*map(jnp.asarray, (*told_of_few(rng), STD)))
    p, shift = STD * rng.normal(size=(2, SIZE))
    assert energy(shifted(past, jnp.asarray(shift)), p) == pytest.approx(energy(past, p + shift), rel=1e-9)


def test_measurements_are_least_squares(x64):
    rng = np.random.default_rng(4)
    J, values = rng.normal(size=(3, SIZE)), rng.normal(size=3)
    past = of_measurements(jnp.asarray(J), jnp.asarray(values))
    p = rng.normal(size=SIZE)
    assert energy(past, p) == pytest.approx(0.5 * np.sum((J @ p - values) ** 2))


def test_a_parameter_without_a_unit_is_not_told_of(x64):
    information, gradient, at = told_of_few(np.random.default_rng(5))
    unit = np.where(np.arange(SIZE) == 3, 0.0, STD)
    past = of_energy(*map(jnp.asarray, (information, gradient, at, unit)))
    assert not np.any(past.root[:, 3])
    assert np.isfinite(past.towards).all()


@pytest.mark.system
def test_single_precision_holds_what_hundreds_of_frames_tell():
    """Each tells of eight of twelve directions, with rounding errors that make it indefinite; so is their sum, of ten.

    The mean person that they agree on is found, and the two directions that none tells of stay as they were known.
    """
    rng = np.random.default_rng(6)
    true = STD * rng.normal(size=SIZE)
    open_to_all = np.linalg.qr(rng.normal(size=(SIZE, 2)))[0]
    message, past = jax.jit(of_energy), nothing(SIZE, jnp.float32)
    join, indefinite = jax.jit(joined), 0
    total = np.zeros((SIZE, SIZE))
    for _ in range(300):
        J = rng.normal(size=(8, SIZE)) * 3
        J -= J @ open_to_all @ open_to_all.T
        rounded = (J.T @ J).astype(np.float32)
        total += J.T @ J
        indefinite += np.linalg.eigvalsh(rounded.astype(float))[0] < 0
        at = true + STD * 0.1 * rng.normal(size=SIZE)
        gradient = J.T @ J @ ((at - true) / STD)
        past = join(past, message(*(jnp.asarray(a, jnp.float32) for a in (rounded, gradient, at, STD))))
    assert indefinite > 250
    root, towards = np.asarray(past.root, float) * STD, np.asarray(past.towards, float)
    assert np.isfinite(root).all()
    # With what is known beforehand, one standard deviation about 0, as an adjustment has it.
    found = np.linalg.lstsq(np.vstack([root, np.eye(SIZE)]), np.concatenate([towards, np.zeros(SIZE)]), rcond=None)[0]
    expected = np.linalg.solve(total + np.eye(SIZE), total @ (true / STD))
    # 300 sums of numbers of about 30, each with a relative error of 2^-24, on directions told to 1 / 70: .01 at most.
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert np.abs(root @ open_to_all).max() < 0.1
