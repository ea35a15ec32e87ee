"""A short search for a broken claim of "upper"; long ones are benchmarks/upper_claims.py, _fusion.py, _networks.py."""

import importlib
from pathlib import Path

import pytest

import heliograph as hg

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
STEPS = 3

pytestmark = pytest.mark.slow


@pytest.fixture
def search(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module("upper_claims")


def test_no_claim_is_broken(search):
    for name, ratio in search.families().items():
        assert search.ascended(ratio, 0, STEPS).largest <= 1 + search.ROUNDING, name


def test_the_search_finds_a_rule_that_is_no_bound(search, monkeypatch):
    """`ZeroMean`, as if it claimed "upper"."""
    monkeypatch.setattr(hg.filters.ZeroMean, "claim", lambda rule, uncertain: "upper" if uncertain else "exact")
    monkeypatch.setitem(search.RULES, "zero mean", lambda read: hg.filters.ZeroMean())

    def ratio(numbers):
        return search.ratio_of(search.behind_a_link("a hop", "zero mean")(numbers))

    assert search.ascended(ratio, 2, 20).largest > 1.1


def test_no_claim_of_what_is_fused_or_smoothed_is_broken(search):
    fusion = importlib.import_module("upper_fusion")
    for name, ratio in fusion.families().items():
        assert search.ascended(ratio, 0, STEPS).largest <= 1 + search.ROUNDING, name


def test_the_search_finds_a_fusion_that_is_no_bound(search, monkeypatch):
    """`MatrixWeights`-like: the information of independent errors, as if it claimed "upper"."""
    fusion = importlib.import_module("upper_fusion")

    class Naive(hg.fusion.EqualIntersection):
        def combine(self, means, covariances):
            mean, covariance = super().combine(means, covariances)
            return mean, covariance / len(means)

    assert search.ascended(fusion.intersected(lambda read: Naive()), 0, 5).largest > 1.5


def test_no_claim_of_events_quantizers_and_bounds_in_a_network_is_broken(search):
    networks = importlib.import_module("upper_networks")
    for name, ratio in networks.families().items():
        assert search.ascended(ratio, 0, 0).largest <= 1 + search.ROUNDING, name


def test_the_search_finds_events_that_are_worse_than_they_say(search):
    """Thresholds three times what is claimed of them."""
    networks = importlib.import_module("upper_networks")

    class Coarse(hg.fusion.EventSending):
        def error(self, n):
            return super().error(n) / 3

    def ratio(numbers):
        return networks.at_a_centre(lambda read: hg.CovarianceIntersection(), lambda read: Coarse(3.0))(numbers)

    assert search.ascended(ratio, 0, 5).largest > 1.1
