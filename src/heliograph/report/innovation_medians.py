"""Medians of innovations under laws of noise that are not symmetric, which are no bias of a sensor."""

import jax
import numpy as np

from heliograph.model.over_time import first
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

DRAWS = 20_000  # the median of this many is known to 1 % of a deviation


def find_law_medians(
    network: Network, node: str, variance: Float[np.ndarray, " received"]
) -> Float[np.ndarray, " received"]:
    """Return the median of an innovation under the node's own law, by received number; 0 where the law is symmetric.

    The innovation is taken for M (v - E v), the noise v through the mean gain M of the link, plus a Gaussian number,
    independent, that makes its variance the claimed one; drawn with a fixed key.

    Args:
        network: the network.
        node: name of the node; of a filter of the centre, the nodes' numbers one after the other.
        variance: claimed variance of each innovation.
    """
    if node == Network.FUSED:
        sizes = np.cumsum([0, *(network.nodes[name].received for name in network.names)])
        return np.concatenate([find_law_medians(network, name, variance[a:b])
                               for name, a, b in zip(network.names, sizes[:-1], sizes[1:], strict=True)])  # fmt: skip
    receiver = network.nodes[node]
    if not isinstance(receiver, Node):
        return np.zeros(receiver.received)
    noise, channel = first(receiver.sensor).noise, first(receiver.channel).condition_on_arrival()
    if noise.is_symmetric or channel.remembers or channel.past or channel.outputs != receiver.received:
        return np.zeros(receiver.received)
    # v through the mean gain, and what else the innovation is made of.
    with jax.enable_x64(True):
        drawn = np.asarray(jax.vmap(noise.sample)(jax.random.split(jax.random.key(0), DRAWS)))
        gain = np.asarray(channel.moments(1).matrix)[: channel.outputs, : channel.inputs]
    through = (drawn - np.asarray(noise.mean)) @ gain.T
    rest = np.sqrt(np.maximum(variance - through.var(axis=0), 0.0))
    return np.asarray(np.median(through + rest * np.random.default_rng(0).standard_normal(through.shape), axis=0))
