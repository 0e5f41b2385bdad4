import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.filter import run
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import Observation, extended_kalman
from jaxfilters.gaussian.linear import kalman
from jaxfilters.gaussian.linearize import cubature, taylor
from jaxfilters.gaussian.manifold import Manifold, add, displacement
from jaxfilters.gaussian.smoothing import filter_and_smooth, lag_one_covariances, posterior_samples, rts
from jaxfilters.gaussian.two_filter import two_filter
from jaxfilters.particle.bootstrap import bootstrap

RNG = np.random.default_rng(11)
N, M, T = 3, 2, 6
F, H = 0.8 * RNG.normal(size=(N, N)), RNG.normal(size=(M, N))
DRIFT, MEAN = RNG.normal(size=N), RNG.normal(size=N)
ROOT_P, ROOT_Q, ROOT_R = (np.tril(RNG.normal(size=(size, size))) for size in (N, N, M))
YS = RNG.normal(size=(T, M))
SEEN = np.array([[1, 1], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]], bool)
KEY = jax.random.key(0)


def transition(x, inputs):
    return F @ x + inputs * DRIFT


def observe(x):
    return H @ x


def build(arithmetic, **options):
    if arithmetic is arithmetics.square_root:
        prior, noises = GaussianRoot(jnp.asarray(MEAN), jnp.asarray(ROOT_P)), (ROOT_Q, ROOT_R)
    else:
        prior = Gaussian(jnp.asarray(MEAN), jnp.asarray(ROOT_P @ ROOT_P.T))
        noises = (ROOT_Q @ ROOT_Q.T, ROOT_R @ ROOT_R.T)
    Q, R = map(jnp.asarray, noises)
    return extended_kalman(prior, transition, Q, observe, R, arithmetic=arithmetic, **options)


def joint_posterior():
    """All states given all readings, from their joint Gaussian; and the log density of the readings."""
    means, blocks = [MEAN], [[ROOT_P @ ROOT_P.T]]
    for t in range(T):
        means.append(F @ means[-1] + (t + 1) * DRIFT)
        last = [F @ block for block in blocks[-1]]
        blocks.append([*last, last[-1] @ F.T + ROOT_Q @ ROOT_Q.T])
    P = np.zeros(((T + 1) * N, (T + 1) * N))
    for i, row in enumerate(blocks):
        for j, block in enumerate(row):
            P[i * N : (i + 1) * N, j * N : (j + 1) * N] = block
            P[j * N : (j + 1) * N, i * N : (i + 1) * N] = block.T
    mean, P = np.concatenate(means)[N:], P[N:, N:]
    observed = SEEN.ravel()
    C = np.kron(np.eye(T), H)[observed]
    R = np.kron(np.eye(T), ROOT_R @ ROOT_R.T)[np.ix_(observed, observed)]
    S, surprise = C @ P @ C.T + R, YS.ravel()[observed] - C @ mean
    gain = P @ C.T @ np.linalg.inv(S)
    log_evidence = -0.5 * (surprise @ np.linalg.solve(S, surprise) + np.linalg.slogdet(2 * np.pi * S)[1])
    posterior = P - gain @ C @ P
    return (mean + gain @ surprise).reshape(T, N), posterior, log_evidence


def blocks_of(posterior, lag):
    """Covariances of the states of frames t and t + lag."""
    return np.array([posterior[i : i + N, i + lag * N :][:, :N] for i in range(0, (T - lag) * N, N)])


# The same space, but the covariances go through tangent spaces.
CURVED = Manifold(add, displacement)


@pytest.mark.system
@pytest.mark.parametrize(
    ("arithmetic", "options"),
    [
        (arithmetics.joseph, dict(linearize=taylor)),
        (arithmetics.square_root, dict(linearize=taylor)),
        (arithmetics.fast, dict(linearize=taylor)),
        (arithmetics.square_root, dict(linearize=cubature, manifold=CURVED)),
        (arithmetics.joseph, dict(linearize=cubature, manifold=CURVED)),
    ],
    ids=["joseph", "square_root", "fast", "square_root_cubature_curved", "joseph_cubature_curved"],
)
def test_smoothed_beliefs_are_those_of_the_joint_gaussian(x64, arithmetic, options):
    ys = Observation(jnp.where(SEEN, YS, jnp.nan), jnp.asarray(SEEN))
    inputs = jnp.arange(1.0, T + 1)
    means, posterior, log_evidence = joint_posterior()
    beliefs, infos = filter_and_smooth(build(arithmetic, **options), KEY, ys, inputs)
    np.testing.assert_allclose(beliefs.mean, means, atol=1e-9)
    found = beliefs.covariance if isinstance(beliefs, Gaussian) else beliefs.root @ beliefs.root.transpose(0, 2, 1)
    np.testing.assert_allclose(found, blocks_of(posterior, 0), atol=1e-9)
    np.testing.assert_allclose(infos.log_evidence.sum(), log_evidence, rtol=1e-10)


