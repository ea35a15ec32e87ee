"""Student's and contaminated noise: draws, moments, branches, and what is refused."""

import jax
import numpy as np
import pytest
from scipy import stats

import heliograph as hg
from heliograph.random_affine.noises.outlier_noise import has_bounded_noise
from tests.draws import draw

R = np.array([[1.0, 0.3], [0.3, 2.0]])


def drawn(law, count=100_000):
    return draw(law.sample, count, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "law",
    [
        hg.StudentT(R, 9.0),
        hg.Contaminated(R, 0.1, 4 * R, [1.0, -2.0]),
        hg.Contaminated(R, [0.1, 0.2], [2.0, 5.0], [3.0, -1.0]),
        hg.Contaminated.one_sided(R, 0.3, 2.0),
    ],
)
def test_draws_have_the_moments_of_the_law(law):
    """Standard errors of 100,000 draws: 4 of them, from the draws' own spread."""
    n = drawn(law)
    assert np.all(np.abs(n.mean(0) - law.mean) < 4 * n.std(0) / np.sqrt(len(n)))
    products = (n - law.mean)[:, :, None] * (n - law.mean)[:, None]
    assert np.all(np.abs(products.mean(0) - law.covariance) < 4 * products.std(0) / np.sqrt(len(n)))
    for powers in ((2, 0), (1, 1), (3, 1), (2, 2)):
        items = np.prod(n ** np.array(powers), axis=1)
        assert abs(items.mean() - law.moment(powers)) < 4 * items.std() / np.sqrt(len(n))


def test_one_sided_noise_has_mean_and_variance_of_an_exponential_delay():
    """E = p mu, Var = r + p (2 mu^2) - (p mu)^2: to rounding, since each slice has its own mean and variance."""
    law = hg.Contaminated.one_sided(1.5, 0.3, 2.0)
    np.testing.assert_allclose([law.mean[0], law.covariance[0, 0]], [0.6, 1.5 + 0.3 * 8 - 0.36], rtol=1e-12)


@pytest.mark.slow
def test_share_and_delay_of_a_one_sided_law_can_be_free():
    """d/d(share) of the mean, share times the delay's mean."""
    with jax.enable_x64(True):
        slope = jax.grad(lambda share: hg.Contaminated.one_sided(1.5, share, 2.0).mean[0])(0.3)
    assert np.isclose(slope, 2.0, rtol=1e-12)


@pytest.mark.parametrize("nu", [2.0, 3.0, 5.0])
def test_branches_of_students_law_have_its_density(nu):
    """To 0.08 in the logarithm within 100 scales: what 25 precisions over 5.7 decades give for 2 to 5 degrees."""
    part = hg.StudentT(1.0, nu).branches()
    e = np.linspace(-100, 100, 2001)
    density = np.sum(np.exp(part.log_share[0]) * stats.norm.pdf(e[:, None], 0, np.sqrt(part.variance[0])), axis=1)
    assert np.max(np.abs(np.log(density) - stats.t.logpdf(e, nu))) < 0.08


def test_students_law_tends_to_the_gaussian_one():
    law = hg.StudentT(R, 1e9)
    np.testing.assert_allclose(law.covariance, R, rtol=1e-8)
    assert law.moment((2, 2)) == pytest.approx(hg.Gaussian(R).moment((2, 2)), rel=1e-8)


def test_components_apart_keep_the_branches_of_each():
    law = hg.random_affine.Independent([hg.Contaminated(1.0, 0.1, 9.0), hg.Gaussian([[2.0]])])
    part = law.branches()
    np.testing.assert_allclose(np.exp(part.log_share), [[0.9, 0.1], [1.0, 0.0]])
    np.testing.assert_allclose(part.variance[:, 0], [1.0, 2.0])


def test_bounds_of_share_and_size_dominate_every_law_within_them():
    bound = hg.Contaminated.at_most(R, 0.1, 9 * R)
    for share in (0.0, 0.05, 0.1):
        gap = bound.covariance - hg.Contaminated(R, share, 9 * R).covariance
        assert np.linalg.eigvalsh(gap).min() > -1e-12
    assert has_bounded_noise(hg.LinearSensor(np.eye(2), bound)) and not has_bounded_noise(hg.LinearSensor(np.eye(2), R))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hg.StudentT(1.0, 0.0), "degrees of Student's law: expected a positive number, got 0"),
        (
            lambda: hg.StudentT([[1.0, 2.0], [2.0, 1.0]], 3.0),
            "scale of Student's law: expected a positive semidefinite",
        ),
        (lambda: hg.StudentT(1.0, 2.0).covariance, r"more than 2, below which it has no covariance \(robust_filter"),
        (lambda: hg.StudentT(1.0, 4.0).moment((4,)), "moments of order 4: expected more than 4, got 4"),
        (lambda: hg.Contaminated(1.0, 1.2, 9.0), "share of outliers: expected a number from 0 to 1, got 1.2"),
        (lambda: hg.Contaminated(1.0, [], 9.0), "shares of outliers: expected at least one, got none"),
        (lambda: hg.Contaminated(1.0, -0.1, 9.0), "share of outliers: expected a number from 0 to 1, got -0.1"),
        (lambda: hg.Contaminated(1.0, [0.7, 0.7], [1.0, 2.0]), "sum of the shares of outliers"),
        (lambda: hg.Contaminated(1.0, 0.1, -9.0), "covariance of the outliers: expected a positive semidefinite"),
        (lambda: hg.Contaminated(1.0, [0.1, 0.1], [9.0]), "one for each of the 2 shares, got 1"),
        (lambda: hg.Contaminated.at_most(2.0, 0.1, 1.0), "at least the covariance of the others"),
    ],
)
def test_what_is_no_law_is_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
