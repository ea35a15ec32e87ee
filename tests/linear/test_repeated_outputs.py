"""An output that repeats another, noise and all, says nothing: the error is that of the link without it."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine import GainAndNoise, Series, Stack, known

HORIZON = 3
SHARE = 0.854  # z_1 = 0.854 z_3
FEW = hg.Discrete([0.3, 0.5], [0.4, 0.6])


def plant(mean=(0.0, 0.0)):
    return hg.LinearPlant(np.array([[0.9, 0.3], [-0.2, 0.7]]), np.diag([0.3, 0.1]), mean, np.diag([1.0, 2.0]))


def sensor(noise=(1e-3, 1e-1)):
    return hg.LinearSensor(np.array([[1.0, 0.3], [0.3, -1.0]]), np.diag(noise))


def part(gain, component, noise=0.0):
    """A hop that carries one of two components."""
    return Series([known(np.eye(2)[[component]]), hg.hop(gain, noise)])


def behind_own_gains(repeats, noise=0.0):
    """Known gains beside a random one; what repeats comes before it, so that it could take something from it."""
    repeated = [part(SHARE, 0)] if repeats else []
    return Stack([part(1.0, 0), *repeated, part(FEW, 1, noise)])


def behind_one_gain(repeats, spread=0.01):
    """A gain that varies little, common to all outputs: Cov(v) is what a subtraction leaves of E[z z']."""
    rows = np.array([[1.0, 0.0], *[[SHARE, 0.0]] * repeats, [0.0, 1.0]])
    law = hg.Discrete([1 - spread, 1 + spread], [0.5, 0.5])
    return GainAndNoise(law, rows, 0.0)


def behind_modes(repeats):
    return hg.gilbert_elliott(behind_own_gains(repeats), behind_own_gains(repeats, 0.4), 0.3, 0.4)


def claimed(plant, sensor, channel, degree):
    """Covariances that the filter claims, and those of the recursion before any data."""
    filter = hg.polynomial_filter(plant, sensor, channel, HORIZON, degree)
    scheduled = hg.filters.scheduled_polynomial_filter(plant, sensor, channel, HORIZON, degree)
    assert filter.claim == scheduled.claim == "exact"
    planned = filter.planned(np.zeros((HORIZON, 0)))
    return [np.asarray(f.inner.covariances)[2::2] for f in (planned, scheduled)]


@pytest.mark.parametrize("degree", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mean", [(0.0, 0.0), (100.0, 30.0)])
@pytest.mark.parametrize("channel", [behind_own_gains, behind_modes])
def test_outputs_of_known_gains_are_not_compared_to_measure_the_state(channel, mean, degree):
    """Cov(v) of known gains owes nothing to the state, so 1e-10 is what 1e4 times rounding leaves of E[z^4] far off."""
    for whole, less in zip(*(claimed(plant(mean), sensor(), channel(r), degree) for r in (1, 0)), strict=True):
        np.testing.assert_allclose(whole, less, rtol=1e-10, atol=0)


@pytest.mark.parametrize("degree", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_noise_that_a_subtraction_left_is_no_more_exact_than_its_rounding(degree):
    """The gain's spread is 1e-4 of its square, so that Cov(v) is known to some 1e-12 of itself, and the error too."""
    exact = [claimed(plant(), sensor((0.0, 1e-6)), behind_one_gain(r), degree) for r in (1, 0)]
    for whole, less in zip(*exact, strict=True):
        np.testing.assert_allclose(whole, less, rtol=1e-10, atol=1e-13)


def test_what_is_claimed_is_the_true_error_of_the_gains():
    """Both are sums of products of numbers of order one: twelve digits."""
    system = hg.linear.lifted_system(plant(), sensor(), behind_own_gains(True), 1, HORIZON)
    schedule = hg.linear.lmmse(system)
    truth = hg.linear.true_covariance(system, schedule)
    np.testing.assert_allclose(schedule.gains.covariance, truth, rtol=1e-12, atol=1e-14)
