# ---
# jupytext:
#   formats: ipynb,py:percent
# kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A finger joint between its limits
#
# A glove measures the angle $\theta$ of a joint with a noise of 40 degrees. The joint cannot leave 0 to 90 degrees:
#
# $$\ddot\theta = w, \quad y_t = \theta_t + v_t, \quad v_t \sim N(0, (40^\circ)^2), \quad 0 \le \theta_t \le 90^\circ.$$
#
# `jf.constrained` truncates the belief of a Kalman filter to the limits after every update. Beside it stand the same
# Kalman filter without limits, and its mean clipped to them. A joint that rests at its limits is another case: with a
# noise of 15 degrees clipping had 5.4 degrees there, and truncation, whose mean is always inside, 7.3.
#
# **Result:** the root mean square error is **14.6** degrees with truncation, **16.2** by clipping, **19.9** by the
# Kalman filter and **40.7** without a filter; **0.90** of the true angles are within 2 sigma of the truncated belief.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxfilters as jf

DT, NOISE = 1 / 30, 40.0  # seconds, degrees
F, Q = jf.motion.constant_velocity(2e4).discretize(DT)
kalman = jf.kalman(jf.Gaussian(jnp.array([45.0, 0.0]), 900 * jnp.eye(2)), F, Q, jnp.eye(1, 2), NOISE**2 * jnp.eye(1))
limits = jf.constraints.linear_constraints([[1.0, 0.0]], lower=0.0, upper=90.0)
rule = jf.TruncateEachStep(limits, jf.constraints.cut.sequential_intervals)

seconds = DT * np.arange(300)
truth = np.clip(45 - 42 * np.cos(2 * np.pi * seconds / 2), 0, 90)
y = jnp.asarray(truth[:, None] + NOISE * np.random.default_rng(0).normal(size=(300, 1)), jnp.float32)
key = jax.random.key(0)
_, (plain, _) = jf.run(kalman, key, y)
_, (states, _) = jf.run(jf.constrained(kalman, rule), key, y)
mean, std = np.asarray(states.belief.mean[:, 0]), np.sqrt(np.asarray(states.belief.covariance[:, 0, 0]))
by_kalman = np.asarray(plain.mean[:, 0])

rms = lambda angles: np.sqrt(np.mean((angles - truth) ** 2))
coverage = np.mean(np.abs(mean - truth) <= 2 * std)
result = rms(mean), rms(np.clip(by_kalman, 0, 90)), rms(by_kalman), rms(np.asarray(y[:, 0])), coverage

# %%
plt.rcParams.update({"axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False})
figure, ax = plt.subplots(figsize=(10, 4), layout="constrained")
ax.axhspan(-110, 0, color="0.93")
ax.axhspan(90, 220, color="0.93", label="impossible")
ax.plot(seconds, y, ".", color="0.6", markersize=4, label="measured")
ax.fill_between(seconds, mean - 2 * std, mean + 2 * std, color="tab:blue", alpha=0.2, label="truncated, 2 sigma")
ax.plot(seconds, truth, color="0.25", linewidth=2, label="truth")
ax.plot(seconds, by_kalman, color="tab:orange", label="Kalman filter")
ax.plot(seconds, mean, color="tab:blue", label="truncated")
ax.set(xlabel="time (s)", ylabel="angle of the joint (degrees)", ylim=(-110, 220), title="A joint between its limits")
ax.legend(ncols=6, fontsize=8, loc="upper center")
figure.savefig(Path(*sys.argv[1:2] if "__file__" in globals() else (), "constraints.webp"), dpi=110)
