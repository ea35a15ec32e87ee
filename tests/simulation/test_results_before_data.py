"""Results before any data are for senders that transmit at each step: of others they are refused, not wrong."""

import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.1)
FADING = hg.Rayleigh(0.8)


def network(trigger, channel=None, **fused):
    channel = hg.hop(FADING, 0.1) if channel is None else channel
    filters = {"f": hg.linear_filter(PLANT, SENSOR, channel)}
    nodes = {name: hg.Node(SENSOR, channel, filters, trigger=trigger) for name in "ab"}
    return hg.Network(PLANT, nodes, fused)


def one_node(trigger, gain=1.0):
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.hop(gain, 0.1), {}, trigger=trigger)})


def fuse(rule, **options):
    return hg.Fusion("f", rule, **options)


NEIGHBOURS = {"a": ["b"], "b": ["a"]}
RESULTS = {
    "power": lambda t: hg.power(network(t)).total,
    "cross covariances": lambda t: hg.simulation.cross_covariances(network(t), "f", 3).joint,
    "fused": lambda t: hg.simulation.fused_covariances(network(t, w=fuse(hg.fusion.MatrixWeights())), 3)["w"],
    "tree": lambda t: hg.simulation.relay_tree(
        PLANT, lambda one: network(t, hg.hop(1.0, one)).nodes["a"], np.array([0.1, 0.2]), 2, 3
    ),
    "mesh": lambda t: hg.simulation.mesh_errors(
        network(t, m=fuse(hg.fusion.TraceIntersection(), neighbours=NEIGHBOURS)), "m", 3
    ),
    "samples": lambda t: hg.learning.samples_to_tell(FADING, hg.random_affine.LogNormal(0, 0.5), one_node(t, FADING)),
    "identifiable": lambda t: hg.learning.identifiable(lambda: one_node(t, hg.free(1.0))),
}


@pytest.mark.parametrize("result", RESULTS)
@pytest.mark.parametrize("trigger", [hg.Periodic(3), hg.SendOnDelta(0.5)])
def test_a_sender_that_decides_when_to_transmit_is_refused(result, trigger):
    """A trigger was ignored: a sender of every third step "sent" three times its power."""
    with pytest.raises(hg.InputError, match=r"expected senders that transmit at each step, got triggers of"):
        RESULTS[result](trigger)
