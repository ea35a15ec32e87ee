"""Links that add up in the air: what is refused, and how a network shows them."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.sum_of_maps import Superposed

HOP = hg.hop(1.0, 0.1)
LATE = hg.model.delayed(HOP, hg.Discrete([0, 1], [0.5, 0.5]), timestamped=True)
FLAGGED = hg.model.with_flag(hg.gilbert_elliott(HOP, hg.model.silent(), 0.1, 0.5))


@pytest.mark.parametrize(
    ("links", "noise", "same", "message"),
    [
        ([HOP, hg.hop(1.0, 0.1, dimension=2)], 0.1, False, r"one number of outputs, got \[1, 2\]"),
        ([HOP, hg.erasure(HOP, 0.9)], 0.1, False, r"link 2 of a sum: .*dropout\(link, arrival\) inside"),
        ([HOP, LATE], 0.1, False, "link 2 of a sum: expected one without flags and time stamps"),
        ([FLAGGED, HOP], 0.1, False, "link 1 of a sum: expected one without flags and time stamps"),
        ([HOP, hg.random_affine.known([[1.0, 2.0]])], 0.1, True, r"all carry all of y, got links of \[1, 2\] numbers"),
        ([HOP, HOP], 0.1, "yes", "same: expected True or False, got 'yes'"),
        ([HOP, HOP], np.eye(2), False, r"noise of a sum: expected shape \(1, 1\)"),
        ([], 0.1, False, "links of a sum: expected at least one map"),
    ],
)
def test_what_cannot_be_added_up_is_refused_in_one_line(links, noise, same, message):
    with pytest.raises(ValueError, match=message) as refused:
        hg.superposed(links, noise, same)
    assert "\n" not in str(refused.value)


def test_places_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="distinct ones below 1, as many as each map has inputs"):
        Superposed([HOP], hg.Gaussian([[0.1]]), [(1,)], 1)


def test_a_sum_is_lost_as_a_whole():
    channel = hg.erasure(hg.superposed([HOP, HOP], 0.1), 0.8)
    assert channel.erases
    assert (channel.outputs, channel.inputs) == (1, 2)


def test_a_late_link_takes_its_own_part_of_the_line():
    """Two parts of two numbers, the second late by one step: (y_k, y_{k-1}) has eight numbers."""
    wide = hg.hop(2.0, 0.0, dimension=2)
    channel = hg.superposed([wide, hg.model.delayed(wide, 1)], np.zeros((2, 2)))
    assert (channel.inputs, channel.past) == (8, 1)
    expected = np.zeros((2, 8))
    expected[:, :2] = expected[:, 6:] = 2 * np.eye(2)
    np.testing.assert_array_equal(channel.moments(1).mean[:-1, :-1], expected)


def test_the_diagram_shows_a_sum():
    plant, sensor = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]]), hg.LinearSensor([[1.0], [1.0]], np.eye(2))
    channel = hg.superposed([HOP, hg.hop(hg.Rayleigh(1.0), 0.0)], 0.1)
    assert "sum of (hop | Rayleigh hop)" in str(hg.Network(plant, {"a": hg.Node(sensor, channel, {})}))
    same = hg.superposed([hg.hop(hg.Rayleigh(1.0), 0.0)] * 16, 0.1)
    assert "sum of 16 × (Rayleigh hop)" in str(
        hg.Network(plant, {"a": hg.Node(hg.LinearSensor(np.ones((16, 1)), np.eye(16)), same, {})})
    )
