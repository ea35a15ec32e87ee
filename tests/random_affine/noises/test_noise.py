import equinox as eqx
import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.moments import list_exponents
from heliograph.random_affine.noises.noise import noise_moment_vector
from tests.draws import draw

COVARIANCE = np.array([[1.0, 0.3, 0.0], [0.3, 0.5, -0.2], [0.0, -0.2, 0.8]])


def test_gaussian_moments_are_gauss_hermite_quadrature():
    noise = hg.Gaussian(COVARIANCE, [0.2, -0.1, 0.4])
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)  # exact to degree 9
    grid = np.array(np.meshgrid(nodes, nodes, nodes)).reshape(3, -1)
    weight = np.prod(np.array(np.meshgrid(weights, weights, weights)).reshape(3, -1), axis=0) / (2 * np.pi) ** 1.5
    points = noise.mean[:, None] + np.linalg.cholesky(COVARIANCE) @ grid
    for (*powers, _), value in zip(list_exponents(4, 4), noise_moment_vector(noise, 4), strict=True):
        quadrature = weight @ np.prod(points ** np.array(powers)[:, None], axis=0)
        assert value == pytest.approx(quadrature, abs=1e-12)


def test_finite_support_knows_its_mean_and_covariance():
    noise = hg.random_affine.FiniteSupport([[1.0, 0.0], [-1.0, 2.0]], [0.25, 0.75])
    np.testing.assert_allclose(noise.mean, [-0.5, 1.5], rtol=1e-15)
    np.testing.assert_allclose(noise.covariance, [[0.75, -0.75], [-0.75, 0.75]], rtol=1e-14)


def test_a_singular_covariance_is_sampled_on_its_subspace():
    noise = hg.Gaussian([[1.0, 1.0], [1.0, 1.0]])
    drawn = draw(noise.sample, 100)
    np.testing.assert_allclose(drawn[:, 0], drawn[:, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([[1.0, 0.5], [0.4, 1.0]], "symmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], "positive semidefinite matrix, got smallest eigenvalue -1"),
        ([[np.inf, 0.0], [0.0, 1.0]], "finite"),
        (hg.Gaussian(np.eye(3)), "dimension 2, got dimension 3"),
    ],
)
def test_what_is_no_covariance_is_refused(value, message):
    with pytest.raises(ValueError, match=message):
        hg.LinearSensor(np.eye(2), value)


@pytest.mark.parametrize("covariance", [[[0.1, 0.3], [0.3, 0.9]], [[1.0, 1e-9], [1e-9, 1e-18]]])
def test_samples_of_a_singular_covariance_stay_in_its_range(covariance):
    """The root of an eigenvalue of rounding, 1e-8, would be a noise where there is none."""
    noise = hg.Gaussian(covariance)
    s = np.asarray(covariance)
    null = np.array([s[0, 1], -s[0, 0]])
    with jax.enable_x64(True):
        samples = np.array([noise.sample(jax.random.key(i)) for i in range(20)])
    assert np.abs(samples @ null).max() <= 1e-14 * np.abs(samples * null).max()
    np.testing.assert_allclose(noise.factor @ noise.factor.T, s, rtol=1e-12)


def test_a_thousand_independent_components_need_no_eigenvectors():
    """Unlike variances, one of them zero and one of 1e-20: the root is exact, where eigenvectors lose the smallest."""
    variances = np.linspace(0.1, 2.0, 1000)
    variances[:2] = 0.0, 1e-20
    noise = hg.Gaussian(np.diag(variances))
    np.testing.assert_array_equal(np.asarray(noise.factor), np.diag(np.sqrt(variances)))
    assert noise.covariance[1, 1] == 1e-20


@pytest.mark.parametrize("put", [np.asarray, jax.numpy.asarray])
def test_a_covariance_put_into_a_noise_is_factored(put):
    """Of one plant and over steps: what is put there counts for filters and for draws, as a law made anew."""
    other = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.1], [0.0, 0.1, 3.0]])
    with jax.enable_x64(True):
        changed = eqx.tree_at(lambda noise: noise.covariance, hg.Gaussian(COVARIANCE), put(other))
    np.testing.assert_allclose((changed.factor * changed.weights) @ changed.factor.T, other, rtol=1e-12, atol=1e-15)
    kept = eqx.tree_at(lambda noise: noise.mean, changed, np.ones(3))
    assert kept.factor is changed.factor
    several = jax.tree.map(lambda *leaves: np.stack(leaves), hg.Gaussian(COVARIANCE), hg.Gaussian(other))
    several = eqx.tree_at(lambda noise: noise.covariance, several, np.stack([other, COVARIANCE]))
    products = several.factor @ several.factor.swapaxes(-1, -2)
    np.testing.assert_allclose(products, [other, COVARIANCE], rtol=1e-12, atol=1e-15)


def test_a_filter_with_another_covariance_put_into_it_filters_by_it():
    sensor = hg.LinearSensor(np.eye(3), np.eye(3))
    old, new = (hg.kalman_filter(hg.LinearPlant(np.eye(3), q, np.zeros(3), np.eye(3)), sensor) for q in (1.0, 5.0))
    changed = eqx.tree_at(lambda f: f.plant.noise.covariance, old, 5.0 * np.eye(3))
    z = np.ones((4, 3))
    assert hg.log_likelihood(changed, z) == hg.log_likelihood(new, z) != hg.log_likelihood(old, z)


def test_a_covariance_put_into_a_traced_noise_is_factored():
    """Where both are traced no number tells that the factor is of the old one: traced or known, the new one counts."""
    other = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.1], [0.0, 0.1, 3.0]])

    def products(scale):
        old = hg.Gaussian(scale * jax.numpy.asarray(COVARIANCE))
        several = jax.tree.map(lambda *leaves: jax.numpy.stack(leaves), old, old)
        pairs = (old, scale * other), (old, other), (several, scale * np.stack([other, COVARIANCE]))
        laws = [eqx.tree_at(lambda noise: noise.covariance, *pair) for pair in pairs]
        return [(law.factor * law.weights[..., None, :]) @ law.factor.swapaxes(-1, -2) for law in laws]

    with jax.enable_x64(True):
        found = jax.jit(products)(3.0)
    for product, expected in zip(found, (3 * other, other, 3 * np.stack([other, COVARIANCE])), strict=True):
        np.testing.assert_allclose(product, expected, rtol=1e-12, atol=1e-15)
