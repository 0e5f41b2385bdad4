"""The fit to aligned landmarks against SciPy's least squares, and its covariances against many draws."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import multivariate_normal, multivariate_t

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face import refinement as module
from jaxfilters.models.face.alignment import Alignment
from jaxfilters.models.face.landmarks import MEAN_SHAPE
from jaxfilters.models.face.patches import Slopes
from jaxfilters.models.face.pose import place, rotation
from jaxfilters.models.face.refinement import COMMON_BIAS_PX, DEGREES_OF_FREEDOM, LEAST_SCORE, PIXEL_FLOOR
from jaxfilters.models.face.rig import jacobian, nominal, project_shape, triangulate
from jaxfilters.models.face.shape_model import FaceModel, shape

pytestmark = pytest.mark.system

NU = DEGREES_OF_FREEDOM
POSE = np.array([60.0, 5, 640, 0.05, -0.2, 0.1])
PRIOR_STD = np.array([2.0, 2, 4, 0.03, 0.05, 0.05, 3.0, 2.0])
NOISE = np.array([[0.0016, 0.0004], [0.0004, 0.0009]])
LOOSE_STD, SLOPE_STD = 0.1, 0.1
refine, displaced = jax.jit(module.refine), jax.jit(module.displaced)


@jax.jit
def projected(rig, model, x, moved):
    return project_shape(rig, shape(model, x[6:]) + moved, x[:6])[0]


derivatives = jax.jit(jacobian)
by_state = jax.jit(jax.jacfwd(projected, argnums=2))


class Face:
    """Ten landmarks with two modes, and drawn alignments; what `refine` takes."""

    def __init__(self):
        rng = np.random.default_rng(0)
        basis = np.linalg.qr(rng.normal(size=(30, 2)))[0]
        self.rig = nominal()
        self.model = FaceModel(
            jnp.asarray(MEAN_SHAPE), jnp.asarray(basis), jnp.array([3.0, 2.0]), jnp.zeros((2, 10, 16, 16))
        )
        self.model_variance = jnp.tile(LOOSE_STD**2 * jnp.eye(3), (10, 1, 1))
        self.slopes = Slopes(jnp.zeros((10, 2)), jnp.tile(SLOPE_STD**2 * jnp.eye(2), (10, 1, 1)))
        self.by_slope = jnp.asarray(rng.normal(0, 0.3, (2, 10, 2, 2)))
        self.prior = Gaussian(jnp.asarray([*POSE, 0.0, 0.0]), jnp.diag(jnp.asarray(PRIOR_STD**2)))

    def found(self, uv, observed=None):
        observed = jnp.ones((2, 10), bool) if observed is None else observed
        return Alignment(
            uv=jnp.asarray(uv),
            covariance=jnp.broadcast_to(jnp.asarray(NOISE), (2, 10, 2, 2)),
            score=jnp.ones((2, 10)),
            observed=observed,
            by_slope=self.by_slope,
            slope_information=jnp.zeros((10, 2, 2)),
            slope_score=jnp.zeros((10, 2)),
        )

    def refine(self, found, prior=None):
        prior = self.prior if prior is None else prior
        return refine(prior, found, self.slopes, self.model, self.model_variance, self.rig, prior.mean)

    def project(self, x, moved=0.0):
        return projected(self.rig, self.model, jnp.asarray(x), jnp.asarray(moved))

    def shape(self, x):
        return np.asarray(self.model.mean) + (np.asarray(self.model.basis) @ np.asarray(x[6:])).reshape(10, 3)

    def by_shape(self, x):
        return np.asarray(derivatives(self.rig, jnp.asarray(self.shape(x)), jnp.asarray(x[:6]))[0])

    def draw(self, key):
        """A state from the prior, and what would be seen of it."""
        keys = jax.random.split(key, 4)
        x = self.prior.mean + jnp.asarray(PRIOR_STD) * jax.random.normal(keys[0], (8,))
        moved = LOOSE_STD * jax.random.normal(keys[1], (10, 3))
        bent = SLOPE_STD * jnp.einsum("ckis,ks->cki", self.by_slope, jax.random.normal(keys[2], (10, 2)))
        noise = jax.random.normal(keys[3], (2, 10, 2)) @ jnp.linalg.cholesky(jnp.asarray(NOISE)).T
        return x, self.project(x, moved) + bent + noise


@pytest.fixture
def face(x64):
    return the_face()


@cache
def the_face():
    return Face()


def covariances(face, x, observed):
    """Of the seen rows of each landmark, as the module's text has them, in NumPy."""
    blocks = []
    for k in range(10):
        J, bend = (np.concatenate([a[c, k] for c in range(2)]) for a in (face.by_shape(x), np.asarray(face.by_slope)))
        S = LOOSE_STD**2 * J @ J.T + SLOPE_STD**2 * bend @ bend.T
        S += np.kron(np.eye(2), NOISE + PIXEL_FLOOR**2 * np.eye(2))
        rows = np.repeat(np.asarray(observed)[:, k], 2)
        blocks.append(S[np.ix_(rows, rows)])
    return blocks


