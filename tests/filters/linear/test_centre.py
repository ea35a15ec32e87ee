"""Polynomial filters keep their claims far from zero, and where a state outgrows its error."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.noises import about_mean
from heliograph.random_affine.noises.noise_from_moments import CentredNoise
from heliograph.testing import check_filter
from tests.follow import last

SKEWED = hg.random_affine.FiniteSupport([[1.0], [-0.25]], [0.2, 0.8])
EITHER = hg.random_affine.FiniteSupport([[0.1], [-0.1]], [0.5, 0.5])


@pytest.mark.parametrize("build", [hg.polynomial_filter, hg.filters.scheduled_polynomial_filter])
@pytest.mark.parametrize("mean", [1e4, 1e8])
def test_where_the_state_is_does_not_matter_behind_a_known_gain(build, mean):
    """x - mean has the same law wherever the mean is; 1e8 itself is known to 1e-8 only."""
    z = 0.3 * np.sin(np.arange(12.0))

    def evaluate(start, gain):
        plant, sensor = hg.LinearPlant([[1.0]], EITHER, [start], 1.0), hg.LinearSensor([[1.0]], SKEWED)
        item = build(plant, sensor, hg.hop(gain, 0.0), 12, 2)
        assert item.claim == "exact"
        return last(item, gain * (start + z))

    near, far = evaluate(0.0, 0.5), evaluate(mean, 0.5)
    np.testing.assert_allclose(far.covariance, near.covariance, rtol=1e-12)
    np.testing.assert_allclose(far.mean - mean, near.mean, atol=1e-15 * mean + 1e-14)


@pytest.mark.parametrize(("growth", "steps"), [(1.02, 900), (1.5, 50)])
def test_what_a_growing_state_claims_is_its_error(growth, steps):
    """Gaussian noises: the quadratic filter is the linear one, whose error is the Riccati equation's."""
    plant, sensor, hop = hg.LinearPlant([[growth]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1), hg.hop(1.0, 0.1)
    p = 1.0
    for _ in range(steps):
        p = 1 / (1 / (growth**2 * p + 0.1) + 1 / 0.2)
    for degree in (1, 2):
        item = hg.filters.scheduled_polynomial_filter(plant, sensor, hop, steps, degree)
        assert item.claim == "exact"
        assert item.inner.covariances[-1, 0, 0] == pytest.approx(p, rel=1e-6)  # what may be lost before it is seen


def test_a_growing_mean_and_a_noise_with_a_mean():
    plant = hg.LinearPlant([[1.1]], hg.Gaussian([[0.1]], [3.0]), [5.0], 1.0)
    sensor = hg.LinearSensor([[2.0]], SKEWED)
    item = hg.polynomial_filter(plant, sensor, hg.hop(0.5, 0.1), 8, 1)
    z = np.random.default_rng(0).normal(size=8) + 40
    expected = hg.linear_filter(plant, sensor, hg.hop(0.5, 0.1))
    np.testing.assert_allclose(last(item, z).mean, last(expected, z).mean, rtol=1e-12)
    check_filter(item)


def test_far_from_zero_behind_a_random_gain_the_claim_is_lowered():
    plant, sensor = hg.LinearPlant([[1.0]], EITHER, [1e4], 1.0), hg.LinearSensor([[1.0]], SKEWED)
    channel = hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5]), 0.1)
    with pytest.warns(UserWarning, match="the claim is nominal"):
        assert hg.polynomial_filter(plant, sensor, channel, 10, 2).claim == "nominal"


@pytest.mark.parametrize(
    "law",
    [
        hg.Gaussian([[2.0, 0.5], [0.5, 1.0]], [3.0, -1.0]),
        hg.random_affine.Independent([SKEWED, hg.Gaussian([[1.0]], [2.0])]),
        hg.random_affine.Shaped([[1.0], [2.0]], hg.Gaussian([[1.0]], [2.0])),
    ],
    ids=lambda law: type(law).__name__,
)
def test_a_law_about_its_mean(law):
    for item in (about_mean(law), CentredNoise(law)):
        np.testing.assert_allclose(item.mean, 0.0, atol=1e-15)
        np.testing.assert_allclose(item.covariance, law.covariance)
        assert item.moment((1, 0)) == pytest.approx(0.0, abs=1e-14)
        assert item.moment((1, 1)) == pytest.approx(law.covariance[0, 1], abs=1e-14)
        assert item.moment((2, 1)) == pytest.approx(about_mean(law).moment((2, 1)), abs=1e-12)
