"""Noise through a matrix keeps what its law says of outliers: its branches are those of its samples."""

import jax
import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.stats import norm

import heliograph as hg
from heliograph.random_affine import Independent, Shaped

MIXING = np.array([[1.0, 2.0], [0.0, -3.0], [1.0, -1.0]])
TOGETHER = hg.Contaminated([[1.0, 0.5], [0.5, 1.0]], 0.2, [[9.0, -2.0], [-2.0, 4.0]], [1.0, -1.0])
APART = Independent([hg.Contaminated(1.0, 0.1, 20.0), hg.Gaussian([[2.0]], [1.0]), hg.StudentT(0.5, 3.0)])
LAWS = {
    "one outlier for all": Shaped(MIXING, TOGETHER),
    "one precision for all": Shaped(MIXING, hg.StudentT([[1.0, 0.5], [0.5, 1.0]], 4.0)),
    "independent": Shaped([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [1.0, 1.0, 1.0]], APART),
    "twice": Shaped([[1.0, 1.0, 1.0]], Shaped(MIXING, TOGETHER)),
}


@pytest.mark.parametrize("name", LAWS)
def test_branches_are_those_of_samples(name):
    """Their distribution functions agree to five standard errors of 100,000 samples, .008, at four places."""
    law = LAWS[name]
    drawn = np.asarray(jax.vmap(law.sample)(jax.random.split(jax.random.key(0), 100_000))) - law.mean
    log_share, mean, variance = map(np.asarray, law.branches())
    for i, place in np.ndindex(law.dimension, 4):
        below = (-3.0, -0.5, 0.2, 2.0)[place]
        chance = np.exp(log_share[i]) @ norm.cdf((below - mean[i]) / np.sqrt(variance[i]))
        assert np.mean(drawn[:, i] < below) == pytest.approx(chance, abs=0.008)
    assert law.has_outliers and law.is_symmetric == (law.source.is_symmetric)


def test_a_robust_filter_doubts_outliers_of_shaped_noise():
    """It took them for Gaussian noise of the same variance: a log-likelihood of -2.67 where it is -4.51."""
    plant = hg.LinearPlant([[0.9]], 0.1, [1.0], [[0.5]])
    sensor = hg.LinearSensor([[1.0]], Shaped([[2.0]], hg.Contaminated(0.05, 0.1, 5.0)))
    found = hg.robust_filter(plant, sensor, hg.perfect()).run([[3.5]])
    x = np.linspace(-8, 10, 200_001)
    noise = 0.9 * norm.pdf(3.5 - x, 0, 0.2**0.5) + 0.1 * norm.pdf(3.5 - x, 0, 20**0.5)
    joint = norm.pdf(x, 0.9, (0.81 * 0.5 + 0.1) ** 0.5) * noise
    density = trapezoid(joint, x)
    mean = trapezoid(x * joint, x) / density
    assert found.log_likelihoods[0] == pytest.approx(np.log(density), rel=1e-9)
    assert found.means[0, 0] == pytest.approx(mean, rel=1e-9)
    assert found.covariances[0, 0, 0] == pytest.approx(trapezoid((x - mean) ** 2 * joint, x) / density, rel=1e-9)
