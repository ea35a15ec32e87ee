import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph.random_affine import Independent, Series, Stack, Superposed, known
from heliograph.random_affine.moments.second_moments import second_order
from tests.as_code import printing
from tests.random_affine.conditional import conditional_moments

GAMMA = hg.Discrete([0.7, 0.85, 1.0], [0.3, 0.3, 0.4], 0.02)
XI = hg.Discrete([0.8, 0.9, 1.0], [0.2, 0.3, 0.5], 0.02)


def relay(gamma=GAMMA, xi=XI, dimension=2):
    return hg.amplify_and_forward(
        [hg.hop(gamma, 1e-3, dimension=dimension), hg.hop(xi, 1e-3, amplification=2.0, dimension=dimension)]
    )


def evaluate(quadratic, w):
    """The dominating matrix C:W + diag(R:|W| row sums), in NumPy."""
    center = np.einsum("ijab,ab->ij", quadratic.center, w)
    return center + np.diag(np.einsum("ijab,ab->ij", quadratic.radius, np.abs(w)).sum(axis=1))


def test_worst_cases_of_a_relay_are_those_of_brute_force():
    """V0 = max E(xi gamma - mu)^2, lambda^2 = max (mu' - mu)^2 and max E xi^2, over all corner pairs."""
    c = 2.0
    mu = GAMMA.moment(1) * XI.moment(1)
    corners = [(g, x) for g in GAMMA.extremes() for x in XI.extremes()]
    spread = max(g.moment(2) * x.moment(2) - 2 * mu * g.moment(1) * x.moment(1) + mu**2 for g, x in corners)
    shift = max((g.moment(1) * x.moment(1) - mu) ** 2 for g, x in corners)
    noise = max(c**2 * x.moment(2) * 1e-3 + 1e-3 for _, x in corners)
    power = max(g.moment(2) * x.moment(2) for g, x in corners)
    moments = hg.random_affine.second_order(relay())
    y = np.zeros((3, 3))
    y[0, 0] = 1.0
    assert moments.mean_gain[0, 0] == pytest.approx(c * mu, rel=1e-14)
    assert evaluate(moments.spread, y)[0, 0] == pytest.approx(c**2 * spread, rel=1e-12)
    assert evaluate(moments.shift, y)[0, 0] == pytest.approx(c**2 * shift, rel=1e-12)
    assert evaluate(moments.power, y)[0, 0] == pytest.approx(c**2 * power, rel=1e-12)
    y[0, 0], y[2, 2] = 0.0, 1.0
    assert evaluate(moments.spread, y)[0, 0] == pytest.approx(noise, rel=1e-12)
    assert not np.any(moments.spread.radius)  # one scalar gain: exact, no interval arithmetic


def test_a_known_channel_has_its_own_second_moments():
    moments = hg.random_affine.second_order(relay(hg.Rayleigh(1.0), hg.random_affine.Nakagami(2.0)))
    assert not moments.uncertain and not np.any(moments.shift.center)
    y = np.array([0.5, -1.0])
    w = np.append(y, 1.0)
    second = conditional_moments(relay(hg.Rayleigh(1.0), hg.random_affine.Nakagami(2.0)), y, 2)
    mean = moments.mean_gain @ y + moments.offset
    spread = evaluate(moments.spread, np.outer(w, w))
    np.testing.assert_allclose(
        spread + np.outer(mean, mean), [[second[0], second[1]], [second[1], second[3]]], rtol=1e-12
    )


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), components=st.integers(2, 3), direct=st.booleans())
def test_the_maps_dominate_every_possible_law(seed, components, direct):
    """Random uncertain parallel relays, with or without a direct link: no corner law exceeds the maps."""
    rng = np.random.default_rng(seed)

    def law():
        p = rng.dirichlet(np.ones(3))
        return hg.Discrete(rng.uniform(-0.5, 1.5, 3), p, 0.5 * p.min())

    channel = hg.parallel([hg.amplify_and_forward([hg.hop(law(), 0.1), hg.hop(law(), 0.2)]) for _ in range(components)])
    if direct:
        channel = hg.model.with_direct_link(channel, hg.hop(law(), 0.1, dimension=components))
    with printing(channel=channel):
        check_that_maps_dominate(channel, rng)


def check_that_maps_dominate(channel, rng):
    components = channel.inputs
    moments = hg.random_affine.second_order(channel)
    a = rng.normal(size=(components + 1, components + 1))
    w = a @ a.T

    def corner(part):
        """One of its corner laws: that of every hop by itself."""
        if isinstance(part, hg.random_affine.Series | hg.random_affine.Stack):
            return type(part)([corner(map_) for map_ in part.maps])
        options = part.extremes()
        return options[rng.integers(len(options))]

    for _ in range(4):
        extreme = corner(channel)
        assert extreme.corner_count() == 1 < channel.corner_count()
        separate = hg.random_affine.second_order(extreme)
        shift = np.concatenate(
            [separate.mean_gain - moments.mean_gain, (separate.offset - moments.offset)[:, None]], axis=1
        )
        moved = shift @ w @ shift.T
        cross = np.concatenate([separate.mean_gain, separate.offset[:, None]], axis=1)
        assert np.isfinite(cross).all()
        for bound, actual in (
            (evaluate(moments.spread, w), evaluate(separate.spread, w) + moved),
            (evaluate(moments.shift, w), moved),
            (evaluate(moments.power, w), evaluate(separate.power, w)),
        ):
            gap = np.linalg.eigvalsh(bound - actual)[0]
            assert gap >= -1e-10 * np.abs(bound).max()  # rounding


