"""Filters that know the mode: modes of any kinds, flags of the right step, and what is refused."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.filters import mode_known_filter, mode_late_filter, side_information_filter
from heliograph.model import with_flag
from tests.follow import follow

PLANT, SENSOR = hg.LinearPlant([[0.9]], 0.1, [0.5], 1.0), hg.LinearSensor([[1.0]], 0.1)
HOP = hg.hop(1.0, 0.05)
RELAY = hg.amplify_and_forward([hg.hop(1.0, 0.1), hg.hop(hg.Rayleigh(0.5), 0.2)])
EYE = np.eye(2)
LINK = hg.gilbert_elliott(HOP, hg.hop(0.2, 0.05), 0.2, 0.2)
MIXED = {
    "a dropout beside a hop": hg.gilbert_elliott(hg.dropout(HOP, 0.5), hg.hop(0.2, 0.05), 0.2, 0.3),
    "a relay beside a hop": hg.gilbert_elliott(RELAY, HOP, 0.2, 0.3),
    "three kinds": hg.markov_fading([RELAY, HOP, hg.dropout(HOP, 0.5)], [[0.8, 0.1, 0.1]] * 2 + [[0.1, 0.1, 0.8]]),
}
SENT = [[1.0, 0.0], [0.3, 1.0], [np.nan, 1.0]]  # z and flag; without a flag one skips z, the other weighs the modes


@pytest.mark.slow
@pytest.mark.parametrize("name", MIXED)
def test_modes_of_any_kinds_are_those_of_the_filter_that_takes_flags(name):
    """Two programs of one recursion: 1e-12 of numbers of order one."""
    link = MIXED[name]
    ours = follow(mode_known_filter(PLANT, SENSOR, link), SENT)
    theirs = follow(side_information_filter(PLANT, SENSOR, link, np.eye(len(link.maps))), SENT)
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=0, atol=1e-12)


@pytest.mark.parametrize("make", [mode_known_filter, mode_late_filter])
def test_its_covariance_is_its_error_where_modes_are_of_two_kinds(make):
    """e'P^-1e is 1 on average over 4,000 runs: within 4.5 of its standard errors at each of 20 steps."""
    link = MIXED["a relay beside a hop"]
    node = hg.Node(SENSOR, with_flag(link, late=make is mode_late_filter), {"f": make(PLANT, SENSOR, link)})
    record = hg.monte_carlo(hg.Network(PLANT, {"a": node}), 20, 4000, 3)
    estimate = record.estimates["a"]["f"]
    assert estimate.claim == "exact"
    squared = record.errors("a", "f")[..., 0] ** 2 / estimate.covariance[..., 0, 0]
    error = squared.std(axis=0) / np.sqrt(len(squared))
    assert np.abs(squared.mean(axis=0) - 1).max() < 4.5 * error.max()


THIS, BEFORE = r"hg\.model\.with_flag\(link\)", r"hg\.model\.with_flag\(link, late=True\)"
WRONG = {
    "late for now": (with_flag(LINK, late=True), mode_known_filter(PLANT, SENSOR, LINK), THIS, "the step before"),
    "now for late": (with_flag(LINK), mode_late_filter(PLANT, SENSOR, LINK), BEFORE, "one of this step"),
    "a class": (with_flag(LINK, EYE), mode_known_filter(PLANT, SENSOR, LINK), THIS, "Modes, no mode"),
    "a number": (hg.model.with_direct_link(HOP, HOP), mode_late_filter(PLANT, SENSOR, LINK), BEFORE,
                 "GainAndNoise, no mode"),
    "late class": (with_flag(LINK, EYE, late=True), side_information_filter(PLANT, SENSOR, LINK, EYE),
                   r"hg\.model\.with_flag\(link, flags\)", "the step before"),
    "inside": (with_flag(LINK), hg.filters.late_filter(mode_late_filter(PLANT, SENSOR, LINK), 2), BEFORE, "this step"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_node_refuses_flags_of_another_step(name):
    channel, item, expected, came = WRONG[name]
    with pytest.raises(ValueError, match=f"^filter 'f', flags: expected those of {expected}, got .*{came}$"):
        hg.Node(SENSOR, channel, {"f": item})


def test_a_fused_filter_is_refused_flags_of_another_step():
    node = hg.Node(SENSOR, with_flag(LINK, late=True), {})
    with pytest.raises(ValueError, match=r"^fused 'f', flags: expected those of"):
        hg.Network(PLANT, {"a": node}, {"f": mode_known_filter(PLANT, SENSOR, LINK)})
    hg.Network(PLANT, {"a": node}, {"f": mode_late_filter(PLANT, SENSOR, LINK)})


@pytest.mark.parametrize("make", [mode_known_filter, mode_late_filter])
def test_erasures_are_refused_when_it_is_made(make):
    lossy = hg.gilbert_elliott(hg.erasure(HOP, 0.9), HOP, 0.2, 0.2)
    with pytest.raises(
        ValueError, match=r"observes the mode: expected a channel without erasures .*side_information_filter"
    ):
        make(PLANT, SENSOR, lossy)
    with pytest.raises(ValueError, match="without erasures"):
        make(PLANT, SENSOR, hg.model.over_time([lossy] * 3))