def residuals(face, uv, x, observed):
    off = np.asarray(uv) - np.asarray(face.project(x))
    return [off[:, k][np.asarray(observed)[:, k]].ravel() for k in range(10)]


def some_seen():
    return jnp.ones((2, 10), bool).at[0, 3].set(False).at[:, 7].set(False)


@pytest.mark.parametrize("outlier", [0.0, 3.0])
def test_the_fit_is_the_least_squares_of_scipy(face, outlier):
    """The same Student residuals, a number each landmark, with the covariances at the solution.

    Five rounds of reweighting leave a few hundredths of a standard deviation.
    """
    _, uv = face.draw(jax.random.key(1))
    observed = some_seen()
    uv = uv.at[:, 5].add(outlier)
    found = face.refine(face.found(uv, observed))
    whiten = [np.linalg.inv(np.linalg.cholesky(S)) for S in covariances(face, found.belief.mean, observed)]

    def function(x):
        white = [L @ r for L, r in zip(whiten, residuals(face, uv, x, observed), strict=True)]
        student = [np.sqrt((NU + len(w)) * np.log1p(w @ w / NU)) for w in white]
        return np.concatenate([student, (x - np.asarray(face.prior.mean)) / PRIOR_STD])

    fit = least_squares(function, face.prior.mean, x_scale=PRIOR_STD, xtol=1e-12, ftol=1e-14)
    apart = (np.asarray(found.belief.mean) - fit.x) / np.sqrt(np.diagonal(found.belief.covariance))
    assert np.abs(apart).max() < 0.05
    assert np.abs(fit.x - np.asarray(face.prior.mean)).max() > 1


def information_at(face, found, uv, observed, fisher=False):
    """Of the prior and all landmarks, written out; and the landmarks' residuals and covariances."""
    x = np.asarray(found.belief.mean)
    S, off = covariances(face, x, observed), residuals(face, uv, x, observed)
    H = np.asarray(by_state(face.rig, face.model, found.belief.mean, jnp.asarray(0.0)))
    information = np.diag(PRIOR_STD**-2.0)
    for k, (r, C) in enumerate(zip(off, S, strict=True)):
        h = H[:, k][np.asarray(observed)[:, k]].reshape(-1, 8)
        trust = (NU + r.size) / (NU + r @ np.linalg.solve(C, r)) if r.size else 1.0
        assert float(found.trust[k]) == pytest.approx(trust, rel=1e-6)
        trust *= (NU + r.size) / (NU + r.size + 2) if fisher else 1.0
        information += trust * h.T @ np.linalg.solve(C, h)
    return information, off, S


def test_the_evidence_is_that_of_student_and_laplace(face):
    _, uv = face.draw(jax.random.key(2))
    observed = some_seen()
    found = face.refine(face.found(uv, observed))
    information, off, S = information_at(face, found, uv, observed)
    evidence = multivariate_normal.logpdf(found.belief.mean, face.prior.mean, np.diag(PRIOR_STD**2.0))
    evidence += sum(multivariate_t.logpdf(r, shape=C, df=NU) for r, C in zip(off, S, strict=True) if r.size)
    evidence += 4 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(information)[1]
    assert float(found.log_evidence) == pytest.approx(evidence, abs=1e-4)
    assert float(found.num_observed) == 9


