"""Relays on a line: sites and numbers against direct minimisation and the closed forms."""

import numpy as np
import pytest
from scipy.optimize import minimize

import heliograph as hg
from heliograph.planning import split_power
from heliograph_studies.theory.relay_line import best_relays, relay_line


def searched(rho, exponent, hops):
    """Least noise over lengths and powers together, from several starts: nothing known of the structure."""
    draw = np.random.default_rng(0)
    starts = [np.full(2 * hops, 1 / hops), *draw.dirichlet(np.full(hops, 0.5), (12, 2)).reshape(12, -1)]

    def noise(x):
        d, q = np.split(np.maximum(x, 1e-9), 2)
        return np.log1p(rho * d**exponent / q).sum()

    whole = [{"type": "eq", "fun": lambda x, i=i: np.split(x, 2)[i].sum() - 1} for i in range(2)]
    bounds = [(1e-6, 1.0)] * (2 * hops)
    result = [minimize(noise, x, bounds=bounds, constraints=whole, options={"ftol": 1e-13}) for x in starts]
    return min(item.fun for item in result if item.success)


@pytest.mark.parametrize(("rho", "exponent", "hops"), [(2.0, 3.0, 2), (20.0, 3.0, 3), (6.0, 2.4, 3)])
def test_lengths_and_powers_are_the_best_of_all(rho, exponent, hops):
    assert np.log(relay_line(rho, exponent, hops - 1).noise) == pytest.approx(searched(rho, exponent, hops), abs=1e-6)


def test_one_relay_moves_towards_an_end_as_the_way_gets_noisy():
    for rho in (1.0, 4.0):
        assert relay_line(rho, 3.0).sites == pytest.approx([0.5], abs=1e-6)
    for rho in (5.0, 7.9, 8.1, 100.0):
        line = relay_line(rho, 3.0)
        x = line.sites[0]
        assert x * (1 - x) == pytest.approx(1 / rho, rel=1e-5) and line.noise == pytest.approx(rho, rel=1e-9)
        assert (line.even < line.direct) == (rho < 8)  # 4^(e - 1) - 2^e
        assert line.noise < line.direct == 1 + rho


def test_the_number_of_relays_follows_from_what_each_costs():
    lines = best_relays(0.5, 3.0, 8, kappa=1.02)
    assert len(lines[0].lengths) == 5 and lines[0].noise == pytest.approx(1.02**5 * (1 + 0.5 * 5**-2) ** 5, rel=1e-12)
    assert len(best_relays(0.5, 2.0, 8, kappa=1.02)[0].lengths) == 1
    assert [len(line.lengths) for line in best_relays(0.5, 3.0, 4)] == [5, 4, 3, 2, 1]  # without fading ever more
    np.testing.assert_allclose(relay_line(20.0, 3.0, 2).lengths, [0.056, 0.056, 0.887], atol=5e-4)


def test_a_line_is_the_chain_of_hops_that_planning_knows():
    """Its noise is that of `split_power`'s best powers, which do not know that they are the lengths."""
    for rho, exponent, relays in ((20.0, 3.0, 2), (2.0, 2.4, 1), (0.0, 3.0, 1)):
        line = relay_line(rho, exponent, relays)
        alpha = rho * line.lengths**exponent
        powers = split_power(alpha, 1.0)
        through = np.prod(1 + np.divide(alpha, powers, out=np.zeros_like(alpha), where=alpha > 0))
        assert line.noise == pytest.approx(through, rel=1e-12)


def test_what_cannot_be_is_refused():
    with pytest.raises(hg.InputError, match="kappa: expected a number of at least 1"):
        relay_line(1.0, 3.0, kappa=0.5)
    with pytest.raises(hg.InputError, match="rho: expected a number of at least 0"):
        relay_line(-1.0, 3.0)