def test_interval_arithmetic_takes_over_beyond_the_corner_limit_and_stays_sound():
    chain = hg.random_affine.Series(
        [hg.hop(hg.Discrete([0.5, 1.0, 1.5], [0.2, 0.6, 0.2], 0.05), 0.1) for _ in range(5)]
    )
    assert chain.corner_count() > 2048
    low, high = chain.moment_interval(2)
    rng = np.random.default_rng(0)
    for _ in range(50):
        item = hg.random_affine.Series(
            [options[rng.integers(len(options))] for options in (m.extremes() for m in chain.maps)]
        )
        inside = item.moments(2).matrix
        assert np.all(inside >= low - 1e-12) and np.all(inside <= high + 1e-12)

    assert low[0, 0] <= chain.moments(2).matrix[0, 0] <= high[0, 0]


def test_a_gain_with_many_uncertain_atoms_uses_the_closed_form_programme():
    p = np.full(14, 1 / 14)
    law = hg.Discrete(np.linspace(0.1, 1.4, 14), p, 0.01)
    low, high = hg.hop(law, 0.5).moment_interval(2)
    assert high[0, 0] == pytest.approx(law.worst(law.values**2), rel=1e-9)
    assert low[1, 1] == pytest.approx(-law.worst(-law.values), rel=1e-9)


def corner_cases():
    """Every kind of map that says what its corners are, some in the place of a part of another."""
    uncertain, known = hg.hop(GAMMA, 0.3), hg.hop(hg.Rayleigh(1.0), 0.2)
    lost = hg.dropout(uncertain, 0.7, 0.1)
    count = hg.parallel([lost, hg.amplify_and_forward([uncertain, hg.hop(XI, 0.1)])])
    series = hg.random_affine.Series([count, hg.hop(GAMMA, np.diag([0.1, 0.2]))])
    return [
        uncertain,
        known,
        hg.hop(hg.random_affine.GivenMoments([1.0, 2.0]), 0.1),
        lost,
        count,
        series,
        hg.erasure(known, 0.5),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("channel", corner_cases(), ids=lambda channel: type(channel).__name__)
def test_moments_at_corners_are_those_of_the_extremes(channel):
    """Their entries are sums of a few dozen terms of one size, in another order: equal to rounding."""
    if channel.erases:
        assert channel.corner_count() == len(channel.extremes())
        return
    for order in (1, 2):
        expected = [extreme.moments(order).matrix for extreme in channel.extremes()]
        result = channel.corner_moments(order)
        assert len(result) == channel.corner_count()
        np.testing.assert_allclose(result, expected, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(channel.moments(2).lower(order), channel.moments(order).matrix, rtol=1e-13)


def test_outputs_of_known_gain_are_those_that_take_nothing_through_a_random_one():
    """One output each of: a known gain, a random one, and what sums both, or takes the first alone."""
    pair = Stack([Series([known(np.eye(2)[[i]]), hg.hop(g, 1e-3)]) for i, g in enumerate([0.5, GAMMA])])
    mixed = Series([pair, known(np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 0.0]]))])
    swapped = Series([pair, known(np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 0.0]]))])
    first, hop = known(np.eye(3)[[0]]), hg.hop(1.0, 1e-3)
    cases = {
        (True, False): pair,
        (True, False, True): mixed,
        (True, False, False): Series(
            [mixed, Stack([first, Series([known(np.eye(3)[1:]), hg.hop(XI, 0.0, dimension=2)])])]
        ),
        (False, False): hg.erasure(pair, 0.5),
        (False, False, True): Superposed([mixed, swapped], Independent([hop.noise] * 3), [(0, 1), (2, 1)], 3),
    }
    for expected, channel in cases.items():
        np.testing.assert_array_equal(channel.known_gains, expected)
        assert not channel.has_known_gain
    assert Series([pair, known(np.eye(2)[[0]])]).has_known_gain


def test_the_product_of_known_gains_has_no_spread():
    """(a b)^2 is a^2 b^2 but for the last digit: the difference is no variance, and may be below zero."""
    for gain in np.linspace(0.3, 1.7, 40):
        chain = Series([hg.hop(gain, 1e-3), hg.hop(0.93, 1e-3)])
        assert not np.any(second_order(chain).gain_covariance)
