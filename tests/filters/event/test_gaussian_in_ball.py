"""Moments of Gaussians in a ball and outside of it, beside a fine grid and beside draws."""

from functools import partial

import numpy as np
import pytest

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.event.gaussian_in_ball import ball_moments, truncate_to_ball
from heliograph.filters.event.gaussian_sum import GaussianSum
from heliograph.numerics import compile_in_float64

# One program for each side and number of components, whatever the numbers.
moments_in_ball = {side: compile_in_float64(partial(ball_moments, inside=side)) for side in (True, False)}


def on_a_grid(centre, variance, radius, inside):
    """Mass, mean and covariance by 400 Gauss-Legendre rings, smooth on either side of the circle."""
    reach = np.sqrt(np.sum(np.square(centre))) + 12 * np.sqrt(max(variance))
    edges = (0, radius) if inside else (radius, radius + reach)
    nodes, weights = np.polynomial.legendre.leggauss(400)
    r = edges[0] + (nodes + 1) / 2 * (edges[1] - edges[0])
    angle = 2 * np.pi * np.arange(720) / 720
    e = np.stack([r[:, None] * np.cos(angle), r[:, None] * np.sin(angle)])
    square = sum((x - c) ** 2 / v for x, c, v in zip(e, centre, variance, strict=True))
    weight = np.exp(-square / 2) / (2 * np.pi * np.sqrt(np.prod(variance))) * r[:, None]
    weight *= weights[:, None] * (edges[1] - edges[0]) / 2 * 2 * np.pi / 720
    mass = weight.sum()
    mean = np.array([np.sum(weight * x) for x in e]) / mass
    apart = e - mean[:, None, None]
    return mass, mean, np.einsum("iab,jab,ab->ij", apart, apart, weight) / mass


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize(
    ("centre", "variance"),
    [((0.0, 0.0), (0.3, 0.8)), ((0.7, -0.4), (0.05, 2.0)), ((1.5, 0.2), (0.1, 0.1)), ((0.2, 0.1), (4.0, 0.02))],
)
def test_moments_of_two_components_are_those_of_a_grid(centre, variance, inside):
    result = moments_in_ball[inside](np.array(centre), np.array(variance), np.array(1.0))
    mass, mean, covariance = on_a_grid(centre, variance, 1.0, inside)
    # The rings are good to rounding; 32 slices to 1e-9 here.
    assert np.exp(result.log_mass) == pytest.approx(mass, rel=1e-8)
    np.testing.assert_allclose(result.mean, mean, atol=1e-8)
    np.testing.assert_allclose(result.covariance, covariance, atol=1e-8)


def test_three_components_are_those_of_draws():
    """Five deviations of a mean of a million draws."""
    centre, variance = np.array([0.3, -0.2, 0.5]), np.array([0.2, 0.5, 0.1])
    draws = centre + np.sqrt(variance) * np.random.default_rng(0).normal(size=(10**6, 3))
    within = np.sum(draws**2, axis=1) <= 1
    for inside in (True, False):
        result = moments_in_ball[inside](centre, variance, np.array(1.0))
        some = draws[within == inside]
        assert np.exp(result.log_mass) == pytest.approx(len(some) / 1e6, abs=0.003)
        np.testing.assert_allclose(result.mean, some.mean(axis=0), atol=0.006)
        np.testing.assert_allclose(result.covariance, np.cov(some.T), atol=0.006)


@pytest.mark.slow
def test_inside_and_outside_are_the_whole_and_what_is_known_stays():
    random = np.random.default_rng(1)
    law = Gaussian(random.normal(size=(1, 4)), random.normal(size=(1, 6)), random.uniform(0.5, 4, size=(1, 4)))
    parts = GaussianSum(np.zeros(1), law, np.ones((1, 1, 1)))
    directions = np.eye(4)[:2] - np.eye(4)[2:]
    near, far = compile_in_float64(
        lambda r: tuple(truncate_to_ball(parts, directions, r, side) for side in (True, False))
    )(1.5)
    share = np.exp([near.log_weight[0], far.log_weight[0]])
    assert share.sum() == pytest.approx(1, rel=1e-9)
    means, covariances = (
        np.stack([getattr(side.gaussian, name)[0] for side in (near, far)]) for name in ("mean", "covariance")
    )
    apart = means - law.mean
    np.testing.assert_allclose(share @ means, law.mean[0], atol=1e-8)
    whole = np.einsum("s,sij->ij", share, covariances + apart[:, :, None] * apart[:, None])
    np.testing.assert_allclose(whole, law.covariance[0], atol=1e-7)
    still = Gaussian(np.array([[0.5, 0.2, 0.0, 0.0]]), np.zeros((1, 6)), np.zeros((1, 4)))
    known = GaussianSum(np.zeros(1), still, np.ones((1, 1, 1)))
    known_inside = compile_in_float64(lambda radius: truncate_to_ball(known, directions, radius, True))
    assert known_inside(1.0).log_weight[0] == pytest.approx(0, abs=1e-8) and known_inside(0.5).log_weight[0] < -1e3
    np.testing.assert_array_equal(known_inside(1.0).gaussian.mean, still.mean)
