"""Nodes whose links hold one memory share one fading state, whatever they are called and however runs are cut."""

import numpy as np
import pytest

import heliograph as hg

pytestmark = pytest.mark.slow

PLANT = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]])
SENSOR = hg.LinearSensor([[0.0]], hg.Gaussian([[0.0]], [1.0]))  # y = 1, so that z is the gain
BURSTS = [[0.9, 0.1], [0.2, 0.8]]


def link(transition=BURSTS, name=None):
    return hg.markov_fading([0.2, 1.0], transition, 0.0, name=name)


RUNS, HORIZON = 64, 30
CHAIN = hg.random_affine.MarkovChain(BURSTS, name="valley")


def gains(channels):
    """What each node receives, (run, time): its gain."""
    nodes = {name: hg.Node(SENSOR, channel, {}) for name, channel in channels.items()}
    record = hg.monte_carlo(hg.Network(PLANT, nodes), HORIZON, RUNS, 7)
    return {name: record.measurements[name][..., 0] for name in channels}


def in_turn(name):
    """A link that switches surely at odd steps and stays at even ones."""
    moves = [np.eye(2), np.eye(2)[::-1]]
    chains = [hg.random_affine.MarkovChain(moves[k % 2], [1.0, 0.0], name) for k in range(HORIZON)]
    return hg.model.over_time([link(chain) for chain in chains])


@pytest.fixture(scope="module")
def received():
    """Of one plant, through links of every kind of memory."""
    channels = {
        "a": link(CHAIN),
        "b": link(CHAIN),
        "c": link(),
        "d": link(name="road"),
        "z": link(name="road"),
        "two hops": hg.amplify_and_forward([link(CHAIN), link(CHAIN)]),
        "low": hg.model.autoregressive_fading(1.0, 0.2, 0.9, 0.0, name="hill"),
        "high": hg.model.autoregressive_fading(2.0, 0.5, 0.9, 0.0, name="hill"),
        "in turn": in_turn("turn"),
        "in turn, unnamed": in_turn(None),
    }
    return gains(channels)


@pytest.fixture(scope="module")
def alone():
    return gains({"z": link(name="road")})["z"]


def test_one_chain_is_one_fading_across_nodes_and_another_is_not(received):
    np.testing.assert_array_equal(received["a"], received["b"])
    np.testing.assert_array_equal(received["d"], received["z"])
    assert np.mean(received["a"] == received["c"]) < 0.8 and np.mean(received["a"] == received["d"]) < 0.8
    assert set(np.unique(received["c"])) == {0.2, 1.0}


def test_a_name_keeps_its_draws_whatever_else_there_is(received, alone):
    np.testing.assert_array_equal(alone, received["z"])


def test_a_shared_drift_may_have_another_size_at_each_node(received):
    np.testing.assert_allclose((received["low"] - 1) / 0.2, (received["high"] - 2) / 0.5, rtol=1e-9, atol=1e-12)


def test_hops_of_one_channel_share_with_another_node(received):
    np.testing.assert_allclose(received["two hops"], received["a"] ** 2, rtol=1e-12)


def test_hops_of_relays_share_too_in_every_slot(alone):
    """A named chain moves on at every step, and draws the same as anywhere else."""
    plant = hg.LinearPlant([[1.0]], [[0.0]], [1.0], [[0.0]])
    slots = [{"receiver": {"sensor": link(name="road")}}, {"receiver": {"sensor": link(name="road")}}]
    relays = hg.model.RelayNetwork(plant, SENSOR, (), slots)
    record = hg.monte_carlo(hg.Network.of_relays(relays, {}, {}), HORIZON, RUNS, 7)
    np.testing.assert_allclose(record.measurements["receiver"][..., 0], alone)


@pytest.mark.parametrize("name", ["in turn", "in turn, unnamed"])
def test_a_chain_that_varies_moves_by_the_step(received, name):
    expected = np.resize([0.2, 0.2, 1.0, 1.0], HORIZON)
    np.testing.assert_array_equal(received[name], np.broadcast_to(expected, (RUNS, HORIZON)))
