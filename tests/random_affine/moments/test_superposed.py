"""Moments of sums of links: by enumeration, against the sum of a stack, and bounds under uncertain probabilities."""

import itertools

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.moments import evaluate_monomials, moment_tensors, second_moments
from heliograph.random_affine.noises.noise import FiniteSupport
from heliograph.random_affine.sum_of_maps import Superposed

FAIR = hg.Discrete([0.4, 1.3, -0.2], [0.5, 0.2, 0.3], 0.05)
COIN = FiniteSupport([[1.0], [-0.5]], [1 / 3, 2 / 3])


def links():
    """Finitely many gains and noises each, one of them a relay and one that may be lost."""
    relay = hg.amplify_and_forward([hg.hop(hg.Discrete([0.5, 1.5], [0.4, 0.6]), COIN), hg.hop(FAIR, COIN)])
    return [relay, hg.hop(FAIR, COIN), hg.dropout(hg.hop(hg.Discrete([1.0, 2.0], [0.3, 0.7]), COIN), 0.8)]


def wide_links():
    """Links of two outputs: one hop of both numbers, and one of a matrix."""
    noise = FiniteSupport([[1.8, 0.0], [-0.2, 0.3], [-0.2, -0.1]], [0.1, 0.3, 0.6])
    return [hg.hop(FAIR, noise), GainAndNoise(FAIR, [[1.0, 0.2], [0.5, -1.0]], noise)]


SUMS = {
    "sensors": lambda: hg.superposed(links(), 0.1),
    "relays of one signal": lambda: hg.superposed(links(), 0.1, same=True),
    "two outputs": lambda: hg.superposed(wide_links(), [[0.3, 0.1], [0.1, 0.4]]),
    "two outputs of one signal": lambda: hg.superposed(wide_links(), COIN_PAIR, same=True),
    "late": lambda: hg.superposed([links()[1], hg.model.delayed(links()[1], hg.Discrete([0, 2], [0.7, 0.3]))], COIN),
    "a sum of sums": lambda: hg.superposed([hg.superposed(links()[:2], 0.0), links()[2]], COIN),
    "a hop after the sum": lambda: hg.amplify_and_forward([hg.superposed(links(), COIN), hg.hop(FAIR, COIN)]),
    "one hop before the relays": lambda: hg.amplify_and_forward(
        [hg.hop(FAIR, COIN), hg.superposed(links(), COIN, same=True)]
    ),
}
COIN_PAIR = FiniteSupport([[1.0, 0.5], [-0.5, 0.0]], [1 / 3, 2 / 3])