def test_the_covariance_is_inverse_expected_information_and_a_bias_of_whole_images(face):
    """Of Student's t with p rows the expected information is `(nu + p) / (nu + p + 2)` of that of the weights.

    The bias is how far the fit goes when all landmarks of an image are a little off; central differences.
    """
    _, uv = face.draw(jax.random.key(2))
    observed = some_seen()
    found = face.refine(face.found(uv, observed))
    ends = [
        [face.refine(face.found(uv.at[c, :, i].add(s), observed)) for s in (0.02, -0.02)] for c, i in np.ndindex(2, 2)
    ]
    moved = COMMON_BIAS_PX * np.array([(a.belief.mean - b.belief.mean) / 0.04 for a, b in ends])
    information, _, _ = information_at(face, found, uv, observed, fisher=True)
    scale = np.sqrt(np.diagonal(found.belief.covariance))
    expected = np.linalg.inv(information) + moved.T @ moved
    np.testing.assert_allclose(
        found.belief.covariance / scale / scale[:, None], expected / scale / scale[:, None], atol=0.03
    )


def test_covariances_are_true_over_many_draws(face):
    """Errors over their covariance: 8 in the mean of 2000 Gaussian draws.

    Weights that are taken as given make Student's information too large, by 10 / 8 for a landmark of four rows.
    """

    def one(key):
        x, uv = face.draw(key)
        found = module.refine(
            face.prior, face.found(uv), face.slopes, face.model, face.model_variance, face.rig, face.prior.mean
        )
        error = found.belief.mean - x
        square = error @ jnp.linalg.solve(found.belief.covariance, error)
        return error, square, jnp.diagonal(found.belief.covariance), found.residual_scale, found.excess

    # One by one: batches of factorisations can stand still on two cores.
    keys = jax.random.split(jax.random.key(4), 2000)
    error, square, variance, residual_scale, excess = jax.jit(lambda keys: jax.lax.map(one, keys))(keys)
    # Standard error of the mean: sqrt(16 / 2000) = 0.09.
    assert 7 < square.mean() < 11
    assert np.all(np.abs(error.mean(axis=0)) < 4 * error.std(axis=0) / np.sqrt(2000) + 0.01 * error.std(axis=0))
    np.testing.assert_allclose(error.std(axis=0), np.sqrt(variance.mean(axis=0)), rtol=0.15)
    within = (np.abs(error) < 2 * np.sqrt(variance)).mean(axis=0)
    assert np.all((within > 0.89) & (within < 0.985))
    assert np.asarray(residual_scale).mean() == pytest.approx(1, abs=0.1)
    # Excess is the model_variance, and what unknown slopes add to it.
    assert 0.7 * LOOSE_STD**2 < np.asarray(excess).mean() < 2 * LOOSE_STD**2


def test_covariances_are_true_under_the_noise_of_student(face):
    """Landmarks whose four rows together are as long as Student's t makes them; 2000 draws of eight numbers.

    4 standard errors of a variance's ratio are 4 sqrt(2 / 2000) = 13 %, and ten landmarks are few: without the factor
    of the expected information the ratio is 1.5.
    """

    def one(key):
        draw, scale = jax.random.split(key)
        x, uv = face.draw(draw)
        root = jnp.sqrt(NU / jax.random.chisquare(scale, NU, shape=(10,)))
        still = face.project(x)
        found = module.refine(
            Gaussian(x, 1e6 * face.prior.covariance),
            face.found(still + root[:, None] * (uv - still)),
            face.slopes,
            face.model,
            face.model_variance,
            face.rig,
            x,
        )
        error = found.belief.mean - x
        return error, jnp.diagonal(found.belief.covariance), found.residual_scale

    keys = jax.random.split(jax.random.key(5), 2000)
    error, variance, residual_scale = jax.jit(lambda keys: jax.lax.map(one, keys))(keys)
    ratio = (error**2).mean(axis=0) / variance.mean(axis=0)
    assert 0.87 < ratio.mean() < 1.3
    assert np.asarray(residual_scale).mean() == pytest.approx(1, abs=0.15)


def test_only_alignments_tell_their_misfit(face):
    """Errors of landmarks twice as large as claimed; a model_variance hides them but across the epipolar lines."""

    def one(key):
        x, uv = face.draw(key)
        narrow = face.found(uv)._replace(covariance=0.25 * face.found(uv).covariance)
        found = [
            module.refine(face.prior, narrow, face.slopes, face.model, s * face.model_variance, face.rig, x, own)
            for s, own in ((1.0, None), (1e4, None), (1.0, jnp.zeros((2, 10), bool)))
        ]
        return [(f.residual_scale, f.misfit_share) for f in found]

    keys = jax.random.split(jax.random.key(6), 300)
    (usual, hidden, none) = jax.jit(lambda keys: jax.lax.map(one, keys))(keys)
    assert 1.2 < np.asarray(usual[0]).mean() < 4
    assert np.asarray(hidden[1]).mean() < 0.6 * np.asarray(usual[1]).mean()
    np.testing.assert_array_equal(none[1], 0.0)


