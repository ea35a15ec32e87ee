"""Rounding counts as noise: it covers what a double leaves of a mean, against rational arithmetic."""

import numpy as np

import heliograph as hg
from tests.factors.exact import exactly, product, total


def test_data_without_noise_are_followed_to_the_noise_that_counts_as_rounding():
    """Means of states of any size and direction within four deviations of the true ones, which are fractions.

    400 such plants have errors of up to 3.0 deviations where 4 eps of a number count as noise; of up to 4.3 with 2 eps
    and of 8.5 with one. A smaller noise of rounding would say more than a double holds.
    """
    rng, most = np.random.default_rng(0), 0.0
    for _ in range(40):
        n, m = rng.integers(2, 6), rng.integers(1, 3)
        a, h, wide = rng.normal(size=(n, n)), rng.normal(size=(m, n)), 10.0 ** rng.integers(0, 15)
        a /= np.abs(np.linalg.eigvals(a)).max()
        plant, sensor = hg.LinearPlant(a, 0.0, np.zeros(n), wide), hg.LinearSensor(h, 0.0)
        truth = [exactly(np.sqrt(wide) * rng.normal(size=(n, 1)))]
        for _ in range(12):
            truth.append(product(exactly(a), truth[-1]))
        z = np.array([product(exactly(h), x) for x in truth[1:]], dtype=float)[:, :, 0]
        result = hg.kalman_filter(plant, sensor).run(z)
        means = [exactly(mean[:, None]) for mean in result.means]
        error = np.array([total(mean, x, -1) for mean, x in zip(means, truth[1:], strict=True)], dtype=float)[:, :, 0]
        most = max(most, np.max(np.abs(error) / np.sqrt(np.diagonal(result.covariances, axis1=1, axis2=2))))
    assert 0.5 < most < 4.0
