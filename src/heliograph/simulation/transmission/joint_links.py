"""All links of a network as one: what may arrive of all sensors, by the mode of the links' joint chain."""

from typing import NamedTuple

import numpy as np
import scipy

from heliograph.linear.steady_state import sensor_matrices
from heliograph.model.channel import Channel, erasure, parallel
from heliograph.model.channel_side_information import separate_told_numbers
from heliograph.model.over_time import OverTime, first
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine, ArrivalOutcome
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import joint_modes, redraw_modes_each_step
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


class JointLinks(NamedTuple):
    """Joint model of all links: a chain of modes, the outcomes of each, and the sensors, one above the other.

    Args:
        initial: probabilities of the modes at the first step.
        chain: [i, j]: probability that mode j follows mode i.
        outcomes: what may arrive in each mode, a list for each.
        sensing: H, m measured components of all nodes by n states.
        sensor_mean: E v.
        sensor_noise: Cov v.
    """

    initial: Float[np.ndarray, "modes"]
    chain: Float[np.ndarray, "modes modes"]
    outcomes: list[list[ArrivalOutcome]]
    sensing: Float[np.ndarray, "m n"]
    sensor_mean: Float[np.ndarray, "m"]
    sensor_noise: Float[np.ndarray, "m m"]


def find_joint_links(network: Network, states: int, counts_all: bool) -> JointLinks:
    """Return the joint model of all nodes' links: sensors stacked, channels in parallel, modes that occur.

    Args:
        network: the network.
        states: number of the plant's.
        counts_all: False to take nodes for silent of which values decide what is used, or words stand for it: what a
            trigger, limits, `stuck` or the range of words hold back is no loss of a known probability.

    Raises:
        ValueError: no node that receives a sensor; relays that filter; a sensor with feedback; channels that vary,
            deliver late or have uncertain probabilities.
    """
    if network.relays is not None:
        raise fail("nodes", "ones that receive the sensors over channels", "relays that filter")
    # Sensors one above the other.
    nodes = [node for node in network.nodes.values() if isinstance(node, Node)]
    if not nodes:
        raise fail("nodes", "at least one that receives a sensor", "none")
    # A random gain multiplies what is sent, with feedback an error and not the state.
    if any(node.informed_by is not None for node in nodes):
        raise fail("nodes", "sensors without feedback", "one that a filter's prediction is fed back to")
    matrices, noises = zip(*(sensor_matrices(node.sensor, states) for node in nodes), strict=True)
    means = [np.asarray(first(node.sensor).noise.mean) for node in nodes]
    channels = [_read_constant_channel(node.channel) for node in nodes]
    if not counts_all:
        channels = [
            erasure(redraw_modes_each_step(channel), 0.0) if node.disturbs_what_is_sent else channel
            for node, channel in zip(nodes, channels, strict=True)
        ]
    # Channels in parallel, as one chain of modes.
    joint = parallel(channels) if len(channels) > 1 else channels[0]
    for memory in memories(joint).values():
        if memory.is_uncertain:
            raise fail("chain of a channel", "one of known transition", "one whose probabilities are uncertain")
    # A drifting gain is put on a grid of two values: enough to know that it is random.
    modes = joint_modes(joint, 2)
    initial, chain = np.asarray(modes.initial), np.asarray(modes.transition)
    # Modes that can occur. Entry j of p (I + T)^M, with p the initial law, T the chain and M its number of modes, sums
    # the weights of all ways to mode j in at most M steps; it is positive if there is one.
    happens = initial @ np.linalg.matrix_power(np.eye(len(chain)) + chain, len(chain)) > 0
    return JointLinks(
        initial=initial[happens],
        chain=chain[np.ix_(happens, happens)],
        outcomes=[mode.list_outcomes() for mode, ever in zip(modes.maps, happens, strict=True) if ever],
        sensing=np.concatenate(matrices),
        sensor_mean=np.concatenate(means),
        sensor_noise=scipy.linalg.block_diag(*noises),
    )


def _read_constant_channel(channel: Channel) -> AbstractRandomAffine:
    """Return the channel as it is; raise ValueError if it varies over time, delays, or tells its gain in messages."""
    if isinstance(channel, OverTime):
        raise fail("channel", "one that does not vary", "one that varies")
    if channel.past:
        raise fail("channel", "one without delays", f"one that is late by up to {channel.past} steps")
    if separate_told_numbers(channel).numbers:
        raise fail("channel", "one whose gain and noise no message tells", "one whose messages tell of it")
    return channel
