# ---
# jupytext:
#   formats: ipynb,py:percent
# kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Stochastic volatility
#
# How strongly do daily returns $y_t$ fluctuate today, and how long does a storm last? The log-variance $x_t$ is an
# autoregression whose persistence $\rho$ and step $\sigma$ are unknown:
#
# $$x_t = \rho\, x_{t-1} + \sigma\, \epsilon_t, \quad y_t = e^{x_t / 2} \eta_t, \quad \epsilon_t, \eta_t \sim N(0, 1).$$
#
# Particle marginal Metropolis-Hastings draws both from their posterior; a particle filter gives the volatility. Beside
# it stands the variance of the last returns, of the best length of 5, 10, 20 and 40 days.
#
# **Result:** the filter's root mean square error of the log-variance is **0.67**; that of the window is **0.76**.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.scipy.stats import norm
from scipy.signal import lfilter

import jaxfilters as jf


def filter_of(theta):
    prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(1), jnp.eye(1)))
    move = lambda noise, x: theta["rho"] * x + theta["scale"] * noise
    log_likelihood = lambda x, y: norm.logpdf(y, 0.0, jnp.exp(x[0] / 2))
    return jf.bootstrap(prior, move, log_likelihood, num_particles=64, noise=jf.StandardNormal(1))


rng = np.random.default_rng(3)
x = lfilter([0.35], [1.0, -0.95], rng.normal(size=400))  # the true step and persistence
returns = jnp.asarray(np.exp(x / 2) * rng.normal(size=400), jnp.float32)

# Four chains with flat priors
constraints = {"rho": jf.fit.interval(0, 1), "scale": jf.fit.interval(0, 2)}
estimate = lambda key, theta: jf.log_evidence(filter_of(theta), key, returns)
sampler = jf.mcmc.pmmh(estimate, lambda theta: 0.0, proposal=jf.mcmc.random_walk(constraints, step=0.4))
start = {"rho": jnp.array([0.7, 0.8, 0.9, 0.98]), "scale": jnp.array([0.2, 0.8, 0.5, 0.3])}
state = jf.mcmc.init(jax.random.key(1), sampler, start)
draws = jax.tree.map(lambda each: each[50:], jf.mcmc.sample(jax.random.key(3), sampler, state, 200)[1].theta)
theta = jax.tree.map(jnp.mean, draws)


def moments(state, info):
    mean = jf.weights.mean(state.particles, state.log_weights)[0]
    square = jf.weights.mean(state.particles**2, state.log_weights)[0]
    return jnp.stack([mean, jnp.sqrt(square - mean**2)])


mean, std = np.asarray(jf.run(filter_of(theta), jax.random.key(4), returns, collect=moments)[1]).T
windows = [np.log(lfilter(np.ones(n) / n, [1.0], returns**2)) for n in (5, 10, 20, 40)]
error = lambda found: np.sqrt(np.mean((found - x)[40:] ** 2))
window = min(windows, key=error)
result = error(mean), error(window)

# %%
plt.rcParams.update({"axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False})
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), width_ratios=[2.2, 1], layout="constrained")
left.set_prop_cycle(color=["0.25", "tab:orange", "tab:blue"])
left.fill_between(range(400), mean - 2 * std, mean + 2 * std, color="tab:blue", alpha=0.2, label="filter, 2 sigma")
left.plot(x, label="truth")
left.plot(np.stack([window, mean], 1), label=["window", "filter"])
left.set(xlabel="time (days)", ylabel="log-variance of a return", title="Volatility", ylim=(-3.5, 5.5))
left.legend(ncols=4, loc="upper center")
right.plot(draws["rho"].ravel(), draws["scale"].ravel(), ".", alpha=0.3, label="posterior draws")
right.plot(0.95, 0.35, "*", color="0.1", markersize=14)
right.set(xlabel="persistence (1)", ylabel="step of the log-variance (1)", title="Posterior; star: truth")
figure.savefig(Path(*sys.argv[1:2] if "__file__" in globals() else (), "stochastic_volatility.webp"), dpi=110)
