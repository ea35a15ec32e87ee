"""The spread of a random gain as a sum of squares."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.gaussian.factored import gain_spread
from heliograph.model.over_time import at
from heliograph.random_affine.combine import GainAndNoise
from heliograph.random_affine.moments.second_moments import second_order

FADED = hg.hop(hg.Rayleigh(0.8), noise=0.02)
RELAYED = hg.amplify_and_forward([FADED, hg.hop(hg.Discrete([0.5, 1.5], [0.3, 0.7]), 0.01, amplification=1.2)])
SHARED = hg.hop(hg.Rayleigh(0.8), noise=[[0.2, 0.1], [0.1, 0.3]], dimension=2)
CHANNELS = {
    "one hop": FADED,
    "relayed": RELAYED,
    "beside a direct link": hg.parallel([RELAYED, hg.perfect()]),
    "one gain for two outputs": SHARED,
    "relayed with one gain for two": hg.amplify_and_forward([SHARED, hg.hop(hg.Rayleigh(1.1), 0.1, dimension=2)]),
    "lost together": hg.dropout(SHARED, 0.7),
    "without a random gain": hg.perfect(2),
}


@pytest.mark.parametrize("name", CHANNELS)
def test_it_is_the_spread(name):
    """E[(z - E z)(z - E z)'] of the channel's own second moments, at any E[(y, 1)(y, 1)']."""
    described = second_order(CHANNELS[name])
    operators = gain_spread(described)
    rng = np.random.default_rng(0)
    root = rng.normal(size=(described.mean_gain.shape[1] + 1, 5))
    second = root @ root.T
    m = len(described.offset)
    expected = described.spread.middle(second, np.ones(m, dtype=bool))
    # Sums of a few products; single precision unless the caller has asked for double.
    np.testing.assert_allclose(np.einsum("ria,ab,rjb->ij", operators, second, operators), expected, rtol=2e-6)


def test_it_needs_no_more_operators_than_there_are_random_numbers():
    """A gain and two noises; a gain alone gives one operator, not one for each pair of entries."""
    assert len(gain_spread(second_order(SHARED))) == 3
    assert len(gain_spread(second_order(hg.perfect(3)))) == 0


def test_over_time():
    hops = [hg.hop(hg.Rayleigh(0.8), 0.0), hg.hop(1.0, 0.5)]
    varying = hg.model.over_time([second_order(hop) for hop in hops])
    spread = gain_spread(varying)
    for k, hop in enumerate(hops):
        present = [row for row in at(spread, k) if np.any(row)]
        np.testing.assert_array_equal(present, gain_spread(second_order(hop)))


def test_what_is_no_sum_of_squares_is_refused():
    mixing = GainAndNoise(hg.Rayleigh(1.0), np.array([[1.0, 2.0], [3.0, -1.0]]), hg.Gaussian(np.eye(2)))
    with pytest.raises(ValueError, match="single precision: expected a channel whose gain varies by a sum of squares"):
        gain_spread(second_order(mixing))
    unsure = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5], 0.1), 0.1)
    with pytest.raises(ValueError, match="single precision: expected a channel whose probabilities are known"):
        gain_spread(second_order(unsure))