def spelt_out(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    """The channel with each sum as a stack whose outputs are added."""

    def replaced(leaf: object) -> object:
        if not isinstance(leaf, Superposed):
            return leaf
        inner = Superposed([spelt_out(m) for m in leaf.maps], leaf.noise, leaf.places, leaf.inputs)
        return inner.as_stack

    return jax.tree.map(replaced, channel, is_leaf=lambda leaf: isinstance(leaf, Superposed))


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("name", SUMS)
def test_moments_are_those_of_the_sum_of_a_stack(name, order):
    """Rounding of sums of some hundred products of numbers of order one to the sixth power."""
    channel = SUMS[name]()
    whole = spelt_out(channel).moments(order).matrix
    np.testing.assert_allclose(channel.moments(order).matrix, whole, rtol=1e-11, atol=1e-12 * np.abs(whole).max())


@pytest.mark.parametrize("order", [1, 2, 4])
def test_corners_are_those_of_the_product_of_the_links(order):
    channel = hg.superposed(links()[1:], COIN)
    expected = [m.moments(order).matrix for m in channel.extremes()]
    np.testing.assert_allclose(channel.corner_moments(order), expected, rtol=1e-12, atol=1e-13)
    assert channel.corner_count() == len(expected) == 3 * 2  # (the coin of what is lost is known)


def test_moments_by_enumeration_of_all_atoms():
    """Two hops of two gains each, with the coin of each and of the receiver: 2^5 cases."""
    gains = ([0.5, 1.5], [0.4, 0.6]), ([-1.0, 2.0], [0.3, 0.7])
    channel = hg.superposed([hg.hop(hg.Discrete(*g), COIN) for g in gains], COIN)
    y, coin, totals = np.array([0.7, -1.2]), list(zip(COIN.probabilities, COIN.atoms[:, 0], strict=True)), np.zeros(7)
    for cases in itertools.product(*(list(zip(p, v, strict=True)) for v, p in gains), coin, coin, coin):
        p, values = np.prod([c[0] for c in cases]), [c[1] for c in cases]
        z = values[0] * y[0] + values[1] * y[1] + sum(values[2:])
        totals += p * z ** np.arange(7)
    np.testing.assert_allclose(channel.moments(6).expect(evaluate_monomials(y, 6)), totals[::-1], rtol=1e-12)


def described(channel):
    return second_moments.second_order(channel)


@pytest.mark.parametrize("name", SUMS)
def test_the_second_order_description_is_that_of_the_moments(name):
    channel = SUMS[name]()
    nominal, seen = channel.moments(2), described(channel)
    tensor = nominal.second
    mean = nominal.mean[:-1]
    spread = tensor - moment_tensors.symmetric_product(mean, mean)
    np.testing.assert_allclose(np.column_stack([seen.mean_gain, seen.offset]), mean, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(seen.nominal.center, spread, rtol=1e-10, atol=1e-12)


def true_bounds(channel, laws, second):
    """Spread, shift and power of each law, by its moments alone, at a second moment of (y, 1)."""
    mean = channel.moments(1).mean[:-1]
    for law in laws:
        moments = law.moments(2)
        tensor = moments.second
        of_law = moments.mean[:-1]
        raw, cross = np.einsum("ijab,ab->ij", tensor, second), mean @ second @ of_law.T
        signal = second.copy()
        signal[-1] = signal[:, -1] = 0.0
        shift = (of_law - mean) @ second @ (of_law - mean).T
        yield raw - cross - cross.T + mean @ second @ mean.T, shift, np.einsum("ijab,ab->ij", tensor, signal)


def second_moment(generator, size):
    root = generator.normal(size=(size, size))
    return root @ root.T


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize("name", SUMS)
def test_bounds_hold_under_every_corner(name, few, monkeypatch):
    """The corners of the product are the worst cases of second moments about the nominal means; beyond, sums bound."""
    channel = SUMS[name]()
    laws = channel.extremes()
    assert len(laws) > 1
    if not few:
        monkeypatch.setattr(second_moments, "CORNERS", 1)
    seen, generator = (
        second_moments.describe_second_moments(*second_moments._bound_moments(channel), True),
        np.random.default_rng(3),
    )
    present = np.ones(channel.outputs, dtype=bool)
    for _ in range(3):
        second = second_moment(generator, channel.inputs + 1)
        with jax.enable_x64(True):
            bounds = [np.asarray(quadratic(second, present)) for quadratic in (seen.spread, seen.shift, seen.power)]
        for case in true_bounds(channel, laws, second):
            for bound, value in zip(bounds, case, strict=True):
                gap = np.linalg.eigvalsh(bound - value).min()
                assert gap >= -1e-12 * np.abs(bound).max(), gap


def test_shifts_of_many_relays_are_not_added_up_one_by_one():
    """M relays of one signal whose means all shift by d: together they shift by M d, and d^2 M^2 is attained."""
    law = hg.Discrete([0.0, 1.0], [0.5, 0.5], 0.1)
    channel = hg.superposed([hg.hop(law, 0.0) for _ in range(24)], 0.1, same=True)  # 2^24 corners
    seen = described(channel)
    assert seen.shift.center[0, 0, 0, 0] == pytest.approx((24 * 0.1) ** 2, rel=1e-12)
    assert np.max(np.abs(seen.shift.radius)) == 0
    # Worst spread about the nominal means, all at one end: 24 p (1 - p) + (24 * 0.1)^2; the bound adds each 0.25.
    worst = 24 * 0.24 + (24 * 0.1) ** 2
    assert worst <= seen.spread.center[0, 0, 0, 0] <= 1.03 * worst
    assert seen.power.center[0, 0, 0, 0] == pytest.approx(24 * 0.25 + (24 * 0.6) ** 2, rel=0.01)


def test_intervals_of_a_sum_in_series_hold():
    channel = hg.superposed(links()[1:], COIN)
    low, high = channel.moment_interval(2)
    for m in channel.extremes():
        assert np.all(low <= m.moments(2).matrix + 1e-12)
        assert np.all(m.moments(2).matrix <= high + 1e-12)


def test_hundreds_of_links_are_described():
    """By sums of the links' own moments: no matrix of moments of the sum, with 45,000 columns, 16 GB, is made."""
    made = [hg.hop(hg.Rayleigh(0.8 + i / 300), 0.01) for i in range(300)]
    channel = hg.superposed(made, 0.1)
    seen = described(channel)
    scale = 0.8 + np.arange(300) / 300
    np.testing.assert_allclose(seen.mean_gain[0], scale * np.sqrt(np.pi / 2), rtol=1e-12)
    expected = np.diag([*(2 - np.pi / 2) * scale**2, 0.1 + 3.0])
    np.testing.assert_allclose(seen.spread.center[0, 0], expected, rtol=1e-11, atol=1e-12)
