"""A design as a network that runs: channels with the powers of the design, and the best linear filters of them."""

from collections.abc import Mapping, Sequence
from math import ceil
from typing import TypeVar

import jax
import numpy as np

from heliograph.filters.linear.linear import linear_filter
from heliograph.model.augmented.joint_sensors import join_links
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, at, first, over_time
from heliograph.model.plant import AnyPlant
from heliograph.numerics.check import array, fail, instance, table
from heliograph.numerics.module import are_same
from heliograph.numerics.types import Float
from heliograph.planning.error_objective import Error
from heliograph.planning.multihop_paths.model import require_at_least
from heliograph.planning.plant_moments import measured_moment_with_one, moments_with_one_over, steady_moment_with_one
from heliograph.planning.transmitters import require_plain_senders, set_transmitter_powers, transmitter_names
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

BEST = "best"
COVERED = 100  # steps for which a design with a period is written down
T = TypeVar("T")


def designed_network(network: Network, powers: Mapping[str, Float[np.ndarray, "steps"]], error: Error) -> Network:
    """Return the network whose transmitters send these powers, with the best linear filters behind them.

    Every node has the filter "best" behind its channel. With several nodes the network also has a fused filter "best",
    which uses all measurements that they receive together. Error codes of sensors stay. A node's limits of plausible
    measurements stay only where its powers are unchanged: other powers change the scale of what is received.

    Args:
        network: the network as it is.
        powers: of transmitters by name, as `hg.power` lists them, shape (steps,): of each step of the error's period
            or horizon, one if steady. Others keep theirs.
        error: the error that the powers are for: its period or horizon says over which steps.

    Returns:
        The network; a period is repeated for about 100 steps.

    Raises:
        ValueError: an unstable plant without a horizon, a transmitter that receives nothing or that there is not, a
            node with a trigger, words or feedback.
    """
    plant = instance("network", network, Network, "a Network").plant
    instance("error", error, Error, "an Error")
    require_plain_senders("a designed network", network.nodes)
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    powers = _check_powers(powers, nodes, error.steps)
    # E (x, 1)(x, 1)' of the state at each step, in the steady state or over the horizon. It gives E (y, 1)(y, 1)' of
    # what is sent, and so the gain of a transmitter that has a certain power.
    if error.horizon is None:
        seconds = [steady_moment_with_one(plant)] * error.period
    else:
        seconds = moments_with_one_over(plant, error.horizon)
    # Each node's channel with these powers at each step.
    channels = {}
    for name, node in nodes.items():
        by_step: list[AbstractRandomAffine] = []
        for k, second in enumerate(seconds):
            measured = measured_moment_with_one(node.sensor, second, k)  # E (y, 1)(y, 1)'
            powers_of_node = _select_powers_of_node(name, powers, k)
            by_step.append(set_transmitter_powers(at(node.channel, k), measured, powers_of_node, k))
        channels[name] = _join_steps_over_time(by_step)
    designed = {name: add_best_filter(plant, node, channels[name]) for name, node in nodes.items()}
    fused = {}
    if len(nodes) > 1:
        # All sensors and channels as one node, for the filter of all that is received.
        joint = join_links({name: node.sensor for name, node in nodes.items()}, list(channels.values()))
        fused = {BEST: linear_filter(plant, *joint)}
    realised = Network(plant, designed, fused)
    return repeat_network(realised) if error.period > 1 else realised


def repeat_network(network: Network) -> Network:
    """Return the network with everything that varies over time repeated, so that it lasts for a long run.

    A design of a period covers only one period; what varies over time (`OverTime`) is repeated to COVERED (100) steps
    or more.
    """

    def repeat(leaf: object) -> object:
        """Return an OverTime repeated to COVERED steps or more; anything else as it is."""
        if not isinstance(leaf, OverTime):
            return leaf
        # Its arrays have a leading axis of steps.
        times = ceil(COVERED / leaf.steps)
        return OverTime(jax.tree.map(lambda over_steps: np.concatenate([over_steps] * times), leaf.values))

    # An OverTime is repeated as a whole.
    covered: Network = jax.tree.map(repeat, network, is_leaf=lambda leaf: isinstance(leaf, OverTime))
    return covered


def _check_powers(powers: object, nodes: Mapping[str, Node], steps: int) -> dict[str, Float[np.ndarray, "steps"]]:
    """Return the powers (steps,) by transmitter; raise ValueError for unknown names, bad shapes, negative powers.

    Args:
        powers: {transmitter: (steps,)}, as the user gives them.
        nodes: nodes by name, whose channels have the transmitters.
        steps: number of steps.
    """
    known = {f"{name}.{hop}" for name, node in nodes.items() for hop in transmitter_names(first(node.channel))}
    given = table("powers of a network", powers, "powers")
    unknown = sorted(set(given) - known)
    if unknown:
        raise fail("powers of a network", f"names of transmitters {sorted(known)}", unknown)
    return {
        name: require_at_least(0.0, f"power of {name!r}", array(f"power of {name!r}", power, (steps,)))
        for name, power in given.items()
    }


def add_best_filter(plant: AnyPlant, node: Node, channel: Channel) -> Node:
    """Return the node with this channel, and with the best linear filter behind it as its only filter.

    The node's limits were made for its own channel. Behind another channel, only its invalid values still hold.

    Args:
        plant: the plant.
        node: the node, with its sensor and limits.
        channel: the channel that it gets.
    """
    filters = {BEST: linear_filter(plant, node.sensor, channel)}
    if node.limits is None or are_same(channel, node.channel):
        return Node(node.sensor, channel, filters, node.limits, timeout=node.timeout)
    return Node(node.sensor, channel, filters, invalid=node.limits.invalid, timeout=node.timeout)


def _select_powers_of_node(name: str, powers: Mapping[str, Float[np.ndarray, "steps"]], k: int) -> dict[str, float]:
    """Return the powers at step k of a node's transmitters, by their names within the node ("hop1").

    `powers`: powers of all transmitters, {"NODE.hop1": (steps,)}.
    """
    start = f"{name}."
    return {key.removeprefix(start): float(power[k]) for key, power in powers.items() if key.startswith(start)}


def _join_steps_over_time(steps: Sequence[T]) -> T | OverTime:
    """Return the objects of all steps as one `OverTime`; of a single step the object itself, which holds for ever."""
    return steps[0] if len(steps) == 1 else over_time(steps)
