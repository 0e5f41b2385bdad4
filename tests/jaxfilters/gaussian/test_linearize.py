import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.linearize import cubature, second_order, second_order_covariance_only, taylor, unscented

STRATEGIES = {
    "taylor": taylor,
    "second_order_covariance_only": second_order_covariance_only,
    "second_order": second_order,
    "cubature": cubature,
    "unscented": unscented(),
    "unscented_wide": unscented(1.3, 0.0, 1.0),
}
FORMS = {
    "covariance": lambda mean, root: Gaussian(jnp.asarray(mean), jnp.asarray(root @ root.T)),
    "root": lambda mean, root: GaussianRoot(jnp.asarray(mean), jnp.asarray(root)),
}


@pytest.fixture(params=FORMS, ids=str)
def form(request):
    return FORMS[request.param]


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.mark.system
@pytest.mark.parametrize("strategy", STRATEGIES.values(), ids=STRATEGIES)
@pytest.mark.parametrize("n", [3, 10])
def test_a_linear_function_is_itself(x64, rng, form, strategy, n):
    A, b, mean, root = rng.normal(size=(4, n)), rng.normal(size=4), rng.normal(size=n), rng.normal(size=(n, n + 2))
    found = jax.jit(lambda belief: strategy(lambda x: A @ x + b, belief))(form(mean, root))
    np.testing.assert_allclose(found.value, A @ mean + b, atol=1e-10)
    np.testing.assert_allclose(found.F, A, atol=1e-9)
    np.testing.assert_allclose(found.residual_root @ found.residual_root.T, np.zeros((4, 4)), atol=1e-18)


@pytest.mark.system
@pytest.mark.parametrize("strategy", STRATEGIES.values(), ids=STRATEGIES)
def test_directions_without_variance_do_no_harm(x64, rng, form, strategy):
    A, mean, root = rng.normal(size=(2, 10)), rng.normal(size=10), np.tril(rng.normal(size=(10, 10)))
    root[3] = 0
    root[6] = root[2]

    def spread(root):
        found = strategy(lambda x: jnp.sin(A @ x), form(mean, root))
        P = root @ root.T
        return found.F @ P @ found.F.T + found.residual_root @ found.residual_root.T

    # Four components of the state carry all of its variance, if the others follow from them.
    value, slope = jax.jit(jax.value_and_grad(lambda root: jnp.trace(spread(root))))(jnp.asarray(root))
    again = jnp.trace(spread(jnp.asarray(root) @ np.linalg.qr(rng.normal(size=(10, 10)))[0]))
    assert np.isfinite(slope).all()
    if strategy in (taylor, second_order_covariance_only, second_order):
        np.testing.assert_allclose(value, again, rtol=1e-6)


def quadratic(rng, n, m):
    bend = rng.normal(size=(m, n, n))
    bend = bend + bend.transpose(0, 2, 1)
    slope = rng.normal(size=(m, n))
    return bend, slope, lambda x: 0.5 * jnp.einsum("kij,i,j->k", bend, x, x) + slope @ x


def test_second_order_finds_the_moments_of_a_quadratic(x64, rng, form):
    n, m = 4, 3
    bend, slope, h = quadratic(rng, n, m)
    mean, root = rng.normal(size=n), np.tril(rng.normal(size=(n, n)))
    P = root @ root.T
    found, biased = jax.jit(lambda belief: (second_order_covariance_only(h, belief), second_order(h, belief)))(
        form(mean, root)
    )
    lost = found.residual_root @ found.residual_root.T
    np.testing.assert_allclose(lost, 0.5 * np.einsum("kij,jp,lpq,qi->kl", bend, P, bend, P), rtol=1e-9)
    np.testing.assert_allclose(found.value, h(mean), rtol=1e-12)

    draws = mean[:, None] + root @ rng.normal(size=(n, 400_000))
    observed = 0.5 * np.einsum("kij,in,jn->kn", bend, draws, draws) + slope @ draws
    # The fourth moments of a quadratic form make the relative error of a variance about 1 / sqrt(400 000 / 6) here.
    exact = found.F @ P @ found.F.T + lost
    np.testing.assert_allclose(np.cov(observed), exact, atol=0.02 * np.diag(exact).max())
    np.testing.assert_allclose(np.diag(np.cov(observed)), np.diag(exact), rtol=0.02)
    error = 4 * np.sqrt(np.diag(exact) / 400_000)
    assert (abs(observed.mean(axis=1) - biased.value) < error).all()
    np.testing.assert_allclose(biased.residual_root @ biased.residual_root.T, lost, rtol=1e-9)


def textbook_unscented(h, mean, P, alpha, beta, kappa):
    """Sigma points and weights as everybody writes them: mean, covariance and cross-covariance."""
    n = len(mean)
    spread = alpha**2 * (n + kappa)
    L = np.linalg.cholesky(spread * P)
    points = np.vstack([mean, *(mean + L.T), *(mean - L.T)])
    weights = np.full(2 * n + 1, 0.5 / spread)
    centre = 1 - n / spread
    mean_weights, weights[0] = np.append(centre, weights[1:]), centre + 1 - alpha**2 + beta
    observed = np.array([h(point) for point in points])
    expected = mean_weights @ observed
    return (
        expected,
        np.einsum("i,ik,il->kl", weights, observed - expected, observed - expected),
        np.einsum("i,ik,il->kl", weights, points - mean, observed - expected),
    )


@pytest.mark.parametrize(
    ("strategy", "parameters"),
    [(unscented(), (1, 2, 0)), (unscented(0.6, 1.5, 0.7), (0.6, 1.5, 0.7)), (cubature, (1, 0, 0))],
)
def test_sigma_points_agree_with_textbook(x64, rng, form, strategy, parameters):
    mean, root, A = rng.normal(size=4), np.tril(rng.normal(size=(4, 4))), rng.normal(size=(3, 4))
    root *= np.sign(np.diag(root))
    h = lambda x: jnp.stack([jnp.sin(A[0] @ x), jnp.exp(0.3 * A[1] @ x), x[0] * x[1] + A[2] @ x])
    found = jax.jit(lambda belief: strategy(h, belief))(form(mean, root))
    P = root @ root.T
    expected, covariance, cross = textbook_unscented(h, mean, P, *parameters)
    np.testing.assert_allclose(found.value, expected, rtol=1e-10)
    np.testing.assert_allclose(P @ found.F.T, cross, atol=1e-10)
    np.testing.assert_allclose(
        found.F @ P @ found.F.T + found.residual_root @ found.residual_root.T, covariance, atol=1e-10
    )


def test_strategies_with_equal_numbers_are_equal():
    assert unscented(0.5, 2.0, 1.0) == unscented(0.5, 2.0, 1.0)
    assert hash(unscented()) == hash(unscented())


@pytest.mark.parametrize(
    ("arguments", "named"), [((0.0,), "alpha"), ((1.0, -1.0), "beta and kappa"), ((1.0, 2.0, -2.0), "beta and kappa")]
)
def test_spreads_that_cannot_be_are_rejected(arguments, named):
    with pytest.raises(ValueError, match=named):
        unscented(*arguments)
