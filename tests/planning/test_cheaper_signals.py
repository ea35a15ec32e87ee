"""What is taken off before sending counts in powers and designs: both see E (y - r)^2."""

import pytest

import heliograph as hg
from heliograph.model import centred
from heliograph.planning import Error

PLANT = hg.LinearPlant([[0.9]], hg.Gaussian([[0.2]], [1.0]), [10.0], [[1.0]])  # settles at a mean of 10
SENSOR = hg.LinearSensor([[2.0]], 0.3)
HOPS = [hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.1), hg.hop(hg.Discrete([0.7, 1.1], [0.5, 0.5]), 0.2)]
RELAYED = hg.amplify_and_forward(HOPS)


def network(channel: hg.random_affine.AbstractRandomAffine) -> hg.Network:
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, channel, {"linear": hg.linear_filter(PLANT, SENSOR, channel)})})


def test_power_is_that_of_what_is_left() -> None:
    spread = 4 * 0.2 / 0.19 + 0.3
    for r in (0.0, 18.0, 20.0):
        sent = spread + (20.0 - r) ** 2
        result = hg.power(network(centred(RELAYED, r))).mean
        assert result == pytest.approx({"a.hop1": sent, "a.hop2": 1.04 * sent + 0.1}, rel=1e-10)


def test_a_design_of_what_is_left_is_the_filter_that_runs() -> None:
    """The steady error of a design is that of its network's filter, and centring buys the most of it."""
    errors = []
    for r in (0.0, 20.0):
        result = hg.design(network(centred(RELAYED, r)), budget=3.0)
        assert sum(hg.power(result.network).mean.values()) == pytest.approx(3.0, rel=1e-9)
        node = result.network.nodes["a"]
        item = node.filters["best"]
        state = item.init()
        for _ in range(200):
            state, estimate = item.step(state, [0.0])
        assert estimate.covariance[0, 0] == pytest.approx(result.error, rel=1e-9)
        errors.append(result.error)
    assert errors[1] < 0.5 * errors[0]


def test_a_reference_of_a_relay_is_accounted_for_and_not_designed() -> None:
    channel = hg.amplify_and_forward([HOPS[0], centred(HOPS[1], 15.0)])
    sent = 4 * 0.2 / 0.19 + 0.3 + 400
    result = hg.power(network(channel)).mean
    assert result == pytest.approx({"a.hop1": sent, "a.hop2": 1.04 * sent + 0.1 - 2 * 15 * 20 + 225}, rel=1e-10)
    with pytest.raises(ValueError, match="a relay that takes a reference off"):
        hg.design(network(channel), error=Error(), budget=3.0)
