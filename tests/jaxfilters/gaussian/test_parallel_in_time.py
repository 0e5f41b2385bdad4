import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian import arithmetic
from jaxfilters.gaussian.belief import GaussianRoot
from jaxfilters.gaussian.parallel_in_time import LinearModel, parallel_kalman, parallel_rts

RNG = np.random.default_rng(6)
N, M, T = 3, 2, 7
VARYING = LinearModel(
    F=0.6 * RNG.normal(size=(T, N, N)),
    root_Q=RNG.normal(size=(T, N, 2)),
    H=RNG.normal(size=(T, M, N)),
    root_R=np.tril(RNG.normal(size=(T, M, M))),
    b=RNG.normal(size=(T, N)),
    d=RNG.normal(size=(T, M)),
)
CONSTANT = LinearModel(*(leaf[0] for leaf in VARYING[:4]), b=VARYING.b[0])
MEAN, ROOT = RNG.normal(size=N), RNG.normal(size=(N, N))
YS = RNG.normal(size=(T, M))
SEEN = RNG.random((T, M)) < 0.7
SEEN[1, 0] = SEEN[4] = False


def one_after_the_other(model, ys, observed):
    """Square-root filter and smoother in a plain loop."""
    offsets = [np.broadcast_to(model.b, (T, N)), np.broadcast_to(model.d, (T, M))]
    steps = [np.broadcast_to(leaf, (T, *leaf.shape[-2:])) for leaf in model[:4]]
    belief, beliefs, evidences = GaussianRoot(jnp.asarray(MEAN), jnp.asarray(ROOT)), [], []
    for F, root_Q, H, root_R, b, d, y, mask in zip(*steps, *offsets, ys, observed, strict=True):
        ahead = PREDICT(belief, jnp.asarray(F), jnp.asarray(root_Q), jnp.asarray(b))
        belief, info = UPDATE(ahead, jnp.asarray(y - d), jnp.asarray(H), jnp.asarray(root_R), None, jnp.asarray(mask))
        belief = GaussianRoot(belief.mean, belief.root[:, :N])
        beliefs.append(belief)
        evidences.append(info.log_evidence)
    smoothed = [belief]
    for t in range(T - 2, -1, -1):
        arguments = (jnp.asarray(leaf[t + 1]) for leaf in (steps[0], steps[1], offsets[0]))
        smoothed.insert(0, RTS(beliefs[t], smoothed[0], *arguments))
    return beliefs, smoothed, np.array(evidences)


PREDICT, UPDATE, RTS = (
    jax.jit(f) for f in (arithmetic.square_root.predict, arithmetic.square_root.update, arithmetic.square_root.rts)
)


def covariances(beliefs):
    return np.array([np.asarray(b.root) @ np.asarray(b.root).T for b in beliefs])


@pytest.mark.system
def test_the_beliefs_are_those_of_the_sequential_filter_and_smoother(x64):
    model = VARYING
    ys = np.where(SEEN, YS, np.nan)
    beliefs, smoothed, evidences = one_after_the_other(model, ys, SEEN)
    steps = jax.tree.map(jnp.asarray, model)
    found, found_evidences = parallel_kalman(GaussianRoot(jnp.asarray(MEAN), jnp.asarray(ROOT)), steps, jnp.asarray(ys))
    found_smoothed = parallel_rts(found, steps)
    np.testing.assert_allclose(found_evidences, evidences, atol=1e-9)
    for many, one_by_one in ((found, beliefs), (found_smoothed, smoothed)):
        np.testing.assert_allclose(many.mean, [b.mean for b in one_by_one], atol=1e-8)
        roots = np.asarray(many.root)
        np.testing.assert_allclose(roots @ roots.transpose(0, 2, 1), covariances(one_by_one), atol=1e-8)


@pytest.mark.system
def test_masked_readings_do_not_matter_and_the_evidence_differentiates(x64):
    prior = GaussianRoot(jnp.asarray(MEAN), jnp.asarray(ROOT))
    # Few frames: every round of the scan is compiled, and its derivative.
    steps, observed, some_ys = jax.tree.map(lambda leaf: jnp.asarray(leaf[:3]), (VARYING, SEEN, YS))

    def evidence(scale, ys):
        scaled = steps._replace(F=scale[0] * steps.F, root_R=scale[1] * steps.root_R)
        return parallel_kalman(prior, scaled, ys, observed)[1].sum()

    evaluate = jax.jit(jax.value_and_grad(evidence))
    scale = jnp.array([1.0, 1.2])
    value, slope = evaluate(scale, jnp.where(observed, some_ys, jnp.nan))
    np.testing.assert_allclose(evaluate(scale, jnp.where(observed, some_ys, 7.0))[0], value, rtol=1e-12)
    ys = jnp.where(observed, some_ys, 0.0)
    differences = [(evaluate(scale + e, ys)[0] - evaluate(scale - e, ys)[0]) / 2e-6 for e in 1e-6 * np.eye(2)]
    np.testing.assert_allclose(slope, differences, rtol=1e-6)


@pytest.mark.system
def test_float32_keeps_the_evidence_of_certain_readings():
    # The process noise is a million times that of the readings.
    model = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), CONSTANT._replace(root_R=1e-3 * CONSTANT.root_R))
    prior = GaussianRoot(jnp.asarray(MEAN, jnp.float32), jnp.asarray(ROOT, jnp.float32))
    _, found = parallel_kalman(prior, model, jnp.asarray(YS, jnp.float32))
    with jax.enable_x64(True):
        _, _, expected = one_after_the_other(CONSTANT._replace(root_R=1e-3 * CONSTANT.root_R), YS, np.ones_like(SEEN))
    np.testing.assert_allclose(found.sum(), expected.sum(), rtol=1e-3)


@pytest.mark.system
def test_infinite_information_is_announced(x64):
    """An exact position whose noise acts on the velocity alone; by hand, the first reading has the variance 5."""
    F = jnp.array([[1.0, 1.0], [0.0, 1.0]])
    root_Q, H = jnp.diag(jnp.array([0.0, 0.5])), jnp.array([[1.0, 0.0], [1.0, 0.0]])
    model = LinearModel(F, root_Q, H, jnp.zeros((2, 2)))
    prior = GaussianRoot(jnp.zeros(2), jnp.diag(jnp.array([2.0, 1.0])))
    ys = jnp.array([[3.0, jnp.nan], [jnp.nan, jnp.nan], [1.0, jnp.nan], [1.0, jnp.nan]])
    beliefs, evidences = parallel_kalman(prior, model, ys)
    np.testing.assert_allclose(evidences[0], -0.5 * (9 / 5 + np.log(2 * np.pi * 5)), rtol=1e-12)
    # A frame without readings loses nothing; the third frame does, and all from it on.
    assert np.isfinite(beliefs.mean[:2]).all()
    assert np.isfinite(beliefs.root[:2]).all()
    assert np.isnan(beliefs.mean[2:]).all()
    assert np.isnan(evidences[3])


def test_a_model_of_another_length_is_rejected():
    prior = GaussianRoot(jnp.asarray(MEAN), jnp.asarray(ROOT))
    with pytest.raises(ValueError, match=r"model\.F must have the 6 frames of the sequence; got 7"):
        parallel_kalman(prior, jax.tree.map(jnp.asarray, VARYING), jnp.asarray(YS[:-1]))
