"""Nodes whose links hold one memory are in one shadow, whatever they are called and however runs are cut."""

import numpy as np

import heliograph as hg

PLANT = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]])
SENSOR = hg.LinearSensor([[0.0]], hg.Gaussian([[0.0]], [1.0]))  # y = 1, so that z is the gain
BURSTS = [[0.9, 0.1], [0.2, 0.8]]


def link(transition=BURSTS, name=None):
    return hg.markov_fading([0.2, 1.0], transition, 0.0, name=name)


def gains(channels, runs=64, horizon=30):
    """What each node hears, (run, time): its gain."""
    listen = {"silent": hg.filters.open_loop_filter(PLANT)}
    nodes = {name: hg.Node(SENSOR, channel, listen) for name, channel in channels.items()}
    record = hg.monte_carlo(hg.Network(PLANT, nodes), horizon, runs, 7)
    return {name: record.measurements[name][..., 0] for name in channels}


def test_one_chain_is_one_shadow_across_nodes_and_another_is_not():
    chain = hg.random_affine.MarkovChain(BURSTS)
    heard = gains({"a": link(chain), "b": link(chain), "c": link(), "d": link(name="road"), "e": link(name="road")})
    np.testing.assert_array_equal(heard["a"], heard["b"])
    np.testing.assert_array_equal(heard["d"], heard["e"])
    assert np.mean(heard["a"] == heard["c"]) < 0.8 and np.mean(heard["a"] == heard["d"]) < 0.8
    assert set(np.unique(heard["c"])) == {0.2, 1.0}


def test_a_name_keeps_its_draws_whatever_else_there_is():
    alone, among = gains({"z": link(name="road")}), gains({"a": link(), "z": link(name="road"), "q": link(name="road")})
    np.testing.assert_array_equal(alone["z"], among["z"])


def test_a_shared_drift_may_have_another_size_at_each_node():
    channels = {
        name: hg.autoregressive_fading(mean, size, 0.9, 0.0, name="hill")
        for name, mean, size in (("a", 1.0, 0.2), ("b", 2.0, 0.5))
    }
    heard = gains(channels)
    np.testing.assert_allclose((heard["a"] - 1) / 0.2, (heard["b"] - 2) / 0.5, rtol=1e-9, atol=1e-12)


def test_hops_of_one_channel_share_with_another_node():
    chain = hg.random_affine.MarkovChain(BURSTS)
    heard = gains({"two hops": hg.amplify_and_forward([link(chain), link(chain)]), "one": link(chain)})
    np.testing.assert_allclose(heard["two hops"], heard["one"] ** 2, rtol=1e-12)


def test_hops_of_relays_share_too_in_every_slot():
    """A named chain moves on at every step, and draws the same as anywhere else."""
    plant = hg.LinearPlant([[1.0]], [[0.0]], [1.0], [[0.0]])
    slots = [{"receiver": {"sensor": link(name="road")}}, {"receiver": {"sensor": link(name="road")}}]
    relays = hg.model.RelayNetwork(plant, SENSOR, (), slots)
    record = hg.monte_carlo(hg.Network.of_relays(relays, {}, {}), 30, 64, 7)
    np.testing.assert_allclose(record.measurements["receiver"][..., 0], gains({"a": link(name="road")})["a"])


def test_a_chain_that_varies_moves_by_the_step():
    """It switches surely at odd steps and stays at even ones."""
    stay, switch = np.eye(2), np.eye(2)[::-1]
    for name in ("c", None):
        steps = [hg.random_affine.MarkovChain(switch if k % 2 else stay, [1.0, 0.0], name) for k in range(6)]
        heard = gains({"a": hg.model.over_time([link(chain) for chain in steps])}, runs=2, horizon=6)["a"]
        np.testing.assert_array_equal(heard, [[0.2, 0.2, 1.0, 1.0, 0.2, 0.2]] * 2)
