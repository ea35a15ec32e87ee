"""Medians of innovations under laws of noise that are not symmetric, which are no bias of a sensor."""

import jax
import numpy as np

from heliograph.model.over_time import first
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

DRAWS = 20_000  # the median of this many is known to 1 % of a deviation


def compute_innovation_medians(
    network: Network, node: str, variance: Float[np.ndarray, " received"]
) -> Float[np.ndarray, " received"]:
    """Return the median that each received number's innovation has by the law of its noise; 0 if it is symmetric.

    A skewed noise has a median other than 0, which is no sign of a constant error. The innovation is taken for
    M (v - E v) + e: the sensor's noise v through the mean gain M of the link, and an independent Gaussian number e that
    makes the variance the claimed one. The median is that of draws with a fixed key.

    Args:
        network: the network.
        node: name of the node; or Network.FUSED for a filter at the centre, which receives all nodes' numbers one
            after the other.
        variance: claimed variance of each innovation.
    """
    # The filter of the centre receives all nodes' numbers: each node's part by its own law.
    if node == Network.FUSED:
        ends = np.cumsum([network.nodes[name].received for name in network.names])
        of_nodes = zip(network.names, np.split(variance, ends[:-1]), strict=True)
        return np.concatenate([compute_innovation_medians(network, name, of_node) for name, of_node in of_nodes])
    receiver = network.nodes[node]
    if not isinstance(receiver, Node):
        return np.zeros(receiver.received)
    # The median of a symmetric law is 0. It is taken for 0 too behind a link with memory, with delayed outputs
    # (`past`), or with other outputs than the received numbers, where M (v - E v) does not describe the innovation.
    noise = first(receiver.sensor).noise
    channel = first(receiver.channel).condition_on_arrival()
    if noise.is_symmetric or channel.remembers or channel.past or channel.outputs != receiver.received:
        return np.zeros(receiver.received)
    # M (v - E v) of DRAWS noises, (draws, received), with the mean gain M.
    with jax.enable_x64(True):
        noises = np.asarray(jax.vmap(noise.sample)(jax.random.split(jax.random.key(0), DRAWS)))
        # M is a block of the mean of the map from (y, 1) to (z, 1): the rows of z and the columns of y.
        gain = np.asarray(channel.moments(1).matrix)[: channel.outputs, : channel.inputs]
    received = (noises - np.asarray(noise.mean)) @ gain.T
    # Var e is the claimed variance minus that of M (v - E v), at least 0.
    rest = np.sqrt(np.maximum(variance - received.var(axis=0), 0.0))
    drawn = received + rest * np.random.default_rng(0).standard_normal(received.shape)
    return np.asarray(np.median(drawn, axis=0))
