"""Every kind of channel: samples against joint moments to order 4, through the check that users call."""

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import AbstractLaw
from heliograph.testing import check_random_affine

COVARIANCE = np.array([[0.2, 0.05], [0.05, 0.1]])
SKEWED = hg.random_affine.FiniteSupport([[1.8, 0.0], [-0.2, 0.3], [-0.2, -0.1]], [0.1, 0.3, 0.6])
TWO_HOPS = hg.amplify_and_forward(
    [
        hg.hop(hg.Discrete([0.7, 0.85, 1.0], [0.3, 0.3, 0.4], 0.02), COVARIANCE, power=0.5),
        hg.hop(hg.Rayleigh(0.8), 0.1, amplification=2.0, dimension=2),
    ]
)
SCALAR = hg.amplify_and_forward(
    [hg.hop(hg.random_affine.Rician(1.0, 0.3), 0.2), hg.hop(hg.Discrete([0.6, 1.2], [0.4, 0.6]), 0.1)]
)

CHANNELS = {
    "known": hg.random_affine.known([[1.0, 2.0]], [0.5]),
    "discrete": GainAndNoise(hg.Discrete([0.5, 1.0], [0.3, 0.7]), [[1.0, 0.5]], 0.3),
    "log-normal": hg.hop(hg.random_affine.LogNormal(-0.1, 0.2), 0.2),
    "skewed noise": hg.hop(hg.random_affine.bernoulli(0.8), SKEWED),
    "two hops": TWO_HOPS,
    "three hops": hg.amplify_and_forward([*TWO_HOPS.maps, hg.hop(hg.random_affine.bernoulli(0.9), COVARIANCE)]),
    "dropout": hg.dropout(TWO_HOPS, 0.7),
    "direct link": hg.model.with_direct_link(TWO_HOPS, hg.hop(hg.random_affine.Nakagami(1.5), 0.1, dimension=2)),
    "parallel": hg.parallel([SCALAR, hg.hop(hg.Rayleigh(1.0), 0.1)]),
    "dropout of a direct link in series": hg.random_affine.Series(
        [hg.dropout(hg.model.with_direct_link(SCALAR, SCALAR), 0.6), hg.random_affine.known([[1.0, -0.5]])]
    ),
    "rotation": hg.random_affine.Rotation(0.7),
    "silent": hg.model.silent(2, 3, 0.5),
    "sum": hg.superposed([SCALAR, hg.dropout(hg.hop(hg.Rayleigh(1.0), 0.1), 0.8)], 0.1),
    "sum of relays": hg.superposed([TWO_HOPS, hg.hop(hg.Rayleigh(0.5), 0.0, dimension=2)], SKEWED, same=True),
}

LARGE = {
    "sum of relays",
    "three hops",
    "dropout",
    "direct link",
    "parallel",
    "dropout of a direct link in series",
}  # cost most


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LARGE else n for n in CHANNELS])
def test_samples_match_moments_to_order_four(name):
    check_random_affine(CHANNELS[name])


@pytest.mark.parametrize("degree", [2, 3])
def test_lifted_maps_match_to_order_two(degree):
    check_random_affine(hg.random_affine.Lift(SCALAR, degree), highest=2)


def test_square_of_a_channel_with_two_outputs():
    check_random_affine(hg.random_affine.square(CHANNELS["direct link"]), highest=2)


class _WrongVariance(AbstractRandomAffine):
    """A channel whose second moment is stated one tenth too small."""

    true: GainAndNoise

    @property
    def outputs(self):
        return self.true.outputs

    @property
    def inputs(self):
        return self.true.inputs

    def sample(self, key):
        return self.true.sample(key)

    def moments(self, order):
        right = self.true.moments(order)
        return right.matrix * (0.9 if order == 2 else 1.0)


def test_the_check_finds_a_wrong_moment():
    with pytest.raises(AssertionError, match="order 2"):
        check_random_affine(_WrongVariance(GainAndNoise(hg.Rayleigh(1.0), [[1.0]], 0.1)))


class _WrongLaw(AbstractLaw):
    def sample(self, key):
        return 1.0 + 0.1 * jax.random.normal(key, dtype=float)

    def moment(self, order):
        return 1.0


def test_the_check_finds_a_law_whose_moments_are_not_its_own():
    with pytest.raises(AssertionError, match="standard errors"):
        check_random_affine(GainAndNoise(_WrongLaw(), [[3.0]], 0.01))


def test_a_shared_second_hop_makes_gain_and_noise_dependent():
    """E[G^2 n^2] is not the product of the marginals, so marginal moments would not do."""
    channel = hg.amplify_and_forward([hg.hop(hg.Discrete([0.5, 1.5], [0.5, 0.5]), 1.0), hg.hop(hg.Rayleigh(1.0), 0.5)])
    gamma2, xi2, xi4 = (0.25 + 2.25) / 2, 2.0, 8.0  # E g^2 and Rayleigh E x^2 = 2 s^2, E x^4 = 8 s^4
    joint = gamma2 * (xi4 * 1.0 + xi2 * 0.5)  # E[(xi gamma)^2 (xi m + n)^2]
    product = gamma2 * xi2 * (xi2 * 1.0 + 0.5)
    moments = channel.moments(4)
    row = moments.matrix[0]  # E[z^4 | y], with the coefficient of y^2 equal to 6 E[G^2 n^2]
    assert row[2] == pytest.approx(6 * joint, rel=1e-12)
    assert joint > 1.2 * product


def test_series_of_maps_that_do_not_fit_is_refused():
    with pytest.raises(ValueError, match="a map that takes 1 inputs, got one that takes 2"):
        hg.random_affine.Series([hg.hop(1.0, 0.1), hg.hop(1.0, 0.1, dimension=2)])
