"""Bounds of the mean error of filters that are told numbers, against enumeration and a table by quadrature."""

from itertools import pairwise, product

import numpy as np
import pytest

import heliograph as hg
from heliograph.filters import mean_error_bound
from heliograph.model import Pilot, told
from heliograph.random_affine import FiniteSupport, MarkovChain

PLANT, SENSOR = hg.LinearPlant([[0.95]], 0.1, [0.0], 0.1 / (1 - 0.95**2)), hg.LinearSensor([[1.0]], 0.05)
NOISES = np.array([0.02, 1.5])
FRESH = np.array([0.6, 0.4])
CHAIN = MarkovChain([[0.8, 0.2], [0.3, 0.7]])


def left(p, noise):
    """f(P, a): what is left of a variance after a message of known noise."""
    prior = 0.95**2 * p + 0.1
    return prior * (0.05 + noise) / (prior + 0.05 + noise)


def enumerated(steps, chance_of):
    """E P over all sequences of modes."""
    total = 0.0
    for modes in product((0, 1), repeat=steps):
        p = float(PLANT.initial_covariance[0, 0])
        for mode in modes:
            p = left(p, NOISES[mode])
        total += chance_of(modes) * p
    return total


def of_chain(modes):
    chance = CHAIN.initial[modes[0]]
    for before, now in pairwise(modes):
        chance *= CHAIN.transition[before, now]
    return chance


def recursion(steps, law, transition):
    """V+_j = f(sum_i b_ij V_i, a_j), and its mean over the modes; of fresh modes all V_i are one."""
    before, fresh = np.full(2, float(PLANT.initial_covariance[0, 0])), np.allclose(transition, transition[0])
    means = []
    for _ in range(steps):
        after = np.array([left(before[j], NOISES[j]) for j in range(2)])
        means.append(law @ after)
        following = law @ transition
        before = np.full(2, law @ after) if fresh else (law * after) @ transition / following
        law = following
    return means


def by_mode(a):
    return hg.hop(1.0, NOISES[0] * (1 - a[0]) + NOISES[1] * a[0])


@pytest.mark.slow
def test_bound_of_two_noises_against_all_sequences():
    fresh = told(lambda a: hg.hop(1.0, a[0]), ["variance"], law=FiniteSupport(NOISES[:, None], FRESH))
    chances = {"fresh": lambda modes: np.prod(FRESH[list(modes)]), "chain": of_chain}
    links = {"fresh": fresh, "chain": told(by_mode, ["mode"], law=CHAIN)}
    laws = {"fresh": (FRESH, np.tile(FRESH, (2, 1))), "chain": (CHAIN.initial, CHAIN.transition)}
    for name, link in links.items():
        bound = mean_error_bound(hg.linear_filter(PLANT, SENSOR, link), 8)[:, 0, 0]
        expected = [enumerated(steps, chances[name]) for steps in range(1, 9)]
        assert bound[0] == pytest.approx(expected[0], rel=1e-12)  # of one message it is the mean
        assert np.all(bound[1:] > expected[1:])
        np.testing.assert_allclose(bound, recursion(8, *laws[name]), rtol=1e-12)


@pytest.mark.slow
def test_bounds_of_the_table():
    """After 60 steps, to six digits, by quadrature in another program."""
    for s, expected in ((0.8, 0.141131), (0.4, 0.122694), (0.2, 0.106595), (0.1, 0.099140), (0.0, 0.095921)):
        link = hg.hop(hg.Rayleigh(0.8), 0.1, known=True if s == 0 else Pilot(s**2))
        assert mean_error_bound(hg.linear_filter(PLANT, SENSOR, link), 60)[-1, 0, 0] == pytest.approx(
            expected, abs=6e-7
        )


def test_refusals():
    gain = hg.hop(hg.Rayleigh(0.8), 0.1, known=True)
    nobody_knows = told(lambda a: hg.hop(1.0, a[0]), ["variance"], typical=[0.1])
    for link, named in (
        (hg.perfect(), "behind a link without memory that tells numbers"),
        (nobody_knows, "a law of one gain"),
    ):
        with pytest.raises(ValueError, match=named):
            mean_error_bound(hg.linear_filter(PLANT, SENSOR, link), 3)
    with pytest.raises(ValueError, match="behind a link without memory that tells numbers"):
        mean_error_bound(hg.extended_filter(PLANT, SENSOR, gain), 3)