def test_a_mistaken_landmark_does_not_pull_the_head_along(face):
    x, uv = face.draw(jax.random.key(5))
    clean, wrong = face.refine(face.found(uv)), face.refine(face.found(uv.at[:, 6].add(40.0)))
    deviation = np.sqrt(np.diagonal(clean.belief.covariance))
    assert np.abs((wrong.belief.mean - clean.belief.mean) / deviation).max() < 3
    assert wrong.trust[6] < 1e-3
    assert np.delete(wrong.trust, 6).min() > 0.3
    assert np.all(np.diagonal(wrong.belief.covariance) > 0.99 * np.diagonal(clean.belief.covariance))
    assert np.abs((wrong.belief.mean - x) / deviation).max() < 4


def test_the_order_of_landmarks_and_cameras_does_not_matter(face):
    """Oracle 13; the world stays the frame of the left camera."""
    _, uv = face.draw(jax.random.key(7))
    found = face.found(uv, some_seen())
    expected = face.refine(found)
    order = np.random.default_rng(3).permutation(10)
    rows = (3 * order[:, None] + np.arange(3)).ravel()
    per_camera = {"uv", "covariance", "score", "observed", "by_slope"}
    mixed = found._replace(**{name: getattr(found, name)[:, order] for name in per_camera})
    model = replace(face.model, mean=face.model.mean[order], basis=face.model.basis[rows])
    landmarks = refine(face.prior, mixed, face.slopes, model, face.model_variance, face.rig, face.prior.mean)
    swapped = found._replace(**{name: getattr(found, name)[::-1] for name in per_camera})
    rig = jax.tree.map(lambda leaf: leaf[::-1], face.rig)
    cameras = refine(face.prior, swapped, face.slopes, face.model, face.model_variance, rig, face.prior.mean)
    for again in (landmarks, cameras):
        np.testing.assert_allclose(again.belief.mean, expected.belief.mean, atol=1e-9)
        np.testing.assert_allclose(again.belief.covariance, expected.belief.covariance, rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(again.log_evidence, expected.log_evidence, rtol=1e-9)


@pytest.mark.parametrize("garbage", [1e3, np.nan, np.inf])
def test_landmarks_that_are_not_seen_or_score_low_do_not_count(face, garbage):
    _, uv = face.draw(jax.random.key(6))
    observed = some_seen()
    expected = face.refine(face.found(uv, observed))
    wrong = face.found(jnp.where(observed[..., None], uv, garbage), observed)
    again = face.refine(wrong._replace(covariance=jnp.where(observed[..., None, None], wrong.covariance, garbage)))
    low = wrong._replace(observed=jnp.ones((2, 10), bool), score=jnp.where(observed, 1.0, LEAST_SCORE - 0.01))
    for found in (again, face.refine(low)):
        np.testing.assert_allclose(found.belief.mean, expected.belief.mean, atol=1e-9)
        np.testing.assert_allclose(found.belief.covariance, expected.belief.covariance, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.log_evidence, expected.log_evidence, rtol=1e-9)
    assert again.excess[7] == 0


def test_without_landmarks_the_prior_is_left(face):
    found = face.refine(face.found(jnp.zeros((2, 10, 2)), jnp.zeros((2, 10), bool)))
    np.testing.assert_allclose(found.belief.mean, face.prior.mean, atol=1e-9)
    np.testing.assert_allclose(found.belief.covariance, face.prior.covariance, rtol=1e-4, atol=1e-8)
    assert float(found.num_observed) == 0


def test_displaced_landmarks_are_where_their_pixels_meet(face):
    """Loose landmarks go where triangulation puts them; in the model frame, whatever the pose."""
    moved = np.random.default_rng(1).normal(0, 3, (10, 3))
    x = face.prior.mean.at[6:].set(jnp.array([2.0, -1.0]))
    uv = face.project(x, jnp.asarray(moved))
    found = face.found(uv)._replace(by_slope=jnp.zeros((2, 10, 2, 2)))
    tight = face.slopes._replace(covariance=jnp.zeros((10, 2, 2)))
    loose = jnp.tile(1e4 * jnp.eye(3), (10, 1, 1))
    shapes = [displaced(x, found, tight, face.model, loose, face.rig)]
    expected = (triangulate(face.rig, uv) - x[:3]) @ rotation(x[3:6])
    np.testing.assert_allclose(place(jnp.asarray(expected), x[:6]), triangulate(face.rig, uv), atol=1e-6)
    # One linear step from up to 8 mm away.
    np.testing.assert_allclose(shapes[0], expected, atol=0.12)


def test_displaced_landmarks_stay_where_they_are_tight_or_unseen(face):
    x = face.prior.mean.at[6:].set(jnp.array([2.0, -1.0]))
    found = face.found(face.project(x, 2.0), some_seen())
    still = displaced(x, found, face.slopes, face.model, jnp.zeros((10, 3, 3)), face.rig)
    np.testing.assert_allclose(still, shape(face.model, x[6:]), atol=1e-12)
    loose = displaced(x, found, face.slopes, face.model, 100.0 * face.model_variance, face.rig)
    np.testing.assert_allclose(loose[7], still[7], atol=1e-12)
    # A landmark that one camera sees moves across its line of sight only.
    sight = jnp.cross(*jacobian(face.rig, still, x[:6])[0][1, 3])
    step = np.asarray(loose[3] - still[3])
    assert np.linalg.norm(step) > 1
    assert abs(step @ np.asarray(sight)) < 1e-6 * np.linalg.norm(sight) * np.linalg.norm(step)


def test_displaced_is_the_posterior_mean_of_each_place(face):
    """Linear-Gaussian: the prior `model_variance` about the model, seen through the derivative."""
    x = face.prior.mean
    M = np.asarray(shape(face.model, x[6:]))
    uv = face.project(x) + jnp.asarray(np.random.default_rng(2).normal(0, 0.2, (2, 10, 2)))
    result = displaced(x, face.found(uv), face.slopes, face.model, face.model_variance, face.rig)
    by_shape = np.asarray(jacobian(face.rig, jnp.asarray(M), x[:6])[0])
    for k in range(10):
        J, bend = (np.concatenate([a[c, k] for c in range(2)]) for a in (by_shape, np.asarray(face.by_slope)))
        noise = np.kron(np.eye(2), NOISE + PIXEL_FLOOR**2 * np.eye(2)) + SLOPE_STD**2 * bend @ bend.T
        information = np.eye(3) / LOOSE_STD**2 + J.T @ np.linalg.solve(noise, J)
        off = (np.asarray(uv) - np.asarray(face.project(x)))[:, k].ravel()
        step = np.linalg.solve(information, J.T @ np.linalg.solve(noise, off))
        np.testing.assert_allclose(result[k], M[k] + step, atol=1e-9)


def test_a_variance_is_updated_by_what_a_frame_can_tell_of_it():
    """Exact alignments are averaged as they are; one that is followed imprecisely, or hidden, tells next to nothing."""
    excess = jnp.array([2.0, -9.0, 0.0, 2.0])
    alignment = jnp.array([0.0, 9.0, jnp.inf, 2.0])
    new = module.running_variance(jnp.full(4, 0.5), excess, alignment, 0.1, (1e-4, 100.0))
    # The second loses a tenth of 9.5 by the square of .5 / 9.5; the last gains a tenth of 1.5 by that of 2 / 4.
    np.testing.assert_allclose(new, [0.65, 0.5 - 0.95 * (0.5 / 9.5) ** 2, 0.5, 0.5 + 0.15 / 4], rtol=1e-6)


def test_products_have_full_precision(face, products_at_default_precision):
    def fit(prior, found):
        is_own = jnp.ones((2, 10), bool)
        refined = module.refine(
            prior, found, face.slopes, face.model, face.model_variance, face.rig, prior.mean, is_own
        )
        wide = jnp.tile(jnp.eye(3), (10, 1, 1))
        return refined, module.displaced(prior.mean, found, face.slopes, face.model, wide, face.rig)

    assert not products_at_default_precision(fit, face.prior, face.found(face.project(face.prior.mean)))
