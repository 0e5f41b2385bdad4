# ---
# jupytext:
#   formats: ipynb,py:percent
# kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # The noise of a depth camera, fitted by gradient
#
# A ball swings before a depth camera whose noise grows with the square of the distance $z$. How much, nobody knows; nor
# how far the ball swings. There is no truth to compare with, only the measured depths:
#
# $$x_t = F x_{t-1} + w_t(s), \qquad y_t = z_t + v_t, \qquad \operatorname{std}(v_t) = a + b z_t^2.$$
#
# `jf.fit.maximize` climbs the log evidence of an extended Kalman filter by its gradient in $(a, b, s)$. Beside it stand
# third differences of the depths, which a smooth path has little of, with a line through their sizes over $y_t^2$.
#
# **Result:** over 60 recordings of 20 s the root mean square error of the standard deviation at 3 m is **7.0** percent
# by gradient and **10.2** percent by differences. Where a is not at its limit of 0, **1.0** of the 95 percent intervals
# of b hold the truth; of all recordings **0.87**, as an interval at the limit takes a for known.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxfilters as jf

FRAMES, DT = 600, 1 / 30
TRUE = {"a": 1.0, "b": 2.5, "s": 0.4}  # mm, mm/m^2, m
motion = lambda theta: jf.motion.matern(1.5, 0.7, theta["s"])
depth = lambda x: 1.8 + x[:1]
std = lambda theta, z: 1e-3 * (theta["a"] + theta["b"] * z**2)  # metres


def filter_of(theta):
    F, Q = motion(theta).discretize(DT)
    prior = jf.Gaussian(jnp.zeros(2), motion(theta).stationary_covariance())
    noise = lambda x, inputs: jnp.diag(std(theta, depth(x)) ** 2)
    return jf.extended_kalman(prior, lambda x: F @ x, Q, depth, noise)


def recording(key):
    (F, Q), stationary = motion(TRUE).discretize(DT), motion(TRUE).stationary_covariance()
    draws, noise = jax.random.normal(key, (FRAMES, 2)), jax.random.normal(jax.random.fold_in(key, 1), (FRAMES, 1))
    step = lambda x, w: (F @ x + jnp.linalg.cholesky(Q) @ w, depth(x))
    z = jax.lax.scan(step, jnp.linalg.cholesky(stationary) @ draws[0], draws)[1]
    return z + std(TRUE, z) * noise


def by_differences(y):
    sizes = jnp.sqrt(jnp.pi / 2 / 20.0) * jnp.abs(jnp.diff(y[:, 0], n=3))  # E|v| is std times sqrt(2 / pi)
    rows = jnp.stack([jnp.ones_like(sizes), y[1:-2, 0] ** 2], 1)
    return dict(zip("ab", 1e3 * jnp.linalg.lstsq(rows, sizes)[0], strict=True))


y = jax.jit(jax.vmap(recording))(jax.random.split(jax.random.key(1), 60))
density = lambda y: jf.fit.log_evidence(jax.random.key(0), filter_of, y)
start = {"a": 3.0, "b": 1.0, "s": 1.0}
found, rough = jax.vmap(lambda y: (jf.fit.maximize(density(y), start, jf.fit.positive), by_differences(y)))(y)
theta, errors = found.theta, found.standard_errors
error = lambda found: 100 * np.sqrt(np.mean((std(found, 3.0) / std(TRUE, 3.0) - 1) ** 2))
holds = np.abs(theta["b"] - TRUE["b"]) <= 1.96 * errors["b"]
result = error(theta), error(rough), holds[theta["a"] > 0.2].mean(), holds.mean()

# %%
figure, ax = plt.subplots(figsize=(9, 4), layout="constrained")
z = np.linspace(0.6, 3.0, 50)[:, None]
for found, colour, name in ((rough, "tab:orange", "differences"), (theta, "tab:blue", "gradient")):
    low, high = np.quantile(1e3 * std(found, z), [0.1, 0.9], axis=1)
    ax.fill_between(z[:, 0], low, high, color=colour, alpha=0.3, label=f"by {name}, 80 percent of the recordings")
ax.plot(z, 1e3 * std(TRUE, z), "--", color="0.1", label="truth")
ax.set(xlabel="depth (m)", ylabel="standard deviation (mm)", title="The noise of the camera")
ax.legend()
figure.savefig(Path(*sys.argv[1:2] if "__file__" in globals() else (), "camera_noise.webp"), dpi=110)