@pytest.mark.system
@pytest.mark.parametrize(
    ("arithmetic", "options"),
    [(arithmetics.joseph, {}), (arithmetics.square_root, dict(linearize=cubature, manifold=CURVED))],
    ids=["joseph", "square_root_cubature_curved"],
)
def test_samples_and_neighbours_are_those_of_the_joint_gaussian(x64, arithmetic, options):
    """Whitened by the exact joint covariance, samples are independent standard normal numbers.

    Their 18 means and 171 covariances are tested at 4.5 standard errors: a false alarm has a probability of 1.3e-3.
    """
    filter, inputs, count = build(arithmetic, **options), jnp.arange(1.0, T + 1), 4000
    means, posterior, _ = joint_posterior()
    ys = Observation(jnp.where(SEEN, YS, jnp.nan), jnp.asarray(SEEN))
    _, (beliefs, _) = run(filter, KEY, ys, inputs)
    found = lag_one_covariances(filter, beliefs, rts(filter, beliefs, inputs), inputs)
    np.testing.assert_allclose(found, blocks_of(posterior, 1), atol=1e-9)
    samples = np.asarray(posterior_samples(filter, KEY, beliefs, inputs, num_samples=count))
    assert samples.shape == (T, N, count)
    white = np.linalg.solve(np.linalg.cholesky(posterior), samples.reshape(T * N, count) - means.reshape(-1, 1))
    assert abs(white.mean(axis=1)).max() < 4.5 / np.sqrt(count)
    errors = np.sqrt((1 + np.eye(T * N)) / count)
    assert (abs(white @ white.T / count - np.eye(T * N)) / errors).max() < 4.5


@pytest.mark.system
@pytest.mark.parametrize("name", ["joseph", "square_root"])
def test_a_filter_from_each_side_finds_the_joint_gaussian(x64, name):
    filter, inputs = build(getattr(arithmetics, name)), jnp.arange(1.0, T + 1)
    means, posterior, _ = joint_posterior()
    ys, mask = Observation(jnp.where(SEEN, YS, jnp.nan), jnp.asarray(SEEN)), jnp.arange(T) != 3
    _, (beliefs, _) = run(filter, KEY, ys, inputs, mask=mask)
    found = two_filter(filter, beliefs, ys, inputs, mask=mask)
    np.testing.assert_allclose(found.mean, means, atol=1e-9)
    P = found.covariance if isinstance(found, Gaussian) else found.root @ found.root.transpose(0, 2, 1)
    np.testing.assert_allclose(P, blocks_of(posterior, 0), atol=1e-9)


def test_an_unseen_frame_is_smoothed_from_both_sides(x64):
    kept = np.arange(T) != 3
    filter, inputs = build(arithmetics.joseph), jnp.arange(1.0, T + 1)
    masked, infos = filter_and_smooth(
        filter, KEY, Observation(jnp.asarray(YS), jnp.asarray(SEEN)), inputs, mask=jnp.asarray(kept)
    )
    np.testing.assert_allclose(masked.mean, joint_posterior()[0], atol=1e-9)
    assert infos.log_evidence[3] == 0


@pytest.mark.system
def test_a_second_filter_announces_exact_observations(x64):
    """Their information is infinite: an error where the noise is known, and NaN in earlier frames where it is not."""
    prior, one = Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
    ys, noises = jnp.array([[0.3], [1.1], [0.7]]), jnp.array([1.0, 0.0, 1.0])[:, None, None]
    filter = kalman(prior, one, one, one, lambda noise: noise)
    beliefs = run(filter, KEY, ys, noises)[1][0]
    with pytest.raises(ValueError, match="the variance of component 0 is 0"):
        two_filter(kalman(prior, one, one, one, 0.0 * one), beliefs, ys)
    found = two_filter(filter, beliefs, ys, noises)
    assert np.isnan(found.mean[0]).all()
    assert np.isnan(found.covariance[0]).all()
    np.testing.assert_allclose(found.mean[1:], rts(filter, beliefs, noises).mean[1:], atol=1e-12)


@pytest.mark.system
def test_the_smoother_differentiates(x64):
    filter = build(arithmetics.joseph)
    ys, inputs = jnp.asarray(YS), jnp.ones(T)

    def first_mean(scale):
        _, (beliefs, _) = run(filter, KEY, scale * ys, inputs)
        return rts(filter, beliefs, inputs).mean[0, 0]

    slope = jax.jit(jax.grad(first_mean))(1.0)
    np.testing.assert_allclose(slope, (first_mean(1 + 1e-6) - first_mean(1 - 1e-6)) / 2e-6, rtol=1e-6)


def test_other_filters_and_lengths_are_rejected():
    def unused(x, y):
        return jnp.zeros(())

    with pytest.raises(ValueError, match="made by kalman or extended_kalman"):
        rts(bootstrap(unused, unused, unused, num_particles=2), Gaussian(jnp.zeros((T, 1)), jnp.zeros((T, 1, 1))))
    with pytest.raises(ValueError, match="as long as beliefs, 6"):
        rts(build(arithmetics.joseph), Gaussian(jnp.zeros((T, N)), jnp.zeros((T, N, N))), jnp.zeros(T - 1))
